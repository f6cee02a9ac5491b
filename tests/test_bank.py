"""Building a bank: what it holds, and that no interruption costs what was finished or changes the result."""

import json
import logging
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt.bank import FILL, decoder_of
from lampopt.errors import BankError, FitError, InputError, PluginError
from lampopt.measured import values_of
from lampopt.testing import shapes
from lampopt.types import Exemplars, Parameter, Spec

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402
import toys  # noqa: E402

MEASURED = {"length": "size.length"}


@pytest.fixture(autouse=True)
def fresh():
    small.CALLS.clear()
    small.INTERRUPT[0] = 0


# what it holds


def test_it_holds_what_was_given_and_fitted():
    given = small.boxes(measured=MEASURED)
    bank = small.bank(given, seed=3)
    assert np.array_equal(bank.parameters, given.parameters)
    assert np.array_equal(bank.labels, given.labels, equal_nan=True)
    assert bank.names == given.names
    assert bank.decoder == Spec("stretch")
    assert bank.space == (Parameter("length", "m", 2.0, 3.0), Parameter("width", "m", 1.0, 1.4))
    assert bank.label_space == (Parameter("drag", "", 0.30, 0.38),)  # over those that have it
    assert np.allclose(bank.weights[:, 0], given.parameters[:, 0] * bank.frame.scale, rtol=1e-6)
    assert bank.weights.dtype == np.float32
    assert bank.fit_error.tolist() == [0] * 7
    assert bank.path is None
    assert {"seed": 3, "batch": 2}.items() <= bank.provenance.items()
    assert bank.provenance["decoder"] == "not installed -"  # the distribution and version that fitted it


def test_probe_values_are_what_each_exemplar_says():
    bank = small.bank(probes=5)
    assert bank.probes.shape == (5, 3)
    decoder = decoder_of(bank, small.plugins())
    for weights, values in zip(bank.weights, bank.probe_values, strict=True):
        assert np.array_equal(decoder.evaluate(bank.shared, weights, bank.probes), values)


def test_a_label_that_nobody_has_spans_no_range():
    bank = small.bank(small.boxes(labels=np.full((7, 1), np.nan)))
    assert bank.label_space == (Parameter("drag"),)


@pytest.mark.parametrize(("shift", "scale"), [((0, 0, 0), 1.0), ((1e4, -500, 3), 1000.0)])
def test_one_frame_puts_the_largest_exemplar_at_0_6_of_the_box(shift, scale):
    given = small.boxes(shift=shift, scale=scale, unit="mm")
    bank = small.bank(given)
    moved = np.array([bank.frame.to_box(mesh).bounds for mesh in given.meshes])
    assert np.abs(moved).max() == pytest.approx(FILL)
    assert np.ptp(moved[0], axis=0) == pytest.approx(np.ptp(moved[5], axis=0) * [2 / 3, 1, 1])  # sizes are kept
    back = bank.frame.to_user(bank.frame.to_box(given.meshes[0]))
    assert back.bounds == pytest.approx(given.meshes[0].bounds)
    assert (bank.frame.unit, back.units) == ("mm", "mm")


def test_the_frame_is_about_the_middle_of_all():
    small_one, far_one = shapes.box([1, 1, 1]), shapes.box([1, 1, 1], centre=[9, 0, 0])
    given = Exemplars([[0.0], [9.0]], (Parameter("x", "m"),), [small_one, far_one], ("a", "b"))
    frame = small.bank(given).frame
    assert frame.centre.tolist() == [4.5, 0, 0]
    assert frame.scale == pytest.approx(FILL / 5)


def test_measured_values_are_in_the_parameters_unit():
    lengths = 1000 * small.LENGTHS  # the table says mm, the meshes are in metres
    given = small.boxes()
    given = Exemplars(lengths[:, None], (Parameter("length", "mm"),), given.meshes, given.names, measured=MEASURED)
    bank = small.bank(given)
    assert bank.measured_by == MEASURED
    assert bank.measured[:, 0] == pytest.approx(lengths)


