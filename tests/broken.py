"""Plugins that break one promise each, listed in BROKEN as (kind, plugin, the check that has to notice)."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
from lampopt_gridsdf import GridSDF
from toys import KKT, Able, Boxes, Drag, Linear, Nothing, Size, Volume

from lampopt.decode import NarrowBand
from lampopt.errors import EmptyMesh
from lampopt.testing import shapes

BROKEN = []


def breaks(check, *, plain=False):
    """Register the decorated class; `plain` leaves out the dataclass decorator."""

    def register(cls):
        cls = cls if plain or cls.__eq__ is object.__eq__ else dataclass(frozen=True, repr=False)(cls)
        kinds = {GridSDF: "decoder", KKT: "solver", Size: "measure", Volume: "measure", Linear: "surrogate"}
        kinds |= {Drag: "model", Boxes: "source", Nothing: "check"}
        kind = next(kind for base, kind in kinds.items() if issubclass(cls, base))
        BROKEN.append((kind, cls(size=12) if kind == "decoder" else cls(), check))
        return cls

    return register


def noise(*shape):
    return np.random.default_rng().normal(size=shape)


# decoders


@breaks("check_protocol_and_bounds")
class BoundsAsLists(GridSDF):
    @property
    def bounds(self):
        return [[-1.0] * 3, [1.0] * 3]


@breaks("check_options_rebuild_an_equal_object")
class OptionIsNoScalar(GridSDF):
    margins: tuple = ()


@breaks("check_repr_round_trips")
class ReprSaysNothing(GridSDF):
    def __repr__(self):
        return "<a decoder>"


@breaks("check_plugin_is_frozen", plain=True)
class TakesAttributes(GridSDF):
    pass


@breaks("check_prepare_gives_named_arrays")
class SharesText(GridSDF):
    def prepare(self, meshes, *, mean, seed):
        return {"note": np.array(["made on a Monday"])}


@breaks("check_prepare_is_deterministic")
class StartsAnywhere(GridSDF):
    def prepare(self, meshes, *, mean, seed):
        return {"start": noise(3)}


class Fits(GridSDF):
    def fit(self, shared, meshes, *, seed, progress=None):
        weights, error = super().fit(shared, meshes, seed=seed)
        return self.spoil(shared, meshes, weights, error, progress)


@breaks("check_weights_are_flat_float32")
class DoublePrecision(Fits):
    def spoil(self, shared, meshes, weights, error, progress):
        return weights.astype(float), error


@breaks("check_fit_error_is_stated")
class NegativeError(Fits):
    def spoil(self, shared, meshes, weights, error, progress):
        return weights, error - 1


@breaks("check_fit_is_deterministic")
class UnseededFit(Fits):
    def spoil(self, shared, meshes, weights, error, progress):
        return weights + np.float32(1e-6) * noise(*weights.shape).astype(np.float32), error


@breaks("check_fit_leaves_its_inputs")
class MovesTheMesh(Fits):
    def spoil(self, shared, meshes, weights, error, progress):
        meshes[0].vertices = np.asarray(meshes[0].vertices) - meshes[0].centroid + 1e-9
        return weights, error


@breaks("check_global_random_state_is_left")
class GlobalSeed(GridSDF):
    def probes(self, shared, count, seed):
        np.random.seed(seed)  # noqa: NPY002  # it is what is broken
        return super().probes(shared, count, seed)


@breaks("check_progress_runs_from_0_to_1")
class ProgressInPercent(Fits):
    def spoil(self, shared, meshes, weights, error, progress):
        if progress:
            progress(100)
        return weights, error


@breaks("check_fit_ignores_batch_mates")
class BatchStatistics(Fits):
    def spoil(self, shared, meshes, weights, error, progress):
        return weights + np.float32(0.05 * (len(meshes) - 3)), error


class Decodes(GridSDF):
    def decode(self, shared, weights, *, resolution):
        return self.spoil(GridSDF(self.size).decode(shared, weights, resolution=resolution))

    def spoil(self, mesh):
        return mesh


@breaks("check_evaluate_gives_points_by_channels")
class NoChannels(Decodes):
    def evaluate(self, shared, weights, points):
        return super().evaluate(shared, weights, points)[..., 0]


@breaks("check_evaluate_is_pointwise")
class PointStatistics(GridSDF):
    def evaluate(self, shared, weights, points):
        return super().evaluate(shared, weights, points) + 1e-3 * points.mean()


@breaks("check_evaluate_is_stateless")
class NoisyValues(Decodes):
    def evaluate(self, shared, weights, points):
        return super().evaluate(shared, weights, points) + 1e-6 * noise()


@breaks("check_evaluate_takes_batches_of_weights")
class FirstOfTheBatch(GridSDF):
    def evaluate(self, shared, weights, points):
        return super().evaluate(
            shared, np.broadcast_to(weights.reshape(-1, weights.shape[-1])[0], weights.shape), points
        )


@breaks("check_probes_cover_the_domain")
class UnseededProbes(GridSDF):
    def probes(self, shared, count, seed):
        return np.tanh(noise(count, 3))


@breaks("check_probes_cover_the_domain")
class ProbesTheMiddle(GridSDF):
    def probes(self, shared, count, seed):
        return np.zeros((count, 3))


@breaks("check_fit_leaves_its_inputs")
class PreparesInPlace(GridSDF):
    def prepare(self, meshes, *, mean, seed):
        found = super().prepare(meshes, mean=mean, seed=seed)
        mean.vertices = np.asarray(mean.vertices) * 1.01
        return found


@breaks("check_decode_gives_a_closed_mesh")
class InsideOut(Decodes):
    def spoil(self, mesh):
        mesh.invert()
        return mesh


@breaks("check_decode_is_deterministic")
class NoisyMesh(Decodes):
    def spoil(self, mesh):
        mesh.vertices = mesh.vertices + 1e-9 * noise(*mesh.vertices.shape)
        return mesh


@breaks("check_surface_is_near_the_mesh")
class Shrinks(Decodes):
    def spoil(self, mesh):
        return mesh.apply_scale(0.8)


@breaks("check_size_is_recovered")
class OneSize(Decodes):
    def spoil(self, mesh):
        return mesh.apply_scale([1 / 1.1 if mesh.extents[0] > 1.1 else 1, 1, 1])


@breaks("check_one_hot_mix_is_the_exemplar")
class KnowsFloat32Only(GridSDF):
    def evaluate(self, shared, weights, points):
        return super().evaluate(shared, weights, points) + 0.01 * (weights.dtype != np.float32)


@breaks("check_neighbours_are_aligned")
class SignIsArbitrary(Fits):
    def spoil(self, shared, meshes, weights, error, progress):
        return weights * np.array([[-1 if m.extents[0] > 1.1 else 1] for m in meshes], np.float32), error

    def evaluate(self, shared, weights, points):
        return super().evaluate(shared, weights * np.sign(weights[..., :1]), points)


@breaks("check_wrong_length_is_refused")
class AnyLengthWillDo(GridSDF):
    def evaluate(self, shared, weights, points):
        right = self.size**3
        if weights.shape[-1] != right:
            weights = np.resize(weights, (*weights.shape[:-1], right))
        return super().evaluate(shared, weights, points)


@breaks("check_no_surface_is_empty_mesh")
class AlwaysAMesh(GridSDF):
    def decode(self, shared, weights, *, resolution):
        try:
            return super().decode(shared, weights, resolution=resolution)
        except EmptyMesh:
            return shapes.box()


@breaks("check_empty_mesh_is_refused")
class FitsNothing(GridSDF):
    def fit(self, shared, meshes, *, seed, progress=None):
        return super().fit(shared, [m if len(m.faces) else shapes.box() for m in meshes], seed=seed)


@breaks("check_read_only_arrays_will_do")
class WritesWeights(GridSDF):
    def evaluate(self, shared, weights, points):
        weights *= 1
        return super().evaluate(shared, weights, points)


@breaks("check_fresh_process_agrees")
class Remembers(GridSDF):
    def prepare(self, meshes, *, mean, seed):
        type(self).offset = 0.0
        return {}

    def evaluate(self, shared, weights, points):
        return super().evaluate(shared, weights, points) + getattr(self, "offset", 0.1)


@dataclass(frozen=True, repr=False)
class Sloped(GridSDF):
    """Keeps every promise: the grid with both of its gradients."""

    def corners(self, points):
        """(M, 8) numbers of a cell's nodes, their parts in the value (M, 8), and these by the place (M, 8, 3)."""
        at = (np.asarray(points) + 1) * (self.size - 1) / 2
        cell = np.clip(np.floor(at), 0, self.size - 2).astype(int)
        nodes, parts, slopes = [], [], []
        for corner in np.ndindex(2, 2, 2):
            nodes.append(np.ravel_multi_index(tuple((cell + corner).T), (self.size,) * 3))
            one = np.where(corner, at - cell, 1 - at + cell)
            parts.append(one.prod(1))
            sign = np.where(corner, 1, -1) * (self.size - 1) / 2
            slopes.append(sign * np.stack([one[:, 1] * one[:, 2], one[:, 0] * one[:, 2], one[:, 0] * one[:, 1]], 1))
        return np.stack(nodes, 1), np.stack(parts, 1), np.stack(slopes, 1)

    def adjoint(self, shared, weights, points, gradient):
        nodes, parts, _ = self.corners(points)
        return np.bincount(nodes.ravel(), (parts * gradient).ravel(), minlength=len(weights))

    def pullback(self, shared, weights, mesh, gradient):
        nodes, _, slopes = self.corners(mesh.vertices)
        slope = (weights[nodes][..., None] * slopes).sum(1)
        by = -(gradient * slope).sum(1) / (slope**2).sum(1)
        return Sloped.adjoint(self, shared, weights, mesh.vertices, by[:, None])

    def follow(self, shared, *, resolution):
        band = NarrowBand(self.bounds, resolution)
        return lambda weights: band.mesh(lambda points: self.evaluate(shared, weights, points)[:, 0])


