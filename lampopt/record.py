"""Results → a run folder that loses nothing.

    study.toml     what was asked last
    runs.sqlite    a row per design: targets, alpha, checks, status, time
    designs/KEY/   mesh and passport.json of each design whose mesh was made

A design's key is the hash of bank, resolved study and target: a row that is there is never computed again. Files are
written aside and renamed, the row comes last, so a run that is killed at any moment goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from lampopt.database import readable, said, writable
from lampopt.errors import InputError
from lampopt.meshfile import FORMATS, load_mesh
from lampopt.types import Bank, Check, Conflict, Design, Mix, Result, Scalar

if TYPE_CHECKING:
    from trimesh import Trimesh

KEY = re.compile(r"[0-9a-f]{24}")  # of a design; nothing else is taken from a database for the name of a folder
log = logging.getLogger("lampopt")


@dataclass(frozen=True)
class MeshFile:
    """The file of a recorded design's mesh, which may be gone or no longer what was written."""

    path: Path
    digest: str | None  # of the bytes written; None in rows of schema 1
    passport: Callable[[], str]

    def read(self) -> Trimesh | None:
        """The mesh; None if the file is gone or, which is said, not what was written."""
        try:
            if not self.path.exists():
                return None
            if self.digest is not None and _digest(self.path) != self.digest:
                raise InputError(f"mesh {self.path}: is not what was written")
            return load_mesh(self.path)
        except (OSError, InputError) as error:
            log.warning("%s; it is decoded again", error)
            return None

    def restore(self, mesh: Trimesh) -> None:
        """Write the file and the passport beside it anew; says so where that cannot be."""
        aside = self.path.parent.with_name(f"{self.path.parent.name}.{os.getpid()}.mesh.writing")
        try:
            _write_mesh(mesh, aside, self.path.suffix[1:])
            if self.digest not in (None, _digest(aside)):
                log.warning("%s: decodes to another mesh than was recorded, by other versions; not written", self.path)
                return
            self.path.parent.mkdir(exist_ok=True)
            os.replace(aside, self.path)
            _replace(self.path.with_name("passport.json"), self.passport())
        except OSError as error:
            log.warning("%s: cannot be written anew: %s", self.path, error)
        finally:
            with suppress(OSError):
                aside.unlink(missing_ok=True)


class Rebuild(Protocol):
    """Makes a recorded design again from what its row says."""

    def __call__(
        self, target: Mapping[str, float], mix: Mix, mesh: MeshFile | None, provenance: Mapping[str, Scalar], /
    ) -> Design:
        """`mesh` is None where none was made."""


