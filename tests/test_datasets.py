"""Published datasets as they are downloaded: made folders of their layouts, and the published tables themselves."""

import dataclasses
import logging
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

import lampopt
from lampopt.errors import InputError
from lampopt.plugins import Plugins
from lampopt.testing import source_checks
from lampopt_datasets.blendednet import BlendedNet
from lampopt_datasets.drivaerml import DrivAerML
from lampopt_datasets.drivaernet import DrivAerNet, DrivAerNetPlus, key
from lampopt_datasets.vtk import load_vtk

DATA = Path(__file__).parent.parent.parent / "shared" / "data"
STYLES = ("E_S_WWC_WM", "E_S_WW_WM", "F_S_WWC_WM", "F_S_WWS_WM", "N_S_WWC_WM", "N_S_WWS_WM", "N_S_WW_WM")


def car(path: Path, length: float = 4.6) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box((length, 1.8, 1.4)).export(path)


def refused(source) -> str:
    with pytest.raises(InputError) as caught:
        source()
    return str(caught.value)


@source_checks(DrivAerNetPlus.example(), DrivAerNet.example(), DrivAerML.example(), BlendedNet.example())
def test_they_keep_to_the_protocol(check):
    check()


def test_they_come_in_by_the_front_door():
    plugins = Plugins.load()
    for name, kind in {
        "drivaernet": DrivAerNet,
        "drivaernet++": DrivAerNetPlus,
        "drivaerml": DrivAerML,
        "blendednet": BlendedNet,
    }.items():
        assert plugins.get("source", name).resolve() is kind
        with pytest.raises(InputError, match="no folder nowhere"):
            lampopt.exemplars(name, folder="nowhere")


# DrivAerNet++


@pytest.fixture
def cars(tmp_path):
    """Four designs; one mesh lacks, one lies without a row; ids are written in every way that is published."""
    for name in ("E_S_WW_WM_001", "E_S_WW_WM_002", "DrivAer_N_S_WWS_WM_010", "F_D_WM_WW_0007"):
        car(tmp_path / "3DMeshesSTL" / f"{name}.stl")
    (tmp_path / "DrivAerNet_ParametricData.csv").write_text(
        "Experiment,B_Ramp_Angle,A_Car_Length,A_Car_Green_House_Angle,Average Cd,Std Cd\n"
        "E_S_WW_WM_001,12.5,80,-100,0.29,0.005\n"
        "E_S_WW_WM_002,-3,20,10,0.27,\n"
        "N_S_WWS_WM_010,0,-5,50,,0.004\n"
        "N_S_WWS_WM_011,1,1,1,0.25,0.003\n"
    )
    (tmp_path / "DrivAerNetPlusPlus_Cd_8k_Updated.csv").write_text(
        "Design,Average Cd\nE_S_WW_WM_1,0.9\nN_S_WWS_WM_10,0.26\nF_D_WM_WW_7,0.31\n"
    )
    splits = tmp_path / "train_val_test_splits"
    splits.mkdir()
    (splits / "train_design_ids.txt").write_text("E_S_WW_WM_001\nE_S_WW_WM_002\nF_D_WM_WW_0007\n")
    (splits / "val_design_ids.txt").write_text("N_S_WWS_WM_010\n\n")
    (splits / "test_design_ids.txt").write_text("N_S_WWS_WM_011\n")
    return tmp_path


def test_what_is_read(cars, caplog):
    with caplog.at_level(logging.WARNING, "lampopt"):
        found = DrivAerNetPlus(str(cars), missing="leave out")()
    assert found.names == ("E_S_WW_WM_001", "E_S_WW_WM_002", "N_S_WWS_WM_010")
    assert [str(q) for q in found.space] == ["B_Ramp_Angle [deg]", "A_Car_Length [mm]", "A_Car_Green_House_Angle"]
    np.testing.assert_array_equal(found.parameters, [[12.5, 80, -100], [-3, 20, 10], [0, -5, 50]])
    # the drag table fills the gap that the table of parameters has; where both have a value that one counts
    assert [str(q) for q in found.label_space] == ["Average Cd", "Std Cd"]
    np.testing.assert_array_equal(found.labels, [[0.29, 0.005], [0.27, np.nan], [0.26, 0.004]])
    assert found.unit == "m"
    np.testing.assert_allclose(found.meshes[2].extents, (4.6, 1.8, 1.4), rtol=1e-6)
    assert "without a mesh are left out (1: N_S_WWS_WM_011)" in caplog.text
    assert "without a row in the table are left out (1: 3DMeshesSTL/F_D_WM_WW_0007.stl)" in caplog.text