def test_measured_adds_to_what_the_source_declares():
    bank = small.bank(small.boxes(measured=MEASURED), measured={"width": "extents.width"})
    assert bank.measured_by == {"length": "size.length", "width": "extents.width"}
    assert bank.measured == pytest.approx(bank.parameters)


def test_mesh_facts_are_what_all_have_in_common():
    assert small.bank().mesh_facts == {"bodies": 1, "genus": 0}
    ring = shapes.plate_with_hole()
    assert small.bank(small.boxes(count=1, meshes=[ring])).mesh_facts == {"bodies": 1, "genus": 1}
    assert small.bank(small.boxes(count=2, meshes=[ring, shapes.box()])).mesh_facts == {}


# the mean design


def test_the_start_is_at_the_mean_design_where_the_source_knows_it():
    bank = small.bank(small.boxes(mesh_at=True))
    mean = [small.LENGTHS.mean(), small.WIDTHS.mean(), 0.8]
    assert bank.shared["mean"] / bank.frame.scale == pytest.approx(mean)


def test_the_start_is_else_at_the_exemplar_nearest_the_mean():
    bank = small.bank()
    spread = np.array([1.0, 0.4])
    away = np.linalg.norm((bank.parameters - bank.parameters.mean(0)) / spread, axis=1)
    nearest = bank.parameters[away.argmin()]
    assert bank.shared["mean"] / bank.frame.scale == pytest.approx([*nearest, 0.8])


def test_nearest_is_told_in_ranges_not_in_units():
    # metres beside counts: the third is nearest the mean in ranges, the first in raw numbers
    parameters = np.array([[0.0, 150.0], [10.0, 0.0], [5.0, 200.0], [5.0, 250.0]])
    sizes = [[1, 1, 1], [2, 1, 1], [3, 1, 1], [4, 1, 1]]
    meshes = [shapes.box(size) for size in sizes]
    bank = small.bank(Exemplars(parameters, (Parameter("a"), Parameter("b")), meshes, tuple("abcd")))
    assert bank.shared["mean"][0] / bank.frame.scale == pytest.approx(3)


# refusals


def opened():
    mesh = shapes.box()
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    return mesh


def test_an_exemplar_that_cannot_be_fitted_is_named():
    meshes = [*small.boxes().meshes]
    meshes[4] = opened()
    with pytest.raises(FitError, match="box_4, box_5: expected a closed mesh"):  # its batch, when it is not said which
        small.bank(small.boxes(meshes=meshes))
    with pytest.raises(FitError, match="box_4: expected a closed mesh"):
        small.bank(small.boxes(meshes=meshes), batch=1)


class Says(small.Stretch):
    def fit(self, shared, meshes, *, seed, progress=None):
        for mesh in meshes:
            if not mesh.is_watertight:
                raise FitError(f"exemplar {mesh.metadata['name']!r}: open")
        return super().fit(shared, meshes, seed=seed)


class SaysPlugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"says": Says}


def test_a_decoder_that_names_the_exemplar_is_left_to_speak():
    meshes = [*small.boxes().meshes[:6], opened()]
    with pytest.raises(FitError) as caught:
        small.bank(small.boxes(meshes=meshes), "says", plugins=small.plugins(("says", SaysPlugin())))
    assert str(caught.value) == "exemplar 'box_6': open"


@pytest.mark.parametrize("spoil", [lambda m: m.update_faces(np.zeros(len(m.faces), bool)), lambda m: _nan(m)])
def test_an_exemplar_without_a_surface_is_named(spoil):
    meshes = [*small.boxes().meshes]
    spoil(meshes[3])
    with pytest.raises(InputError, match="exemplar 'box_3': expected a mesh with faces and finite vertices"):
        small.bank(small.boxes(meshes=meshes))
    assert small.CALLS["fit"] == 0


