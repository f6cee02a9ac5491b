"""What a plugin must look like, and what it may be able to do besides.

Typing is structural: a plugin inherits nothing. Plugin objects are frozen hyper-parameters (a frozen dataclass whose
fields are the options): stateless, safe to share between threads; what they learn is returned. Numpy at every
boundary. What the signatures cannot say is checked by `lampopt.testing`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from lampopt.types import Array, Bank, Check, Design, Exemplars, Mix, MixBatch, Needs, Problem, Scalar

if TYPE_CHECKING:
    from trimesh import Trimesh

Shared = Mapping[str, Array]


class Progress(Protocol):
    """Told how far long work has come; may be called often."""

    def __call__(self, done: float, message: str = "", /) -> None:
        """`done` runs from 0 to 1; `message` says what is going on."""


@runtime_checkable
class Decoder(Protocol):
    """Turns a flat weight vector into a function of points, and into a mesh.

    Everything happens in the decoder's box `bounds` (2, 3); the core's `Frame` brings meshes into it and back.
    """

    @property
    def bounds(self) -> Array:
        """(2, 3) low and high corner of the box."""

    def prepare(self, meshes: Sequence[Trimesh], *, mean: Trimesh, seed: int) -> Shared:
        """What all exemplars share, saved in the bank: start weights, a template, a lattice.

        `mean` is the mesh at the mean design, or the exemplar nearest to it.
        """

    def fit(
        self, shared: Shared, meshes: Sequence[Trimesh], *, seed: int, progress: Progress | None = None
    ) -> tuple[Array, Array]:
        """Fit a batch of n meshes from the shared start: weights (n, D) float32, mean surface error (n,) [box].

        Raises FitError naming what is wrong with a mesh that cannot be fitted.
        """

    def evaluate(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Values (..., M, C) of weights (..., D) at points (M, 3) of the decoder's own domain.

        C = 1 means signed distance, negative inside; C = 3 where a template's points have moved to.
        """

    def decode(self, shared: Shared, weights: Array, *, resolution: int) -> Trimesh:
        """The closed mesh of weights (D,), faces outward; `resolution` cells along the box. Raises EmptyMesh."""

    def probes(self, shared: Shared, count: int, seed: int) -> Array:
        """(count, 3) points that cover the domain evenly, where linearity is tested."""


@runtime_checkable
class Solver(Protocol):
    """Chooses alpha. Sees matrices and callables, never meshes or networks."""

    def solve(self, problem: Problem) -> Mix:
        """The mix for one problem. Raises SolveError naming an ability it lacks."""

    def solve_many(self, problem: Problem, targets: Array, ridges: Array | None = None) -> MixBatch:
        """The mixes for targets (B, k) in place of `problem.target`, one ridge (B,) each if given."""


@runtime_checkable
class Measure(Protocol):
    """Mesh in, named values out.

    A unit is what the value scales with ("L", "L^2", ... "L^5": the core fills the mesh's length unit in) or absolute
    ("deg", ""). Values that move with the mesh are named in an attribute `positions`. A value `NAME_error` in the unit
    of another one, `NAME`, is its standard error: the closed loop does not follow what is off by less than half of it.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """The p values' names."""

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""

    def __call__(self, mesh: Trimesh) -> Array:
        """Values (p,). Raises MeasureError where a feature is not there."""


@runtime_checkable
class Surrogate(Protocol):
    """A way to learn a measure from meshes."""

    def fit(
        self, meshes: Sequence[Trimesh], values: Array, names: Sequence[str], units: Sequence[str], *, seed: int
    ) -> Measure:
        """A measure learned from values (n, p)."""


@runtime_checkable
class Model(Protocol):
    """Maps parameters (not meshes) to labels."""

    @property
    def names(self) -> tuple[str, ...]:
        """The labels it predicts."""

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """The parameters it needs, in order."""

    def __call__(self, parameters: Array) -> Array:
        """Labels (B, p) at parameters (B, d)."""

    def gradient(self, parameters: Array) -> Array:
        """Derivatives (B, p, d) at parameters (B, d)."""


@runtime_checkable
class Regression(Protocol):
    """A way to learn a model from exemplars' parameters and labels."""

    def fit(
        self,
        parameters: Array,
        labels: Array,
        *,
        inputs: Sequence[str],
        names: Sequence[str],
        units: Sequence[str],
        seed: int,
    ) -> Model:
        """A model of labels (n, p), called `names` in `units`, by parameters (n, d), called `inputs`.

        A NaN is a label that is not known: its row does not count for it.
        """


