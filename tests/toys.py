"""The smallest plugins that keep every promise; tests/test_kit.py breaks them one promise at a time."""

import json
from dataclasses import dataclass, replace

import numpy as np

import lampopt
from lampopt.errors import EmptyMesh, FitError, InputError, MeasureError, SolveError
from lampopt.testing import shapes
from lampopt.types import Check, Conflict, Exemplars, Mix, MixBatch, Parameter


@dataclass(frozen=True)
class Radial:
    """Decoder that moves a template: weights are how far its vertices go along rays from the middle (C = 3)."""

    divisions: int = 4

    @property
    def bounds(self):
        return np.array([[-1.0] * 3, [1.0] * 3])

    def prepare(self, meshes, *, mean, seed):
        from trimesh import creation

        sphere = creation.icosphere(subdivisions=self.divisions)
        rays = np.asarray(sphere.vertices)
        return {"rays": rays, "faces": np.asarray(sphere.faces), "start": _radii(mean, rays)}

    def fit(self, shared, meshes, *, seed, progress=None):
        if any(len(mesh.faces) == 0 for mesh in meshes):
            raise FitError("expected meshes with faces, got one without")
        radii = np.stack([_radii(mesh, shared["rays"]) for mesh in meshes])
        if progress:
            progress(1.0, "done")
        return (radii - shared["start"]).astype(np.float32), np.zeros(len(meshes))

    def evaluate(self, shared, weights, points):
        if weights.shape[-1] != len(shared["rays"]):
            raise InputError(f"weights: expected {len(shared['rays'])}, got {weights.shape[-1]}")
        template = shared["rays"] * shared["start"][:, None]
        nearest = ((points[:, None] - template) ** 2).sum(-1).argmin(1)
        return points + weights[..., nearest, None] * shared["rays"][nearest]

    def decode(self, shared, weights, *, resolution):
        from trimesh import Trimesh

        self.evaluate(shared, weights, shared["rays"][:1])
        return Trimesh(shared["rays"] * (shared["start"] + weights)[:, None], shared["faces"], process=False)

    def probes(self, shared, count, seed):
        chosen = np.random.default_rng(seed).integers(len(shared["rays"]), size=count)
        return (shared["rays"] * shared["start"][:, None])[chosen]


def _radii(mesh, rays):
    """Where rays from the origin leave a convex mesh."""
    distance = (mesh.face_normals * mesh.triangles_center).sum(1)
    slope = np.maximum(rays @ mesh.face_normals.T, 1e-9)
    return (distance / slope).min(1)


@dataclass(frozen=True)
class KKT:
    """Solver in closed form: rows, hard rows and ridge."""

    ridge: float = 1e-9

    def solve(self, p):
        for ability, asked in {
            "ranges": len(p.range_names),
            "bounds": p.alpha_low is not None or p.alpha_high is not None,
            "objectives": len(p.objectives),
            "constraints": len(p.constraints),
            "equalities": len(p.equalities),
            "norm 1": p.norm == 1,
        }.items():
            if asked:
                raise SolveError(f"toy solver: {ability} are beyond it")
        ridge = self.ridge if p.ridge is None else p.ridge
        exact = np.vstack([np.ones(len(p.centre)), p.matrix[p.hard]])
        alpha = p.centre + np.linalg.pinv(exact) @ (np.append(1.0, p.target[p.hard]) - exact @ p.centre)
        alpha += (1 - alpha.sum()) / len(alpha)
        free = np.eye(len(alpha)) - np.linalg.pinv(exact) @ exact
        root = np.sqrt(p.weight)[:, None] * ~p.hard[:, None]
        rows = np.vstack([root * p.matrix @ free, np.sqrt(ridge) * free])
        gap = np.concatenate([root[:, 0] * (p.target - p.matrix @ alpha), np.sqrt(ridge) * (p.centre - alpha)])
        alpha = alpha + np.linalg.pinv(rows) @ gap
        residual = p.matrix @ alpha - p.target
        if not len(p.names) or np.abs(residual).max() < 1e-8:
            return Mix(alpha, residual, "exact")
        rows = np.vstack([np.ones(len(alpha)), p.matrix])
        short = rows @ np.linalg.pinv(rows) @ np.append(1.0, p.target) - np.append(1.0, p.target)
        rows = np.flatnonzero(np.abs(short[1:]) > 1e-8)
        if not len(rows):
            return Mix(alpha, residual, "inexact")
        return Mix(alpha, residual, "infeasible", "", (Conflict(tuple(p.names[i] for i in rows), short[1:][rows]),))

    def solve_many(self, p, targets, ridges=None):
        from dataclasses import replace

        each = [p.ridge] * len(targets) if ridges is None else ridges
        mixes = [self.solve(replace(p, target=t, ridge=r)) for t, r in zip(targets, each, strict=True)]
        arrays = (np.stack([getattr(m, name) for m in mixes]) for name in ("alpha", "residual"))
        return MixBatch(*arrays, tuple(m.status for m in mixes))


