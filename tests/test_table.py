"""A table beside a folder of meshes: what is read, and every way a table can be wrong."""

import contextlib
import logging
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lampopt.errors import InputError
from lampopt.meshfile import SUFFIXES, load_mesh
from lampopt.plugins import Plugins
from lampopt.protocols import Source
from lampopt.testing import check_plugin
from lampopt_datasets.columns import name_and_unit
from lampopt_datasets.table import Table

CARS = """mesh,length [m],ramp [deg],drag,maker
a.stl,4.0,8,0.30,north
b.stl,4.2,+12.5,,south
c.stl,4.4e0,.5,0.28,west
"""


@pytest.fixture
def folder(tmp_path):
    for name, size in zip("abc", (1, 2, 3), strict=True):
        trimesh.creation.box((size, 1, 1)).export(tmp_path / f"{name}.stl")
    return tmp_path


def table(folder: Path, text: str | bytes = CARS, **options) -> Table:
    path = folder / "cars.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return Table(str(path), **options)


def refused(folder: Path, text: str | bytes = CARS, **options) -> str:
    with pytest.raises(InputError) as caught:
        table(folder, text, **options)()
    assert "cars.csv" in str(caught.value)
    return str(caught.value)


def test_what_is_read(folder):
    source = table(folder, labels="drag", unit="mm")
    assert isinstance(source, Source)
    exemplars = source()
    assert exemplars.names == ("a", "b", "c")
    assert [(q.name, q.unit) for q in exemplars.space] == [("length", "m"), ("ramp", "deg")]
    np.testing.assert_array_equal(exemplars.parameters, [[4.0, 8], [4.2, 12.5], [4.4, 0.5]])
    assert [(q.name, q.unit) for q in exemplars.label_space] == [("drag", "")]
    np.testing.assert_array_equal(exemplars.labels, [[0.30], [np.nan], [0.28]])
    assert exemplars.unit == "mm"
    assert exemplars.mesh_at is None and not exemplars.measured
    assert [mesh.extents[0] for mesh in exemplars.meshes] == [1, 2, 3]
    assert exemplars.meshes[-1].extents[0] == 3
    assert len(exemplars.meshes[1:]) == 2


def test_without_labels(folder):
    exemplars = table(folder, CARS.replace(",,", ",0.29,"))()
    assert [q.name for q in exemplars.space] == ["length", "ramp", "drag"]
    assert exemplars.labels.shape == (3, 0)


def test_columns_left_out_are_logged(folder, caplog):
    with caplog.at_level(logging.INFO, "lampopt"):
        table(folder, labels="drag")()
    assert "left out: maker" in caplog.text


@pytest.mark.parametrize(
    "cells",
    [
        ("1,200", "1,250", "1,300"),
        ("\u22123", "\u22122.5", "3"),
        ("1 200.5", "900", "x"),
        ("1,5", "1,7", "2,0"),
        ("15 %", "16%", "17%"),
        ("10 mm", "11mm", "12.5 mm"),
        ("1.5D+00", "2D1", "3d-2"),
    ],
)
def test_numbers_as_people_write_them_are_told_not_left_out(folder, cells):
    rows = "".join(f'{name}.stl,4.0,"{cell}"\n' for name, cell in zip("abc", cells, strict=True))
    said = refused(folder, "mesh,length [m],mass\n" + rows)
    assert "column 'mass': expected a number, got '" + cells[0] in said


def test_chosen_parameters_leave_out_what_is_no_number(folder):
    rows = "".join(f'{name}.stl,4.{k},"1,200"\n' for k, name in enumerate("abc"))
    exemplars = table(folder, "mesh,length [m],code\n" + rows, parameters="length")()
    assert [q.name for q in exemplars.space] == ["length"]


def test_chosen_parameters(folder):
    exemplars = table(folder, parameters="ramp [deg], length", labels=" drag ")()
    assert [q.name for q in exemplars.space] == ["ramp", "length"]
    np.testing.assert_array_equal(exemplars.parameters[1], [12.5, 4.2])