def test_missing_meshes_are_named(cars):
    message = refused(DrivAerNetPlus(str(cars)))
    assert "3 of 4 designs have a mesh" in message
    assert "missing are 1: N_S_WWS_WM_011" in message
    assert "missing='leave out'" in message
    assert "Harvard Dataverse" in message


def test_designs_without_a_mesh_serve_for_models(cars):
    found = DrivAerNetPlus(str(cars), missing="keep")()
    assert found.names == ("E_S_WW_WM_001", "E_S_WW_WM_002", "N_S_WWS_WM_010", "N_S_WWS_WM_011")
    np.testing.assert_allclose(found.meshes[2].extents, (4.6, 1.8, 1.4), rtol=1e-6)
    with pytest.raises(InputError, match="this exemplar has no mesh: it serves for models"):
        found.meshes[3]
    shutil.rmtree(cars / "3DMeshesSTL")
    assert len(DrivAerNetPlus(str(cars), missing="keep")()) == 4  # none of them has one


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"split": "train"}, ("E_S_WW_WM_001", "E_S_WW_WM_002")),
        ({"split": "val"}, ("N_S_WWS_WM_010",)),
        ({"style": "E_"}, ("E_S_WW_WM_001", "E_S_WW_WM_002")),
        ({"count": 1}, ("E_S_WW_WM_001",)),
        ({"style": "N_S_WWS_WM", "count": 1}, ("N_S_WWS_WM_010",)),
        ({"parameters": False, "missing": "leave out"}, ("E_S_WW_WM_001", "N_S_WWS_WM_010", "F_D_WM_WW_0007")),
    ],
)
def test_what_is_chosen(cars, options, names):
    assert DrivAerNetPlus(str(cars), **options)().names == names


def test_chosen_labels(cars):
    found = DrivAerNetPlus(str(cars), count=2, labels="Std Cd, Average Cd")()
    assert [q.name for q in found.label_space] == ["Std Cd", "Average Cd"]
    message = refused(DrivAerNetPlus(str(cars), count=2, labels="Average Cm"))
    assert "no column 'Average Cm'; known are 'Average Cd', 'Std Cd'" in message


def test_the_first_release_has_drag_and_no_parameters(cars):
    found = DrivAerNet(str(cars))()
    assert found.names == ("F_D_WM_WW_0007",)
    assert found.space == () and found.parameters.shape == (1, 0)
    assert [q.name for q in found.label_space] == ["Average Cd"]  # of Std Cd nothing is known here
    np.testing.assert_array_equal(found.labels, [[0.31]])
    message = refused(DrivAerNet(str(cars), parameters=True))
    assert "no design of style 'F_D_WM_WW' in the table; its styles are E_S_WW_WM, N_S_WWS_WM" in message
    assert "parameters=False" in message


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"style": "X"}, "no design of style 'X'"),
        ({"split": "dev"}, "split: expected one of train, val, test, all, got 'dev'"),
        ({"split": "val", "style": "E_"}, "the split 'val' has none of the designs of style 'E_'"),
        ({"missing": "skip"}, "missing: expected one of error, leave out, keep, got 'skip'"),
        ({"count": -1}, "count: expected a whole number, 0 for all, got -1"),
        ({"unit": "mm", "count": 1}, "got one of 4.6 mm; unit='m' would fit"),
        ({"unit": "cubit", "count": 1}, "unit: expected one of m, mm"),
        ({"meshes": "elsewhere"}, "expected meshes of the designs in the table (4: E_S_WW_WM_001"),
    ],
)
def test_options_that_cannot_be(cars, options, said):
    assert said in refused(DrivAerNetPlus(str(cars), **options))


def test_a_download_that_is_not_unpacked(cars):
    shutil.rmtree(cars / "3DMeshesSTL")
    (cars / "E_S_WW_WM.zip").write_bytes(b"PK")
    message = refused(DrivAerNetPlus(str(cars)))
    assert "archives that may hold it have to be unpacked first (1: E_S_WW_WM.zip)" in message


