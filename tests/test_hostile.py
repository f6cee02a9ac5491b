"""Files made to break a reader: each refused by name, soon, in little memory; five hundred mutated ones besides."""

import importlib
import io
import json
import os
import re
import socket
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from lampopt import Exemplars, Parameter, Study, exemplars, load_bank
from lampopt.errors import BankError, InputError, LampoptError, PluginError, StudyError
from lampopt.meshfile import SUFFIXES, guards, load_mesh, placing

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [p for p in (str(ROOT),) if p not in sys.path]
hostile = importlib.import_module("benchmarks.hostile")
mutate = importlib.import_module("benchmarks.mutate")
parquet = importlib.import_module("lampopt_datasets.parquet")
thrift = importlib.import_module("lampopt_datasets.thrift")
RAW = ROOT.parent / "shared" / "data" / "cars" / "raw"
FACES = 80  # of the seeds' ball


@pytest.fixture(scope="module")
def good():
    return hostile.seeds()


def refused(path, match):
    with pytest.raises(InputError, match=match) as caught:
        load_mesh(path)
    assert path.name[:20] in str(caught.value)
    assert len(str(caught.value)) < 1000


def loaded(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return load_mesh(path)


# five hundred


@pytest.mark.parametrize(("kind", "part"), [(kind, part) for kind in ("lamp", "others") for part in range(5)])
def test_mutated_files_are_read_or_refused(good, tmp_path, kind, part):
    hostile.warm(good, tmp_path)
    told = [hostile.case(kind, 50 * part + i, 1, good, tmp_path) | {"beyond": 0} for i in range(50)]
    assert [case for case in told if case["outcome"] not in ("read", "refused")] == []
    assert {case["outcome"] for case in told} == {"read", "refused"}


def test_the_same_number_gives_the_same_file(good):
    made = [mutate.mutated(good[".lamp"], ".lamp", np.random.default_rng(5)) for _ in range(2)]
    assert made[0] == made[1]


def test_a_reader_that_dies_or_fails_is_counted():
    fine = {"file": ".stl", "seconds": 0.1, "bytes": 10, "beyond": 20, "outcome": "refused"}
    bad = ({"outcome": "died -11"}, {"outcome": "exception KeyError"}, {"seconds": 6.0}, {"beyond": 2**30, "grown": 1})
    assert [hostile.wrong(fine | change) for change in bad] == ["died -11", "exception KeyError", "slow", "memory"]
    assert hostile.wrong(fine) == ""
    assert hostile.summary([fine, fine | bad[0]])["failed"] == 1


@pytest.mark.parametrize(("end", "outcome"), [("kill -9 $$", "died -9"), ("exec sleep 60", "hang")])
def test_a_reader_that_dies_or_hangs_is_replaced(tmp_path, monkeypatch, end, outcome):
    fake = tmp_path / "python"
    fake.write_text(f'#!/bin/sh\necho "{{\\"begun\\": $5}}"\n{end}\n')
    fake.chmod(0o755)
    monkeypatch.setattr(hostile.sys, "executable", str(fake))
    monkeypatch.setattr(hostile, "SILENT", 0.3)
    told = list(hostile.turn("lamp", 3, 5, 0))
    assert [(case["number"], case["outcome"]) for case in told] == [(3, outcome), (4, outcome)]
    assert hostile.summary(told)["failed"] == 2


def test_the_benchmark_end_to_end(tmp_path, capsys):
    assert hostile.main(["--lamp", "6", "--others", "6", "--json", "--out", str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / "hostile.json").read_text(encoding="utf-8"))
    assert document["tables"]["lamp"]["files"] == document["tables"]["others"]["files"] == 6


# meshes of every format


@pytest.mark.parametrize("name", [n for n in hostile.OTHERS if Path(f"x{n}").suffix in SUFFIXES])
def test_a_mesh_cut_short_is_never_taken_for_a_smaller_one(good, tmp_path, name):
    data, path = good[name], tmp_path / f"cut{Path(f'x{name}').suffix}"
    path.write_bytes(data)
    whole = load_mesh(path)
    assert len(whole.faces) >= FACES
    assert whole.is_watertight
    for length in range(0, len(data), max(1, len(data) // 40)):
        path.write_bytes(data[:length])
        try:
            found = load_mesh(path)
        except InputError as error:
            assert "cut" in str(error)
        else:  # what was cut away was no more than blanks, or of no count (OBJ)
            assert path.suffix == ".obj" or len(found.faces) == len(whole.faces)


@pytest.mark.skipif(not RAW.is_dir(), reason="no folder cars/raw in ../shared/data, beside the repository")
def test_a_collada_file_of_a_real_car():
    car = load_mesh(RAW / "pickup.dae")
    assert len(car.faces) == 780 + 304  # what its two <triangles> count
    text = (RAW / "pickup.dae").read_text(encoding="utf-8")
    places = np.array(text.split('positions-array"')[1].split(">")[1].split("<")[0].split(), float).reshape(-1, 3)
    np.testing.assert_allclose(car.extents, np.ptp(places, axis=0))  # inches, as the file has it, z up as it stands


def test_parts_stand_where_the_scene_puts_them(good, tmp_path):
    ball = load_mesh_of(good[".dae"], tmp_path, ".dae")
    pair = load_mesh_of(good["scene.dae"], tmp_path, ".dae")
    np.testing.assert_allclose(pair.extents, ball.extents + np.array([3, 0, 0]), atol=1e-5)
    assert pair.volume == pytest.approx(2 * ball.volume, rel=1e-5)


@pytest.mark.parametrize("suffix", [".glb", ".3mf", ".dae"])
def test_turned_and_moved_parts_are_where_their_scene_has_them(tmp_path, suffix):
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], [0.5, 0, 1])
    box = trimesh.creation.box((1, 2, 3))
    scene = trimesh.Scene({"one": box})
    scene.add_geometry(box if suffix != ".dae" else box.copy(), transform=turn @ np.diag([2.0, 2, 2, 1]))
    truth = np.concatenate([box.vertices, trimesh.transform_points(box.vertices, turn @ np.diag([2.0, 2, 2, 1]))])
    data = scene.export(file_type=suffix[1:]) if suffix != ".dae" else _dae(scene)
    found = loaded(tmp_path, f"x{suffix}", data).vertices
    assert len(found) == len(truth)
    apart = np.linalg.norm(found[:, None] - truth[None], axis=-1)
    assert max(apart.min(0).max(), apart.min(1).max()) < 1e-5


def _dae(scene):
    """COLLADA with a transform: trimesh writes none, so its second node gets the matrix here."""
    meshes = [scene.geometry[scene.graph[name][1]] for name in scene.graph.nodes_geometry]
    matrix = " ".join(map(repr, map(float, scene.graph[scene.graph.nodes_geometry[1]][0].ravel())))
    first, second = trimesh.exchange.dae.export_collada(meshes).decode().split('name="node1"')
    return first + 'name="node1"' + second.replace(">", f"><matrix>{matrix}</matrix>", 1)


def load_mesh_of(data, tmp_path, suffix):
    return loaded(tmp_path, f"x{suffix}", data)


def test_a_mirrored_part_still_faces_outward(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), transform=np.diag([-1.0, 1, 1, 1]))
    for suffix in (".glb", ".3mf"):
        mesh = loaded(tmp_path, f"x{suffix}", scene.export(file_type=suffix[1:]))
        assert mesh.volume == pytest.approx(1)