@breaks("check_follow_is_decode")
class StaysWhereItWas(Sloped):
    def follow(self, shared, *, resolution):
        first = []

        def made(weights):
            first.append(self.decode(shared, weights, resolution=resolution))
            return first[0]

        return made


@breaks("check_pullback_agrees_with_differences")
class ForgetsTheSlope(Sloped):
    def pullback(self, shared, weights, mesh, gradient):
        normal = (gradient * mesh.vertex_normals).sum(1)
        return self.adjoint(shared, weights, mesh.vertices, normal[:, None])  # inward is outward


@breaks("check_adjoint_agrees_with_differences")
class TwiceTheGradient(Sloped):
    def adjoint(self, shared, weights, points, gradient):
        return 2 * super().adjoint(shared, weights, points, gradient)


# solvers


class Solves(KKT):
    def solve(self, p):
        mix = super().solve(p)
        alpha = self.spoil(p, np.array(mix.alpha))
        return replace(mix, alpha=alpha, residual=p.matrix @ alpha - p.target)


@breaks("check_protocol")
class ReturnsNoMix(KKT):
    def solve(self, p):
        return SimpleNamespace(**vars(super().solve(p)))


@breaks("check_alpha_sums_to_one")
class SumIsRough(Solves):
    def spoil(self, p, alpha):
        return alpha + 5e-9