@runtime_checkable
class Source(Protocol):
    """Yields exemplars."""

    def __call__(self) -> Exemplars:
        """The exemplars; the same ones at every call."""


@runtime_checkable
class Checker(Protocol):
    """Makes checks of a stranger's own (hook `lampopt_checks`)."""

    @property
    def needs(self) -> Needs:
        """What must be there: alpha, field or mesh."""

    def __call__(self, bank: Bank, design: Design) -> Sequence[Check]:
        """The evidence about `design`."""


# Optional abilities: checked at run time by name; needing an absent one is refused by name.


@runtime_checkable
class Pullback(Protocol):
    """A decoder that carries gradients from vertices back to weights."""

    def pullback(self, shared: Shared, weights: Array, mesh: Trimesh, gradient: Array) -> Array:
        """(D,) from a gradient by vertices (V, 3)."""


@runtime_checkable
class Adjoint(Protocol):
    """A decoder that carries gradients from the values of `evaluate` back to weights."""

    def adjoint(self, shared: Shared, weights: Array, points: Array, gradient: Array) -> Array:
        """(D,) from a gradient (M, C) by the values at points (M, 3) of one weight vector (D,)."""


@runtime_checkable
class Follow(Protocol):
    """A decoder that makes meshes sooner of weights near those of the last one."""

    def follow(self, shared: Shared, *, resolution: int) -> Callable[[Array], Trimesh]:
        """What turns one weight vector (D,) after another into the mesh that `decode` makes of it, but for rounding.

        Threads may share it.
        """


@runtime_checkable
class Corresponding(Protocol):
    """A decoder whose exemplars have to share one connectivity: their vertices correspond as they come."""

    def corresponds(self, shared: Shared, mesh: Trimesh) -> bool:
        """Whether `mesh` has that connectivity."""


@runtime_checkable
class Displace(Protocol):
    """A decoder that moves points near its template along with the design."""

    def displace(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Moved points (M, 3)."""


@runtime_checkable
class DesignChecks(Protocol):
    """A decoder with checks of its own."""

    def design_checks(self, shared: Shared, weights: Array, mesh: Trimesh) -> Sequence[Check]:
        """The evidence about a mesh [box] decoded from `weights`."""


@runtime_checkable
class Gradient(Protocol):
    """A measure with derivatives by vertices."""

    def gradient(self, mesh: Trimesh) -> Array:
        """(p, V, 3)."""


@runtime_checkable
class Interval(Protocol):
    """A measure that states its uncertainty and its range."""

    def interval(self, mesh: Trimesh, level: float) -> Array:
        """(p, 2) low and high at coverage `level`."""

    def outside(self, mesh: Trimesh) -> bool:
        """Whether `mesh` lies outside what the measure was made for."""


@runtime_checkable
class Keeping(Protocol):
    """A measure that can keep what it works out, such as flow solutions: the same mesh is then not solved twice."""

    def kept_in(self, folder: Path) -> Measure:
        """The same measure, keeping it in `folder`; itself, where it was told another."""


@runtime_checkable
class External(Protocol):
    """A measure whose values another program works out: not all its options are what they depend on."""

    def depends_on(self) -> Mapping[str, Scalar]:
        """Options that the values depend on, by name; those of where and how fast it works are left out."""

    def program(self) -> str:
        """The program's name and version. Raises MeasureError where there is none."""


@runtime_checkable
class Uncertain(Protocol):
    """A model that states its uncertainty and its range: what `Interval` is to a measure."""

    def interval(self, parameters: Array, level: float) -> Array:
        """(B, p, 2) low and high at coverage `level`, at parameters (B, d)."""

    def outside(self, parameters: Array) -> Array:
        """(B,) whether parameters (B, d) lie outside what the model was made for."""


@runtime_checkable
class CrossValidated(Protocol):
    """A fitted measure or model that knows how well it told what it had not been shown."""

    @property
    def cross_validated(self) -> Mapping[str, Mapping[str, float]]:
        """By each of its names: `r2`, and where it is known `mean_absolute_error` [its unit]."""


@runtime_checkable
class Symbolic(Protocol):
    """A model that exists as a CasADi expression."""

    def symbolic(self, parameters: Any) -> Any:
        """The labels as an expression of `parameters` (d,)."""


@runtime_checkable
class State(Protocol):
    """A fitted measure or model that can be written to named arrays and made from them again."""

    def state(self) -> Mapping[str, Array]:
        """The arrays."""

    @classmethod
    def from_state(cls, state: Mapping[str, Array]) -> Any:
        """The object again."""