def _nan(mesh):
    vertices = np.array(mesh.vertices)
    vertices[0, 0] = np.nan
    mesh.vertices = vertices


@pytest.mark.parametrize(
    ("measured", "message"),
    [
        ({"length": "extents.width"}, "'extents.width' does not follow parameter 'length'"),
        ({"height": "extents.height"}, r"\['height'\] are no parameters; known are \['length', 'width'\]"),
        ({"length": "extents.depth"}, "'extents.depth': expected 'measure.value', one of extents.length"),
        ({"length": "extents"}, "'extents': expected 'measure.value', one of extents.length"),
        ({"length": "size.volume"}, r"cannot bring \[m\^3\] to \[m\]"),
        ({"length": "plate.length"}, "'plate.length' cannot be read off exemplar 'box_0'"),
    ],
)
def test_a_measurement_that_does_not_do_is_refused_before_anything_is_fitted(tmp_path, measured, message):
    with pytest.raises(InputError, match=message):
        small.bank(measured=measured, store=tmp_path / "a.lamp")
    assert small.CALLS["fit"] == 0
    assert not list(tmp_path.iterdir())


def test_a_measure_that_is_not_installed_is_refused():
    with pytest.raises(PluginError, match="measure 'sise' is not installed; installed are: area"):
        small.bank(measured={"length": "sise.length"})


@pytest.mark.parametrize("options", [{"batch": 0}, {"probes": 0}])
def test_batch_and_probes_are_at_least_one(options):
    with pytest.raises(InputError, match="expected at least 1"):
        small.bank(**options)


@dataclass(frozen=True)
class NoDecoder:
    size: int = 1


class NoDecoderPlugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"no": NoDecoder}


def test_what_is_no_decoder_is_refused():
    with pytest.raises(PluginError, match=r"decoder 'no'.* lacks what lampopt.protocols.Decoder asks for"):
        small.bank(decoder="no", plugins=small.plugins(("no", NoDecoderPlugin())))


def test_a_store_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BankError, match="cannot be written"):
        small.bank(store=tmp_path / "file" / "a.lamp")


# progress, batches


def test_progress_rises_from_0_to_1():
    told = []
    small.bank(progress=lambda done, message="": told.append((done, message)))
    values = [done for done, _ in told]
    assert values == sorted(values)
    assert (values[0], values[-1]) == (0.0, 1.0)


def test_batches_do_not_show_in_the_weights():
    given = small.boxes(count=5)
    options = {"decoder": Spec("radial", divisions=2), "plugins": small.plugins(("radial", RadialPlugin()))}
    bank, whole = (small.bank(given, batch=batch, **options) for batch in (2, 9))
    assert np.array_equal(bank.weights, whole.weights)
    assert set(bank.shared) == {"rays", "faces", "start"}


class RadialPlugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"radial": toys.Radial}


# stored, interrupted, resumed


def test_a_stored_build_is_the_bank_in_a_file_and_nothing_else(tmp_path):
    store = tmp_path / "new" / "a.lamp"
    bank = small.bank(store=store)
    assert bank.path == store
    assert small.same(bank, small.bank())
    assert small.same(bank, lampopt.load_bank(store))
    assert [p.name for p in store.parent.iterdir()] == ["a.lamp"]


def test_a_finished_store_is_loaded(tmp_path):
    first = small.bank(store=tmp_path / "a.lamp")
    small.CALLS.clear()
    again = small.bank(store=tmp_path / "a.lamp")
    assert not small.CALLS
    assert small.same(first, again)


def test_a_changed_measured_is_measured_anew_without_fitting(tmp_path):
    small.bank(store=tmp_path / "a.lamp")
    small.CALLS.clear()
    bank = small.bank(store=tmp_path / "a.lamp", measured={"width": "extents.width"})
    assert not small.CALLS
    assert bank.measured_by == {"width": "extents.width"}
    assert bank.measured[:, 0] == pytest.approx(small.WIDTHS)
    assert small.same(bank, lampopt.load_bank(tmp_path / "a.lamp"))
    with pytest.raises(InputError, match="does not follow"):
        small.bank(store=tmp_path / "a.lamp", measured={"width": "extents.length"})
    assert small.same(bank, lampopt.load_bank(tmp_path / "a.lamp"))