@pytest.mark.parametrize(
    ("given", "suffix", "kind"),
    [(".ply", ".stl", r"\.ply"), (".glb", ".obj", r"\.glb"), (".3mf", ".glb", "ZIP"), (".dae", ".off", "XML")],
)
def test_a_wrong_suffix_is_told(good, tmp_path, given, suffix, kind):
    path = tmp_path / f"part{suffix}"
    path.write_bytes(good[given])
    refused(path, f"it looks like an? ({kind}|\\.dae)|expected faces")


def test_what_is_no_mesh_is_told(tmp_path):
    for text, match in (
        (b"ISO-10303-21;\nHEADER;\n", "STEP"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
    ):
        (tmp_path / "part.stl").write_bytes(text)
        refused(tmp_path / "part.stl", match)


def test_only_plain_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.stl")
    (tmp_path / "folder.stl").mkdir()
    with socket.socket(socket.AF_UNIX) as listener:
        os.chdir(tmp_path)
        listener.bind("socket.stl")
        for name in ("pipe", "folder", "socket"):
            refused(tmp_path / f"{name}.stl", "expected a file, got a")
    refused(tmp_path / ("long" * 100 + ".stl"), "name too long")
    refused(Path("/dev/null/x.stl"), "cannot be read")
    for nothing in (tmp_path / "a\0.stl", None, 3, b"a.stl", ["a.stl"]):
        with pytest.raises(InputError, match="cannot be read"):
            load_mesh(nothing)
    with (tmp_path / "sparse.stl").open("wb") as file:
        file.truncate(2**40)
    refused(tmp_path / "sparse.stl", "at most")
    with pytest.raises(InputError, match=r"expected one of \.stl"):
        loaded(tmp_path, "part.txt", b"")


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_told(tmp_path, good):
    for name in ("a.stl", "a.lamp"):
        (tmp_path / name).write_bytes(good[Path(name).suffix])
        (tmp_path / name).chmod(0)
        with pytest.raises(LampoptError, match="Permission denied"):
            (load_bank if name.endswith("lamp") else load_mesh)(tmp_path / name)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("name", "data", "match"),
    [
        ("a.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50), "cut short"),
        ("a.stl", b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n", "endsolid"),
        ("a.stl", b"solid\nfacet\nvertex 0 0 0\nvertex 1 x 0\nvertex 0 1 0\nendfacet\nendsolid", "promises|read"),
        ("a.obj", TRIANGLE + "f 0 1 2\n", "count from 1"),
        ("a.obj", "f -3 -2 -1\n" + TRIANGLE, "backwards"),
        ("a.obj", TRIANGLE + "f 1 2 4\n", "cannot be read"),
        ("a.obj", TRIANGLE.replace("1 0 0", "1 inf 0") + "f 1 2 3\n", "finite"),
        ("a.off", "OFF\n99999999999 1 0\n0 0 0\n", "promises"),
        ("a.off", "OFF\n-3 1 0\n0 0 0\n", "header"),
        ("a.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "promises"),
    ],
)
def test_files_that_lie(tmp_path, name, data, match):
    (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    refused(tmp_path / name, match)


def test_corners_may_count_backwards_behind_the_vertices(tmp_path):
    assert len(loaded(tmp_path, "a.obj", TRIANGLE + "f -3 -2 -1\n").faces) == 1


PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n"
PLY += "property list {} int vertex_indices\nend_header\n"


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (PLY.format("ascii", 10**11, 1, "uchar"), "promises"),
        (PLY.format("binary_little_endian", 2**31, 2**31, "uchar"), "promises"),
        (PLY.format("binary_little_endian", 10**30, 0, "uchar"), "COUNT"),
        (PLY.format("ascii", 3, 1, "string"), "type such as"),
        (PLY.format("ascii", 3, 1, "uchar").replace("element face", "element vertex"), "each name once"),
        (PLY.format("ascii", 0, 0, "uchar").replace("end_header", ""), "end_header"),
        (PLY.format("binary_little_endian", 0, 1, "uint") + "\xff\xff\xff\xff" + "a" * 20, "cannot be read"),
        ("ply\n" + "comment a\n" * 200_000, "end_header"),
    ],
)
def test_ply_headers_that_lie(tmp_path, data, match):
    (tmp_path / "a.ply").write_bytes(data.encode("latin-1"))
    refused(tmp_path / "a.ply", match)


# glTF


def glb(document, binary=b""):
    text = json.dumps(document).encode() if isinstance(document, dict) else document
    text += b" " * (-len(text) % 4)
    rest = struct.pack("<II", len(binary), 0x004E4942) + binary if binary else b""
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def scene(**change):
    """One triangle, placed once."""
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    return {**document, **change}


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
VEC3 = {"componentType": 5126, "type": "VEC3"}


def test_the_scene_that_the_lies_are_told_of_is_read(tmp_path):
    assert len(loaded(tmp_path, "a.glb", glb(scene(), CORNERS)).faces) == 1


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"accessors": [{"count": 2**40, **VEC3}]}, "sparse and compressed"),
        ({"accessors": [{"count": 2**40, "bufferView": 0, **VEC3}]}, "more than|items"),
        ({"accessors": [{"count": -3, "bufferView": 0, **VEC3}]}, "whole number"),
        ({"accessors": [{"count": 3, "bufferView": 0, **VEC3, "sparse": {"count": 1}}]}, "sparse"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 2**20}] * 1000}, "more than"),
        ({"buffers": [{"byteLength": 36, "uri": "file:///etc/passwd"}]}, "another file"),
        ({"buffers": [{"byteLength": 36, "uri": "http://localhost/x.bin"}]}, "another file"),
        ({"nodes": [{"children": [1]}, {"children": [0], "mesh": 0}]}, "contains itself"),
        ({"nodes": [{"children": [1, 1], "mesh": 0}, {}]}, "tree"),
        ({"nodes": [{"mesh": 0}] * 20_000, "scenes": [{"nodes": list(range(20_000))}]}, "more than can be meant"),
        ({"nodes": [{"mesh": 7}]}, "expected one of the 1"),
        ({"nodes": {"0": {"mesh": 0}}}, "expected a list"),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "draco"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 6}]}]}, "promises 1"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * 150_000}]}, "more than can be meant"),
    ],
)
def test_gltf_that_lies(tmp_path, change, match):
    (tmp_path / "a.glb").write_bytes(glb(scene(**change), CORNERS))
    refused(tmp_path / "a.glb", match)


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (glb(b"[" * 100_000), "JSON"),
        (glb(b'{"a":' * 50_000), "JSON"),
        (glb(scene(), CORNERS)[:-9], "promises"),
        (glb(scene(), CORNERS)[:12] + struct.pack("<I", 2**32 - 1) + glb(scene(), CORNERS)[16:], "chunk"),
    ],
)
def test_glb_containers_that_lie(tmp_path, data, match):
    (tmp_path / "a.glb").write_bytes(data)
    refused(tmp_path / "a.glb", match)