@dataclass(frozen=True)
class RunFolder:
    """An open run folder; only one process at a time has it to write."""

    folder: Path
    database: sqlite3.Connection

    @classmethod
    @contextmanager
    def open(cls, folder: str | Path) -> Iterator[RunFolder]:
        """Open or create `folder` under a lock.

        Raises
        ------
        InputError
            If another process has it, it cannot be written, or its database is of a newer schema or damaged.
        """
        from filelock import FileLock, Timeout

        folder = Path(folder)
        try:
            (folder / "designs").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be used as a run folder: {error}") from error
        lock = FileLock(folder / "runs.lock", timeout=0)
        with _writing(folder):
            try:
                lock.acquire()
            except Timeout as error:
                raise InputError(
                    f"{folder}: another process is running here; wait for it or name another folder"
                ) from error
        try:
            with _writing(folder):
                _tidy(folder)
            with writable(folder / "runs.sqlite") as database:
                yield cls(folder, database)
        finally:
            lock.release()

    @classmethod
    @contextmanager
    def open_to_read(cls, folder: str | Path) -> Iterator[RunFolder]:
        """Open `folder` without its lock, and without writing to it.

        Raises
        ------
        InputError
            If no run is recorded there, or its database is of a newer schema or damaged.
        """
        folder = Path(folder)
        with readable(folder / "runs.sqlite") as database:
            yield cls(folder, database)

    def write_study(self, text: str) -> None:
        """Keep what was asked. Raises InputError if it cannot be written."""
        with _writing(self.folder):
            _replace(self.folder / "study.toml", text)

    def write(self, key: str, result: Result, bank: Bank, *, form: str, seconds: float) -> Result:
        """Put a result on disk: mesh and passport where a mesh was made, then the row. Returns it with its folder.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        design, folder, digest = result.design, self.folder, None
        mesh = design.__dict__.get("mesh")  # only a mesh that was made: recording decodes nothing
        if mesh is not None:
            folder = self._place(key)
            with _writing(folder):
                digest = _put(folder, mesh, form, _passport(result, bank))
        with said(self._file), self.database:
            self.database.execute(
                "INSERT OR REPLACE INTO designs VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?)",
                (
                    key,
                    json.dumps(dict(design.target)),
                    design.mix.alpha.tobytes(),
                    design.mix.residual.tobytes(),
                    design.mix.status,
                    design.mix.message,
                    json.dumps([[conflict.names, conflict.amounts.tolist()] for conflict in design.mix.conflicts]),
                    json.dumps([_as_row(check) for check in result.checks]),
                    int(result.accepted),
                    json.dumps(dict(result.provenance)),
                    f"mesh.{form}" if mesh is not None else None,
                    seconds,
                    digest,
                ),
            )
        return replace(result, folder=folder)

    def has(self, key: str) -> bool:
        """Whether a result is recorded under `key`."""
        with said(self._file):
            return self.database.execute("SELECT 1 FROM designs WHERE key = ?", (key,)).fetchone() is not None

    def read(self, key: str, bank: Bank, rebuild: Rebuild) -> Result | None:
        """The result recorded under `key`, or None.

        Its mesh is read from its file on access; one that is gone or not what was written is decoded again, and
        written anew with its passport.

        Raises
        ------
        InputError
            If what is recorded there is damaged.
        """
        with said(self._file):
            row = self.database.execute(
                "SELECT target, alpha, residual, status, message, conflicts, checks, provenance, mesh, digest "
                "FROM designs WHERE key = ?",
                (key,),
            ).fetchone()
        if row is None:
            return None
        try:
            return self._decoded(key, row, bank, rebuild)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise InputError(
                f"{self._file}: the row of design {key} is damaged: {error}; delete that row (DELETE FROM designs "
                f"WHERE key = {key!r}) and it is made anew"
            ) from error

    def results(self, bank: Bank, rebuild: Rebuild) -> Iterator[Result]:
        """Every result recorded of `bank`, in the order recorded; those of another bank are counted in a warning."""
        with said(self._file):
            rows = self.database.execute("SELECT key, alpha, provenance FROM designs ORDER BY rowid").fetchall()
        foreign = 0
        for key, alpha, provenance in rows:
            if not _of(bank, alpha, provenance):
                foreign += 1
                continue
            result = self.read(key, bank, rebuild)
            if result is not None:
                yield result
        if foreign:
            log.warning("%s: %d of %d designs are of another bank and left out", self.folder, foreign, len(rows))

    def _decoded(self, key: str, row: tuple[Any, ...], bank: Bank, rebuild: Rebuild) -> Result:
        target, alpha, residual, status, message, conflicts, checks, provenance, mesh, digest = row
        if not (isinstance(key, str) and KEY.fullmatch(key)):
            raise ValueError(f"expected a key of 24 hexadecimal digits, got {key!r:.80}")
        if mesh is not None and mesh not in [f"mesh.{form}" for form in FORMATS]:
            raise ValueError(f"expected a mesh file such as mesh.{FORMATS[0]}, got {mesh!r:.80}")
        clashes = tuple(Conflict(tuple(names), np.array(amounts)) for names, amounts in json.loads(conflicts))
        mix = Mix(np.frombuffer(alpha), np.frombuffer(residual), status, message, clashes)
        place = self._place(key)
        known = dict(json.loads(provenance))
        file = None if mesh is None else MeshFile(place / mesh, digest, lambda: _passport(result, bank))
        design = rebuild(json.loads(target), mix, file, known)
        found = tuple(_from_row(check) for check in json.loads(checks))
        result = Result(design, found, known, self.folder if mesh is None else place)
        return result

    @property
    def _file(self) -> Path:
        return self.folder / "runs.sqlite"

    def _place(self, key: str) -> Path:
        return self.folder / "designs" / key


def _tidy(folder: Path) -> None:
    """Remove what killed runs were writing."""
    for left in (*folder.glob("*.writing"), *(folder / "designs").glob("*.writing")):
        if left.is_dir() and left.parent != folder:
            shutil.rmtree(left)
        else:
            left.unlink(missing_ok=True)


def _put(folder: Path, mesh: Trimesh, form: str, text: str) -> str:
    """Write a design's folder in one step; returns the hash of its mesh file."""
    aside = folder.with_name(folder.name + ".writing")
    try:
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir()
        file = aside / f"mesh.{form}"
        _write_mesh(mesh, file, form)
        digest = _digest(file)
        (aside / "passport.json").write_text(text, encoding="utf-8")
        shutil.rmtree(folder, ignore_errors=True)  # no row names it: left by a run that was killed
        os.replace(aside, folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)  # on a full disk it would take what room there is
    return digest