def test_a_table_is_missing(cars):
    (cars / "DrivAerNet_ParametricData.csv").unlink()
    assert "expected a table DrivAerNet_ParametricData.csv" in refused(DrivAerNetPlus(str(cars)))
    (cars / "DrivAerNetPlusPlus_Cd_8k_Updated.csv").unlink()
    assert "expected a table DrivAerNetPlusPlus_Cd_8k_Updated.csv or" in refused(DrivAerNet(str(cars)))


def test_a_table_lies_there_twice(cars):
    (cars / "copy").mkdir()
    shutil.copy(cars / "DrivAerNet_ParametricData.csv", cars / "copy")
    assert "expected one file DrivAerNet_ParametricData.csv" in refused(DrivAerNetPlus(str(cars)))


def test_a_list_of_a_split_is_missing(cars):
    (cars / "train_val_test_splits" / "train_design_ids.txt").unlink()
    assert "expected a file train_design_ids.txt or train.txt" in refused(DrivAerNetPlus(str(cars), split="train"))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("-3,20", "wide,20", "row 2, column 'B_Ramp_Angle': expected a number, got 'wide'"),
        ("E_S_WW_WM_002", "estate 2", "no id such as E_S_WW_WM_007 in 1: estate 2"),
        ("E_S_WW_WM_002", "E_S_WW_WM_1", "designs with two rows (1: E_S_WW_WM_001)"),
        ("Experiment", "Name", "expected a column Experiment or Design with ids"),
    ],
)
def test_a_table_that_cannot_be_used(cars, old, new, said):
    table = cars / "DrivAerNet_ParametricData.csv"
    table.write_text(table.read_text().replace(old, new))
    assert said in refused(DrivAerNetPlus(str(cars), count=2))


def test_two_meshes_of_one_design(cars):
    car(cars / "other" / "E_S_WW_WM_1.stl", 5.0)
    message = refused(DrivAerNetPlus(str(cars), count=2))
    assert "3DMeshesSTL/E_S_WW_WM_001.stl and other/E_S_WW_WM_1.stl" in message
    assert DrivAerNetPlus(str(cars), count=2, meshes="3DMeshesSTL")().meshes[0].extents[0] == pytest.approx(4.6)


def test_an_empty_mesh_file(cars):
    (cars / "3DMeshesSTL" / "E_S_WW_WM_002.stl").write_bytes(b"")
    assert "E_S_WW_WM_002.stl" in refused(DrivAerNetPlus(str(cars), count=2))


def test_an_empty_folder(tmp_path):
    assert "is empty" in refused(DrivAerNetPlus(str(tmp_path)))


@pytest.mark.parametrize(
    ("name", "design"),
    [
        ("E_S_WWC_WM_005", ("E_S_WWC_WM", 5)),
        ("E_S_WWC_WM_5", ("E_S_WWC_WM", 5)),
        ("DrivAer_F_D_WM_WW_0100", ("F_D_WM_WW", 100)),
        ("E_S_WWC_WM", None),
        ("wheel_1", None),
    ],
)
def test_ids(name, design):
    assert key(name) == design


def published(name: str) -> Path:
    if not (DATA / name).exists():
        pytest.skip(f"{DATA / name} is not there")
    return DATA / name


def test_the_published_table_of_drivaernet(tmp_path):
    source = published("drivaernet")
    for file in ("DrivAerNet_ParametricData.csv", "splits/train.txt", "splits/val.txt", "splits/test.txt"):
        shutil.copy(source / file, tmp_path / Path(file).name)
    for style in STYLES:
        for number in range(120):
            (tmp_path / f"{style}_{number:03d}.stl").write_bytes(b"solid, but not looked at")
    car(tmp_path / "E_S_WWC_WM_005.stl")  # the first row of the table, whose size is looked at
    found = DrivAerNetPlus(str(tmp_path), missing="leave out")()
    assert len(found.space) == 23 and [q.name for q in found.label_space][:2] == ["Average Cd", "Std Cd"]
    assert len(found.label_space) == 8
    assert np.isfinite(found.labels).all()
    assert {name[:-4] for name in found.names} == set(STYLES)
    first = dict(zip([q.name for q in found.space], found.parameters[0], strict=True))
    assert found.names[0] == "E_S_WWC_WM_005"
    assert first["B_Ramp_Angle"] == 12.9715 and first["A_Car_Length"] == 81.2466
    parts = [DrivAerNetPlus(str(tmp_path), missing="leave out", split=s, meshes="") for s in ("train", "val", "test")]
    for part in parts[1:]:  # whose first design is no mesh
        assert "cannot be read" in refused(part)
    assert "4,165" in refused(dataclasses.replace(parts[0], split="all", missing="error"))