OTHERS = [
    {"exemplars": small.boxes(count=6)},
    {"exemplars": small.boxes(scale=2.0)},
    {"exemplars": small.boxes(unit="mm")},
    {"exemplars": replace(small.boxes(), unit="mm")},
    {"exemplars": small.boxes(labels=small.DRAG[:, None] * 2)},
    {"exemplars": small.boxes(mesh_at=True)},
    {"exemplars": replace(small.boxes(), parameters=small.boxes().parameters * 1.01)},
    {"decoder": "stretch-field"},
    {"seed": 1},
    {"batch": 3},
    {"probes": 17},
]


@pytest.mark.parametrize("other", OTHERS, ids=lambda other: next(iter(other)))
@pytest.mark.parametrize("finished", [True, False])
def test_a_store_made_from_other_inputs_is_refused(tmp_path, other, finished):
    if finished:
        small.bank(store=tmp_path / "a.lamp")
    else:
        interrupted(tmp_path / "a.lamp", 3)
    before = contents(tmp_path)
    small.CALLS.clear()
    with pytest.raises(BankError, match=r"made from other exemplars, options or seed.*: delete it"):
        small.bank(store=tmp_path / "a.lamp", **other)
    assert not small.CALLS
    assert contents(tmp_path) == before


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def interrupted(store, batch):
    """Begin to build at `store` and press Ctrl-C in the so-manieth batch."""
    small.CALLS.clear()
    small.INTERRUPT[0] = batch
    with pytest.raises(KeyboardInterrupt):
        small.bank(store=store)
    small.INTERRUPT[0] = 0
    assert not store.exists()


@pytest.mark.parametrize("batch", [1, 2, 4])
def test_an_interrupted_build_goes_on_and_ends_the_same(tmp_path, batch, caplog):
    small.bank(store=tmp_path / "whole.lamp")
    interrupted(tmp_path / "a.lamp", batch)
    fitted = small.CALLS["fit"]
    assert fitted == 2 * (batch - 1)
    with caplog.at_level(logging.INFO, "lampopt"):
        small.bank(store=tmp_path / "a.lamp")
    assert "resuming the build in" in caplog.text
    assert small.CALLS["fit"] == 7  # each exemplar once, over both builds
    assert small.CALLS["prepare"] == 1
    assert (tmp_path / "a.lamp").read_bytes() == (tmp_path / "whole.lamp").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.lamp", "whole.lamp"]


def test_it_may_be_interrupted_again_and_again(tmp_path):
    interrupted(tmp_path / "a.lamp", 2)
    interrupted(tmp_path / "a.lamp", 2)
    interrupted(tmp_path / "a.lamp", 1)
    small.CALLS.clear()
    bank = small.bank(store=tmp_path / "a.lamp")
    assert small.CALLS["fit"] == 3
    assert small.same(bank, small.bank())


@pytest.mark.parametrize("note", ["", '{"pl', "[]", None])
def test_killed_while_the_plan_was_written(tmp_path, note):
    folder = tmp_path / "a.lamp.partial"
    folder.mkdir()
    if note is not None:
        (folder / "plan.json").write_text(note)
    (folder / "batch_0000.safetensors").write_bytes(b"of an unknown plan")
    bank = small.bank(store=tmp_path / "a.lamp")
    assert small.same(bank, small.bank())
    assert not folder.exists()


def test_killed_between_the_file_and_the_tidying(tmp_path):
    store = tmp_path / "a.lamp"
    interrupted(store, 4)
    left = contents(tmp_path)
    bank = small.bank(store=store)
    for name, raw in left.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(raw)
    assert small.same(bank, small.bank(store=store))
    assert [p.name for p in tmp_path.iterdir()] == ["a.lamp"]