def test_gltf_beside_its_buffer_is_told(tmp_path):
    files = trimesh.Scene(trimesh.creation.box()).export(file_type="gltf")
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    refused(tmp_path / "model.gltf", "another file.*export it as .glb")


# 3MF

MODEL = '<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
MODEL += '<object id="0"><mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/>'
MODEL += '<vertex x="0" y="1" z="0"/></vertices><triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh></object>'
MODEL += '{}</resources><build><item objectid="{}"/></build></model>'


def threemf(model, **others):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", model)
        for name, data in others.items():
            archive.writestr(name, data)
    return out.getvalue()


def doubling(levels):
    """Objects that each contain the one before twice."""
    made = (
        f'<object id="{k}"><components>{f"""<component objectid="{k - 1}"/>""" * 2}</components></object>'
        for k in range(1, levels + 1)
    )
    return MODEL.format("".join(made), levels)


def test_components_are_placed(tmp_path):
    assert len(loaded(tmp_path, "a.3mf", threemf(MODEL.format("", 0))).faces) == 1
    assert len(loaded(tmp_path, "a.3mf", threemf(doubling(3))).faces) == 8


CIRCLE = '<object id="1"><components><component objectid="2"/></components></object>'
CIRCLE += '<object id="2"><components><component objectid="1"/></components></object>'
ELSEWHERE = '<object id="1"><components><component objectid="5" p:path="/3D/other.model" xmlns:p="p"/></components>'


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (threemf(doubling(40)), "more than can be meant"),
        (threemf(MODEL.format(CIRCLE, 1)), "contains itself"),
        (threemf(MODEL.format(ELSEWHERE + "</object>", 1)), "as one model"),
        (threemf(MODEL.format("", 0) + " " * 70_000_000), "at most"),
        (threemf(MODEL.format("", 7)), "not there"),
        (threemf(MODEL.format("", 0).replace('v2="1"', 'v2="one"')), "expected numbers"),
        (threemf(MODEL.format("", 0).replace('v2="1"', "")), "expected numbers"),
        (threemf(MODEL.format("", 0).replace('v2="1"', 'v2="3"')), "corners"),
        (threemf("<!DOCTYPE a [<!ENTITY b 'c'>]>" + MODEL.format("", 0)), "DOCTYPE"),
        (threemf("<a>" * 100_000), "elements within elements"),
        (threemf(MODEL.format("", 0), **{"3D/second.model": "<model/>"}), "one model"),
        (threemf(MODEL.format("", 0))[:-30], "ZIP"),
        (b"PK\x03\x04" + bytes(100), "ZIP"),
    ],
)
def test_3mf_that_lies(tmp_path, data, match):
    (tmp_path / "a.3mf").write_bytes(data)
    refused(tmp_path / "a.3mf", match)


