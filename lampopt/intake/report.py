"""The stage itself: every mesh is looked at once, alone and against its fellows; what is wrong is told all at once."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, overload

import numpy as np

from lampopt import lamp
from lampopt.errors import InputError, LampoptError
from lampopt.intake.fellows import Fellows
from lampopt.intake.health import examine, own_findings
from lampopt.intake.records import Finding, Health
from lampopt.intake.repair import repaired
from lampopt.meshfile import indexed
from lampopt.progress import silent
from lampopt.protocols import Progress
from lampopt.types import Array, Exemplars

if TYPE_CHECKING:
    from trimesh import Trimesh

ALL = "all"
BY_NAME = ("size",)  # kinds of refusal that accepting the exemplar by name overrules: the user knows better
log = logging.getLogger("lampopt")


@dataclass(frozen=True, eq=False)
class Intake:
    """What `intake` found. It holds no mesh.

    Parameters
    ----------
    given
        The exemplars that were looked at.
    health
        One record for each mesh that could be looked at.
    findings
        What is to be said, exemplar by exemplar.
    accepted
        Names whose doubts are settled, or "all".
    facts
        What a bank needs to know of the meshes.
    """

    given: Exemplars
    health: tuple[Health, ...]
    findings: tuple[Finding, ...]
    accepted: tuple[str, ...] | str
    facts: Facts

    @property
    def problems(self) -> tuple[Finding, ...]:
        """What stands in the way: everything refused, and every doubt that was not accepted; refused ones first."""
        open_ones = [f for f in self.findings if f.severity != "note" and not self._settled(f)]
        return tuple(sorted(open_ones, key=lambda f: f.severity != "refused"))

    @property
    def exemplars(self) -> Exemplars:
        """Those that can be used, repaired on access; the given ones themselves where there is nothing to do.

        Raises
        ------
        InputError
            If there is none.
        """
        bad = {finding.exemplar for finding in self.problems}
        rows = [i for i, name in enumerate(self.given.names) if name not in bad]
        mended = {h.name for h in self.health if h.repairs}
        if len(rows) == len(self.given) and not mended:
            return self.given
        if not rows:
            raise InputError(self.message())
        return replace(
            self.given,
            parameters=self.given.parameters[rows],
            labels=self.given.labels[rows],
            names=tuple(self.given.names[i] for i in rows),
            mesh_at=self.given.mesh_at and partial(_repaired_at, self.given.mesh_at),
            meshes=_Repaired(self.given.meshes, rows, [self.given.names[i] in mended for i in rows]),
        )

    def refuse(self) -> None:
        """Raise InputError naming every exemplar that stands in the way, if any does."""
        if self.problems:
            raise InputError(self.message())

    def message(self) -> str:
        """Every problem in one text, a line each; empty if there is none."""
        refused = [f for f in self.problems if f.severity == "refused"]
        doubtful = [f for f in self.problems if f.severity == "doubtful"]
        lines = []
        if refused:
            lines += [f"{_exemplars(refused)} of {len(self.given)} cannot be used:", *(f"  {f}" for f in refused)]
        if doubtful:
            whose = dict.fromkeys(f.exemplar for f in doubtful)
            names, flags = ", ".join(map(repr, whose)), " ".join(f"--accept {quote(name)}" for name in whose)
            lines += [
                f"{_exemplars(doubtful)} of {len(self.given)} {'is' if _count(doubtful) == 1 else 'are'} in doubt:",
                *(f"  {f}" for f in doubtful),
                f"Those that are meant to be so: accept them by name, accept=({names},) or {flags}",
            ]
        return "\n".join(lines)

    def _settled(self, finding: Finding) -> bool:
        if finding.severity == "doubtful":
            return self.accepted == ALL or finding.exemplar in self.accepted
        return finding.kind in BY_NAME and self.accepted != ALL and finding.exemplar in self.accepted


@dataclass(frozen=True)
class Facts:
    """What one look at every mesh tells a bank, of those that could be looked at."""

    bounds: Array  # (n, 2, 3) [unit]
    hashes: tuple[str, ...]
    mean: str | None  # hash of the mesh at the mean design, where the source knows it
    common: Mapping[str, int]  # bodies and genus, where all have the same


def intake(
    exemplars: Exemplars,
    *,
    repair: bool = True,
    accept: Iterable[str] = (),
    fellows: bool = True,
    crossings: bool = True,
    progress: Progress | None = None,
) -> Intake:
    """Look at every mesh before anything is fitted.

    Parameters
    ----------
    exemplars
        N meshes with parameters; one is held at a time.
    repair
        Make safe repairs; each is listed. A mesh that needs none is used bit for bit as it is.
    accept
        Names of exemplars whose doubts are settled, or "all". A size that was refused is overruled by the name alone.
    fellows
        Hold each mesh against the others, too.
    crossings
        Count pairs of faces that cross: most of the time, on a large mesh.
    progress
        Told how far it is.

    Returns
    -------
    Intake
        Also where meshes cannot be used: what is wrong is in its `problems`.

    Raises
    ------
    InputError
        If `exemplars` are none, or `accept` names no exemplar.
    """
    if not isinstance(exemplars, Exemplars):
        raise InputError(f"exemplars: expected lampopt.types.Exemplars, got {exemplars!r:.80}")
    accepted = _accepted(accept, exemplars.names)
    tell = progress or silent
    health: list[Health] = []
    findings: list[Finding] = []
    bounds: list[Array] = []
    hashes: dict[str, int] = {}
    hashed: list[str] = []
    family = Fellows(exemplars.unit, exemplars.space)
    for i, name in enumerate(exemplars.names):
        tell(i / len(exemplars), f"looking at {name}")
        mesh, why = _loaded(exemplars, i)
        if mesh is None:
            findings.append(Finding(name, "unreadable", "refused", why))
            continue
        mesh, words = repaired(mesh) if repair else (mesh, ())
        one = examine(mesh, name, words, crossings=crossings)
        health.append(one)
        findings += own_findings(one, mesh, exemplars.unit, _file(exemplars.meshes, i))
        family.add(one, mesh, exemplars.parameters[i])
        bounds.append(mesh.bounds)
        hashed.append(digest(mesh))
        first = hashes.setdefault(hashed[-1], i)
        if not np.array_equal(exemplars.parameters[first], exemplars.parameters[i]):
            both = (exemplars.names[first], name)
            log.warning("exemplars %r and %r: one mesh, different parameters; one of the two may be wrong", *both)
            message = f"has the mesh of {both[0]!r}, but other parameters: one of the two may be wrong"
            findings.append(Finding(name, "same mesh", "note", message))
    if fellows:
        findings += family.findings(_by_name(exemplars, repair))
    place = {name: i for i, name in enumerate((*exemplars.names, ""))}  # the family as a whole comes last
    findings.sort(key=lambda f: place[f.exemplar])
    shapes = {(h.bodies, h.genus) for h in health}
    bodies, genus = next(iter(shapes)) if len(shapes) == 1 else (0, None)
    common = {} if genus is None else {"bodies": bodies, "genus": genus}
    mean = None if exemplars.mesh_at is None else digest(exemplars.mesh_at(exemplars.parameters.mean(0)))
    facts = Facts(np.array(bounds).reshape(-1, 2, 3), tuple(hashed), mean, common)
    tell(1.0, "looked at all")
    return Intake(exemplars, tuple(health), tuple(findings), accepted, facts)


def digest(mesh: Trimesh) -> str:
    """A hash of vertices and faces."""
    return lamp.digest(np.asarray(mesh.vertices, float)) + lamp.digest(np.asarray(mesh.faces, np.int64))


def _loaded(exemplars: Exemplars, index: int) -> tuple[Trimesh | None, str]:
    """A mesh that can be looked at, or None and why there is none."""
    from trimesh import Trimesh

    try:
        mesh: object = exemplars.meshes[index]  # by index: a loader's IndexError would end an iteration
    except LampoptError as error:
        return None, f"{error}; mend or remove it"
    except Exception as error:  # noqa: BLE001  # whatever a stranger's source raises
        return None, f"cannot be loaded: {error!r}; mend or remove it"
    if not isinstance(mesh, Trimesh):
        return None, f"expected a trimesh.Trimesh, got {mesh!r:.80}"
    if not indexed(mesh) or len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        return None, "expected a mesh with faces and finite vertices; repair or remove it"
    return mesh, ""


def _by_name(exemplars: Exemplars, repair: bool) -> Callable[[str], Trimesh]:
    def mesh_of(name: str) -> Trimesh:
        mesh = exemplars.meshes[exemplars.names.index(name)]
        return repaired(mesh)[0] if repair else mesh

    return mesh_of


def _file(meshes: Sequence[Trimesh], index: int) -> str | None:
    """Which file a mesh comes from, where the sequence says so: `folder` and `files`, as that of source `table`."""
    folder, files = getattr(meshes, "folder", None), getattr(meshes, "files", None)
    return None if folder is None or files is None else str(Path(folder) / files[index])


def _accepted(accept: Iterable[str], names: Sequence[str]) -> tuple[str, ...] | str:
    if accept == ALL:
        return ALL
    if not isinstance(accept, Iterable):
        raise InputError(f"accept: expected names of exemplars or {ALL!r}, got {accept!r:.80}")
    listed = (accept,) if isinstance(accept, str) else tuple(accept)
    if unknown := [name for name in listed if name not in names]:
        shown = ", ".join(map(repr, names[:20])) + (" and more" if len(names) > 20 else "")
        raise InputError(f"accept: expected names of exemplars or {ALL!r}, got {unknown[0]!r}; names are {shown}")
    return listed


def _exemplars(findings: Sequence[Finding]) -> str:
    count = _count(findings)
    return f"{count} exemplar" if count == 1 else f"{count} exemplars"


def _count(findings: Sequence[Finding]) -> int:
    return len({finding.exemplar for finding in findings})


def _repaired_at(mesh_at: Callable[[Array], Trimesh], parameters: Array) -> Trimesh:
    """What is wrong with a source's exemplars is with its other shapes, too."""
    return repaired(mesh_at(parameters))[0]


class _Repaired(Sequence["Trimesh"]):
    """Some of `meshes`, those that need it repaired on access; nothing is kept."""

    def __init__(self, meshes: Sequence[Trimesh], rows: Sequence[int], mend: Sequence[bool]) -> None:
        self._meshes, self._rows, self._mend = meshes, rows, mend

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[Trimesh]:
        return (self[i] for i in range(len(self)))

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> _Repaired: ...
    def __getitem__(self, index: int | slice) -> Trimesh | _Repaired:
        if isinstance(index, slice):
            return _Repaired(self._meshes, self._rows[index], self._mend[index])
        mesh = self._meshes[self._rows[index]]
        return repaired(mesh)[0] if self._mend[index] else mesh
