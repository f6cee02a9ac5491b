"""A preview mixes the exemplars' own values: held against balls, and against a grid with every node mixed."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lampopt
from lampopt import Preview
from lampopt.errors import EmptyMesh, InputError, PluginError
from lampopt.plugins import Plugins
from lampopt.testing import shapes
from lampopt.types import Bank, Frame, Parameter, Spec


@dataclass(frozen=True)
class Thorn:
    """A ball with a thorn so steep and thin that no block's middle tells of it: it is found from where it begins."""

    bounds = np.array([[-1.0] * 3, [1.0] * 3])

    def prepare(self, meshes, *, mean, seed):
        return {}

    def fit(self, shared, meshes, *, seed, progress=None):
        return np.zeros((len(meshes), 2), np.float32), np.zeros(len(meshes))

    def evaluate(self, shared, weights, points):
        ball = np.linalg.norm(points, axis=1) - 0.2
        beside = 8 * (np.linalg.norm(points[:, 1:] - 0.016, axis=1) - 0.03)
        return np.minimum(ball, np.maximum(beside, np.maximum(points[:, 0] - 0.8, -points[:, 0])))[:, None]

    def decode(self, shared, weights, *, resolution):
        return shapes.box()

    def probes(self, shared, count, seed):
        return np.zeros((count, 3))


@dataclass(frozen=True)
class Balls:
    """Decoder: weights are a radius and a place along x; values |z − place| − radius are linear in the radius alone."""

    wide: float = 1.0
    channels: int = 1

    @property
    def bounds(self):
        return np.array([[-1.0] * 3, [1.0, self.wide, 1.0]])

    def prepare(self, meshes, *, mean, seed):
        return {}

    def fit(self, shared, meshes, *, seed, progress=None):
        weights = np.array([[mesh.extents[1] / 2, mesh.bounds.mean(0)[0]] for mesh in meshes], np.float32)
        return weights, np.zeros(len(meshes))

    def evaluate(self, shared, weights, points):
        apart = points - [1.0, 0.0, 0.0] * np.asarray(weights)[..., 1:, None]
        values = np.linalg.norm(apart, axis=-1) - np.asarray(weights)[..., :1]
        return np.repeat(values[..., None], self.channels, axis=-1)

    def decode(self, shared, weights, *, resolution):
        return shapes.box([weights[0]] * 3)

    def probes(self, shared, count, seed):
        return np.zeros((count, 3))


class Offer:
    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"balls": Balls, "thorn": Thorn}


PLUGINS = Plugins.load([("balls", Offer())])


def bank(weights, channels=1, decoder=None, scale=0.1):
    weights = np.asarray(weights, np.float32)
    return Bank(
        space=(Parameter("radius", "m"),),
        label_space=(),
        labels=np.empty((len(weights), 0)),
        names=tuple(f"ball_{k}" for k in range(len(weights))),
        parameters=weights[:, :1],
        decoder=decoder or Spec("balls"),
        shared={},
        weights=weights,
        probes=np.zeros((1, 3)),
        probe_values=np.zeros((len(weights), 1, channels)),
        fit_error=np.zeros(len(weights)),
        frame=Frame(scale, np.array([1.0, 2.0, 3.0]), "m"),
    )


@pytest.fixture(scope="module")
def balls():
    return Preview.of(bank([[0.2, 0.0], [0.5, 0.0]]), plugins=PLUGINS)


@pytest.mark.parametrize("radius", [0.1, 0.3, 0.5, 0.8])
def test_a_mix_of_balls_is_a_ball_in_the_users_unit(balls, radius):
    share = (radius - 0.2) / 0.3  # outside 0 to 1: extrapolated
    mesh = balls.mesh([1 - share, share])
    assert mesh.is_watertight
    away = np.linalg.norm(mesh.vertices - [1, 2, 3], axis=1)
    assert away == pytest.approx(radius / 0.1, abs=0.01 / 0.1)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * (radius / 0.1) ** 3, rel=0.07)


def dense(look, alpha):
    """All nodes mixed, in the blocks' order."""
    return look._values @ np.asarray(alpha, np.float32)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3))