# COLLADA


def library(levels, mesh):
    """Nodes that each use the one before twice."""
    nodes = [f'<node id="n0"><instance_geometry url="#{mesh}"/></node>']
    nodes += [f'<node id="n{k}">{f"""<instance_node url="#n{k - 1}"/>""" * 2}</node>' for k in range(1, levels + 1)]
    return f"<library_nodes>{''.join(nodes)}</library_nodes>"


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t, mesh: t.replace("<library_v", library(40, mesh) + "<library_v").replace(
            "<node id=\"node0\"", '<node id="top"><instance_node url="#n40"/></node><node id="node0"'), "can be meant"),
        (lambda t, mesh: t.replace("</node>", '<instance_node url="#node0"/></node>'), "contains itself"),
        (lambda t, mesh: t.replace(f'url="#{mesh}"', f'url="http://localhost/x.dae#{mesh}"'), "no other is opened"),
        (lambda t, mesh: t.replace("<asset>", "<asset>" + "<a>" * 50_000), "elements within|XML"),
        (lambda t, mesh: mutate.XML[0].decode() + t, "DOCTYPE"),
        (lambda t, mesh: mutate.XML[1].decode() + t, "DOCTYPE"),
        (lambda t, mesh: t.replace('offset="0"', 'offset="1000000"'), "offset"),
    ],
)  # fmt: skip
def test_collada_that_lies(good, tmp_path, change, match):
    text = good[".dae"].decode()
    mesh = text.split('<geometry id="')[1].split('"')[0]
    changed = change(text, mesh)
    assert changed != text
    (tmp_path / "a.dae").write_text(changed)
    refused(tmp_path / "a.dae", match)


def test_as_many_elements_as_documented_and_one_more(good, tmp_path):
    text = good[".dae"].decode()
    room = 200_000 - len(re.findall(r"<[A-Za-z]", text))
    filled = (text.replace("</asset>", "<extra/>" * n + "</asset>").encode() for n in (room, room + 1))
    assert guards.collada(next(filled)) == FACES
    (tmp_path / "a.dae").write_bytes(next(filled))
    refused(tmp_path / "a.dae", "expected at most 200,000 elements, got more")


def test_as_many_triangles_by_placing_as_documented_and_some_more(good, tmp_path):
    """A part of 80 triangles counts 320, with the corners: 1562 times come to less than half a million, 1563 do not."""
    text = good[".dae"].decode()
    (once,) = re.findall(r"<instance_geometry.*?</instance_geometry>|<instance_geometry[^>]*/>", text, re.DOTALL)
    filled = (text.replace(once, once * n).encode() for n in (1562, 1563))
    assert guards.collada(next(filled)) == 1562 * FACES
    (tmp_path / "a.dae").write_bytes(next(filled))
    refused(tmp_path / "a.dae", "more than can be meant")


