"""More of tests/broken.py: measures, surrogates, models, sources, checkers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import cycle

import casadi
import numpy as np
from broken import BROKEN, breaks, noise
from toys import Boxes, Drag, Learned, Linear, Nothing, Roughly, Size, Volume

from lampopt.errors import MeasureError
from lampopt.testing import shapes
from lampopt.types import Check

__all__ = ["BROKEN"]
TURN = cycle([True, False])


# measures


@breaks("check_protocol")
class NamesInAList(Size):
    @property
    def names(self):
        return ["length", "volume", "fill"]


@breaks("check_units_can_be_read")
class InventsAUnit(Size):
    units = ("L", "L^3", "blorbs")


@breaks("check_something_is_measured")
class MeasuresNothing(Size):
    def __call__(self, mesh):
        raise MeasureError("expected a teapot, got something else")


class Measures(Size):
    def __call__(self, mesh):
        return super().__call__(mesh) + np.array([self.spoil(mesh), 0, 0])


@breaks("check_place_does_not_matter")
class MeasuresThePlace(Measures):
    def spoil(self, mesh):
        return np.mean(mesh.vertices[:, 0])


@breaks("check_scale_follows_the_unit")
class VolumeIsAnArea(Size):
    units = ("L", "L^2", "")


@breaks("check_measuring_is_deterministic")
class NoisyLength(Measures):
    def spoil(self, mesh):
        return 1e-9 * noise()


@breaks("check_vertex_order_does_not_matter")
class FirstVerticesCount(Measures):
    def spoil(self, mesh):
        return 0.01 * np.linalg.norm(mesh.vertices[0] - mesh.vertices[1])


@breaks("check_mesh_is_left")
class NudgesTheMesh(Measures):
    def spoil(self, mesh):
        mesh.vertices = mesh.vertices + 1e-9
        return 0.0


@breaks("check_empty_mesh_is_refused")
class NaNForEmpty(Size):
    def __call__(self, mesh):
        return super().__call__(mesh) if len(mesh.faces) else np.full(3, np.nan)


@breaks("check_gradient_agrees_with_differences")
class SteepGradient(Volume):
    def gradient(self, mesh):
        return 1.1 * super().gradient(mesh)


@breaks("check_gradient_agrees_with_differences")
class NoGradientAtAll(Volume):
    def gradient(self, mesh):
        return 0 * super().gradient(mesh)


@breaks("check_gradient_agrees_with_differences")
class DriftsWithTheMesh(Volume):
    """Right for every motion about the middle."""

    def gradient(self, mesh):
        return super().gradient(mesh) + 7.0


@breaks("check_gradient_agrees_with_differences")
class GradientNudgesTheMesh(Volume):
    def gradient(self, mesh):
        found = super().gradient(mesh)
        mesh.vertices = mesh.vertices + 1e-9
        return found


@breaks("check_interval_holds_the_value")
class NarrowerWhenSurer(Size):
    def interval(self, mesh, level):
        return super().interval(mesh, 1 - level)


@breaks("check_mesh_is_left")
class AsksWithANudge(Size):
    def outside(self, mesh):
        mesh.vertices = mesh.vertices + 1e-9
        return False


# surrogates, and what they learn


@dataclass(frozen=True, eq=False)
class HalfRemembered(Learned):
    @classmethod
    def from_state(cls, state):
        again = super().from_state(state)
        return replace(again, matrix=1.1 * again.matrix)


class VertexReader(Learned):
    def __call__(self, mesh):
        return super().__call__(mesh) + 0.2 * np.linalg.norm(mesh.vertices[0] - mesh.vertices[1])


BROKEN.append(("measure", HalfRemembered(np.eye(4, 1), ("length",), ("L",)), "check_state_gives_it_again"))


@dataclass(frozen=True, eq=False)
class KeepsItself(Learned):
    def state(self):
        return {"names": np.array(self.names)}

    @classmethod
    def from_state(cls, state):
        return cls(np.eye(4, 1), ("length",), ("L",))


BROKEN.append(("measure", KeepsItself(np.eye(4, 1), ("length",), ("L",)), "check_state_gives_it_again"))


@dataclass(frozen=True, eq=False)
class ForgetsItsDoubt(Learned):
    doubt: float = 0.1

    def interval(self, mesh, level):
        return self(mesh)[:, None] + self.doubt * level * np.array([-1, 1])

    def outside(self, mesh):
        return False

    @classmethod
    def from_state(cls, state):
        return replace(super().from_state(state), doubt=0.0)


BROKEN.append(("measure", ForgetsItsDoubt(np.eye(4, 1), ("length",), ("L",)), "check_state_gives_it_again"))


class Learns(Linear):
    def fit(self, meshes, values, names, units, *, seed):
        return self.spoil(super().fit(meshes, values, names, units, seed=seed))


@breaks("check_fit_gives_a_measure")
class Renames(Learns):
    def spoil(self, learned):
        return replace(learned, names=("y",))


@breaks("check_fit_is_deterministic")
class UnseededLearning(Learns):
    def spoil(self, learned):
        return replace(learned, matrix=learned.matrix + 1e-9 * noise(4, 1))


@breaks("check_learned_measure_ignores_vertex_order")
class ReadsVertices(Learns):
    def spoil(self, learned):
        return VertexReader(learned.matrix, learned.names, learned.units)


@breaks("check_length_is_learned")
class AlwaysTheMean(Learns):
    def spoil(self, learned):
        return replace(learned, matrix=np.array([[0.0], [0], [0], [1]]))


@breaks("check_learned_measure_is_kept")
class Forgets(Learns):
    def spoil(self, learned):
        return HalfRemembered(learned.matrix, learned.names, learned.units)


# models


class Predicts(Drag):
    def __call__(self, parameters):
        return super().__call__(parameters) + self.spoil(parameters)


@breaks("check_model_protocol")
class InputsInAList(Drag):
    @property
    def inputs(self):
        return ["speed", "area"]


@breaks("check_model_shapes")
class NeedsARow(Predicts):
    def spoil(self, parameters):
        return 0 * parameters[0, 0]


@breaks("check_model_rows_are_independent")
class RowStatistics(Predicts):
    def spoil(self, parameters):
        return 1e-3 * parameters.sum() / max(len(parameters), 1)


@breaks("check_model_is_deterministic")
class NoisyModel(Predicts):
    def spoil(self, parameters):
        return 1e-10 * noise()


@breaks("check_model_gradient_agrees_with_differences")
class SteepModel(Drag):
    def gradient(self, parameters):
        return 1.1 * super().gradient(parameters)


@breaks("check_model_parameters_are_left")
class NudgesParameters(Drag):
    def gradient(self, parameters):
        gradient = super().gradient(parameters)
        parameters += 1e-12
        return gradient


@breaks("check_model_interval_holds_the_value")
class SurerTheMoreIsAsked(Roughly):
    def interval(self, parameters, level):
        return super().interval(parameters, 1 - level)


@breaks("check_model_interval_holds_the_value")
class SaysLowAndHighApart(Roughly):
    def interval(self, parameters, level):
        return np.moveaxis(super().interval(parameters, level), 2, 0)


@breaks("check_model_interval_holds_the_value")
class AboveItself(Roughly):
    def interval(self, parameters, level):
        return super().interval(parameters, level) + np.array([0.4, 1.0])


@breaks("check_model_interval_holds_the_value")
class OutsideAsOne(Roughly):
    def outside(self, parameters):
        return bool(super().outside(parameters).any())


@breaks("check_model_interval_holds_the_value")
class DoubtsTogether(Roughly):
    def interval(self, parameters, level):
        return super().interval(parameters, level) * [1 - 1e-3 * len(parameters), 1 + 1e-3 * len(parameters)]


@breaks("check_model_rows_are_independent")
class FallsAlone(Drag):
    def gradient(self, parameters):
        return super().gradient(parameters) * (1 if len(parameters) != 1 else -1)


@breaks("check_model_rows_are_independent")
class SqueezesOne(Drag):
    def gradient(self, parameters):
        return np.squeeze(super().gradient(parameters))


@breaks("check_model_expression_is_the_model")
class OppositeInSymbols(Drag):
    def symbolic(self, parameters):
        speed, area = parameters[0], parameters[1]
        return -casadi.vertcat(self.factor * area * speed**2, area - speed)


@breaks("check_model_expression_is_the_model")
class OneLabelInSymbols(Drag):
    def symbolic(self, parameters):
        return self.factor * parameters[1] * parameters[0] ** 2


@breaks("check_model_parameters_are_left")
class ClipsToAsk(Roughly):
    def outside(self, parameters):
        parameters.clip(0.6, 1.4, out=parameters)
        return super().outside(parameters)


# regressions, and what they learn


@dataclass(frozen=True, eq=False)
class Quadric:
    matrix: np.ndarray
    names: tuple
    units: tuple
    inputs: tuple

    def __call__(self, parameters):
        given = np.asarray(parameters)
        return np.hstack([np.ones((len(given), 1)), given, given**2]) @ self.matrix

    def gradient(self, parameters):
        given, (_, first, second) = np.asarray(parameters), np.split(self.matrix, [1, 1 + len(self.inputs)])
        return first.T + 2 * given[:, None] * second.T

    def state(self):
        return {"matrix": self.matrix}

    @classmethod
    def from_state(cls, state):
        return cls(state["matrix"], ("drag", "lift"), ("N", ""), ("height", "angle", "kind"))


@dataclass(frozen=True)
class Squares:
    """Regression: least squares on the parameters and their squares."""

    ridge: float = 1e-9

    def fit(self, parameters, labels, *, inputs, names, units, seed):
        terms = np.hstack([np.ones((len(parameters), 1)), parameters, parameters**2])
        columns = []
        for column in np.asarray(labels).T:
            known = ~np.isnan(column)
            columns.append(np.linalg.lstsq(terms[known], column[known], self.ridge)[0])
        return Quadric(np.stack(columns, 1), tuple(names), tuple(units), tuple(inputs))


def breaks_regression(check):
    """As `breaks`, for a regression."""

    def register(cls):
        BROKEN.append(("regression", dataclass(frozen=True, repr=False)(cls)(), check))
        return cls

    return register


class Regresses(Squares):
    def fit(self, parameters, labels, **named):
        return self.spoil(super().fit(parameters, labels, **named))


@breaks_regression("check_fit_gives_a_model")
class SwapsUnits(Regresses):
    def spoil(self, fitted):
        return replace(fitted, units=fitted.units[::-1])


@breaks_regression("check_model_fit_is_deterministic")
class UnseededRegression(Regresses):
    def spoil(self, fitted):
        return replace(fitted, matrix=fitted.matrix + 1e-12 * noise(*fitted.matrix.shape))


@breaks_regression("check_plane_is_learned")
class AlwaysOneLabel(Regresses):
    def spoil(self, fitted):
        matrix = 1e-9 * fitted.matrix
        matrix[0] = 1.0
        return replace(fitted, matrix=matrix)


@breaks_regression("check_unlabelled_rows_do_not_count")
class GapsAreZero(Squares):
    def fit(self, parameters, labels, **named):
        return super().fit(parameters, np.nan_to_num(labels), **named)


@breaks_regression("check_unlabelled_rows_do_not_count")
class GapsAreTheMean(Squares):
    def fit(self, parameters, labels, **named):
        return super().fit(parameters, np.where(np.isnan(labels), np.nanmean(labels, axis=0), labels), **named)


@breaks_regression("check_unlabelled_rows_do_not_count")
class GapsAreTheNeighbours(Squares):
    """Fills each gap with the label of the nearest row that has one."""

    def fit(self, parameters, labels, **named):
        filled = np.array(labels)
        for column in filled.T:
            known = np.flatnonzero(~np.isnan(column))
            apart = np.abs(parameters[:, None] - parameters[known]).sum(axis=2)
            column[:] = column[known][apart.argmin(axis=1)]
        return super().fit(parameters, filled, **named)


@breaks_regression("check_unlabelled_rows_do_not_count")
class CompleteRowsOnly(Squares):
    def fit(self, parameters, labels, **named):
        whole = np.isfinite(labels).all(axis=1)
        far = parameters[whole] + (0 if whole.all() else np.array([0.1, 0, 0]))
        return super().fit(far, labels[whole], **named)


@breaks_regression("check_one_label_is_learned_alike")
class FlattensOne(Regresses):
    def spoil(self, fitted):
        return Flattened(**vars(fitted)) if len(fitted.names) == 1 else fitted


class Flattened(Quadric):
    def __call__(self, parameters):
        return super().__call__(parameters)[:, 0]


class RowsMeet(Quadric):
    def __call__(self, parameters):
        return super().__call__(parameters) + 1e-6 * len(parameters)


@breaks_regression("check_learned_rows_are_independent")
class LearnsRowsTogether(Regresses):
    def spoil(self, fitted):
        return RowsMeet(fitted.matrix, fitted.names, fitted.units, fitted.inputs)


class TooSteep(Quadric):
    def gradient(self, parameters):
        return 1.1 * super().gradient(parameters)


class Flat(Quadric):
    def gradient(self, parameters):
        return 0 * super().gradient(parameters)


@breaks_regression("check_learned_gradient_follows_the_values")
class SaysThatItGoesInSteps(Regresses):
    def spoil(self, fitted):
        return Flat(fitted.matrix, fitted.names, fitted.units, fitted.inputs)


@breaks_regression("check_learned_gradient_follows_the_values")
class LearnsTooSteep(Regresses):
    def spoil(self, fitted):
        return TooSteep(fitted.matrix, fitted.names, fitted.units, fitted.inputs)


class Vain(Quadric):
    def interval(self, parameters, level):
        values = self(parameters)
        return np.stack([values, values + level], axis=2) + 0.1

    def outside(self, parameters):
        return np.abs(np.asarray(parameters) - [1.4, 20, 3]).max(axis=1) > 6


@breaks_regression("check_learned_interval_holds_the_value")
class LearnsToBeVain(Regresses):
    def spoil(self, fitted):
        return Vain(fitted.matrix, fitted.names, fitted.units, fitted.inputs)


class Anywhere(Vain):
    def interval(self, parameters, level):
        values = self(parameters)
        return np.stack([values - level, values + level], axis=2)

    def outside(self, parameters):
        return np.zeros(len(parameters), bool)


@breaks_regression("check_far_from_the_rows_is_outside")
class TrustsItselfAnywhere(Regresses):
    def spoil(self, fitted):
        return Anywhere(fitted.matrix, fitted.names, fitted.units, fitted.inputs)


class Nowhere(Anywhere):
    def outside(self, parameters):
        return np.ones(len(parameters), bool)


@breaks_regression("check_far_from_the_rows_is_outside")
class TrustsItselfNowhere(Regresses):
    def spoil(self, fitted):
        return Nowhere(fitted.matrix, fitted.names, fitted.units, fitted.inputs)


class Opposite(Quadric):
    def symbolic(self, parameters):
        given = casadi.vertcat(1, parameters, parameters**2)
        return -casadi.mtimes(casadi.DM(self.matrix.T), given)


@breaks_regression("check_learned_expression_is_the_model")
class LearnsTheOpposite(Regresses):
    def spoil(self, fitted):
        return Opposite(**vars(fitted))


class OneSided(Anywhere):
    def outside(self, parameters):
        return (np.asarray(parameters) > [2, 30, 3]).any(axis=1)


@breaks_regression("check_far_from_the_rows_is_outside")
class LooksUpOnly(Regresses):
    def spoil(self, fitted):
        return OneSided(**vars(fitted))


class Certain(Vain):
    doubt = 1.0

    def interval(self, parameters, level):
        values = self(parameters)
        return np.stack([values - self.doubt * level, values + self.doubt * level], axis=2)

    @classmethod
    def from_state(cls, state):
        return Sure(**vars(super().from_state(state)))


class Sure(Certain):
    doubt = 0.0


@breaks_regression("check_learned_model_is_kept")
class GrowsSureInTheFile(Regresses):
    def spoil(self, fitted):
        return Certain(**vars(fitted))


class Nest:
    @dataclass(frozen=True, eq=False)
    class Fitted(Quadric):
        pass


@breaks_regression("check_learned_model_is_kept")
class LearnsInANest(Regresses):
    def spoil(self, fitted):
        return Nest.Fitted(**vars(fitted))


class HalfKept(Quadric):
    def state(self):
        return {"matrix": self.matrix.astype(np.float32)}


@breaks_regression("check_learned_model_is_kept")
class KeepsHalf(Regresses):
    def spoil(self, fitted):
        return HalfKept(fitted.matrix, fitted.names, fitted.units, fitted.inputs)


@breaks_regression("check_rows_given_are_left")
class FillsGaps(Squares):
    def fit(self, parameters, labels, **named):
        fitted = super().fit(parameters, labels, **named)
        labels[:] = np.nan_to_num(labels)
        labels[0] += 1e-9
        return fitted


# sources, and a checker


class Yields(Boxes):
    def __call__(self):
        return self.spoil(super().__call__())


class Duck:
    def __init__(self, real):
        self.real = real

    def __getattr__(self, name):
        return getattr(self.real, name)

    def __len__(self):
        return len(self.real)


@breaks("check_source_protocol")
class YieldsADuck(Yields):
    def spoil(self, found):
        return Duck(found)


@breaks("check_source_repeats_itself")
class OtherBoxesEachTime(Boxes):
    def __call__(self):
        return type(self).__base__(self.count, int(np.random.default_rng().integers(2**31)))()


@breaks("check_source_meshes_load")
class ReachesInfinity(Yields):
    def spoil(self, found):
        vertices = np.array(found.meshes[0].vertices)
        vertices[0, 0] = np.inf
        found.meshes[0].vertices = vertices
        return replace(found, mesh_at=None)


@breaks("check_source_meshes_are_closed")
class LosesAFace(Boxes):
    def meshes(self, parameters):
        meshes = super().meshes(parameters)
        for mesh in meshes:
            mesh.faces = mesh.faces[1:]
        return meshes


class Lazy(Sequence):
    def __init__(self, meshes):
        self.meshes, self.reads = meshes, 0

    def __len__(self):
        return len(self.meshes)


class Drifting(Lazy):
    def __getitem__(self, index):
        mesh = self.meshes[index].copy()
        self.reads += 1
        mesh.vertices = mesh.vertices + 1e-9 * self.reads
        return mesh


class Endless(Lazy):
    def __getitem__(self, index):
        return self.meshes[index % len(self)]


@breaks("check_source_meshes_can_be_read_twice")
class DriftingMeshes(Boxes):
    def meshes(self, parameters):
        return Drifting(super().meshes(parameters))


@breaks("check_source_meshes_end")
class EndlessMeshes(Boxes):
    def meshes(self, parameters):
        return Endless(super().meshes(parameters))


@breaks("check_source_parameters_differ")
class OneNameForTwo(Yields):
    def spoil(self, found):
        return replace(found, parameters=found.parameters[[0, 0, 2, 3, 4]], mesh_at=None)


@breaks("check_source_mesh_at_is_the_exemplar")
class RoundsWhatItIsAsked(Yields):
    def spoil(self, found):
        return replace(found, mesh_at=lambda row: self.mesh_at(row.round(3, out=row)))


@breaks("check_source_repeats_itself")
class MeasuredNowAndThen(Yields):
    def spoil(self, found):
        return replace(found, measured={"length": "extents.length"} if next(TURN) else {})


@breaks("check_source_mesh_at_is_the_exemplar")
class TruthHasACavity(Yields):
    def spoil(self, found):
        def truth(row):
            made = self.mesh_at(row)
            inner = shapes.ellipsoid(np.full(3, 0.3 * made.extents.min()), centre=made.bounds.mean(0))
            inner.invert()
            return made + inner

        return replace(found, mesh_at=truth)


@breaks("check_source_mesh_at_is_the_exemplar")
class TruthIsLarger(Yields):
    def spoil(self, found):
        return replace(found, mesh_at=lambda row: self.mesh_at(1.1 * row))


@breaks("check_checker_protocol")
class NeedsEverything(Nothing):
    needs = "everything"


class Says(Nothing):
    def __call__(self, bank, design):
        return [Check("shares", float(abs(design.mix.alpha).sum()), "<=", 2.0, "", "alpha")]


@breaks("check_checks_are_told")
class SaysYes(Says):
    def __call__(self, bank, design):
        return [True]


@breaks("check_checks_are_told")
class TakesAName(Says):
    def __call__(self, bank, design):
        return [replace(check, name="watertight") for check in super().__call__(bank, design)]


@breaks("check_checks_are_told")
class OneNameForTwoChecks(Says):
    def __call__(self, bank, design):
        return 2 * super().__call__(bank, design)


@breaks("check_checks_are_told")
class LooksAtTheFieldUnsaid(Says):
    def __call__(self, bank, design):
        return [replace(check, needs="field") for check in super().__call__(bank, design)]


@breaks("check_checking_is_deterministic")
class ThrowsDice(Says):
    def __call__(self, bank, design):
        return [replace(check, value=float(noise())) for check in super().__call__(bank, design)]


@breaks("check_design_is_left")
class Straightens(Nothing):
    needs = "mesh"

    def __call__(self, bank, design):
        design.mesh.vertices[:] = design.mesh.vertices.round(1)
        return ()


@breaks("check_no_mesh_is_made_unasked")
class LooksAtTheMeshUnsaid(Says):
    def __call__(self, bank, design):
        return [replace(check, value=design.mesh.volume) for check in super().__call__(bank, design)]