def test_meshes_in_another_folder_and_below_it(tmp_path):
    (tmp_path / "stl" / "deep").mkdir(parents=True)
    trimesh.creation.box().export(tmp_path / "stl" / "x.stl")
    trimesh.creation.box((2, 2, 2)).export(tmp_path / "stl" / "deep" / "x.stl")
    exemplars = table(tmp_path, "mesh,p\nx.stl,1\ndeep/x.stl,2\n", meshes=str(tmp_path / "stl"))()
    assert exemplars.names == ("x", "deep/x")
    assert exemplars.meshes[1].extents[0] == 2


def test_csv_and_parquet_agree(folder):
    table(folder)
    cells = pyarrow.csv.read_csv(folder / "cars.csv")
    cells = cells.append_column("label [N]", pa.array([1, None, 3], pa.int32()))
    cells = cells.append_column("day", pa.array([0, 1, 2], pa.date32()))
    cells = cells.append_column("kind", pa.array(["a", "b", "a"]).dictionary_encode())
    pyarrow.parquet.write_table(cells, folder / "cars.parquet")
    pyarrow.csv.write_csv(
        cells.drop_columns("kind").append_column("kind", cells["kind"].cast("string")), folder / "cars.csv"
    )
    first, second = (Table(str(folder / f"cars.{end}"), labels="drag,label")() for end in ("csv", "parquet"))
    assert first.names == second.names
    assert first.space == second.space and first.label_space == second.label_space
    np.testing.assert_array_equal(first.parameters, second.parameters)
    np.testing.assert_array_equal(first.labels, second.labels)


def test_the_index_of_a_data_frame_is_no_parameter(folder):
    exemplars = table(folder, ",mesh,p\n0,a.stl,1\n1,b.stl,2\n")()
    assert [q.name for q in exemplars.space] == ["p"]


def test_byte_order_mark_blanks_and_windows_lines(folder):
    text = "\ufeffmesh , length [m] \r\n a.stl , 1.5 \r\n\r\nb.stl,2\r\n"
    exemplars = table(folder, text.encode())()
    np.testing.assert_array_equal(exemplars.parameters, [[1.5], [2]])
    assert str(exemplars.space[0]) == "length [m]"


@pytest.mark.parametrize(
    ("header", "expected"),
    [("ramp [deg]", ("ramp", "deg")), (" ramp[ deg ] ", ("ramp", "deg")), ("ramp", ("ramp", "")), ("r []", ("r", ""))],
)
def test_headers(header, expected):
    assert name_and_unit(header) == expected


# meshes


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".STL", ".Obj"])
def test_formats(tmp_path, suffix):
    box = trimesh.creation.box((1, 2, 3))
    (tmp_path / f"box{suffix}").write_bytes(_exported(box, suffix))
    exemplars = table(tmp_path, f"mesh,p\nbox{suffix},1\n")()
    mesh = exemplars.meshes[0]
    assert exemplars.names == ("box",)
    assert mesh.is_watertight and len(mesh.vertices) == 8
    np.testing.assert_allclose(mesh.extents, [1, 2, 3])


def _exported(mesh: trimesh.Trimesh | trimesh.Scene, suffix: str) -> bytes:
    if suffix == ".gltf":  # with its buffers within
        return trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh), embed_buffers=True)["model.gltf"]
    data = mesh.export(file_type=suffix[1:].lower())
    return data.encode() if isinstance(data, str) else data


