"""Decoder `gridsdf`: the weights are signed distances at the nodes of a grid. Exactly linear in them: every mix has
mismatch 0, which alone does not make a shape good."""

from dataclasses import dataclass

import numpy as np

from lampopt import hookimpl
from lampopt.decode import field_to_mesh
from lampopt.errors import FitError, InputError


@dataclass(frozen=True)
class GridSDF:
    """`size` nodes along each side of the box [-1, 1]³; D = size³."""

    size: int = 48

    @property
    def bounds(self):
        return np.array([[-1.0] * 3, [1.0] * 3])

    def prepare(self, meshes, *, mean, seed):
        if not 2 <= self.size <= 512:
            raise InputError(f"size: expected 2 to 512 nodes along a side, got {self.size}")
        return {}  # nothing is learned, so nothing is shared

    def fit(self, shared, meshes, *, seed, progress=None):
        import igl

        nodes = np.stack(np.meshgrid(*[np.linspace(-1, 1, self.size)] * 3, indexing="ij"), -1).reshape(-1, 3)
        weights, error = np.empty((len(meshes), len(nodes)), np.float32), np.zeros(len(meshes))
        for i, mesh in enumerate(meshes):
            if len(mesh.faces) == 0:
                raise FitError(f"mesh {i}: expected a surface, got a mesh without faces")
            corners, kind = np.asarray(mesh.vertices), igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
            scaled, _, near, _ = igl.signed_distance(nodes, corners, np.asarray(mesh.faces), sign_type=kind)
            weights[i] = np.copysign(np.linalg.norm(nodes - near, axis=1), scaled)
            error[i] = np.abs(self.evaluate(shared, weights[i], corners)).mean()
        return weights, error

    def evaluate(self, shared, weights, points):
        from scipy.interpolate import RegularGridInterpolator

        if weights.shape[-1] != self.size**3:
            raise InputError(f"weights: expected {self.size**3} (size {self.size}), got {weights.shape[-1]}")
        axes, grid = [np.linspace(-1, 1, self.size)] * 3, np.moveaxis(weights.reshape(-1, *[self.size] * 3), 0, -1)
        field = RegularGridInterpolator(axes, grid, bounds_error=False, fill_value=None)
        return field(points).T.reshape(*weights.shape[:-1], len(points), 1)

    def decode(self, shared, weights, *, resolution):
        return field_to_mesh(lambda points: self.evaluate(shared, weights, points)[:, 0], self.bounds, resolution)

    def probes(self, shared, count, seed):
        return np.random.default_rng(seed).uniform(-1, 1, (count, 3))


@hookimpl
def lampopt_decoders():
    return {"gridsdf": GridSDF}
