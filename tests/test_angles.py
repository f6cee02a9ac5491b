"""What angles do to a mix: against wedges whose true surface is known at any angle."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import lampopt
from lampopt.angles import deviations
from lampopt.check import DEFAULTS
from lampopt.types import Exemplars, Parameter

sys.path[:0] = [p for p in (str(Path(__file__).parent),) if p not in sys.path]
import small  # noqa: E402

ANGLES = np.linspace(-12.0, 12.0, 7)  # [deg]
LENGTHS = np.array([2.0, 2.4, 2.2, 2.6, 2.1, 2.5, 2.3])


def leaning(length, degrees):
    """A block whose top is pushed along by the tangent of an angle."""
    mesh = trimesh.creation.box([length, 1.0, 1.0]).subdivide()
    mesh.vertices = mesh.vertices + np.tan(np.radians(degrees)) * mesh.vertices[:, 2:] * [1, 0, 0]
    return mesh


@dataclass(frozen=True)
class Vertices:
    """Decoder: the weights are the mesh's vertices, which all shapes share in their order."""

    @property
    def bounds(self):
        return np.array([[-1.0] * 3, [1.0] * 3])

    def prepare(self, meshes, *, mean, seed):
        return {"faces": np.asarray(mean.faces)}

    def fit(self, shared, meshes, *, seed, progress=None):
        return np.array([m.vertices.ravel() for m in meshes], "f4"), np.zeros(len(meshes))

    def evaluate(self, shared, weights, points):
        return np.broadcast_to(weights.reshape(*weights.shape[:-1], -1, 3), (*weights.shape[:-1], len(points), 3))

    def decode(self, shared, weights, *, resolution):
        return trimesh.Trimesh(weights.reshape(-1, 3), shared["faces"], process=False)

    def probes(self, shared, count, seed):
        return np.zeros((26, 3))


class Moved(Vertices):
    """The same, and it says that its values are places."""

    def displace(self, shared, weights, points):
        return points


class Plugin:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"vertices": Vertices, "moved": Moved}


PLUGINS = small.plugins(("vertices", Plugin()))


def bank(decoder="moved", unit="deg", angles=ANGLES, made=lambda a: a, count=7):
    shapes = [leaning(*row) for row in zip(LENGTHS, made(angles), strict=True)][:count]
    space = (Parameter("length", "m"), Parameter("lean", unit))
    source = Exemplars(np.column_stack([LENGTHS, angles])[:count], space, shapes, tuple("abcdefg")[:count], unit="m")
    return lampopt.build_bank(source, decoder, probes=26, plugins=PLUGINS)


def asked(bank, **targets):
    return lampopt.design(bank, targets, plugins=PLUGINS, limits={"alpha": 1e9, "angles": 1e9})


@pytest.mark.parametrize("middle", [0.0, 30.0, -45.0])
@pytest.mark.parametrize("degrees", [-50.0, -24.0, 30.0, 60.0])
def test_it_foretells_how_far_a_shear_is_off(middle, degrees):
    """Also about a slope that exemplars have already, where the tangent is steeper."""
    cars = bank(angles=ANGLES + middle)
    result = asked(cars, length=2.3, lean=degrees)
    true = leaning(2.3, degrees)
    off = np.linalg.norm(result.design.mesh.vertices - true.vertices, axis=1).mean() * cars.frame.scale
    found = result.check("angles")
    assert (found.unit, found.needs) == ("box", "field")
    assert found.value == pytest.approx(off, rel=1e-3, abs=1e-6)


def test_within_reach_of_exemplars_it_is_small_and_at_them_nothing():
    cars = bank()
    assert asked(cars, length=2.3, lean=5.0).check("angles").value < 2e-4
    assert np.allclose(deviations(cars, Moved(), np.eye(7)), 0, atol=1e-12)


def test_lengths_are_no_angles_however_far():
    assert asked(bank(), length=9.0, lean=0.0).check("angles").value < 1e-3
    cars = bank(unit="m")
    assert "angles" not in [check.name for check in asked(cars, length=9.0, lean=0.0).checks]