def test_no_block_that_the_surface_reaches_is_left_out(looks, shares):
    alpha = np.append(shares, 1 - sum(shares))
    whole = dense(looks, alpha)
    grid = looks.grid(alpha)
    inner = (slice(1, -1),) * 3
    every = whole.reshape(*looks._blocks, 4, 4, 4).transpose(0, 3, 1, 4, 2, 5).reshape(grid.shape)
    np.testing.assert_array_equal((grid < 0)[inner], (every < 0)[inner])
    crossed = np.abs(every) < looks.pitch / 2
    np.testing.assert_allclose(grid[inner][crossed[inner]], every[inner][crossed[inner]], atol=1e-5)


@pytest.fixture(scope="module")
def looks():
    return Preview.of(bank([[0.2, 0.0], [0.5, 0.3], [0.1, -0.6], [0.4, 0.7]]), 32, plugins=PLUGINS)


def test_what_begins_where_the_surface_was_seen_is_followed_to_its_end():
    look = Preview.of(bank([[0.2, 0.0], [0.2, 0.0]], decoder=Spec("thorn"), scale=1.0), plugins=PLUGINS)
    alpha = np.array([0.5, 0.5])
    assert not look._reached(look._centres @ alpha.astype("f4")).reshape(look._blocks)[13:, 8, 8].all()
    mesh = look.mesh(alpha)
    assert mesh.is_watertight
    assert mesh.bounds[1, 0] - 1 == pytest.approx(0.8, abs=look.pitch)


def test_a_surface_that_reaches_the_box_is_closed_there(balls):
    mesh = balls.mesh([-2.0, 3.0])  # radius 1.1
    assert mesh.is_watertight
    assert (np.abs(mesh.vertices - [1, 2, 3]) <= 10 + 1e-6).all()


def test_boxes_need_not_be_cubes():
    look = Preview.of(bank([[0.4, 0.0], [0.6, 0.0]], decoder=Spec("balls", wide=0.3)), 33, plugins=PLUGINS)
    mesh = look.mesh([0.5, 0.5])
    assert mesh.is_watertight
    low, high = mesh.bounds
    assert low == pytest.approx([1 - 5, 2 - 5, 3 - 5], abs=0.1)
    assert high[1] == pytest.approx(2 + 3, abs=2 / 32 / 0.1)  # cut by the box


def test_progress_is_told():
    told = []
    Preview.of(bank([[0.2, 0.0], [0.5, 0.0]]), 8, plugins=PLUGINS, progress=lambda done, m="": told.append((done, m)))
    assert told == [(0.5, "ball_0"), (1.0, "ball_1")]


def test_what_cannot_be_shown_is_told(balls):
    with pytest.raises(EmptyMesh, match="no surface to show"):
        balls.mesh([2.0, -1.0])  # radius -0.1
    with pytest.raises(InputError, match=r"alpha: expected shape \(2,\), got \(3,\)"):
        balls.mesh([1.0, 0.0, 0.0])
    with pytest.raises(InputError, match="finite"):
        balls.mesh([np.nan, 1.0])
    for odd in ("ab", ["a", "b"], [1j, 1.0], [1e300, 0.0]):
        with pytest.raises(InputError, match="alpha: expected"):
            balls.mesh(odd)
    with pytest.raises(InputError, match=r"preview: expected a Bank, got 'boxes\.lamp'"):
        Preview.of("boxes.lamp")
    with pytest.raises(PluginError, match="decoder 'balls': evaluate: expected shape"):
        Preview.of(bank([[0.2, 0.0], [0.5, 0.0]], decoder=Spec("balls", channels=2)), plugins=PLUGINS)
    with pytest.raises(InputError, match="moves a template: its meshes take no longer"):
        Preview.of(bank([[0.2, 0.0], [0.5, 0.0]], channels=3), plugins=PLUGINS)
    with pytest.raises(InputError, match="resolution: expected at least 8 and at most 256"):
        Preview.of(bank([[0.2, 0.0], [0.5, 0.0]]), 4, plugins=PLUGINS)
