"""The designs of a run as exemplars: boxes whose designs are exact, so that every value is known in closed form."""

import shutil
import sqlite3
import sys
from contextlib import closing
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt.errors import InputError
from lampopt.plugins import Plugins
from lampopt.protocols import Source
from lampopt.testing import check_plugin
from lampopt.types import Parameter
from lampopt_datasets.run import Run

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

LENGTHS, WIDTHS = (2.1, 2.4, 2.7, 3.4), (1.1, 1.3)


def swept(folder, grid=None, bank=None, **options):
    """A run folder of boxes: every length with every width."""
    folder.mkdir(exist_ok=True)
    bank = bank or small.bank(small.boxes(), measured={"length": "extents.length"})
    lampopt.store_bank(bank, folder / "boxes.lamp")
    options = {"measures": ("size", "extents"), "level": "mesh", **options}
    study = lampopt.Study(folder / "boxes.lamp", **options)
    grid = grid or {"length": LENGTHS, "width": WIDTHS}
    for _ in lampopt.sweep(study, grid, folder=folder / "run", report=False, plugins=small.plugins()):
        pass
    return folder / "run"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return swept(tmp_path_factory.mktemp("run"), limits={"alpha": 1.0})


def test_accepted_designs_are_exemplars(folder):
    source = Run(str(folder))
    assert isinstance(source, Source)
    found = source()
    results = list(lampopt.results(folder))
    accepted = [result for result in results if result.accepted]
    assert len(results) == 8 and 0 < len(found) == len(accepted) < 8  # 3.4 m is farther out than alpha may be
    assert found.names == tuple(result.folder.name for result in accepted)
    assert all((folder / "designs" / name / "passport.json").is_file() for name in found.names)
    assert found.space == (Parameter("length", "m"), Parameter("width", "m"))
    assert found.unit == "m"
    np.testing.assert_allclose(found.parameters, [list(r.design.target.values()) for r in accepted], atol=1e-9)
    for mesh, row in zip(found.meshes, found.parameters, strict=True):
        np.testing.assert_allclose(mesh.extents, [*row, 0.8], atol=1e-5)
    assert found.measured == {"length": "extents.length"}
    assert found.mesh_at is None


def test_rejected_ones_too(folder):
    found = lampopt.exemplars("run", folder=folder, accepted=False)
    assert len(found) == 8
    assert found.parameters[:, 0].max() == pytest.approx(3.4)


def test_labels_are_what_the_study_measured(folder):
    found = Run(str(folder))()
    names = [q.name for q in found.label_space]
    # by their own name, with the measure's where a parameter or another measure has it
    assert names == ["height", "extents_length", "extents_width", "fill", "size_length", "volume"]
    assert {q.name: q.unit for q in found.label_space}["volume"] == "m^3"
    volume = found.labels[:, names.index("volume")]
    np.testing.assert_allclose(volume, found.parameters.prod(axis=1) * 0.8, rtol=1e-5)
    chosen = Run(str(folder), labels="size.volume, extents.length")()
    assert [q.name for q in chosen.label_space] == ["volume", "extents_length"]
    with pytest.raises(InputError, match=r"labels: size\.mass not measured; known are size\.length"):
        Run(str(folder), labels="size.mass")()


def test_a_gap_in_the_labels_is_unlabelled(tmp_path):
    folder = swept(tmp_path, {"length": [2.2, 2.5]}, measures=())
    with closing(sqlite3.connect(folder / "runs.sqlite")) as rows, rows:
        rows.execute("UPDATE designs SET task = ''")  # as those of schema 1, which know no study
    swept(tmp_path, {"length": [2.3]}, measures=("size",))
    found = Run(str(folder))()
    assert len(found) == 3
    volume = found.labels[:, [q.name for q in found.label_space].index("volume")]
    assert np.isnan(volume[1:]).all() and volume[0] > 0  # the one asked for last comes first


def test_designs_of_other_studies_in_the_folder_teach_nothing(tmp_path, caplog):
    """One target, two verdicts: only those of the study that is there count, each once."""
    grid = {"length": [2.2, 2.9], "width": [1.2]}
    swept(tmp_path, grid, limits={"alpha": 9.0})
    folder = swept(tmp_path, grid, limits={"alpha": 0.01})
    with pytest.raises(InputError, match=r"all 2 designs were rejected, by alpha \(2\)"):
        Run(str(folder))()
    assert len(Run(str(folder), accepted=False)()) == 2
    assert "2 of 4 designs are of other studies and left out" in caplog.text


def test_measured_values_take_the_place_of_predicted_ones(tmp_path):
    """What is measured is 1.1 times the parameter and 0.2 m: the parameter is corrected, not replaced."""
    given = small.boxes()
    meshes = [small.shapes.box([1.1 * length + 0.2, width, 0.8]) for length, width in given.parameters]
    bank = small.bank(small.boxes(meshes=meshes, measured={"length": "extents.length"}))
    folder = swept(tmp_path, {"length": [2.3, 2.6], "width": [1.2]}, bank=bank)
    predicted, measured = (Run(str(folder), parameters=kind)() for kind in ("predicted", "measured"))
    np.testing.assert_allclose(measured.parameters, predicted.parameters, atol=1e-6)  # the mix is exact
    name = predicted.names[0]
    with sqlite3.connect(folder / "runs.sqlite") as rows:  # as if this one had come out 0.011 m longer
        (checks,) = rows.execute("SELECT checks FROM designs WHERE key = ?", (name,)).fetchone()
        length = predicted.labels[0, [q.name for q in predicted.label_space].index("extents_length")]
        old, new = f'["extents.length", {float(length)!r}', f'["extents.length", {float(length) + 0.011!r}'
        assert old in checks
        rows.execute("UPDATE designs SET checks = ? WHERE key = ?", (checks.replace(old, new), name))
    rows.close()
    changed = Run(str(folder), parameters="measured")()
    np.testing.assert_allclose(changed.parameters - measured.parameters, [[0.01, 0], [0, 0]], atol=1e-9)