def test_as_many_places_as_documented_and_one_more():
    """A part of no size, in nothing but the scene: one place is the scene's own."""
    for count, held in ((9_999, True), (10_000, False)):
        parts = placing.Parts()
        parts.add("part", placing.Size(0, 1, 3))
        for _ in range(count):
            parts.put("scene", "part")
        if held:
            assert parts.spread(["scene"]) == count
        else:
            with pytest.raises(InputError, match="10,001 places"):
                parts.spread(["scene"])


def test_as_many_values_at_a_corner_as_documented_and_one_more(good):
    def strided(offset):
        """Every corner with `offset` values that nobody reads before its own."""
        text = good[".dae"].decode()
        stride = 1 + max(map(int, re.findall(r'offset="(\d+)"', text)))
        text = text.replace('offset="0"', f'offset="{offset}"')
        corners = re.search(r"<p>(.*?)</p>", text, re.DOTALL)
        own = re.findall(r"\d+", corners.group(1))[::stride]
        return text.replace(corners.group(1), " ".join("0 " * offset + index for index in own)).encode()

    assert guards.collada(strided(31)) == FACES
    with pytest.raises(InputError, match="expected an offset from 0 to 31, got '32'"):
        guards.collada(strided(32))


def test_an_archive_in_a_collada_file_is_not_unpacked(good, tmp_path):
    (tmp_path / "a.dae").write_bytes(good[".dae"] + threemf(MODEL.format("", 0)))
    refused(tmp_path / "a.dae", "ZIP")


# tables


@pytest.fixture
def folder(tmp_path, good):
    (tmp_path / "in").mkdir()
    for place in (tmp_path, tmp_path / "in"):
        (place / "a.ply").write_bytes(good[".ply"])
    return tmp_path / "in"


def table(folder, text):
    path = folder / "t.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return exemplars("table", table=path)


@pytest.mark.parametrize("name", ["../a.ply", "/etc/x.ply", "C:\\a.ply", "C:a.ply", "b/../../a.ply", "..\\a.ply"])
def test_no_path_leaves_the_folder(folder, name):
    with pytest.raises(InputError, match="leads out of the folder"):
        table(folder, f"mesh,p\n{name},1\n")


def test_no_link_leaves_the_folder(folder):
    (folder / "link.ply").symlink_to(folder.parent / "a.ply")
    (folder / "up").symlink_to(folder.parent)
    (folder / "circle.ply").symlink_to("circle.ply")
    for name in ("link.ply", "up/a.ply"):
        with pytest.raises(InputError, match="a link that leads out of the folder"):
            table(folder, f"mesh,p\n{name},1\n")
    with pytest.raises(InputError, match="no such file"):
        table(folder, "mesh,p\ncircle.ply,1\n")
    (folder / "inner.ply").symlink_to("a.ply")
    found = table(folder, "mesh,p\ninner.ply,1\n")
    assert len(found.meshes[0].faces) == FACES
    (folder / "inner.ply").unlink()
    (folder / "inner.ply").symlink_to(folder.parent / "a.ply")  # put there between the table and the mesh
    with pytest.raises(InputError, match="leads out"):
        found.meshes[0]


@pytest.mark.parametrize("name", ["NUL.ply", "con.ply", "sub/com1.ply", "lpt9.a.ply", "aux .ply"])
def test_names_of_devices_are_refused_everywhere(folder, name):
    with pytest.raises(InputError, match="device"):
        table(folder, f"mesh,p\n{name},1\n")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (b"mesh,p" + b",q" * 20_000 + b"\n", "columns"),
        (b"mesh,p\n" + b"\n" * 1_100_000, "rows"),
        (b"mesh,p\na.ply," + b"1" * 3_000_000 + b"\n", "cannot be read"),
        (b"mesh,p\na.ply,1,2,3\n", "cannot be read"),
        ("mesh,p\na.ply,1\n".encode("utf-16"), "cannot be read"),
        (b"mesh,p\na.ply,\0\n", "numeric column"),
        (b"mesh,p [m]\na.ply,\0\n", "expected a number"),
        (b"mesh,p\na.ply,nan\n", "expected a number, got an empty cell"),
        (b"mesh,p,q\na.ply,1,1e308\n", "'q'.*1e100"),
        (b"", "Empty"),
    ],
)
def test_csv_that_is_no_table(folder, text, match):
    with pytest.raises(InputError, match=match) as caught:
        table(folder, text)
    assert "t.csv" in str(caught.value) or "1e100" in match


def test_a_spread_too_small_to_normalise_is_refused(folder):
    with pytest.raises(InputError, match=r"differ by 4\.94e-324"):
        Exemplars(np.array([[0.0], [5e-324]]), (Parameter("p"),), [0, 1], ("a", "b"))


def parquet_of(folder, columns, **options):
    import pyarrow as pa
    import pyarrow.parquet

    pa.parquet.write_table(pa.table(columns), folder / "t.parquet", **options)
    return folder / "t.parquet"