@breaks("check_residual_and_status_are_true")
class ResidualTheOtherWay(KKT):
    def solve(self, p):
        mix = super().solve(p)
        return replace(mix, residual=-mix.residual)


@breaks("check_reachable_target_is_hit")
class GivesUpOnManyRows(Solves):
    def spoil(self, p, alpha):
        return np.array(p.centre) if len(p.names) == 7 and p.ridge == 0 else alpha


@breaks("check_hard_rows_are_met")
class HardIsSoft(KKT):
    def solve(self, p):
        return super().solve(replace(p, hard=None))


@breaks("check_closed_form_agrees")
class HalfTheRidge(KKT):
    def solve(self, p):
        return super().solve(p if p.hard.any() or not p.ridge else replace(p, ridge=p.ridge / 2))


@breaks("check_freedom_stays_near_the_centre")
class Wanders(Solves):
    def spoil(self, p, alpha):
        rows = np.vstack([np.ones(len(alpha)), p.matrix])
        free = np.eye(len(alpha)) - np.linalg.pinv(rows) @ rows
        return alpha + 0.1 * free[0] if p.names and p.ridge == 0 else alpha


@breaks("check_nothing_asked_is_the_centre")
class BackToTheMean(Solves):
    def spoil(self, p, alpha):
        return alpha if p.names else np.full(len(alpha), 1 / len(alpha))


