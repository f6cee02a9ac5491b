"""Measures and models that were learned: fitted through their plugin, kept in a file, read back, used by a study."""

import importlib
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh

import lampopt
from lampopt import Exemplars, Parameter, Spec, lamp
from lampopt.errors import InputError, MeasureError, PluginError
from lampopt.plugins import Plugins
from lampopt.protocols import Gradient, Interval, State
from lampopt.testing import shapes
from lampopt.types import Bank

sys.path.insert(0, str(Path(__file__).parent))
small = importlib.import_module("small")
SIZES = np.random.default_rng(3).uniform([0.8, 0.3, 0.2], [1.6, 0.6, 0.5], (12, 3))


def boxes(count=12, **changes):
    """Boxes whose parameter `change` is their length in mm beyond 1 m, and whose label is their volume in litres."""
    sizes = SIZES[:count]
    known = {
        "parameters": np.column_stack([1000 * (sizes[:, 0] - 1), sizes[:, 1], np.full(count, 7.0)]),
        "space": (Parameter("change", "mm"), Parameter("width", "m"), Parameter("idle", "m")),
        "meshes": [shapes.box(size) for size in sizes],
        "names": tuple(f"box_{i}" for i in range(count)),
        "labels": 1000 * sizes.prod(1)[:, None],
        "label_space": (Parameter("litres", "l"),),
        "unit": "m",
    }
    return Exemplars(**{**known, **changes})


def test_a_straight_line_is_found_exactly_with_its_errors():
    found = lampopt.fit_surrogate(boxes(), Spec("calibrated", by="extents.length"), ["change"])
    assert (found.names, found.units) == (("change",), ("mm",))
    np.testing.assert_allclose(found.lines, [[-1000.0, 1000.0]])
    np.testing.assert_allclose(found(shapes.box((1.3, 0.4, 0.4))), [300.0])
    np.testing.assert_allclose(found.r2, [1.0])
    assert found.mean_absolute_error[0] < 1e-9


def test_the_error_by_leaving_one_out_is_that_of_fits_without_it():
    """The hat matrix's short cut against fitting anew without each exemplar."""
    given = boxes()
    found = lampopt.fit_surrogate(given, Spec("calibrated", by="extents.length,extents.width"), ["litres"])
    for i in range(len(given)):
        rest = [k for k in range(len(given)) if k != i]
        design = np.column_stack([np.ones(len(rest)), SIZES[rest, :2]])
        line = np.linalg.lstsq(design, given.labels[rest, 0], rcond=None)[0]
        assert found.left_out[i, 0] == pytest.approx(given.labels[i, 0] - [1, *SIZES[i, :2]] @ line)
    errors = np.abs(found.left_out[:, 0])
    assert found.mean_absolute_error[0] == pytest.approx(errors.mean())
    spread = ((given.labels[:, 0] - given.labels.mean()) ** 2).sum()
    assert found.r2[0] == pytest.approx(1 - (errors**2).sum() / spread)
    said = {"r2": found.r2[0], "mean_absolute_error": found.mean_absolute_error[0]}
    assert found.cross_validated == {"litres": said}


def test_the_interval_is_the_conformal_quantile():
    found = lampopt.fit_surrogate(boxes(), Spec("calibrated", by="extents.length"), ["litres"])
    assert isinstance(found, Interval)
    mesh = shapes.box((1.2, 0.4, 0.4))
    errors = np.sort(np.abs(found.left_out[:, 0]))
    for level, place in ((0.5, 7), (0.9, 12)):  # the ceil(level * 13)-th of 12
        ends = found(mesh)[0] + errors[place - 1] * np.array([-1, 1])
        np.testing.assert_allclose(found.interval(mesh, level)[0], ends)
    assert np.isinf(found.interval(mesh, 0.95)).all()  # twelve cannot promise that
    for level in (0.0, 1.0, -1, 7):
        with pytest.raises(InputError, match="level: expected a coverage between 0 and 1"):
            found.interval(mesh, level)
    assert not found.outside(mesh)
    spread = np.ptp(SIZES[:, 0])
    assert not found.outside(shapes.box((SIZES[:, 0].max() + 0.09 * spread, 0.4, 0.4)))
    assert found.outside(shapes.box((SIZES[:, 0].max() + 0.11 * spread, 0.4, 0.4)))