@pytest.mark.parametrize(
    ("columns", "match"),
    [
        (lambda: {"mesh": np.zeros(5_000_000)}, "at most"),
        (lambda: {f"c{i}": [1.0] for i in range(11_000)}, "columns"),
        (lambda: {"mesh": ["x" * 100_000] * 1000}, "texts of at most"),
        (lambda: {"mesh": ["x" * 100_000_000]}, "when unpacked|texts"),
    ],
)
def test_parquet_that_explodes(folder, columns, match):
    path = parquet_of(folder, columns(), compression="zstd")
    assert path.stat().st_size < 5_000_000
    with pytest.raises(InputError, match=match):
        exemplars("table", table=path)


def unpacked(path):
    return parquet.read(path.read_bytes(), 10**6, 2 * 10**6, 10**4)


def test_as_many_bytes_unpacked_as_documented_and_some_more(folder):
    """Texts of 4096 bytes, each with its length: 8184 of them are just below 32 MiB, 8185 above."""
    for count, held in ((8183, True), (8185, False)):
        path = parquet_of(folder, {"mesh": ["x" * 4096] * count}, compression="zstd", use_dictionary=False)
        assert path.stat().st_size < 2**20
        if held:
            assert unpacked(path).num_rows == count
        else:
            with pytest.raises(InputError, match=r"at most 33,554,432 bytes and 100,000 pages when unpacked"):
                unpacked(path)


def test_as_many_pages_as_documented_and_one_more(folder):
    small = {"use_dictionary": False, "data_page_size": 1, "write_batch_size": 1, "compression": "none"}
    for count, held in ((100_000, True), (100_001, False)):
        path = parquet_of(folder, {"p": np.arange(count, dtype=float)}, **small)
        if held:
            assert unpacked(path).num_rows == count
        else:
            with pytest.raises(InputError, match="100,000 pages when unpacked"):
                unpacked(path)


def test_parquet_with_lists_is_read_without_them(folder):
    path = parquet_of(folder, {"mesh": ["a.ply"], "p": [1.0], "tags": [["x", "y"]], "point": [{"x": 1.0}]})
    assert [q.name for q in exemplars("table", table=path).space] == ["p"]


def test_a_table_is_a_plain_file(tmp_path):
    os.mkfifo(tmp_path / "t.csv")
    with pytest.raises(InputError, match="pipe"):
        exemplars("table", table=tmp_path / "t.csv")


# studies


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (".".join(["a"] * 100_000) + " = 1", "keys of a few parts"),
        ("bank = 'a'\n[" + ".".join(["a"] * 100_000) + "]", "keys of a few parts"),
        ("bank = " + "[" * 100_000, "TOML"),
        ("bank = " + "{a=" * 50_000, "TOML"),
        ("bank = 'a'\nseed = " + "9" * 5000, "TOML"),
        ("bank = 'a'\nseed = 1979-05-27", "seed"),
        ("bank = 'a'\nresolution = true", "resolution"),
        ("bank = 'a'\nreference = 5", "reference"),
        ("bank = 'a'\ntargets = { roof = 1979-05-27 }", "targets: roof"),
        ("bank = 'a'\ntargets = { roof = true }", "targets: roof"),
        ("bank = 'a'\nlimits = { mismatch = nan }", "limits: mismatch"),
        ("bank = 'a'\nobjective = { reduce = 3, by = 0.1 }", "objective"),
        ("bank = 'a'\nobjective = { reduce = 'd', by = true }\nreference='x'", "by"),
        ("bank = 'a'\nsolver = { name = 'kkt', ridge = [1] }", "solver"),
        ("bank = 'a'\nsolver = 3", "solver"),
        ("bank = 3", "bank"),
        ("bank = 'a'\nranges = 7", "ranges"),
        ("bank = 'a'\nkeep = 'length'", "keep"),
        ("# " + "a" * 2**22, "at most"),
    ],
)
def test_a_study_file_says_which_and_where(tmp_path, text, match):
    path = tmp_path / "roof.toml"
    path.write_text(text)
    with pytest.raises(StudyError, match=match) as caught:
        Study.read(path)
    assert "roof.toml" in str(caught.value)
    assert len(str(caught.value)) < 3000


def test_a_study_takes_numpy_numbers():
    study = Study("a.lamp", resolution=np.int64(64), seed=np.uint8(3), limits={"mismatch": np.float32(0.5)})
    assert (study.resolution, study.seed, study.limits["mismatch"]) == (64, 3, 0.5)
    assert Study.from_toml(study.to_toml()).resolution == 64
    with pytest.raises(StudyError, match="seed"):
        Study("a.lamp", seed=np.bool_(True))


def test_study_files_that_are_none(tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "text.toml").write_bytes(b"\xff\xfe")
    for path in (tmp_path, tmp_path / "pipe.toml", tmp_path / "none.toml", tmp_path / "text.toml", None, 3):
        with pytest.raises(StudyError, match="cannot be read as a study"):
            Study.read(path)


# banks


