"""openfoam-drag with OpenFOAM itself: a box-like car on cells twice as large as the coarse level's, seconds a flow."""

import dataclasses

import numpy as np
import pytest
import trimesh

from lampopt.testing import check_measure
from lampopt_openfoam import grid
from lampopt_openfoam.drag import OpenFoamDrag
from lampopt_openfoam.installed import installed
from lampopt_openfoam.outcomes import FlowError

pytest.importorskip("foamlib", reason="the extra openfoam is not installed: pip install 'lampopt[openfoam]'")
COARSER = 1 / 2  # edge of a background cell [length]


def there(tmp_path):
    try:
        return installed("", tmp_path)
    except FlowError as error:
        pytest.skip(f"no OpenFOAM: {error}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One folder of results for all tests here: each flow is solved once."""
    made = tmp_path_factory.mktemp("flows")
    there(made)
    return made


@pytest.fixture(autouse=True)
def coarser(monkeypatch):
    monkeypatch.setitem(grid.CELL, "coarse", COARSER)


def car():
    """A box with a cabin that slopes to the rear."""
    low = trimesh.creation.box((4, 1.6, 0.7))
    side = ((-1.2, 0), (-0.6, 0.8), (0.8, 0.8), (1.9, 0))
    cabin = trimesh.convex.convex_hull([[x, y, z] for x, z in side for y in (-0.7, 0.7)])
    return trimesh.boolean.union([low, cabin], engine="manifold")


def drag(folder, **options):
    return OpenFoamDrag(**{"placements": 1, "clearance": 0.05, "folder": str(folder), "timeout_s": 300.0, **options})


def test_a_flow_is_what_a_blunt_body_has(folder):
    flow = drag(folder).solve(car())
    assert flow.half and flow.openfoam == str(there(folder))
    assert 0.2 < flow.drag < 0.8 and abs(flow.lift) < 1 and 1000 < flow.cells < 10_000
    assert 0.5 < flow.pressure.max() < 1.3  # the stagnation point's is 1
    front, back = flow.points[:, 0] < 0.01, flow.points[:, 0] > 0.99
    assert flow.pressure[front].mean() > 0.2 > 0 > flow.pressure[back].mean()
    assert np.ptp(flow.points, axis=0) == pytest.approx([1, 0.2, 1.15 / 4], abs=0.02)


def test_the_same_flow_comes_out_again(folder, tmp_path):
    first, again = drag(folder).solve(car()), drag(tmp_path).solve(car())
    assert again.drag == first.drag and again.lift == first.lift
    assert np.allclose(again.pressure, first.pressure, atol=1e-2)  # of the last iteration, which may be another


def test_half_and_whole_agree_within_the_noise(folder):
    half, whole = drag(folder).solve(car()), drag(folder, half="no").solve(car())
    assert whole.cells == pytest.approx(2 * half.cells, rel=0.1)
    assert whole.drag == pytest.approx(half.drag, rel=0.05)


def test_the_ground_matters(folder):
    moving, fixed, none = (drag(folder, ground=ground).solve(car()) for ground in ("moving", "fixed", "none"))
    assert len({round(flow.lift, 3) for flow in (moving, fixed, none)}) == 3
    assert fixed.drag == pytest.approx(moving.drag, rel=0.25)


def test_an_impossible_grid_is_refused(folder, monkeypatch):
    monkeypatch.setitem(grid.CELL, "coarse", 4.0)
    with pytest.raises(FlowError) as caught:
        drag(folder)(car())
    assert caught.value.outcome == "bad-grid"


@dataclasses.dataclass(frozen=True)
class OfACar(OpenFoamDrag):
    """With a body that is solved already."""

    def example_mesh(self):
        return car()


def test_the_kit(folder):
    check_measure(OfACar(**dataclasses.asdict(drag(folder))))