def test_a_scene_becomes_one_mesh(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    scene.add_geometry(trimesh.creation.box(), transform=trimesh.transformations.scale_matrix(2))
    (tmp_path / "scene.glb").write_bytes(_exported(scene, ".glb"))
    mesh = load_mesh(tmp_path / "scene.glb")
    np.testing.assert_allclose(mesh.bounds, [[-1, -1, -1], [5.5, 1, 1]])
    np.testing.assert_allclose(mesh.volume, 9)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("a.stl", b"solid nothing\nendsolid nothing\n", "expected faces, got none"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "expected faces, got none"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n", "expected finite vertices"),
        ("a.obj", b"v 0 0 0\nf 1 2 30000\n", "cannot be read"),
        ("a.ply", b"junk", "cannot be read"),
        ("a.off", b"", "cannot be read"),
        ("a.glb", b"", "cannot be read"),
        ("a.glb", bytes(1000), "cannot be read"),
    ],
)
def test_mesh_files_that_are_none(tmp_path, file, content, message):
    (tmp_path / file).write_bytes(content)
    exemplars = table(tmp_path, f"mesh,p\n{file},1\n")()  # looking at the table loads no mesh
    with pytest.raises(InputError, match=message) as caught:
        exemplars.meshes[0]
    assert file in str(caught.value)


def test_a_mesh_deleted_meanwhile(folder):
    exemplars = table(folder, labels="drag")()
    (folder / "b.stl").unlink()
    with pytest.raises(InputError, match=r"b\.stl: cannot be read"):
        exemplars.meshes[1]


def test_a_mesh_file_reaches_no_other_file(tmp_path):
    """An OBJ names materials beside itself; nothing but the mesh file is opened."""
    (tmp_path / "evil.mtl").write_text("newmtl m\nmap_Kd ../secret.png\n")
    obj = "mtllib evil.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(obj)
    assert len(load_mesh(tmp_path / "a.obj").faces) == 1


# what can be wrong with a table


def test_missing_table(tmp_path):
    with pytest.raises(InputError, match=r"none\.csv: no such file; a relative path starts at"):
        Table(str(tmp_path / "none.csv"))()
    with pytest.raises(InputError, match=r"expected a \.csv or \.parquet file, got suffix '\.xlsx'"):
        Table(str(tmp_path / "cars.xlsx"))()


def test_missing_folder(folder):
    assert "meshes: no folder" in refused(folder, meshes=str(folder / "stl"), labels="drag")


def test_missing_mesh_column(folder):
    assert "expected a column 'mesh' with file names, got columns 'file', 'p'" in refused(folder, "file,p\na.stl,1\n")
    assert "must be separated by commas" in refused(folder, "mesh;p\na.stl;1\n")


def test_no_rows(folder):
    assert "expected at least one row" in refused(folder, "mesh,p [m]\n")
    assert "cannot be read" in refused(folder, "")


def test_all_bad_rows_at_once(folder):
    message = refused(
        folder,
        "mesh,length,ramp,drag\na.stl,1,2,3\nnone.stl,,2,3\na.stl,4,steep,\n,5,1,x\nc.step,6,1,1e999\nb.stl,nan,1,1\n",
        labels="drag",
    )
    for expected in (
        "row 2, column 'length': expected a number, got an empty cell",
        "row 6, column 'length': expected a number, got an empty cell",
        "row 3, column 'ramp': expected a number, got 'steep'",
        "row 4, column 'drag': expected a number, got 'x'",
        "row 5, column 'drag': expected a number, got '1e999'",
        "row 2: mesh 'none.stl': no such file",
        "row 3: mesh 'a.stl': row 1 has a file of this name already",
        "row 4, column 'mesh': expected a file name, got an empty cell",
        "row 5: mesh 'c.step': expected a file of .stl",
    ):
        assert expected in message, message
    assert message.count("\n  ") == 9


def test_one_name_in_two_formats(folder):
    trimesh.creation.box().export(folder / "a.obj")
    assert "row 2: mesh 'a.obj': row 1 has a file of this name" in refused(folder, "mesh,p\na.stl,1\na.obj,2\n")


@pytest.mark.parametrize(
    "file", ["../x.stl", "a/../../x.stl", "/etc/x.stl", "C:\\x.stl", "..\\x.stl", "\\\\host\\x.stl"]
)
def test_mesh_outside_the_folder(folder, file):
    trimesh.creation.box().export(folder / "x.stl")
    (folder / "stl").mkdir()
    message = refused(folder, f"mesh,p\n{file},1\n", meshes=str(folder / "stl"))
    assert f"row 1: mesh {file!r} leads out of the folder" in message