def damage(part):
    raw = bytearray(part.read_bytes())
    raw[-1] ^= 1
    part.write_bytes(raw)


def test_a_damaged_part_is_said_and_fitted_again(tmp_path, caplog):
    interrupted(tmp_path / "a.lamp", 4)
    damage(tmp_path / "a.lamp.partial" / "batch_0001.safetensors")
    small.CALLS.clear()
    with caplog.at_level(logging.WARNING, "lampopt"):
        bank = small.bank(store=tmp_path / "a.lamp")
    assert "batch_0001" in caplog.text and "damaged; it is fitted again" in caplog.text
    assert (small.CALLS["prepare"], small.CALLS["fit"]) == (0, 2 + 1)  # the damaged batch and the last one
    assert small.same(bank, small.bank())


def test_with_a_damaged_start_the_batches_made_from_it_go_too(tmp_path):
    interrupted(tmp_path / "a.lamp", 4)
    damage(tmp_path / "a.lamp.partial" / "shared.safetensors")
    small.CALLS.clear()
    bank = small.bank(store=tmp_path / "a.lamp")
    assert (small.CALLS["prepare"], small.CALLS["fit"]) == (1, 7)
    assert small.same(bank, small.bank())


def test_a_store_half_written_by_a_killed_build_is_tidied(tmp_path):
    interrupted(tmp_path / "a.lamp", 2)
    (tmp_path / "a.lamp.4711.writing").write_bytes(b"half of it")
    small.bank(store=tmp_path / "a.lamp")
    assert [p.name for p in tmp_path.iterdir()] == ["a.lamp"]


BUILD = """
import sys
sys.path.insert(0, {here!r})
import small
small.bank(store={store!r})
"""


@pytest.mark.parametrize("moment", ["batch_0000.safetensors", "batch_0001.safetensors", 0.13])
def test_a_killed_build_goes_on_and_ends_the_same(tmp_path, moment):
    store, folder = tmp_path / "a.lamp", tmp_path / "a.lamp.partial"
    small.bank(store=tmp_path / "whole.lamp")
    code = BUILD.format(here=str(HERE), store=str(store))
    process = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "SMALL_SLOW": "0.15"})
    try:
        wait_for(folder / "plan.json" if isinstance(moment, float) else folder / moment, process)
        time.sleep(moment if isinstance(moment, float) else 0)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not store.exists()
    assert json.loads((folder / "plan.json").read_text())
    done = len(list(folder.glob("batch_*.safetensors")))
    assert done < 4
    small.CALLS.clear()
    small.bank(store=store)
    assert small.CALLS["batches"] == 4 - done
    assert store.read_bytes() == (tmp_path / "whole.lamp").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.lamp", "whole.lamp"]


def test_a_bank_begun_with_other_defaults_is_not_gone_on_with(tmp_path):
    """A later version may fit by other options where none are given: its exemplars would not lie where these do."""

    @dataclass(frozen=True)
    class Later(toys.Radial):
        divisions: int = toys.Radial.divisions + 1

    Later.__qualname__ = toys.Radial.__qualname__

    class LaterPlugin:
        @lampopt.hookimpl
        def lampopt_decoders(self):
            return {"radial": Later}

    now, later = (small.plugins(("radial", plugin)) for plugin in (RadialPlugin(), LaterPlugin()))
    small.bank(decoder="radial", plugins=now, store=tmp_path / "a.lamp")
    small.bank(decoder="radial", plugins=now, store=tmp_path / "a.lamp")
    with pytest.raises(BankError, match="made from other exemplars, options or seed"):
        small.bank(decoder="radial", plugins=later, store=tmp_path / "a.lamp")
    bank = lampopt.load_bank(tmp_path / "a.lamp")
    assert bank.decoder == Spec("radial", divisions=toys.Radial.divisions)
    assert decoder_of(bank, later) == Later(toys.Radial.divisions)