def test_the_published_tables_of_drivaerml(tmp_path):
    source = published("drivaerml")
    for file in source.glob("*.csv"):
        shutil.copy(file, tmp_path)
    for run in range(1, 501):
        (tmp_path / f"drivaer_{run}.stl").write_bytes(b"solid, but not looked at")
    car(tmp_path / "drivaer_1.stl")
    found = DrivAerML(str(tmp_path))()
    assert len(found) == 500 and found.names[0] == "run_1"
    units = {q.name: q.unit for q in found.space}
    assert len(units) == 16 and units.pop("Vehicle_Pitch") == "deg" and set(units.values()) == {"mm"}
    assert np.isfinite(found.labels).all(axis=1).sum() == 484
    np.testing.assert_allclose(found.labels[0, 0], 0.3109247)
    # a linear model explains 96 % of cd, as is known of these data: rows and runs belong together
    there = np.isfinite(found.labels[:, 0])
    columns = np.column_stack([np.ones(there.sum()), found.parameters[there]])
    cd = found.labels[there, 0]
    rest = cd - columns @ np.linalg.lstsq(columns, cd, rcond=None)[0]
    assert 1 - rest.var() / cd.var() == pytest.approx(0.96, abs=0.01)


# DrivAerML


def test_drivaerml_runs_without_forces_have_no_labels(caplog):
    source = DrivAerML.example()
    found = source()
    assert [str(q) for q in found.space] == ["Vehicle_Length [mm]", "Vehicle_Pitch [deg]"]
    np.testing.assert_array_equal(np.isnan(found.labels).all(axis=1), [False, False, True])
    assert [q.name for q in dataclasses.replace(source, labels="cl,cd")().label_space] == ["cl", "cd"]
    assert "reference: expected one of constant, own" in refused(dataclasses.replace(source, reference="none"))
    assert "force_mom_all.csv" in refused(dataclasses.replace(source, reference="own"))
    assert "no column 'drag'" in refused(dataclasses.replace(source, labels="drag"))


def test_drivaerml_runs_are_whole_numbers_of_their_own(tmp_path):
    folder = Path(DrivAerML.example().folder)
    shutil.copytree(folder, tmp_path / "a")
    table = tmp_path / "a" / "geo_parameters_all.csv"
    table.write_text(table.read_text().replace("\n2,", "\n1,"))
    assert "expected a run of its own in each row" in refused(DrivAerML(str(tmp_path / "a")))


# BlendedNet


def text_vtk(path: Path, mesh: trimesh.Trimesh, dataset: str = "POLYDATA") -> None:
    cells = "\n".join("3 " + " ".join(map(str, face)) for face in mesh.faces)
    count = len(mesh.faces)
    kind = "POLYGONS" if dataset == "POLYDATA" else "CELLS"
    types = "" if dataset == "POLYDATA" else f"CELL_TYPES {count}\n" + "5\n" * count
    path.write_text(
        f"# vtk DataFile Version 3.0\nsurface\nASCII\nDATASET {dataset}\nPOINTS {len(mesh.vertices)} double\n"
        + "\n".join(" ".join(map(repr, map(float, point))) for point in mesh.vertices)
        + f"\n{kind} {count} {4 * count}\n{cells}\n{types}POINT_DATA {len(mesh.vertices)}\n"
        + f"SCALARS cp float 1\nLOOKUP_TABLE default\n{'0 ' * len(mesh.vertices)}\n"
    )