@breaks("check_negative_alpha_is_allowed")
class ConvexOfThree(Solves):
    def spoil(self, p, alpha):
        return alpha.clip(0) / alpha.clip(0).sum() if len(alpha) == 3 else alpha


@breaks("check_conflicts_are_named")
class NamesNoConflict(KKT):
    def solve(self, p):
        return replace(super().solve(p), conflicts=())


@breaks("check_exemplar_order_does_not_matter")
class FirstHalfIsBetter(Solves):
    def spoil(self, p, alpha):
        return alpha + 8e-6 * np.repeat([1, -1], 4) if len(alpha) == 8 and p.ridge == 1e-3 else alpha


@breaks("check_row_order_does_not_matter")
class FirstRowIsBetter(Solves):
    def spoil(self, p, alpha):
        return alpha + 1e-3 * np.repeat([1, -1], 4) if p.names[:1] == ("q2",) else alpha


@breaks("check_inputs_are_left")
class WritesItsProblem(Solves):
    def spoil(self, p, alpha):
        if p.weight.flags.owndata:
            p.weight.flags.writeable = True
            p.weight[p.hard] = 7
        return alpha


@breaks("check_solve_is_deterministic")
class NoisyAlpha(Solves):
    def spoil(self, p, alpha):
        step = 1e-12 * noise(len(alpha))
        return alpha + step - step.mean()


@breaks("check_many_is_one_by_one")
class ManyForgetsRidges(KKT):
    def solve_many(self, p, targets, ridges=None):
        return super().solve_many(p, targets)


class Ignores(KKT):
    def solve(self, p):
        return super().solve(replace(p, **self.ignored()))


@breaks("check_ranges_are_kept_or_refused")
class IgnoresRanges(Ignores):
    def ignored(self):
        return {"range_names": (), "range_matrix": None, "range_low": None, "range_high": None}


@breaks("check_bounds_are_kept_or_refused")
class IgnoresBounds(Ignores):
    def ignored(self):
        return {"alpha_low": None, "alpha_high": None}


@breaks("check_objectives_are_minimised_or_refused")
class IgnoresObjectives(Ignores):
    def ignored(self):
        return {"objectives": ()}


@breaks("check_constraints_are_kept_or_refused")
class IgnoresConstraints(Ignores):
    def ignored(self):
        return {"constraints": ()}


@breaks("check_equalities_are_kept_or_refused")
class IgnoresEqualities(Ignores):
    def ignored(self):
        return {"equalities": ()}


class Forgets(Able):
    """Knows what it is asked, and leaves a part of it out."""

    def solve(self, p):
        return super().solve(replace(p, **{name: value for name, value in self.left(p).items() if len(value)}))


@breaks("check_ranges_are_kept_or_refused")
class ForgetsHighEnds(Forgets):
    def left(self, p):
        return {"range_high": np.full(len(p.range_high), np.inf)}


@breaks("check_bounds_are_kept_or_refused")
class ForgetsHighBounds(Forgets):
    def left(self, p):
        return {} if p.alpha_high is None else {"alpha_high": np.full(len(p.centre), 1e3)}


@breaks("check_objectives_are_minimised_or_refused")
class OneObjectiveWillDo(Forgets):
    def left(self, p):
        return {"objectives": p.objectives[:1]}


@breaks("check_constraints_are_kept_or_refused")
class OneConstraintWillDo(Forgets):
    def left(self, p):
        return {"constraints": p.constraints[:1]}


@breaks("check_norm_1_is_used_or_refused")
class IgnoresNorm(Ignores):
    def ignored(self):
        return {"norm": 2}