def wait_for(path, process):
    for _ in range(3000):
        if path.exists():
            return
        assert process.poll() is None, "the build ended before it could be killed"
        time.sleep(0.01)
    raise AssertionError(f"{path} never came")


def test_two_processes_do_not_build_one_store(tmp_path):
    store, folder = tmp_path / "a.lamp", tmp_path / "a.lamp.partial"
    code = BUILD.format(here=str(HERE), store=str(store))
    process = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "SMALL_SLOW": "0.5"})
    try:
        wait_for(folder / "plan.json", process)
        with pytest.raises(BankError, match="another process builds this bank"):
            small.bank(store=store)
        with pytest.raises(BankError, match="made from other exemplars"):
            small.bank(store=store, seed=1)
        assert not small.CALLS
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait()
    bank = small.bank(store=store)
    assert not small.CALLS["fit"]
    assert small.same(bank, small.bank())
    assert [p.name for p in tmp_path.iterdir()] == ["a.lamp"]


def test_a_store_finished_by_another_while_we_measured_is_loaded(tmp_path, monkeypatch):
    store = tmp_path / "a.lamp"

    def meanwhile(*args):
        monkeypatch.undo()
        small.bank(store=store)
        small.CALLS.clear()
        return np.empty((7, 0))

    monkeypatch.setattr("lampopt.bank.measure_all", meanwhile)
    bank = small.bank(store=store)
    assert not small.CALLS
    assert bank.path == store
    assert [p.name for p in tmp_path.iterdir()] == ["a.lamp"]


# limits, hashes, what every batch is given


def test_limits_are_kept_and_changed_without_fitting(tmp_path):
    assert small.bank().limits == {}
    bank = small.bank(store=tmp_path / "a.lamp", limits={"alpha": np.float32(2), "mismatch": 0})
    assert bank.limits == {"alpha": 2.0, "mismatch": 0.0}
    small.CALLS.clear()
    assert small.bank(store=tmp_path / "a.lamp").limits == bank.limits  # not said: left as they are
    assert small.bank(store=tmp_path / "a.lamp", limits={"alpha": 1}).limits == {"alpha": 1.0}
    assert lampopt.load_bank(tmp_path / "a.lamp").limits == {"alpha": 1.0}
    assert small.bank(store=tmp_path / "a.lamp", limits={}).limits == {}
    assert not small.CALLS


@pytest.mark.parametrize("limit", [-0.1, float("nan"), float("inf"), "2", None, True, 1j, np.complex64(1)])
def test_limits_are_numbers_from_0(limit):
    with pytest.raises(InputError, match="limits: expected names with finite numbers, 0 or more, got 'alpha'"):
        small.bank(limits={"alpha": limit})
    assert not small.CALLS


def test_provenance_tells_meshes_and_start_apart():
    one = small.bank().provenance
    assert small.bank(batch=3, seed=9).provenance["start"] == one["start"]  # this decoder draws nothing
    assert small.bank(batch=3, seed=9).provenance["meshes"] == one["meshes"]
    truth = small.bank(small.boxes(mesh_at=True)).provenance  # the start is then at the mean design
    assert (truth["meshes"] == one["meshes"], truth["start"] == one["start"]) == (True, False)
    meshes = [*small.boxes().meshes]
    meshes[1] = shapes.box([2.2, 1.4, 0.9])  # no part in the start
    other = small.bank(small.boxes(meshes=meshes)).provenance
    assert (other["meshes"] == one["meshes"], other["start"] == one["start"]) == (False, True)


class Scribbles(small.Stretch):
    def prepare(self, meshes, *, mean, seed):
        return {"mean": np.array(mean.extents)}

    def fit(self, shared, meshes, *, seed, progress=None):
        shared["mean"][:] = 0
        return super().fit(shared, meshes, seed=seed)