@pytest.fixture
def aircraft(tmp_path):
    """Two geometries in each split; both splits count their cases from 0, and pad them differently."""
    for split, pad in (("train", 4), ("test", 3)):
        (tmp_path / split / "vtk").mkdir(parents=True)
        ini, lines = "", ["case_name geom_name alt_kft Re M_inf alpha_deg beta_deg CD CL Cmy"]
        for g in range(2):
            planform = "".join(
                f"{name} = {100 + g + i}\n" for i, name in enumerate(("B1", "B2", "B3", "C2", "C3", "C4"))
            )
            sweeps = "".join(f"{name} = {40 + g}\n" for name in ("S1", "S2", "S3"))
            ini += f"[geom_{g:04d}]\nC1 = 1000\n{planform}{sweeps}"
            for c in range(2 - g):
                number = f"{2 * g + c:0{pad}d}"
                lines.append(f"case_{number} geom_{g:04d} {10 + c} 1e7 0.3 {4 * c} 0.0 0.02 {0.1 + c + g} -0.05")
                body = trimesh.creation.box((1 + 0.1 * g + (split == "test"), 0.8, 0.1))
                text_vtk(tmp_path / split / "vtk" / f"case_{number}.vtk", body)
        (tmp_path / split / "geom_params.ini").write_text(ini)
        (tmp_path / split / "case_data.dat").write_text("#" + "\n".join(lines) + "\n")
    return tmp_path


def test_aircraft_by_geometry(aircraft):
    found = BlendedNet(str(aircraft))()
    assert found.names == ("train_geom_0000", "train_geom_0001", "test_geom_0000", "test_geom_0001")
    assert [str(q) for q in found.space] == [
        *(f"{name} [mm]" for name in ("B1", "B2", "B3", "C2", "C3", "C4")),
        *(f"{name} [deg]" for name in ("S1", "S2", "S3")),
    ]
    np.testing.assert_array_equal(found.parameters[1], [101, 102, 103, 104, 105, 106, 41, 41, 41])
    assert [q.name for q in found.label_space] == ["alt_kft", "Re_L", "M_inf", "alpha_deg", "CL", "CD", "CMy"]
    np.testing.assert_allclose(found.labels[1], [10, 1e7, 0.3, 0, 1.1, 0.02, -0.05])
    assert [mesh.extents[0] for mesh in found.meshes] == pytest.approx([1, 1.1, 2, 2.1])
    second = BlendedNet(str(aircraft), case=2)()
    np.testing.assert_allclose(second.labels[0], [11, 1e7, 0.3, 4, 1.1, 0.02, -0.05])
    assert np.isnan(second.labels[1]).all()


def test_aircraft_by_case(aircraft):
    found = BlendedNet(str(aircraft), each="case", split="train", labels="CD,CL")()
    assert found.names == ("train_case_0000", "train_case_0001", "train_case_0002")
    assert [q.name for q in found.space][9:] == ["alt_kft", "Re_L", "M_inf", "alpha_deg"]
    np.testing.assert_array_equal(found.parameters[1][9:], [11, 1e7, 0.3, 4])
    np.testing.assert_allclose(found.labels, [[0.02, 0.1], [0.02, 1.1], [0.02, 1.1]])


def test_one_mesh_of_a_geometry_is_enough(aircraft, caplog):
    (aircraft / "train" / "vtk" / "case_0000.vtk").unlink()
    assert len(BlendedNet(str(aircraft), each="case")()) == 6
    (aircraft / "train" / "vtk" / "case_0002.vtk").rename(aircraft / "train" / "vtk" / "case_0099.vtk")
    assert "missing are 1: train_geom_0001" in refused(BlendedNet(str(aircraft)))
    with caplog.at_level(logging.WARNING, "lampopt"):
        assert len(BlendedNet(str(aircraft), missing="leave out")()) == 3
    assert "left out (1: train/vtk/case_0099.vtk)" in caplog.text


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"split": "val"}, "split: expected one of train, test, all"),
        ({"each": "mesh"}, "each: expected one of geometry, case"),
        ({"case": 0}, "case: expected a whole number from 1"),
        ({"labels": "drag"}, "labels: no drag; known are alt_kft"),
        ({"unit": "mm"}, "unit='m' would fit"),
    ],
)
def test_options_of_aircraft_that_cannot_be(aircraft, options, said):
    assert said in refused(BlendedNet(str(aircraft), **options))


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("case_data.dat", "geom_0001", "geom_0009", "names geometries that geom_params.ini lacks (1: geom_0009)"),
        ("case_data.dat", " 10 1e7", " 1e7", "expected 10 cells in each row, not so in rows"),
        ("case_data.dat", "geom_name", "shape", "no column geom_name"),
        ("case_data.dat", "1e7", "fast", "expected numbers"),
        ("geom_params.ini", "B2 = 101", "", "expected a number of B2 in every row"),
        ("geom_params.ini", "[geom_0000]", "", "cannot be read"),
    ],
)
def test_tables_of_aircraft_that_cannot_be_used(aircraft, file, old, new, said):
    table = aircraft / "train" / file
    table.write_text(table.read_text().replace(old, new))
    assert said in refused(BlendedNet(str(aircraft), split="train"))


