"""A family from one mesh: named free-form deformations of it, each by a value."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.meshfile import load_mesh
from lampopt.types import Exemplars, Parameter

from .body import Body
from .deformation import Deformation
from .deformation_file import read_deformations
from .draws import draws
from .morphing import Morph, Morphs
from .parametric import check_draws
from .refine import refined
from .vehicle import vehicle

if TYPE_CHECKING:
    from trimesh import Trimesh

log = logging.getLogger("lampopt")
BASE = "base"  # the exemplar that is the body as it is
A_PARAMETER = 3  # exemplars, unless `count` says otherwise
COARSE = 0.1  # of the body's length: a face with a longer edge is a stiff plate
STIFF = 0.1  # share of the surface that may consist of such faces unnoticed
EXTENTS = ("extents.length", "extents.width", "extents.height")  # along x, y, z


@dataclass(frozen=True)
class MorphSource:
    """Free-form deformations of one mesh; the first exemplar, `base`, is the mesh as it is.

    Parameters
    ----------
    mesh
        A mesh file: STL, OBJ, PLY, GLB or another that is read.
    unit
        Its length unit.
    forward
        The way its nose points: x, -x, y, ...; by default along its longer horizontal side, to the low end, as in a
        wind tunnel whose wind blows that axis up.
    up
        The way its roof points.
    deformations
        Comma-separated names, in the order that the parameters are to have; by default all eight of a vehicle and
        those in `custom`.
    ranges
        Ranges that replace the deformations' own: "length=-0.3:0.3, roof=-0.1:0.15".
    custom
        TOML file of further deformations, one table each; one of a vehicle's names replaces that.
    count
        How many exemplars, `base` included; by default three for each deformation, and for the design `ends` the
        base and both ends of each.
    design
        `lhs`, `sobol`, `random`: draws over the ranges by Latin hypercube, scrambled Sobol sequence, or independently.
        `ends`: each deformation alone at its two ends.
    seed
        Of the draws.
    edge
        Longest edge [unit]: longer ones are halved beforehand, since a face bends at its corners only. By default the
        mesh stays as it is.

    Raises
    ------
    InputError
        For options that make no family.
    """

    mesh: str
    unit: str = "m"
    forward: str = ""
    up: str = "z"
    deformations: str = ""
    ranges: str = ""
    custom: str = ""
    count: int = 0
    design: str = "lhs"
    seed: int = 0
    edge: float = 0.0

    def __post_init__(self) -> None:
        check_draws("morph", self.design, count=self.count, seed=self.seed)
        if not 0 <= self.edge < float("inf"):
            raise InputError(f"morph: edge: expected a length, or 0 for the mesh as it is, got {self.edge}")
        _ranges(self.ranges)

    @staticmethod
    def example() -> MorphSource:
        """An ellipsoid in a temporary folder, which is removed when Python ends: for `lampopt.testing.check_plugin`."""
        import atexit
        from shutil import rmtree
        from tempfile import mkdtemp

        from trimesh.creation import icosphere

        folder = Path(mkdtemp(prefix="lampopt-morph-"))
        atexit.register(rmtree, folder, ignore_errors=True)
        body = icosphere(subdivisions=3)
        body.vertices *= (2.0, 0.9, 0.7)
        body.export(folder / "body.ply")
        return MorphSource(str(folder / "body.ply"), count=6)

    def __call__(self) -> Exemplars:
        """The exemplars; meshes are made on access.

        Raises
        ------
        InputError
            If a file cannot be read or a name is unknown; on access, where a deformation folds the body over.
        """
        from trimesh import Trimesh

        mesh = load_mesh(self.mesh)
        if self.edge:
            mesh = Trimesh(*refined(np.asarray(mesh.vertices), np.asarray(mesh.faces), self.edge), process=False)
        body = Body.of(mesh, forward=self.forward, up=self.up)
        if (stiff := _stiff(body)) > STIFF:
            log.warning(
                "morph: %s: %.0f %% of the surface are faces longer than %g of the body, which stay flat; "
                "edge=%.2g divides them", self.mesh, 100 * stiff, COARSE, COARSE / 4 * body.size[0]
            )  # fmt: skip
        known = {d.name: d for d in vehicle(body)}
        if self.custom:
            known |= {d.name: d for d in read_deformations(self.custom, body)}
        return family(body, self._chosen(known), unit=self.unit, count=self.count, design=self.design, seed=self.seed)

    def _chosen(self, known: dict[str, Deformation]) -> list[Deformation]:
        ranges = _ranges(self.ranges)
        names = [name.strip() for name in self.deformations.split(",") if name.strip()] or list(known)
        for option, given in (("deformations", names), ("ranges", list(ranges))):
            if unknown := sorted(set(given) - set(known)):
                raise InputError(f"morph: {option}: unknown {', '.join(unknown)}; known are {', '.join(known)}")
            if twice := sorted({name for name in given if given.count(name) > 1}):
                raise InputError(f"morph: {option}: {', '.join(twice)} named twice")
        if idle := sorted(set(ranges) - set(names)):
            raise InputError(f"morph: ranges: {', '.join(idle)} not among the deformations chosen, {', '.join(names)}")
        chosen = []
        for name in names:
            low, high = ranges.get(name, (known[name].low, known[name].high))
            chosen.append(replace(known[name], low=low, high=high))
        return chosen


def family(
    body: Body | Trimesh,
    deformations: Sequence[Deformation] = (),
    *,
    unit: str = "m",
    count: int = 0,
    design: str = "lhs",
    seed: int = 0,
) -> Exemplars:
    """Exemplars from a mesh and deformations that are at hand; what `MorphSource` does with files.

    Parameters
    ----------
    body
        A mesh, its nose at the low end of its longer horizontal side, z up; or `Body.of(mesh, forward=..., up=...)`.
    deformations
        By default the eight of a vehicle.
    unit, count, design, seed
        As in `MorphSource`.

    Raises
    ------
    InputError
        For what makes no family.
    """
    check_draws("morph", design, count=count, seed=seed)
    body = body if isinstance(body, Body) else Body.of(body)
    morph = Morph.of(body, deformations or vehicle(body))
    chosen = [field.deformation for field in morph.fields]
    low, high = (np.array([getattr(d, end) for d in chosen], float) for end in ("low", "high"))
    names, parameters = [BASE], np.zeros((1, len(chosen)))
    if design == "ends":
        ends = [(d.name, end, k) for k, d in enumerate(chosen) for end in ("low", "high") if getattr(d, end)]
        names += [f"{name}_{end}" for name, end, _ in ends]  # an end at 0 is the base
        parameters = np.zeros((len(names), len(chosen)))
        for row, (_, end, k) in enumerate(ends, 1):
            parameters[row, k] = (low if end == "low" else high)[k]
        if count not in (0, len(names)):
            raise InputError(f"morph: design 'ends' has {len(names)} exemplars here, got count={count}")
    else:
        count = count or A_PARAMETER * len(chosen)
        parameters = np.concatenate([parameters, draws(design, count - 1, low, high, seed)])
        names += [f"morph_{i:0{len(str(count - 1))}d}" for i in range(1, count)]
    return Exemplars(
        parameters=parameters,
        space=tuple(Parameter(d.name, "deg" if d.angle else unit) for d in chosen),
        meshes=Morphs(morph, parameters),
        names=tuple(names),
        unit=unit,
        measured=_measured(body, chosen, len(names)),
        mesh_at=morph,
    )


def _ranges(text: str) -> dict[str, tuple[float, float]]:
    """ "length=-0.3:0.3, roof=-0.1:0.15" by name."""
    found: dict[str, tuple[float, float]] = {}
    for part in filter(None, map(str.strip, text.split(","))):
        name, equals, values = part.partition("=")
        low, colon, high = values.partition(":")
        try:
            if not (equals and colon) or name.strip() in found:
                raise ValueError
            found[name.strip()] = (float(low), float(high))
        except ValueError:
            raise InputError(
                f"morph: ranges: expected each name once, as in 'length=-0.3:0.3, roof=-0.1:0.15', got {part!r}"
            ) from None
    return found


def _measured(body: Body, deformations: Sequence[Deformation], count: int) -> dict[str, str]:
    """The stretches of the whole body, which its extents show.

    Others may move the extents too, as a greenhouse moves the mirrors. Over few exemplars (fewer than three more than
    parameters) the core cannot tell them apart, and a bank would be refused for it: then only what is alone on its axis
    is declared.
    """
    found = {}
    for d in deformations:
        if d.kind == "stretch" and not any(any(d.ends(axis)) for axis in range(3)):
            axis = int(np.abs(d.vector).argmax())
            alone = not any(other is not d and (other.kind == "turn" or other.vector[axis]) for other in deformations)
            if alone or count >= len(deformations) + 3:
                found[d.name] = EXTENTS[body.index[axis]]
    return found


def _stiff(body: Body) -> float:
    """The share of the surface that is made of faces with an edge longer than `COARSE`."""
    corners = body.vertices[body.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    areas = np.linalg.norm(body.areas, axis=1)
    return float(areas[longest > COARSE * body.size[0]].sum() / areas.sum())
