"""Wrapping polygon soups: closed, outward, one body, where the original is."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

import lampopt
from lampopt.errors import InputError
from lampopt.meshfile import load_mesh
from lampopt.metrics import sample_surface
from lampopt.testing import shapes
from lampopt.topology import Topology, topology

RAW = Path(__file__).parent.parent.parent / "shared" / "data" / "cars" / "raw"


def soup(solid, seed=0):
    """The triangles of a solid, each for itself, turned anyhow."""
    vertices = np.asarray(solid.triangles).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    turn = np.random.default_rng(seed).random(len(faces)) < 0.5
    return trimesh.Trimesh(vertices, np.where(turn[:, None], faces[:, ::-1], faces), process=False)


def away(wrapped, original):
    """Mean distance from points on the wrap to the original."""
    import igl

    points = sample_surface(wrapped, 3000)
    squared = igl.point_mesh_squared_distance(points, np.array(original.vertices), np.array(original.faces, np.int64))[
        0
    ]
    return np.sqrt(squared).mean()


def slotted(width):
    """Five sides of a unit box, thin as paper, and a lid with a slot of `width` across it."""
    box = shapes.box((1, 1, 1), divisions=0)
    sides = trimesh.Trimesh(box.vertices, box.faces[(box.triangles[:, :, 2] < 0.5).any(1)], process=False)
    lids = []
    for low, high in ((-0.5, -width / 2), (width / 2, 0.5)):
        corners = [[low, -0.5, 0.5], [high, -0.5, 0.5], [high, 0.5, 0.5], [low, 0.5, 0.5]]
        lids.append(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))
    return trimesh.util.concatenate([sides, *lids])


def test_a_box_in_pieces_becomes_the_box():
    box = shapes.box((1.0, 0.7, 0.5))
    made = lampopt.wrap(soup(box), gap=0.1)
    assert topology(made) == Topology(True, 1, 0)
    assert made.volume == pytest.approx(box.volume, rel=0.02)
    assert away(made, box) < 0.1 / 3 / 10  # a tenth of a cell
    assert np.abs(made.bounds - box.bounds).max() < 0.1 / 3


def test_it_keeps_a_through_hole_wider_than_the_gap():
    plate = shapes.plate_with_hole((1.0, 0.6, 0.2), 0.15)
    assert topology(lampopt.wrap(soup(plate), gap=0.08)) == Topology(True, 1, 1)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_unit_does_not_matter(scale):
    box = shapes.box((1.0, 0.7, 0.5)).apply_scale(scale).apply_translation([5 * scale, 0, -3 * scale])
    made = lampopt.wrap(soup(box), gap=0.1 * scale)
    assert made.volume == pytest.approx(box.volume, rel=0.02)


def test_openings_narrower_than_the_gap_are_closed():
    made = lampopt.wrap(slotted(0.08), gap=0.12)
    assert topology(made) == Topology(True, 1, 0)
    assert made.volume == pytest.approx(1.0, rel=0.02)


def test_openings_wider_than_the_gap_are_told():
    with pytest.raises(InputError, match=r"a body thicker than the gap of 0.12, got none: .* through wider openings"):
        lampopt.wrap(slotted(0.3), gap=0.12)


def test_what_crosses_becomes_one_and_what_is_inside_is_filled():
    crossing = [shapes.box((1, 1, 1)), shapes.box((1, 1, 1), centre=(0.5, 0.5, 0.5)), shapes.box((0.3, 0.3, 0.3))]
    made = lampopt.wrap(soup(trimesh.util.concatenate(crossing)), gap=0.15)
    assert topology(made) == Topology(True, 1, 0)
    assert made.volume == pytest.approx(2 - 0.5**3, rel=0.02)


def test_finer_cells_are_nearer():
    ball = shapes.ellipsoid((0.5, 0.4, 0.3), divisions=3)
    coarse, fine = (lampopt.wrap(ball, gap=0.2, resolution=n) for n in (16, 64))
    assert away(fine, ball) < away(coarse, ball) / 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gap": 0}, r"gap: expected a length above 0 and below the mesh's 1, got 0"),
        ({"gap": 2.0}, "gap: expected a length above 0"),
        ({"gap": np.nan}, "gap: expected a length above 0"),
        ({"gap": "wide"}, "gap: expected a length above 0"),
        ({"gap": 1e-3}, "gap: expected at least 0.01172, 256 cells along"),
        ({"gap": 0.1, "resolution": 10}, "resolution: expected 20 .* to 256 cells, or 0, got 10"),
        ({"gap": 0.1, "resolution": 500}, "resolution: expected 20"),
        ({"gap": 0.1, "resolution": 30.0}, "resolution: expected 20"),
    ],
)
def test_arguments_are_checked(options, message):
    with pytest.raises(InputError, match=message):
        lampopt.wrap(shapes.box((1, 0.5, 0.5)), **options)


@pytest.mark.parametrize("vertices", [np.zeros((0, 3)), [[0, 0, 0], [1, 0, np.inf], [0, 1, 0]]])
def test_what_is_no_surface_is_refused(vertices):
    faces = np.arange(len(vertices)).reshape(-1, 3)
    with pytest.raises(InputError, match="expected a mesh with faces and finite vertices"):
        lampopt.wrap(trimesh.Trimesh(vertices, faces, process=False), gap=0.1)


@pytest.mark.parametrize("name", ["Hybrid.obj", "fire_truck.obj", "hatchback.obj", "pickup.dae", "suv.obj"])
def test_real_soups_become_one_closed_body(name):
    if not (RAW / name).exists():
        pytest.skip(f"no file cars/raw/{name} in ../shared/data, beside the repository")
    mesh = load_mesh(RAW / name)
    length = mesh.extents.max()
    made = lampopt.wrap(mesh, gap=length / 60)
    shape = topology(made)
    assert (shape.closed, shape.bodies) == (True, 1)
    assert made.volume > 0
    assert away(made, mesh) < 0.001 * length
    assert not lampopt.intake(lampopt.Exemplars(np.zeros((1, 0)), (), [made], ("wrap",)), crossings=False).problems