def test_unknown_and_doubled_columns(folder):
    message = refused(folder, labels="drag,lift,drag,mesh", parameters="length,hight,drag")
    assert "labels: no column 'lift'; known are 'length', 'ramp', 'drag', 'maker'" in message
    assert "labels: no column 'mesh'" in message
    assert "parameters: no column 'hight'" in message
    assert "labels: 'drag' is named twice" in message
    assert "'drag' is named in parameters and in labels" in message


def test_text_in_a_chosen_column(folder):
    message = refused(folder, labels="maker")
    assert "row 1, column 'maker': expected a number, got 'north'" in message


def test_a_column_of_dates_is_refused(folder):
    cells = pa.table({"mesh": ["a.stl"], "day": pa.array([1], pa.date32()), "p": [1.0]})
    pyarrow.parquet.write_table(cells, folder / "cars.parquet")
    with pytest.raises(InputError, match=r"column 'day': expected numbers, got date32"):
        Table(str(folder / "cars.parquet"), labels="day")()


def test_no_parameter_column(folder):
    message = refused(folder, "mesh,drag,maker\na.stl,1,x\n", labels="drag")
    assert "expected a numeric column beside 'mesh' and the labels ['drag'], got none" in message


def test_two_columns_of_one_name(folder):
    assert "expected distinct column names, got 'length' twice" in refused(
        folder, "mesh,length [m],length [mm]\na.stl,1,2\n"
    )


def test_a_name_that_no_parameter_can_have(folder):
    assert "'nose.angle': expected text without '.'" in refused(folder, "mesh,nose.angle\na.stl,1\n")


def test_rows_of_unequal_length(folder):
    assert "Expected 2 columns, got 3" in refused(folder, "mesh,p\na.stl,1,2\n")


def test_long_lists_are_cut(folder):
    message = refused(folder, "mesh,p [m]\n" + "none.stl,\n" * 5000)
    assert message.count("\n") < 60
    assert "and more" in message


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xfe\x00mesh",
        b"\0" * 1000,
        b'mesh,p\n"a.stl,1\n',
        b"mesh,p\n\xff,1\n",
        b"mesh," * 10000,
        b"," * 3000 + b"\n",
    ],
)
def test_hostile_text(folder, content):
    refused(folder, content)


def test_hostile_parquet(folder):
    for content in (b"", b"PAR1", b"PAR1" + bytes(200) + b"PAR1"):
        (folder / "cars.parquet").write_bytes(content)
        with pytest.raises(InputError, match="cannot be read"):
            Table(str(folder / "cars.parquet"))()


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(max_size=200), st.text(alphabet='mesh,p\n"[]1.e- ;\\/\0é', max_size=80).map(str.encode)))
def test_whatever_bytes_raise_only_input_errors(folder, content):
    for text in (content, b"mesh,p\na.stl,1\n" + content):
        with contextlib.suppress(InputError):
            table(folder, text)()


def test_a_long_table(folder):
    """Types guessed from a first block would not last: text comes late."""
    rows = [f"a.stl,{i}" for i in range(200_000)]
    message = refused(folder, "\n".join(["mesh,p", *rows, "b.stl,late", ""]))
    assert "row 200001, column 'p': expected a number, got 'late'" in message


def test_its_example_keeps_the_promises_of_a_source():
    plugins = Plugins.load(block=[p.name for p in entry_points(group="lampopt") if p.name != "datasets"])
    records = check_plugin(plugins, "datasets")
    assert records and all(record.passed for record in records), records


def test_its_example_is_gone_when_python_ends():
    code = "from lampopt_datasets.table import Table; t = Table.example(); print(t.table, len(t().meshes[0].faces))"
    place, faces = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.rsplit(maxsplit=1)
    assert faces == "12"
    assert not Path(place).parent.exists()


@pytest.mark.parametrize("unit", ["kg", "mmm"])
def test_a_unit_that_is_no_length_is_refused(folder, unit):
    with pytest.raises(InputError, match="unit"):
        table(folder, labels="drag", unit=unit)()