def test_one_split_is_enough_and_none_is_not(aircraft):
    shutil.rmtree(aircraft / "test")
    assert len(BlendedNet(str(aircraft))()) == 2
    (aircraft / "train" / "case_data.dat").unlink()
    assert "expected one file case_data.dat below train" in refused(BlendedNet(str(aircraft)))
    (aircraft / "train" / "geom_params.ini").unlink()
    assert "expected geom_params.ini and case_data.dat" in refused(BlendedNet(str(aircraft)))


# VTK


def binary_vtk(mesh: trimesh.Trimesh, version: float) -> bytes:
    """Polygons as ParaView writes them: big-endian, with METADATA; version 5 with offsets and connectivity."""
    head = (
        f"# vtk DataFile Version {version}\nvtk output\nBINARY\nDATASET POLYDATA\nFIELD FieldData 1\nTIME 1 1 double\n"
    )
    data = head.encode() + struct.pack(">d", 1.0) + f"\nPOINTS {len(mesh.vertices)} float\n".encode()
    data += mesh.vertices.astype(">f4").tobytes() + b"\nMETADATA\nINFORMATION 0\n\n"
    count = len(mesh.faces)
    if version < 5:
        data += f"POLYGONS {count} {4 * count}\n".encode()
        data += np.column_stack([np.full(count, 3), mesh.faces]).astype(">i4").tobytes()
    else:
        data += f"POLYGONS {count + 1} {3 * count}\nOFFSETS vtktypeint64\n".encode()
        data += (3 * np.arange(count + 1)).astype(">i8").tobytes() + b"\nCONNECTIVITY vtktypeint64\n"
        data += mesh.faces.astype(">i8").tobytes()
    return data + b"\nCELL_DATA 12\n"


@pytest.mark.parametrize("version", [3.0, 5.1])
def test_binary_vtk(tmp_path, version):
    body = trimesh.creation.icosphere(2)
    (tmp_path / "a.vtk").write_bytes(binary_vtk(body, version))
    found = load_vtk(tmp_path / "a.vtk")
    assert found.is_watertight
    assert found.volume == pytest.approx(body.volume, rel=1e-5)


@pytest.mark.parametrize("dataset", ["POLYDATA", "UNSTRUCTURED_GRID"])
def test_text_vtk(tmp_path, dataset):
    body = trimesh.creation.box((1, 2, 3))
    text_vtk(tmp_path / "a.vtk", body, dataset)
    found = load_vtk(tmp_path / "a.vtk")
    assert found.is_watertight and found.volume == pytest.approx(6)


def test_polygons_are_cut_into_triangles(tmp_path):
    points = "0 0 0 1 0 0 1 1 0 0 1 0 -0.5 0.5 0"
    (tmp_path / "a.vtk").write_text(
        f"# vtk DataFile Version 2.0\n\nASCII\nDATASET POLYDATA\nPOINTS 5 float\n{points}\nPOLYGONS 1 6\n5 0 1 2 3 4\n"
    )
    assert load_vtk(tmp_path / "a.vtk").area == pytest.approx(1.25)