def test_the_gradient_is_the_lines():
    found = lampopt.fit_surrogate(boxes(), Spec("calibrated", by="volume.volume"), ["litres"])
    assert isinstance(found, Gradient)
    mesh, step = shapes.box((1.1, 0.4, 0.3)), 1e-6
    direction = np.random.default_rng(0).normal(size=mesh.vertices.shape)
    ends = []
    for sign in (-1, 1):
        moved = mesh.copy()
        moved.vertices = mesh.vertices + sign * step * direction
        ends.append(found(moved)[0])
    slope = (ends[1] - ends[0]) / (2 * step)
    assert (found.gradient(mesh)[0] * direction).sum() == pytest.approx(slope, rel=1e-6)


def test_labels_that_are_not_known_do_not_count():
    labels = np.array(boxes().labels)
    labels[:4] = np.nan
    found = lampopt.fit_surrogate(boxes(labels=labels), Spec("calibrated", by="extents.length"), ["change", "litres"])
    assert np.isnan(found.left_out[:4, 1]).all() and np.isfinite(found.left_out[:, 0]).all()
    without = lampopt.fit_surrogate(boxes(labels=labels), Spec("calibrated", by="extents.length"), ["litres"])
    np.testing.assert_allclose(found.lines[1], without.lines[0])
    assert np.isfinite(found.r2).all()


def test_it_is_outside_of_those_that_have_the_label():
    labels = np.array(boxes().labels)
    labels[SIZES[:, 0] > 1.2] = np.nan
    found = lampopt.fit_surrogate(boxes(labels=labels), Spec("calibrated", by="extents.length"), ["litres"])
    assert found.outside(shapes.box((1.5, 0.4, 0.4)))
    assert not found.outside(shapes.box((1.1, 0.4, 0.4)))


@pytest.mark.parametrize(
    ("options", "names", "error", "message"),
    [
        ({"by": "extents.lenght"}, ["change"], InputError, "extents.length"),
        ({"by": ""}, ["change"], PluginError, "expected addresses"),
        ({"by": "extents.length,extents.length"}, ["change"], PluginError, "each once"),
        ({"by": "genus.genus"}, ["change"], InputError, "genus.genus: the same on all exemplars"),
        ({"by": "plate.hole_x"}, ["change"], MeasureError, "mesh 0: plate"),
        (
            {"by": "extents.length"},
            ["chance"],
            InputError,
            "chance: not among the parameters and labels, which are",
        ),
        ({"by": "extents.length"}, ["change", "change"], InputError, "each once"),
        ({"by": "extents.length"}, "change", InputError, "expected a list of names"),
    ],
)
def test_what_cannot_be_calibrated_is_said(options, names, error, message):
    with pytest.raises(error, match=message):
        lampopt.fit_surrogate(boxes(), Spec("calibrated", **options), names)


def test_too_few_exemplars_are_said():
    with pytest.raises(InputError, match="at least 3 exemplars with a value, got 2"):
        lampopt.fit_surrogate(boxes(2), Spec("calibrated", by="extents.length"), ["change"])


def test_by_default_all_that_varies_is_learned_and_progress_is_told():
    told = []
    found = lampopt.fit_surrogate(
        boxes(), Spec("calibrated", by="extents.length"), progress=lambda done, message="": told.append((done, message))
    )
    assert found.names == ("change", "width", "litres")  # `idle` has no spread
    assert told[0] == (pytest.approx(1 / 12), "mesh 1 of 12") and told[-1] == (1.0, "mesh 12 of 12")


def test_a_measure_is_read_back_bit_for_bit_and_goes_by_the_name_learned(tmp_path):
    file = tmp_path / "length.measure"
    found = lampopt.fit_surrogate(boxes(), Spec("calibrated", by="extents.length"), ["change", "litres"], store=file)
    mesh = shapes.box((1.23, 0.4, 0.4))
    for again in (lampopt.load_measure(file), Plugins.load().make("measure", Spec("learned", file=str(file)))):
        assert (again.names, again.units) == (found.names, found.units)
        assert np.array_equal(again(mesh), found(mesh))
        assert np.array_equal(again.interval(mesh, 0.9), found.interval(mesh, 0.9))
    assert lampopt.measure(Spec("learned", file=str(file)), mesh) == dict(zip(found.names, found(mesh), strict=True))