def _of(bank: Bank, alpha: Any, provenance: Any) -> bool:
    """Whether a row was made from `bank`; one that is damaged passes, and is named when it is read."""
    try:
        same = json.loads(provenance).get("bank.plan") == bank.provenance.get("plan")
        return (same and len(alpha) == 8 * len(bank)) or len(alpha) % 8 > 0
    except (ValueError, TypeError, AttributeError, RecursionError):
        return True


def _passport(result: Result, bank: Bank) -> str:
    return json.dumps(passport(result, bank), indent=2)


def _as_row(check: Check) -> list[Any]:
    value = None if check.value != check.value else check.value  # JSON knows no NaN
    return [check.name, value, check.sense, check.limit, check.unit, check.needs, check.note]


def _from_row(row: list[Any]) -> Check:
    name, value, *rest = row
    return Check(name, float("nan") if value is None else value, *rest)


def passport(result: Result, bank: Bank) -> dict[str, Any]:
    """All that is known of a design, as plain JSON: what was asked, what came, the evidence, where it comes from."""
    design = result.design
    return {
        "accepted": result.accepted,
        "target": dict(design.target),
        "status": design.mix.status,
        "message": design.mix.message,
        "predicted": {
            q.name: {"value": float(v), "unit": q.unit} for q, v in zip(bank.space, design.predicted, strict=True)
        },
        "checks": [
            {
                "name": check.name,
                "value": check.value if np.isfinite(check.value) else None,
                "sense": check.sense,
                "limit": check.limit,
                "unit": check.unit,
                "passed": check.passed,
                "needs": check.needs,
                "note": check.note,
            }
            for check in result.checks
        ],
        "alpha": {name: float(a) for name, a in zip(bank.names, design.mix.alpha, strict=True)},
        "unit": bank.frame.unit,
        "provenance": dict(result.provenance),
    }


def export_mesh(mesh: Trimesh, path: str | Path) -> Path:
    """Write `mesh` to `path` in one step; the format is told by the suffix.

    Raises
    ------
    InputError
        If the format is unknown or the place cannot be written.
    """
    path = Path(path)
    form = path.suffix.lower().lstrip(".")
    if form not in FORMATS:
        raise InputError(f"{path}: expected a file name ending in .{', .'.join(FORMATS)}")
    aside = path.with_name(path.name + ".writing")
    try:
        _write_mesh(mesh, aside, form)
        os.replace(aside, path)
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise InputError(f"{path}: cannot be written: {error}") from error
    finally:
        with suppress(OSError, ValueError):
            aside.unlink(missing_ok=True)
    return path


@contextmanager
def _writing(place: Path) -> Iterator[None]:
    """Say what cannot be written, and that nothing is lost by it."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{place}: cannot be written: {error}; what is recorded there is kept") from error


def _write_mesh(mesh: Trimesh, path: Path, form: str) -> None:
    data: Any = mesh.export(file_type=form)  # not to the path itself: trimesh leaves that open where the disk is full
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def _digest(path: Path) -> str:
    """A hash of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def _replace(path: Path, text: str) -> None:
    aside = path.with_name(path.name + ".writing")
    aside.write_text(text, encoding="utf-8")
    os.replace(aside, path)