@pytest.fixture
def bank(good, tmp_path):
    """Write a bank with other layout, record or body, sealed."""

    def written(layout=lambda _: None, record=lambda _: None, body=lambda b: b):
        found, told, data = mutate.opened(good[".lamp"])
        layout(found)
        record(told)
        (tmp_path / "a.lamp").write_bytes(mutate.sealed(found, told, body(data)))
        return tmp_path / "a.lamp"

    return written


def bank_refused(path, match):
    with pytest.raises(BankError, match=match) as caught:
        load_bank(path)
    assert len(str(caught.value)) < 1000


def test_a_sealed_bank_is_read(bank):
    assert load_bank(bank()).names[0] == "car_0"


def test_what_is_no_bank(tmp_path):
    os.mkfifo(tmp_path / "pipe.lamp")
    for path, match in (
        (None, "path"), (3, "path"), (b"a", "path"), (tmp_path, "folder"), (tmp_path / "pipe.lamp", "pipe"),
        (tmp_path / "none.lamp", "no such file"), (tmp_path / "a\0.lamp", "null|embedded"),
        (tmp_path / ("a" * 300), "too long"),
    ):  # fmt: skip
        bank_refused(path, match)


@pytest.mark.parametrize("length", [0, 1, 2**22 + 1, 2**31, 2**63, 2**64 - 1])
def test_header_lengths_that_lie(good, tmp_path, length):
    (tmp_path / "a.lamp").write_bytes(struct.pack("<Q", length) + good[".lamp"][8:])
    bank_refused(tmp_path / "a.lamp", "damaged")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("weights", {"shape": [2**40, 2**40]}),
        ("weights", {"shape": [6, -40]}),
        ("weights", {"data_offsets": [0, 2**62]}),
        ("weights", {"data_offsets": [-8, 8]}),
        ("weights", {"shape": [6, 40.0]}),
        ("weights", {"shape": None}),
        ("weights", {"dtype": "F128"}),
        ("weights", {"dtype": ["F32"]}),
        ("weights", {"shape": [1] * 100}),
    ],
)
def test_layouts_that_lie(bank, name, change):
    bank_refused(bank(layout=lambda found: found[name].update(change)), "damaged|expected")


def test_a_name_twice_is_refused(good, tmp_path):
    data = good[".lamp"]
    (length,) = struct.unpack("<Q", data[:8])
    text = data[8 : 8 + length].rstrip()[:-1] + b',"weights":{"dtype":"F32","shape":[0],"data_offsets":[0,0]}}'
    (tmp_path / "a.lamp").write_bytes(struct.pack("<Q", len(text)) + text + data[8 + length :])
    bank_refused(tmp_path / "a.lamp", "twice")


def test_arrays_of_another_kind_are_not_converted(bank):
    def half(found):
        found["parameters"].update(dtype="F32", shape=[6, 4])

    bank_refused(bank(layout=half), "expected float64")


@pytest.mark.parametrize(
    "change",
    [
        {"names": "abcdef"},
        {"names": [1, 2, 3, 4, 5, 6]},
        {"names": ["\ud800", "b", "c", "d", "e", "f"]},
        {"names": ["a"] * 6},
        {"names": [str(i) for i in range(100_000)]},
        {"space": "ab"},
        {"space": [["a", "m", "1", 2.0], ["b", "m", 1.0, 2.0]]},
        {"space": [["a", "m", float("nan"), 2.0], ["b", "m", 1.0, 2.0]]},
        {"frame": {"scale": float("nan"), "centre": [0, 0, 0], "unit": "m"}},
        {"frame": {"scale": True, "centre": [0, 0, 0], "unit": "m"}},
        {"frame": {"scale": 1.0, "centre": [0, 0, 0], "unit": 5}},
        {"frame": {"scale": 1.0, "centre": [0, 0, float("inf")], "unit": "m"}},
        {"decoder": {"name": 3, "options": {}}},
        {"decoder": {"name": "a", "options": {"x": [1]}}},
        {"decoder": None},
        {"measured_by": [["a", 3]]},
        {"measured_by": {"a": {}}},
        {"mesh_facts": {"genus": True}},
        {"mesh_facts": [1]},
        {"limits": 3},
        {"provenance": [1, 2]},
        {"calibration": {"tolerance": "x", "checks": ["mismatch"]}},
        {"calibration": {"tolerance": 0.1, "checks": "m"}},
        {"calibration": []},
        {"schema": True},
        {"schema": 2**70},
        {"schema": "2"},
        {"format": ["lampopt bank"] * 1000},
        {"hashes": []},
    ],
)
def test_records_that_lie(bank, change):
    bank_refused(bank(record=lambda record: record.update(change)), "expected|describe a bank|damaged|newer")


def test_values_beyond_all_bounds_are_refused(good, bank):
    first = mutate.opened(good[".lamp"])[0]["parameters"]["data_offsets"][0]
    path = bank(body=lambda body: body[:first] + np.float64(1e300).tobytes() + body[first + 8 :])
    bank_refused(path, "1e100")