def test_a_model_is_read_back_and_is_no_measure(tmp_path):
    file = tmp_path / "litres.model"
    found = lampopt.fit_model(boxes(), "linear", ["litres"], store=file)
    assert (found.names, found.units, found.inputs) == (("litres",), ("l",), ("change", "width"))
    given = np.array([[100.0, 0.4], [200.0, 0.5]])
    assert np.array_equal(lampopt.load_model(file)(given), found(given))
    with pytest.raises(InputError, match="expected a fitted measure, got a file of 'model'"):
        lampopt.load_measure(file)


def test_a_bank_teaches_a_model_too(tmp_path):
    bank = lampopt.build_bank(boxes(), lampopt.Spec("gridsdf", size=17), store=tmp_path / "boxes.lamp")
    assert isinstance(bank, Bank)
    given = np.array([[100.0, 0.4]])
    assert np.array_equal(lampopt.fit_model(bank, "linear")(given), lampopt.fit_model(boxes(), "linear")(given))
    with pytest.raises(InputError, match="drag: not among the labels, which are litres"):
        lampopt.fit_model(bank, "linear", ["drag"])


@dataclass(frozen=True)
class Elsewhere:
    """A surrogate whose measure is of another package: this test's own."""

    kind: str = "foreign"

    def fit(self, meshes, values, names, units, *, seed):
        if self.kind == "foreign":
            inner = importlib.import_module("lampopt_measure.calibrated").Calibrated()
            return inner.fit(meshes, values, names, units, seed=seed)
        if self.kind == "nested":
            return Nest.Kept(tuple(names), tuple(units))
        return Stateless(tuple(names) if self.kind == "stateless" else ("other",), tuple(units))


@dataclass(frozen=True)
class Stateless:
    names: tuple
    units: tuple

    def __call__(self, mesh):
        return np.array([mesh.extents[0]])


class Nest:
    class Kept(Stateless):
        def state(self):
            return {"nothing": np.zeros(1)}

        @classmethod
        def from_state(cls, state):
            return cls(("change",), ("",))


class Offering:
    @lampopt.hookimpl
    def lampopt_surrogates(self):
        return {"elsewhere": Elsewhere}


PLUGINS = Plugins.load(extra=[("offering", Offering())])


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("foreign", "expected a class of its own package"),
        ("stateless", "has no state"),
        ("nested", r"fits a .*:Nest\.Kept, expected a class of its module's own"),
        ("misnamed", r"expected what tells \('change',\)"),
    ],
)
def test_what_could_not_be_read_back_is_refused(tmp_path, kind, message):
    with pytest.raises(PluginError, match=message):
        lampopt.fit_surrogate(
            boxes(), Spec("elsewhere", kind=kind), ["change"], store=tmp_path / "x.measure", plugins=PLUGINS
        )
    assert not list(tmp_path.iterdir())


def altered(file, **changes):
    arrays, record = lamp.read(file)
    record = {k: v for k, v in record.items() if k != "hashes"} | changes
    lamp.write(file, {name: np.array(a) for name, a in arrays.items()}, record)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"class": "os:system"}, InputError, "says 'os', which is not of"),
        ({"class": "lampopt_measure.calibrated:Calibrated"}, PluginError, "cannot read it"),
        ({"class": "lampopt_measure.nothing:Calibrated"}, PluginError, "cannot read it"),
        ({"class": 5}, InputError, "does not say what fitted it"),
        ({"by": {"name": "gone", "options": {}}}, PluginError, "surrogate 'gone' is not installed"),
        ({"by": "calibrated"}, InputError, "does not say what fitted it"),
        ({"schema": 2}, InputError, "schema 2, this lampopt reads 1"),
        ({"format": "lampopt bank"}, InputError, "expected a fitted measure, got a file of 'lampopt bank'"),
    ],
)
def test_files_that_are_something_else_are_refused(tmp_path, changes, error, message):
    file = tmp_path / "length.measure"
    lampopt.fit_surrogate(boxes(), Spec("calibrated", by="extents.length"), ["change"], store=file)
    altered(file, **changes)
    with pytest.raises(error, match=message):
        lampopt.load_measure(file)


def test_a_damaged_file_is_refused(tmp_path):
    file = tmp_path / "length.measure"
    lampopt.fit_surrogate(boxes(), Spec("calibrated", by="extents.length"), ["change"], store=file)
    whole = bytearray(file.read_bytes())
    whole[-3] ^= 1
    file.write_bytes(whole)
    with pytest.raises(InputError, match="the file is damaged"):
        lampopt.load_measure(file)
    with pytest.raises(InputError, match="nowhere"):
        lampopt.load_measure(tmp_path / "nowhere.measure")


