"""Space and vertices along with a design; exemplars met, and where not: against closed forms."""

import importlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh

import lampopt
from lampopt import cli
from lampopt.decode import decode
from lampopt.errors import InputError, PluginError
from lampopt.mix import mixed_weights
from lampopt.solve import pose, solve
from lampopt.testing import shapes
from lampopt.types import Exemplars, Parameter

sys.path.insert(0, str(Path(__file__).parent))
small = importlib.import_module("small")

SPEC = lampopt.Spec("mesh-template", faces=1500, cell=0.25, tolerance=0.0)
DESIGNS = np.array([[1.0, 0.6], [1.4, 0.6], [1.0, 0.9], [1.4, 0.9], [1.2, 0.75]])


def ellipsoid(axes):
    mesh = trimesh.creation.icosphere(3)
    return trimesh.Trimesh(mesh.vertices * [axes[0], axes[1], 0.5], mesh.faces, process=False)


@pytest.fixture(scope="module")
def exemplars():
    space = (Parameter("long", "m"), Parameter("wide", "m"))
    meshes = [ellipsoid(row) for row in DESIGNS]
    return Exemplars(DESIGNS, space, meshes, tuple(f"e{i}" for i in range(5)), unit="m", mesh_at=ellipsoid)


@pytest.fixture(scope="module")
def bank(exemplars, tmp_path_factory):
    return lampopt.build_bank(exemplars, SPEC, probes=500, store=tmp_path_factory.mktemp("b") / "e.lamp")


def asked(bank, long, wide):
    return lampopt.design(bank, {"long": long, "wide": wide}).design


def on_ellipsoid(points, long, wide):
    """How far (x/a)² + (y/b)² + (z/c)² is from 1, as a length."""
    return np.abs(np.linalg.norm(points / [long, wide, 0.5], axis=1) - 1)


def test_template_at_rest_is_the_start_of_warp(bank):
    design = asked(bank, 1.5, 0.7)
    rest = lampopt.template_of(bank)
    assert np.allclose(lampopt.warp(bank, design, rest.vertices), design.mesh.vertices, atol=1e-12)


def test_points_go_from_one_design_to_another_and_back(bank):
    one, other = asked(bank, 1.1, 0.65), asked(bank, 1.6, 0.95)
    points = trimesh.sample.sample_surface(ellipsoid([1.1, 0.65]), 400, seed=0)[0] * np.linspace(0.9, 1.1, 400)[:, None]
    there = lampopt.warp(bank, other, points, start=one)
    assert np.allclose(lampopt.warp(bank, one, there, start=other), points, atol=1e-7)
    on = lampopt.warp(bank, other, one.mesh.vertices, start=one)
    assert np.allclose(on, other.mesh.vertices, atol=1e-7)
    assert on_ellipsoid(on, 1.6, 0.95).mean() < 0.01


@pytest.mark.parametrize("wide", [0.3, 2.5])
def test_a_start_far_from_the_template_is_one_too(bank, wide):
    """Space stretched three times over in one direction, or shrunk: Newton finds where its points come from."""
    one, other = asked(bank, 3.5, wide), asked(bank, 1.2, 0.75)
    on = lampopt.warp(bank, other, one.mesh.vertices, start=one)
    assert np.allclose(on, other.mesh.vertices, atol=1e-7)
    around = one.mesh.vertices * np.linspace(0.7, 1.05, len(one.mesh.vertices))[:, None]
    there = lampopt.warp(bank, other, around, start=one)
    assert np.allclose(lampopt.warp(bank, one, there, start=other), around, atol=1e-6)


def test_points_far_from_a_start_are_found_by_shorter_steps(bank):
    """Where the motion dies away its slope misleads; whole steps of Newton's lose some of these points."""
    one, other = asked(bank, 1.85, 0.75), asked(bank, 1.2, 0.75)
    points = np.random.default_rng(0).uniform(-1.6, 1.6, (4000, 3)) * [1.85, 0.75, 0.5]
    there = lampopt.warp(bank, other, points, start=one)
    assert np.allclose(lampopt.warp(bank, one, there, start=other), points, atol=1e-6)


def test_far_points_stay(bank):
    far = np.array([[40.0, 0, 0], [0, -30.0, 5.0]])
    assert np.array_equal(lampopt.warp(bank, asked(bank, 1.6, 0.9), far), far)