class Swaps(small.Stretch):
    def fit(self, shared, meshes, *, seed, progress=None):
        shared["mean"] = np.zeros(3)
        return super().fit(shared, meshes, seed=seed)


class ScribblesPlugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"scribbles": Scribbles, "swaps": Swaps}


@pytest.mark.parametrize("stored", [True, False])
@pytest.mark.parametrize(
    ("decoder", "error", "message"),
    [("scribbles", ValueError, "read-only"), ("swaps", TypeError, "does not support item assignment")],
)
def test_what_is_shared_cannot_be_changed_by_a_fit(tmp_path, stored, decoder, error, message):
    plugins = small.plugins(("scribbles", ScribblesPlugin()))
    with pytest.raises(error, match=message):
        small.bank(decoder=decoder, plugins=plugins, store=tmp_path / "a.lamp" if stored else None)


# what comes from others


class Lazy:
    """Meshes whose loader fails as a list does at its end."""

    def __len__(self):
        return 7

    def __getitem__(self, index):
        if index == 6:
            raise IndexError("no such row in the file")
        return small.boxes().meshes[index]


def test_a_loader_that_fails_is_heard():
    with pytest.raises(InputError, match=r"'box_6': cannot be loaded: IndexError\('no such row"):
        small.bank(small.boxes(meshes=Lazy()))


def test_what_is_no_mesh_is_named():
    meshes = [*small.boxes().meshes]
    meshes[2] = "car.stl"
    with pytest.raises(InputError, match=r"exemplar 'box_2': expected a trimesh.Trimesh, got 'car.stl'"):
        small.bank(small.boxes(meshes=meshes))


def test_one_mesh_with_two_parameters_is_told(caplog):
    meshes = [*small.boxes().meshes]
    small.bank()
    assert "one of the two" not in caplog.text
    meshes[4] = meshes[1].copy()
    small.bank(small.boxes(meshes=meshes))
    assert "exemplars 'box_1' and 'box_4'" in caplog.text
    assert "one of the two may be wrong" in caplog.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"exemplars": [1]}, "exemplars: expected lampopt.types.Exemplars, got "),
        ({"seed": -1}, "seed: expected at least 0, a whole number, got -1"),
        ({"seed": True}, "seed: expected .* got True"),
        ({"seed": 1.5}, "seed: expected .* got 1.5"),
        ({"batch": 2.0}, "batch: expected .* got 2.0"),
        ({"probes": "9"}, "probes: expected .* got '9'"),
        ({"measured": ["length"]}, "measured: expected a mapping"),
        ({"measured": {"length": 1}}, "measured: expected a mapping"),
    ],
)
def test_arguments_are_checked_before_any_work(options, message):
    with pytest.raises(InputError, match=message):
        small.bank(decoder="not installed", **options)


def test_numpy_whole_numbers_will_do():
    counted = {"seed": np.int64(3), "batch": np.int32(2), "probes": np.uint8(16)}
    bank = small.bank(**counted)
    assert type(bank.provenance["seed"]) is int
    assert small.same(bank, small.bank(seed=3))


@dataclass(frozen=True)
class Garbage(small.Stretch):
    """Returns what it should not, where `place` says."""

    place: str = ""

    def prepare(self, meshes, *, mean, seed):
        odd = {"prepare list": [1], "prepare text": {"a": "b"}}
        return odd.get(self.place) or super().prepare(meshes, mean=mean, seed=seed)

    def fit(self, shared, meshes, *, seed, progress=None):
        weights, error = super().fit(shared, meshes, seed=seed)
        odd = {
            "fit alone": weights,
            "fit count": (weights[:1], error),
            "fit flat": (weights.ravel(), error),
            "fit nan": (weights * np.nan, error),
            "fit error": (weights, error[:, None]),
            "fit width": (weights[:, : 6 if len(weights) > 1 else 5], error),
        }
        return odd.get(self.place, (weights, error))

    def evaluate(self, shared, weights, points):
        values = super().evaluate(shared, weights, points)
        return {"evaluate flat": values[:, 0], "evaluate short": values[1:]}.get(self.place, values)

    def probes(self, shared, count, seed):
        points = super().probes(shared, count, seed)
        return {"probes": points[1:]}.get(self.place, points)


class GarbagePlugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"garbage": Garbage}


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("prepare list", r"prepare: expected names with arrays, got \[1\]"),
        ("prepare text", "prepare: expected names with arrays, got "),
        ("fit alone", "fit: expected a pair of weights and errors, got "),
        ("fit count", r"fit: weights: expected shape \(2, any\), got \(1, 6\)"),
        ("fit flat", r"fit: weights: expected shape \(2, any\), got \(12,\)"),
        ("fit nan", "fit: weights: expected finite values, got nan"),
        ("fit error", r"fit: error: expected shape \(2,\), got \(2, 1\)"),
        ("fit width", r"fit: weights: expected shape \(1, 6\), got \(1, 5\)"),
        ("probes", r"probes: expected shape \(16, 3\), got \(15, 3\)"),
        ("evaluate flat", r"evaluate: expected shape \(16, any\), got \(16,\)"),
        ("evaluate short", r"evaluate: expected shape \(16, any\), got \(15, 3\)"),
    ],
)
def test_garbage_from_a_decoder_is_named(place, message):
    with pytest.raises(PluginError, match=f"decoder 'garbage': {message}"):
        small.bank(decoder=Spec("garbage", place=place), plugins=small.plugins(("garbage", GarbagePlugin())))


class Odd(toys.Size):
    odd = np.zeros(2)

    def __call__(self, mesh):
        return self.odd


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"odd": np.zeros(2)}, r"expected values of shape \(3,\).* got shape \(2,\)"),
        ({"odd": 1.0}, r"got shape \(\)"),
        ({"odd": None}, r"got shape \(\)"),
        ({"odd": "long"}, "expected numbers, got 'long'"),
        ({"units": ("L",)}, "expected 3 units, one for each of .* got "),
    ],
)
def test_garbage_from_a_measure_is_named(monkeypatch, change, message):
    for name, value in change.items():
        monkeypatch.setattr(Odd, name, value)
    with pytest.raises(PluginError, match=f"measure 'odd': .*{message}"):
        values_of("odd", Odd(), shapes.box())


def test_limits_of_what_is_no_longer_measured_go_with_it(tmp_path):
    """Else no study of the bank could be made any more."""
    file = tmp_path / "boxes.lamp"
    limits = {"drift.length": 0.1, "alpha": 4.0}
    small.bank(measured={"length": "size.length"}, store=file, limits=limits)
    again = small.bank(store=file)
    assert again.limits == {"alpha": 4.0} and not again.measured_by
    assert lampopt.run(lampopt.Study(again, {"length": 2.35}), plugins=small.plugins()).accepted
    measured = small.bank(measured={"length": "size.length"}, store=file)
    calibrated = lampopt.calibrate(measured, "1 m", store=file, plugins=small.plugins())
    assert "drift.length" in calibrated.calibration.checks
    assert small.bank(measured={"length": "size.length"}, store=file).calibration is not None
    assert small.bank(measured={"length": "extents.length"}, store=file).calibration is None  # told by another


def test_meshes_in_another_unit_than_was_told_are_noticed_by_what_is_measured(caplog):
    """All are a thousand times too large, so that none is odd among its fellows."""
    large = [mesh.copy().apply_scale(1000) for mesh in small.boxes().meshes]
    exemplars = replace(small.boxes(), meshes=large)
    with caplog.at_level("WARNING"):
        small.bank(exemplars, measured={"length": "size.length"})
    assert "size.length is 1000 times what the exemplars' length is" in caplog.text
    caplog.clear()
    small.bank(measured={"length": "size.length"})
    assert not caplog.text
