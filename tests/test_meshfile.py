"""Mesh files: joined by their own size, damaged ones refused by name."""

import numpy as np
import pytest
import trimesh

from lampopt.errors import InputError
from lampopt.meshfile import load_mesh
from lampopt_measure.basic import Volume


def torus(scale: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.torus(1.0, 0.3, major_sections=24, minor_sections=12)
    return trimesh.Trimesh(np.asarray(mesh.vertices) * scale, mesh.faces, process=False)


def loose(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False)


def off(mesh: trimesh.Trimesh) -> str:
    """As an OFF file holds it, no digit lost."""
    lines = [f"OFF\n{len(mesh.vertices)} {len(mesh.faces)} 0"]
    lines += [" ".join(repr(float(x)) for x in v) for v in mesh.vertices]
    return "\n".join([*lines, *(f"3 {a} {b} {c}" for a, b, c in mesh.faces)]) + "\n"


@pytest.mark.parametrize("scale", [10.0**k for k in range(-8, 13)])
def test_no_size_collapses(tmp_path, scale):
    path = tmp_path / "torus.off"
    whole = torus(scale)
    for given in (whole, loose(whole)):
        path.write_text(off(given))
        mesh = load_mesh(path)
        assert len(mesh.vertices) == 24 * 12
        assert mesh.is_watertight
    assert Volume()(loose(whole)) == pytest.approx(Volume()(whole), rel=1e-9)


@pytest.mark.parametrize("scale", [1e-120, 1e120])
def test_a_size_that_nothing_has_is_refused(tmp_path, scale):
    (tmp_path / "torus.off").write_text(off(torus(scale)))
    with pytest.raises(InputError, match=r"torus.off: expected a largest coordinate from 1e-100 to 1e100"):
        load_mesh(tmp_path / "torus.off")


@pytest.mark.parametrize("corner", [-7, 70000])
def test_a_face_without_its_vertex_is_refused(tmp_path, corner):
    path = tmp_path / "damaged.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(head + f"0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 {corner}\n")
    with pytest.raises(InputError, match=r"damaged.ply"):
        load_mesh(path)