@pytest.mark.parametrize(("unit", "scale"), [("rad", np.pi / 180), ("mrad", 1000 * np.pi / 180), ("degrees", 1.0)])
def test_units_of_angles_agree(unit, scale):
    other = bank(unit=unit, angles=scale * ANGLES, made=lambda a: a / scale)
    alpha = np.array([-2.0, 0, 0, 0, 0, 0, 3.0])
    assert deviations(other, Moved(), alpha) == pytest.approx(deviations(bank(), Moved(), alpha), rel=1e-9)


def test_turns_have_no_law():
    assert np.isnan(deviations(bank(angles=6 * ANGLES, made=lambda a: a / 6), Moved(), np.eye(7))).all()


def test_beyond_the_vertical_it_stays_finite_and_large():
    cars = bank()
    found = [asked(cars, length=2.3, lean=a).check("angles").value for a in (60.0, 84.9, 120.0, 650.0, 1e6)]
    assert (np.diff(found) > -1e-2 * found[1]).all()
    assert 1 < found[-1] < 100


def test_few_exemplars_share_the_motion_between_causes():
    """Two of them, longer and leaning at once: each may have done half of it, in parts of its range."""
    two = bank(count=2)
    result = asked(two, lean=60.0)
    true = np.tan(np.radians(60.0)) - result.design.mix.alpha @ np.tan(np.radians(ANGLES[:2]))
    motion = np.linalg.norm(two.probe_values[1] - two.probe_values[0], axis=-1).mean()
    assert result.check("angles").value == pytest.approx(
        abs(true) * motion / 2 / np.ptp(np.tan(np.radians(ANGLES[:2]))), rel=1e-4
    )


def test_values_that_are_no_places_are_not_judged():
    assert np.isnan(deviations(bank("vertices"), Vertices(), np.eye(7))).all()


def test_signed_distances_move_as_the_surface_does():
    """Values of a plane of slope θ through points on it: z − x tan θ, near enough a distance."""
    cars = bank()
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))
    values = points[:, 2] - points[:, 0] * np.tan(np.radians(ANGLES))[:, None]
    flat = replace(cars, probes=points, probe_values=values[..., None].astype("f4"))
    alpha = np.array([-3.0, 0, 0, 0, 0, 0, 4.0])
    angle = alpha @ ANGLES
    near = (np.abs(values) <= 0.05).any(0)
    off = np.abs(alpha @ values - (points[:, 2] - points[:, 0] * np.tan(np.radians(angle))))[near].mean()
    assert deviations(flat, Vertices(), alpha) == pytest.approx(off, rel=1e-3)
    far = replace(flat, probe_values=flat.probe_values + np.float32(10))
    assert np.isnan(deviations(far, Vertices(), alpha))


def test_calibration_takes_the_tolerance_for_its_limit():
    """The check foretells the error: its limit is what the user allows, or what a good design shows."""
    cars = bank()
    made = lampopt.calibrate(cars, "5 mm", plugins=PLUGINS)
    assert made.limits["angles"] == pytest.approx(0.005 * cars.frame.scale)
    assert made.limits["angles"] < DEFAULTS["angles"]
    strict = lampopt.calibrate(cars, "1 mm", plugins=PLUGINS)
    evidence = strict.calibration
    shown = evidence.values[evidence.good, evidence.checks.index("angles")].max()
    assert shown > 0.001 * cars.frame.scale
    assert strict.limits["angles"] == pytest.approx(shown)
    result = lampopt.design(made, {"length": 2.3, "lean": 40.0}, plugins=PLUGINS, limits={"alpha": 1e9})
    assert not result.accepted
    assert "angles" in [check.name for check in result.checks if not check.passed]


def test_the_volume_of_extrapolation_counts_it():
    found = lampopt.extrapolation_volume(bank(), 4.0, 300, limits={"alpha": 1e9, "angles": 0.01}, plugins=PLUGINS)
    assert found.rejected["angles"] > 0
    assert 0 < found.share < 1