def test_a_volume_mesh_keeps_its_cells(bank):
    """Tetrahedra of a grid of cubes in a box around the body: no volume changes its sign."""
    n = 12
    grid = np.stack(np.meshgrid(*[np.linspace(-3, 3, n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    corner = np.arange(n**3).reshape(n, n, n)[:-1, :-1, :-1].ravel()
    x, y, z = n * n, n, 1
    tetrahedra = np.concatenate(
        [np.stack([corner, corner + a, corner + a + b, corner + x + y + z], 1) for a, b in ((x, y), (y, z), (z, x))]
    )

    def volumes(points):
        a, b, c, d = points[tetrahedra].transpose(1, 0, 2)
        return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)

    moved = lampopt.warp(bank, asked(bank, 1.6, 1.0), grid)
    assert (volumes(moved) / volumes(grid) > 0.1).all()


def test_wrong_points_and_decoders_are_refused(bank, exemplars):
    design = asked(bank, 1.2, 0.7)
    with pytest.raises(InputError, match=r"shape \(M, 3\)"):
        lampopt.warp(bank, design, np.zeros((3, 2)))
    with pytest.raises(InputError, match="finite numbers, got others in 2 rows"):
        lampopt.warp(bank, design, np.array([[0.0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0]]))
    for points in ([["a", "b", "c"]], [[1.0], [1.0, 2.0]], design.mesh):
        with pytest.raises(InputError, match="points: expected"):
            lampopt.warp(bank, design, points)
    result = lampopt.design(bank, {"long": 1.2}, level="alpha")
    for what, given in (("design", (result, None)), ("start", (design, result))):
        with pytest.raises(InputError, match=f"{what}: expected a Design, such as result.design, got Result"):
            lampopt.warp(bank, given[0], np.zeros((1, 3)), start=given[1])
    with pytest.raises(InputError, match="expected a Design"):
        lampopt.sensitivities(bank, result)
    with pytest.raises(InputError, match="names: expected a list"):
        lampopt.sensitivities(bank, design, "long")
    grid = lampopt.build_bank(exemplars, lampopt.Spec("gridsdf", size=12), probes=50)
    made = lampopt.design(grid, {"long": 1.2}, level="alpha").design
    with pytest.raises(PluginError, match="'gridsdf': cannot displace"):
        lampopt.warp(grid, made, np.zeros((1, 3)))
    with pytest.raises(PluginError, match="'gridsdf'"):
        lampopt.template_of(grid)
    with pytest.raises(PluginError, match="another triangulation"):
        lampopt.sensitivities(grid, made)


def test_a_start_that_folds_space_is_refused(bank):
    design = asked(bank, 1.2, 0.7)
    folded = lampopt.design(bank, {"long": 0.0, "wide": 0.7}, level="alpha").design  # flat: all comes to lie in a plane
    with pytest.raises(InputError, match="start"):
        lampopt.warp(bank, design, lampopt.template_of(bank).vertices, start=folded)


def test_sensitivities_are_the_closed_form(bank):
    """A point (x, y, z) of an ellipsoid goes by x / long when it is stretched: its motion across the surface."""
    design = asked(bank, 1.3, 0.8)
    found = lampopt.sensitivities(bank, design)
    assert found.names == ("long", "wide")
    assert found.units == ("m", "m")
    points = design.mesh.vertices
    assert found.motion.shape == (2, *points.shape)
    normals = points / np.array([1.3, 0.8, 0.5]) ** 2
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    for k, (name, size) in enumerate((("long", 1.3), ("wide", 0.8))):
        true = normals[:, k] * points[:, k] / size
        across = (found.of(name) * normals).sum(1)
        assert np.abs(across - true).mean() < 0.02 * np.abs(true).mean()


def test_sensitivities_are_differences_of_designs(bank):
    found = lampopt.sensitivities(bank, asked(bank, 1.3, 0.8), ["wide"])
    step = np.asarray(asked(bank, 1.3, 0.83).mesh.vertices) - np.asarray(asked(bank, 1.3, 0.8).mesh.vertices)
    assert np.allclose(found.motion[0], step / 0.03, atol=1e-4)


def test_pictures_are_written(bank, tmp_path):
    found = lampopt.sensitivities(bank, asked(bank, 1.3, 0.8), ["long"])
    found.picture("long", tmp_path / "long.png", width=120)
    from PIL import Image

    with Image.open(tmp_path / "long.png") as image:
        assert image.width == 120
        seen = np.asarray(image.convert("RGB"), int)
    red, blue = seen[..., 0] - seen[..., 2] > 60, seen[..., 2] - seen[..., 0] > 60
    assert red.sum() > 100  # the ends come out
    assert not blue.any()
    with pytest.raises(InputError, match="expected one of long"):
        found.of("wide")
    with pytest.raises(InputError, match="expected one of long"):
        found.picture("wide", tmp_path / "wide.png")
    with pytest.raises(InputError, match="cannot be written"):
        found.picture("long", tmp_path / "no" / "long.png", width=120)


def test_unknown_parameters_are_named(bank):
    with pytest.raises(InputError, match="'roof': expected some of long, wide"):
        lampopt.sensitivities(bank, asked(bank, 1.3, 0.8), ["roof"])


def test_residuals_are_distances(bank, exemplars):
    found = lampopt.residuals(bank, exemplars)
    assert [one.name for one in found] == list(bank.names)
    for one, mesh in zip(found, exemplars.meshes, strict=True):
        assert 0 < one.there <= one.worst < 0.03
        assert one.p99 <= one.worst
        assert one.flipped == 0
        assert trimesh.proximity.closest_point(mesh, [one.where])[1][0] <= one.worst + 1e-9


def test_residuals_see_a_dent_and_where_it_is(bank, exemplars):
    meshes = list(exemplars.meshes)
    bumped = meshes[2].copy()
    top = int(bumped.vertices[:, 2].argmax())
    bumped.vertices[top] += [0, 0, 0.4]
    meshes[2] = bumped
    other = Exemplars(DESIGNS, exemplars.space, meshes, exemplars.names, unit="m")
    found = lampopt.residuals(bank, other)[2]
    assert found.worst > 0.2
    assert np.linalg.norm(found.where - bumped.vertices[top]) < 0.2


def test_residuals_are_of_what_was_mended(bank, exemplars):
    """A mesh that is inside out was turned when the bank was built."""
    meshes = [mesh.copy() for mesh in exemplars.meshes]
    meshes[1].invert()
    given = Exemplars(DESIGNS, exemplars.space, meshes, exemplars.names, unit="m")
    found, straight = lampopt.residuals(bank, given)[1], lampopt.residuals(bank, exemplars)[1]
    assert (found.flipped, found.worst) == (0, straight.worst)


def test_residuals_refuse_other_exemplars(bank, exemplars):
    with pytest.raises(InputError, match="got other parameters"):
        lampopt.residuals(bank, Exemplars(DESIGNS + 0.1, exemplars.space, exemplars.meshes, exemplars.names, unit="m"))
    others = Exemplars(DESIGNS, exemplars.space, exemplars.meshes, tuple("abcde"), unit="m")
    with pytest.raises(InputError, match="e0"):
        lampopt.residuals(bank, others)
    with pytest.raises(InputError, match="in 'm', got 'mm'"):
        lampopt.residuals(bank, Exemplars(DESIGNS, exemplars.space, exemplars.meshes, exemplars.names, unit="mm"))


def test_the_command_line_writes_motion(bank, tmp_path, capsys):
    out = tmp_path / "moved"
    assert cli.main(["sensitivities", str(bank.path), "--target", "long=1300 mm", "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in document["parameters"]] == ["long", "wide"]
    assert {path.name for path in Path(out).iterdir()} == {"motion.npz", "long.png", "wide.png"}
    with np.load(out / "motion.npz") as held:
        assert held["motion_0"].shape == held["vertices"].shape
    assert cli.main(["sensitivities", str(bank.path), "--json"]) == 2
    assert "--target" in json.loads(capsys.readouterr().out)["error"]["message"]


def test_who_cannot_hold_the_others_says_so(exemplars, caplog):
    """Two exemplars, whose only mixes are longer and wider at once."""
    axes = DESIGNS[[0, 3]]
    few = Exemplars(axes, exemplars.space, [ellipsoid(row) for row in axes], ("a", "b"), unit="m", mesh_at=ellipsoid)
    bank = lampopt.build_bank(few, SPEC, probes=500)
    lampopt.sensitivities(bank, lampopt.run(lampopt.Study(bank)).design)
    assert "no mix of these exemplars changes long alone: " in caplog.text


def test_where_they_can_be_held_nothing_is_said(bank, caplog):
    lampopt.sensitivities(bank, asked(bank, 1.5, 0.7))
    assert "alone" not in caplog.text


def test_sensitivities_are_about_the_designs_own_mix(exemplars):
    """A decoder that is not linear moves otherwise about another mix with the same parameters."""

    @dataclass(frozen=True)
    class Bent(small.Stretch):
        def decode(self, shared, weights, *, resolution):
            return shapes.box(np.asarray(weights[:3], float) ** 2, centre=np.asarray(weights[3:], float))

        def fit(self, shared, meshes, *, seed, progress=None):
            extents, errors = super().fit(shared, meshes, seed=seed)
            extents[:, :3] = np.sqrt(extents[:, :3]) * (1 + 0.1 * np.cos(np.arange(len(meshes)))[:, None])
            return extents, errors

    class Offer:
        @lampopt.hookimpl
        def lampopt_decoders(self):
            return {"bent": Bent}

    plugins = small.plugins(("bent", Offer()))
    bank = small.bank(decoder="bent", batch=7, plugins=plugins)
    asked = lampopt.Study(bank, {"length": 2.5, "width": 1.2}, reference="box_5", level="alpha")
    design = lampopt.run(asked, plugins=plugins).design
    found = lampopt.sensitivities(bank, design, ["length"], plugins=plugins)
    decoder, kkt = plugins.make("decoder", "bent"), plugins.make("solver", "kkt")
    more, less = (solve(pose(bank, {"length": 2.5 + sign * 0.01, "width": 1.2}), kkt).alpha for sign in (1, -1))
    ahead, behind = (
        decode(bank, decoder, mixed_weights(bank, design.mix.alpha + sign * (more - less) / 2)).vertices
        for sign in (1, -1)
    )
    np.testing.assert_allclose(found.motion[0], (ahead - behind) / 0.02, atol=1e-3)