@dataclass(frozen=True)
class Size:
    """Measure with a gradient: length, the enclosed volume, the share of the bounding box that it takes."""

    names = ("length", "volume", "fill")
    units = ("L", "L^3", "")

    def __call__(self, mesh):
        if len(mesh.faces) == 0:
            raise EmptyMesh("expected a mesh with faces, got one without")
        vertices = np.asarray(mesh.vertices, float)
        length, volume = np.ptp(vertices[:, 0]), _corners(mesh)[0]
        return np.array([length, volume, volume / np.ptp(vertices, axis=0).prod()])

    def interval(self, mesh, level):
        return self(mesh)[:, None] * (1 + level * np.array([-0.1, 0.1]))

    def outside(self, mesh):
        return False


@dataclass(frozen=True)
class Volume:
    """Measure with its derivatives by vertices."""

    names = ("volume",)
    units = ("L^3",)

    def __call__(self, mesh):
        if len(mesh.faces) == 0:
            raise MeasureError("expected a mesh with faces, got one without")
        return _corners(mesh)[:1]

    def gradient(self, mesh):
        a, b, c = np.asarray(mesh.triangles).transpose(1, 0, 2)
        total = np.zeros((1, len(mesh.vertices), 3))
        for k, part in enumerate((np.cross(b, c), np.cross(c, a), np.cross(a, b))):
            np.add.at(total[0], mesh.faces[:, k], part / 6)
        return total


def _corners(mesh):
    a, b, c = np.asarray(mesh.triangles, float).transpose(1, 0, 2)
    return np.array([(a * np.cross(b, c)).sum() / 6])


@dataclass(frozen=True)
class Linear:
    """Surrogate: least squares on the bounding box."""

    ridge: float = 1e-9

    def fit(self, meshes, values, names, units, *, seed):
        inputs = np.column_stack([[m.extents for m in meshes], np.ones(len(meshes))])
        system = inputs.T @ inputs + self.ridge * np.eye(4)
        return Learned(np.linalg.solve(system, inputs.T @ values), tuple(names), tuple(units))


@dataclass(frozen=True, eq=False)
class Learned:
    matrix: np.ndarray
    names: tuple
    units: tuple

    def __call__(self, mesh):
        if len(mesh.faces) == 0:
            raise EmptyMesh("expected a mesh with faces, got one without")
        return np.append(mesh.extents, 1.0) @ self.matrix

    def state(self):
        return {"matrix": self.matrix, "said": np.frombuffer(json.dumps([self.names, self.units]).encode(), np.uint8)}

    @classmethod
    def from_state(cls, state):
        return cls(state["matrix"], *map(tuple, json.loads(state["said"].tobytes())))


@dataclass(frozen=True)
class Drag:
    """Model: a polynomial of two parameters."""

    factor: float = 0.5
    names = ("drag", "lift")
    units = ("N", "")
    inputs = ("speed", "area")

    def __call__(self, parameters):
        speed, area = np.asarray(parameters).T
        return np.stack([self.factor * area * speed**2, area - speed], 1)

    def gradient(self, parameters):
        speed, area = np.asarray(parameters).T
        one = np.ones_like(area)
        drag = np.stack([2 * self.factor * area * speed, self.factor * speed**2], 1)
        return np.stack([drag, np.stack([-one, one], 1)], 1)


@dataclass(frozen=True)
class Roughly(Drag):
    """The same, known to some tenths and for speeds below 2."""

    def interval(self, parameters, level):
        values = self(parameters)
        return np.stack([values - level / 2, values + level / 2], axis=2)

    def outside(self, parameters):
        return np.asarray(parameters)[:, 0] > 2


