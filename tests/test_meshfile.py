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


def obj(mesh: trimesh.Trimesh) -> list[str]:
    """As lines of an OBJ file: vertices, then faces."""
    vertices = ["v " + " ".join(repr(float(x)) for x in v) for v in mesh.vertices]
    return [*vertices, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces)]


@pytest.mark.parametrize("blank", [" ", "    ", "\t", " \t ", "\v", "\f"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize(
    "indented", [slice(None), slice(2, 3), slice(24 * 12 + 5, 24 * 12 + 6), slice(24 * 12 + 5, None)]
)
def test_indented_lines_of_an_obj_file_are_read(tmp_path, blank, end, indented):
    """All of them, one vertex, one face, nearly all faces."""
    whole = torus(1.0)
    lines = obj(whole)
    lines[indented] = [blank + line for line in lines[indented]]
    (tmp_path / "torus.obj").write_bytes(end.join([*lines, ""]).encode())
    mesh = load_mesh(tmp_path / "torus.obj")
    assert len(mesh.faces) == len(whole.faces)
    assert mesh.volume == pytest.approx(whole.volume)


def test_tabs_and_lines_that_go_on_are_read_in_an_obj_file(tmp_path):
    whole = torus(1.0)
    lines = obj(whole)
    lines[3] = lines[3].replace(" ", "\t")
    lines[400] = lines[400].replace(" ", "\t")
    first, second, third, fourth = lines[500].split()
    lines[500] = f"{first} {second} {third}\\\n  {fourth}"  # the blanks part the numbers
    (tmp_path / "torus.obj").write_text("\n".join([*lines, ""]))
    mesh = load_mesh(tmp_path / "torus.obj")
    assert len(mesh.faces) == len(whole.faces)
    assert mesh.volume == pytest.approx(whole.volume)


def test_what_is_indented_is_held_against_its_promises_too(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n  f 0 1 2\n")
    with pytest.raises(InputError, match="count from 1, got 0"):
        load_mesh(tmp_path / "a.obj")


L_SHAPE = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], float)


@pytest.mark.parametrize(("first", "folded"), [(0, True), (1, True), (3, False)])
def test_a_polygon_that_is_not_convex_is_told(tmp_path, caplog, first, folded):
    """An L-shaped prism with one polygon for each cap: right only if the fan begins at the corner that goes inward."""
    top = np.roll(np.arange(6), -first)
    faces = [top + 6, top[::-1], *([i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6))]
    if not folded:
        faces[1] = np.array([3, 2, 1, 0, 5, 4])
    vertices = np.concatenate([np.column_stack([L_SHAPE, np.full(6, z)]) for z in (0.0, 1.0)])
    lines = ["v {} {} {}".format(*v) for v in vertices] + ["  f " + " ".join(str(i + 1) for i in f) for f in faces]
    (tmp_path / "l.obj").write_text("\n".join(lines))
    mesh = load_mesh(tmp_path / "l.obj")
    assert mesh.volume == pytest.approx(3)
    assert ("lie back on their neighbours" in caplog.text) == folded
    assert (abs(mesh.area - 14) > 0.5) == folded


def test_a_face_that_is_turned_over_is_no_polygon_cut_wrong(tmp_path, caplog):
    box = trimesh.creation.box()
    box.faces[0] = box.faces[0][::-1]
    box.export(tmp_path / "box.ply")
    assert load_mesh(tmp_path / "box.ply").area == pytest.approx(box.area)
    assert "lie back" not in caplog.text


def test_remarks_behind_the_lines_of_an_obj_are_none_of_its_numbers(tmp_path):
    lines = ["v 0 0 0 # a corner", "v 1 0 0#another", "v 0 1 0", "f 1 2 3 # bottom"]
    (tmp_path / "a.obj").write_text("\n".join(lines), encoding="utf-8")
    assert load_mesh(tmp_path / "a.obj").area == pytest.approx(0.5)


@pytest.mark.parametrize("head", ["OFF\n6 6 0", "OFF 6 6 0", "# a pyramid\nCOFF\n6 6 0"])
def test_polygons_of_an_off_file_may_differ_in_their_corners(tmp_path, head):
    turns = np.arange(5) * 2 * np.pi / 5
    corners = [*((np.cos(a), np.sin(a), 0.0) for a in turns), (0.0, 0.0, 1.0)]
    faces = [(4, 3, 2, 1, 0), *((i, (i + 1) % 5, 5) for i in range(5))]
    colours = " 9 9 9 255" if "COFF" in head else ""
    lines = [
        head,
        *(" ".join(map(str, at)) + colours for at in corners),
        *(" ".join(map(str, (len(f), *f))) for f in faces),
    ]
    (tmp_path / "a.off").write_text("\n".join(lines), encoding="utf-8")
    mesh = load_mesh(tmp_path / "a.off")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(5 / 2 * np.sin(2 * np.pi / 5) / 3, rel=1e-5)