def test_measured_values_in_another_unit(tmp_path):
    given = small.boxes(unit="m", measured={"length": "extents.length"})
    space = (Parameter("length", "mm"), Parameter("width", "m"))
    given = lampopt.Exemplars(
        given.parameters * (1000, 1), space, given.meshes, given.names, measured={"length": "extents.length"}
    )
    folder = swept(tmp_path, {"length": [2300.0, 2600.0]}, bank=small.bank(given))
    found = Run(str(folder), parameters="measured")()
    np.testing.assert_allclose(found.parameters[:, 0], [2300, 2600], rtol=1e-5)


def test_measured_values_have_to_be_there(tmp_path):
    folder = swept(tmp_path, {"length": [2.3]}, measures=("size",))
    with pytest.raises(InputError, match=r"no value of extents\.length, which measures 'length': name 'extents' among"):
        Run(str(folder), parameters="measured")()


def test_a_parameter_that_was_held_stays_held(tmp_path):
    """What rounding leaves of it would be stretched to a whole range by the next bank."""
    folder = swept(tmp_path, {"length": [2.1, 2.4, 2.7]}, keep=("width",))
    found = Run(str(folder))()
    assert np.ptp(found.parameters[:, 1]) == 0
    assert found.parameters[0, 1] == pytest.approx(small.WIDTHS.mean())
    few = swept(
        tmp_path / "few", {"length": [2.50, 2.51]}, bank=small.bank(small.boxes(measured={"length": "extents.length"}))
    )
    assert Run(str(few))().measured == {}  # varies too little for a measurement to follow it


def test_nothing_is_computed_and_nothing_is_held(folder, monkeypatch):
    before = dict(small.CALLS)
    found = Run(str(folder))()
    first = found.meshes[1]
    kept = np.array(first.vertices)
    first.vertices += 1.0
    assert np.array_equal(found.meshes[1].vertices, kept)
    assert len(found.meshes[1:]) == len(found) - 1
    with pytest.raises(IndexError):
        found.meshes[len(found)]
    assert dict(small.CALLS) == before


def test_no_run_there(tmp_path, monkeypatch):
    for place in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match="expected a folder written by"):
            Run(str(place))()


def test_all_rejected(tmp_path):
    folder = swept(tmp_path, {"length": [4.5, 5.0]}, limits={"alpha": 1.0})
    with pytest.raises(InputError, match=r"all 2 designs were rejected, by alpha \(2\)") as error:
        Run(str(folder))()
    assert "accepted=False" in str(error.value)
    assert len(Run(str(folder), accepted=False)()) == 2


@pytest.mark.parametrize("level", ["alpha", "field"])
def test_designs_without_meshes(tmp_path, level):
    folder = swept(tmp_path, {"length": [2.3, 2.6]}, level=level)
    with pytest.raises(InputError, match=r"none of its 2 designs has a mesh.*level = 'mesh'"):
        Run(str(folder))()


def test_a_mesh_that_is_gone(tmp_path):
    """It is decoded again where the decoder is at hand; this one is not installed."""
    folder = swept(tmp_path, {"length": [2.3]})
    found = Run(str(folder))()
    shutil.rmtree(folder / "designs")
    with pytest.raises(lampopt.errors.PluginError, match="stretch"):
        found.meshes[0]


def test_options_are_checked(folder):
    with pytest.raises(InputError, match="parameters: expected one of predicted, measured, got 'asked'"):
        Run(str(folder), parameters="asked")


def test_a_run_of_plates_teaches_a_second_bank(tmp_path):
    """The paper's generation of a data set: exemplars → designs → exemplars."""
    first = lampopt.build_bank(
        lampopt.exemplars("plate"), decoder=lampopt.Spec("gridsdf", size=25), store=tmp_path / "plates.lamp", probes=200
    )
    loose = {"mismatch": 1.0, "mismatch.band": 1.0, "drift": 1.0}
    study = lampopt.Study(tmp_path / "plates.lamp", measures=("volume",), limits=loose, resolution=48)
    grid = {"length": [2.2, 2.5, 2.8], "hole_radius": [0.18, 0.22]}
    assert first.names[0] == "middle"
    accepted = sum(result.accepted for result in lampopt.sweep(study, grid, folder=tmp_path / "run", report=False))
    assert accepted >= 4
    found = lampopt.exemplars("run", folder=tmp_path / "run")
    assert [str(q) for q in found.label_space] == ["volume [m^3]"]
    assert set(found.measured) <= {q.name for q in found.space}
    second = lampopt.build_bank(found, decoder=lampopt.Spec("gridsdf", size=25), probes=200)
    assert len(second) == accepted
    result = lampopt.design(second, {"length": 2.6, "volume": 1.1}, limits=loose, resolution=48)
    assert result.check("target").passed
    assert result.design.mesh.extents[0] == pytest.approx(2.6, abs=0.1)


def test_the_kit_is_satisfied():
    plugins = Plugins.load(
        block=[p.name for p in entry_points(group="lampopt") if p.name not in ("datasets", "kkt", "measure", "sdf")]
    )
    records = check_plugin(plugins, "datasets")
    assert {record.plugin for record in records} >= {"source run", "source table"}
    assert all(record.passed for record in records), records