def test_it_is_its_state(tmp_path):
    found = lampopt.fit_surrogate(boxes(), Spec("calibrated", by="extents.length"), ["change"])
    assert isinstance(found, State)
    again = type(found).from_state(found.state())
    assert again.addresses == ("extents.length",)
    with pytest.raises(MeasureError, match="got none"):
        again(trimesh.Trimesh())


def test_a_bank_is_not_overwritten_by_what_is_fitted_on_it(tmp_path):
    bank = small.bank(small.boxes(labels=0.1 * small.LENGTHS[:, None]), store=tmp_path / "b.lamp")
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    for name in ("b.lamp", "notes.txt"):
        with pytest.raises(InputError, match=rf"{name}: is there, and is .*name another file"):
            lampopt.fit_model(bank, "linear", ["drag"], store=tmp_path / name)
    assert lampopt.load_bank(tmp_path / "b.lamp").names == bank.names
    for _ in range(2):  # what was fitted before may be
        lampopt.fit_model(bank, "linear", ["drag"], store=tmp_path / "drag.model")
    assert lampopt.load_model(tmp_path / "drag.model").names == ("drag",)


def twice(*sizes, times=1):
    """Exemplars: boxes of these lengths and widths, each given so often; labels `y` are told by `labels`."""
    meshes = [shapes.box([length, width, 0.4]) for length, width in sizes for _ in range(times)]
    return meshes, [f"box_{i}" for i in range(len(meshes))]


def calibrated(by, sizes, values, times=1):
    meshes, _ = twice(*sizes, times=times)
    values = np.repeat(np.asarray(values, float), times)[:, None]
    return Plugins.load().make("surrogate", Spec("calibrated", by=by)).fit(meshes, values, ["y"], [""], seed=0)


def test_shapes_given_several_times_count_once():
    """Five shapes promise nothing at 90 %, however often each is given; nor may one be judged by its twin."""
    draw = np.random.default_rng(0)
    sizes = [(length, 0.3) for length in draw.uniform(1, 2, 12)]
    values = [3 * length + off for (length, _), off in zip(sizes, draw.normal(0, 0.1, 12), strict=True)]
    box = shapes.box([1.5, 0.3, 0.4])
    for count, known in ((5, False), (12, True)):
        once, often = (calibrated("extents.length", sizes[:count], values[:count], times) for times in (1, 3))
        assert np.isfinite(once.interval(box, 0.9)).all() == known
        np.testing.assert_allclose(often.interval(box, 0.9), once.interval(box, 0.9), atol=0.05)
        np.testing.assert_allclose(often.lines, once.lines, rtol=1e-6)
    rough = np.repeat(np.arange(12), 3)  # a group left out, by hand
    lengths, y = np.repeat([length for length, _ in sizes], 3), np.repeat(values, 3)
    for i in range(12):
        line = np.polyfit(lengths[rough != i], y[rough != i], 1)
        np.testing.assert_allclose(often.left_out[rough == i, 0], y[rough == i] - np.polyval(line, lengths[3 * i]))


def test_what_goes_together_on_the_exemplars_and_not_on_a_shape_is_outside():
    draw = np.random.default_rng(0)
    lengths = draw.uniform(1, 2, 20)
    sizes = [(length, 0.5 * length + off) for length, off in zip(lengths, draw.normal(0, 0.002, 20), strict=True)]
    found = calibrated("extents.length,extents.width", sizes, 3 * lengths + draw.normal(0, 0.02, 20))
    assert found.outside(shapes.box([1.1, 0.95, 0.4]))  # within both ranges
    assert not any(found.outside(shapes.box([length, width, 0.4])) for length, width in sizes)
    assert not found.outside(shapes.box([1.5, 0.75, 0.4]))


def test_what_is_constant_but_for_rounding_calibrates_nothing():
    sizes = [(length, 0.3 + 1e-9 * k) for k, length in enumerate(np.linspace(1, 2, 12))]
    with pytest.raises(InputError, match=r"extents\.width: the same on all exemplars"):
        calibrated("extents.length,extents.width", sizes, np.linspace(3, 6, 12))