def test_polygons_of_every_size_are_fans(tmp_path):
    """Regular polygons of 3 to 40 corners and one of 5,000, against their areas; points and lines are left out."""
    sizes = [*range(3, 41), 5000]
    turns = [2 * np.pi * np.arange(n) / n for n in sizes]
    points = np.concatenate([np.column_stack([3 * i + np.cos(t), np.sin(t), 0 * t]) for i, t in enumerate(turns)])
    first = np.cumsum([0, *sizes])
    cells = [[1, 0], [2, 0, 1], *([n, *range(a, a + n)] for n, a in zip(sizes, first, strict=False))]
    lines = "\n".join(" ".join(map(str, cell)) for cell in cells)
    (tmp_path / "a.vtk").write_text(
        f"# vtk DataFile Version 2.0\n\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {len(points)} double\n"
        + "\n".join(" ".join(map(repr, point)) for point in points.tolist())
        + f"\nCELLS {len(cells)} {sum(map(len, cells))}\n{lines}\nCELL_TYPES {len(cells)}\n1 3 {'7 ' * len(sizes)}\n"
    )
    found = load_vtk(tmp_path / "a.vtk")
    assert len(found.faces) == sum(sizes) - 2 * len(sizes)
    assert found.area == pytest.approx(sum(n / 2 * np.sin(2 * np.pi / n) for n in sizes))


HEAD = "# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\n"
VERSION_5 = "# vtk DataFile Version 5.1\n\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n0 0 0 1 0 0 1 1 0 0 1 0\n"


def test_offsets_of_version_5(tmp_path):
    """A triangle and a square; sections that are there but empty."""
    (tmp_path / "a.vtk").write_text(
        f"{VERSION_5}VERTICES 1 0\nOFFSETS vtktypeint64\n0\nCONNECTIVITY vtktypeint64\n"
        "POLYGONS 3 7\nOFFSETS vtktypeint64\n0 3 7\nCONNECTIVITY vtktypeint64\n0 1 2 0 1 2 3\n"
    )
    found = load_vtk(tmp_path / "a.vtk")
    assert len(found.faces) == 3 and found.area == pytest.approx(1.5)


@pytest.mark.parametrize("ends", ["1 3 7", "0 3 6", "0 8 7", "0 4 3 7", "0 -1 7", ""])
def test_offsets_that_are_none(tmp_path, ends):
    (tmp_path / "a.vtk").write_text(
        f"{VERSION_5}POLYGONS {len(ends.split())} 7\nOFFSETS vtktypeint64\n{ends}\n"
        "CONNECTIVITY vtktypeint64\n0 1 2 0 1 2 3\n"
    )
    with pytest.raises(InputError, match=r"a\.vtk: .*offsets of cells that rise from 0 to 7"):
        load_vtk(tmp_path / "a.vtk")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("solid a", "begins with '# vtk DataFile Version'"),
        ("# vtk DataFile Version 3.0\n\nXML\n", "expected ASCII or BINARY"),
        ("# vtk DataFile Version 3.0\n\nASCII\nDATASET STRUCTURED_GRID\n", "expected DATASET POLYDATA"),
        ("# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nPOINTS 3 float\n0 0 0\n", "cut short"),
        ("# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nPOINTS 99999999 float\n0\n", "promises"),
        (
            "# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nPOINTS 1 float\n0 0 0\n",
            "expected polygons, got none",
        ),
        (
            "# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nPOINTS 1 float\n0 0 0\nPOLYGONS 1 4\n3 0 1 2\n",
            "corners among its 1 points",
        ),
        ("# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nTRIANGLE_STRIPS 1 4\n", "section 'TRIANGLE_STRIPS'"),
        *(
            (
                f"{HEAD}POINTS 4 float\n{'0 ' * 12}\nPOLYGONS {cells}\n",
                "cells cut short or numbers left over",
            )
            for cells in ("2 8\n3 0 1 2 4 0 2 3", "1 8\n3 0 1 2 3 0 2 3", "3 8\n3 0 1 2 3 0 2 3", "1 4\n-3 0 1 2")
        ),
        (f"{VERSION_5}POLYGONS 2 3\nOFFSETS float\n0 3\nCONNECTIVITY vtktypeint64\n0 1 2\n", "expected whole numbers"),
        (
            f"{HEAD}POINTS 1 float\n0 0 {'0' * 999}\nPOLYGONS 1 4\n",
            "expected numbers below 64 characters",
        ),
        (
            "# vtk DataFile Version 3.0\n\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n0 0 0 1 0 0 0 1 0 0 0 1\n"
            "CELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n10\n",
            "cells of type [10]",
        ),
    ],
)
def test_vtk_that_cannot_be_read(tmp_path, text, said):
    (tmp_path / "a.vtk").write_text(text)
    with pytest.raises(InputError) as caught:
        load_vtk(tmp_path / "a.vtk")
    assert said in str(caught.value) and "a.vtk" in str(caught.value)