@dataclass(frozen=True)
class Boxes:
    """Source of boxes of given length and width."""

    count: int = 5
    seed: int = 0

    def __call__(self):
        parameters = np.random.default_rng(self.seed).uniform([0.6, 0.3], [1.4, 0.6], (self.count, 2))
        space = (Parameter("length", "m"), Parameter("width", "m"))
        names = tuple(f"box_{i}" for i in range(self.count))
        return Exemplars(parameters, space, self.meshes(parameters), names, mesh_at=self.mesh_at)

    def meshes(self, parameters):
        return [self.mesh_at(row) for row in parameters]

    def mesh_at(self, row):
        return shapes.box([*row, 0.4])


@dataclass(frozen=True)
class Nothing:
    """Checker without evidence."""

    needs = "alpha"

    def __call__(self, bank, design):
        return ()


@dataclass(frozen=True)
class Slender:
    """Checker of proportions."""

    most: float = 4.0
    needs = "mesh"

    def __call__(self, bank, design):
        longest, shortest = max(design.mesh.extents), min(design.mesh.extents)
        return [Check("slenderness", longest / shortest, "<=", self.most, "", self.needs)]


@dataclass(frozen=True)
class Priced:
    """Checker for banks whose exemplars have a price."""

    needs = "alpha"

    def __call__(self, bank, design):
        prices = bank.labels[:, [label.name for label in bank.label_space].index("price")]
        return [Check("price", float(design.mix.alpha @ prices), "info", None, "", "alpha")]

    @staticmethod
    def example_design():
        priced = replace(Boxes()(), labels=np.arange(5.0)[:, None], label_space=(Parameter("price"),))
        bank = lampopt.build_bank(priced, "vertex-template")
        return bank, lampopt.run(lampopt.Study(bank, {"length": 1.0})).design


@dataclass(frozen=True)
class Able(KKT):
    """Solver that takes everything, with SciPy's SLSQP; norm 1 by parts up and down from the centre."""

    def solve(self, p):
        from scipy.optimize import LinearConstraint, NonlinearConstraint, minimize

        bounded = p.alpha_low is not None or p.alpha_high is not None
        special = [p.range_names, p.objectives, p.constraints, p.equalities, p.norm == 1, bounded]
        if not any(special):
            return super().solve(p)
        n = len(p.centre)
        parts = np.hstack([np.eye(n), -np.eye(n)]) if p.norm == 1 else np.eye(n)
        soft = ~p.hard

        def cost(x):
            alpha = p.centre + parts @ x
            misses = p.weight[soft] @ (p.matrix[soft] @ alpha - p.target[soft]) ** 2
            distance = x.sum() if p.norm == 1 else x @ x
            return misses + p.ridge * distance + sum(f(alpha)[0] for f in p.objectives)

        exact = np.vstack([np.ones(n), p.matrix[p.hard]])
        value = np.append(1.0, p.target[p.hard]) - exact @ p.centre
        kept = [LinearConstraint(exact @ parts, value, value)]
        if p.range_names:
            shift = p.range_matrix @ p.centre
            kept.append(LinearConstraint(p.range_matrix @ parts, p.range_low - shift, p.range_high - shift))
        if bounded:
            ends = [
                np.full(n, end) if one is None else one for one, end in ((p.alpha_low, -np.inf), (p.alpha_high, np.inf))
            ]
            kept.append(LinearConstraint(parts, ends[0] - p.centre, ends[1] - p.centre))
        kept += [NonlinearConstraint(lambda x, g=g: g(p.centre + parts @ x)[0], 0, 0) for g in p.equalities]
        kept += [NonlinearConstraint(lambda x, g=g: g(p.centre + parts @ x)[0], -np.inf, 0) for g in p.constraints]
        low = 0 if p.norm == 1 else -np.inf
        found = minimize(
            cost, np.zeros(parts.shape[1]), method="SLSQP", constraints=kept,
            bounds=[(low, None)] * parts.shape[1], options={"ftol": 1e-14},
        )  # fmt: skip
        alpha = p.centre + parts @ found.x
        return Mix(alpha, p.matrix @ alpha - p.target, "exact")