def test_a_header_too_long_to_be_read_is_not_written(tmp_path, good):
    from lampopt import lamp

    with pytest.raises(BankError, match="shorten"):
        lamp.write(tmp_path / "a.lamp", {"a": np.zeros(2)}, {"facts": "a" * lamp.HEADER})
    assert not list(tmp_path.iterdir())


# options


@pytest.mark.parametrize("options", [{"segments": 10**9}, {"count": 10**9, "design": "random"}, {"seed": 2**70}])
def test_plates_without_bound_are_refused(options):
    with pytest.raises(PluginError, match=r"to 100,000|below 2\^63"):
        exemplars("plate", **options)


# Thrift's compact protocol, by its specification: a field's head is (distance << 4 | type), numbers are zigzag varints


@pytest.mark.parametrize(
    ("data", "fields"),
    [
        (b"\x00", {}),
        (b"\x15\x02\x15\x03\x00", {1: 1, 2: -2}),
        (b"\x11\x12\x00", {1: True, 2: False}),
        (b"\x05\x08\x02\x00", {4: 1}),  # the number written out, where the distance would not fit
        (b"\x19\x25\x02\x04\x00", {1: [1, 2]}),
        (b"\x1c\x15\x02\x00\x00", {1: {1: 1}}),
        (b"\x18\x03abc\x15\x02\x00", {1: None, 2: 1}),
        (b"\x1b\x01\x85\x02ab\x02\x00", {1: [None, 1]}),
        (b"\x16\xfe\xff\xff\xff\x0f\x00", {1: 2**31 - 1}),
    ],
)
def test_thrift_records_are_read(data, fields):
    assert thrift.record(data, 0) == (fields, len(data))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x15",
        b"\x15" + b"\xff" * 20,  # a number without end
        b"\x18\xff\xff\xff\xff\x0f",  # a text of 4 GiB
        b"\x19\xf5\xff\xff\xff\xff\x0f",  # a list of 4 billion
        b"\x1c" * 1000,  # records in records
        b"\x19\x19" * 1000,  # lists in lists
        b"\x1d\x00",  # a type that is none
    ],
)
def test_thrift_records_that_lie(data):
    with pytest.raises(InputError):
        thrift.record(data, 0)


# what a file names


WATCHED = """
import sys
from pathlib import Path
from lampopt.errors import LampoptError
from lampopt.meshfile import load_mesh

good, bad = ([Path(name) for name in part.split("|")] for part in sys.argv[1:])
for path in good:  # what is imported on the way is no affair of the files that follow
    load_mesh(path)
seen, telling = [], ("open", "socket.", "subprocess.", "os.", "pickle.", "urllib.", "ctypes.", "exec", "import")

def told(event, args):
    if event.startswith(telling):
        seen.append((event, str(args[0]) if args else ""))

sys.addaudithook(told)
for path in bad:
    try:
        load_mesh(path)
    except LampoptError:
        pass
print([e for e in seen if e[0] != "open" or e[1] not in map(str, bad)])
"""


def test_what_a_mesh_file_names_is_not_opened(good, tmp_path):
    """Watched by an audit hook: beyond the files themselves nothing is opened, imported, run or asked of a network."""
    kept = []
    for name in hostile.OTHERS:
        path = tmp_path / f"good{name.replace('.', '-', name.count('.') - 1)}"
        if path.suffix in SUFFIXES:
            path.write_bytes(good[name])
            kept.append(path)
    secret = tmp_path / "secret.mtl"
    secret.write_text("newmtl m\nmap_Kd secret.png\n")
    outside = f"file://{secret}"
    dae = good[".dae"].decode()
    image = f'<library_images><image id="i"><init_from>{outside}</init_from></image></library_images><library_effects>'
    bad = {
        "a.obj": f"mtllib {secret}\nusemtl m\n{TRIANGLE}f 1 2 3\n",
        "a.ply": PLY.format("ascii", 3, 1, "uchar").replace("element v", f"comment TextureFile {secret}\nelement v", 1)
        + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
        "image.dae": dae.replace("<library_effects>", image),
        "entity.dae": mutate.XML[1].decode() + dae,
        "a.gltf": json.dumps(scene(buffers=[{"byteLength": 36, "uri": outside}])),
        "b.gltf": json.dumps(scene(buffers=[{"byteLength": 36, "uri": "http://127.0.0.1:9/x"}])),
        "a.glb": glb(scene(images=[{"uri": outside}], textures=[{"source": 0}], materials=[{}]), CORNERS),
        "a.3mf": threemf(MODEL.format("", 0), **{"3D/_rels/3dmodel.model.rels": f'<R Target="{outside}"/>'}),
    }
    for name, data in bad.items():
        (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    names = ["|".join(map(str, paths)) for paths in (kept, [tmp_path / name for name in bad])]
    done = subprocess.run([sys.executable, "-c", WATCHED, *names], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_place_where_nothing_can_be_written_is_told(tmp_path):
    from lampopt.cli.options import can_be_written

    for path in (tmp_path / ("a" * 300), Path("/dev/null/a.stl")):
        with pytest.raises(InputError, match=r"--out .*no file can be written"):
            can_be_written("--out", path)
