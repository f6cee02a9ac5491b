"""Results → a run folder that loses nothing.

    study.toml     what was asked last
    runs.sqlite    a row per design: targets, alpha, checks, status, time
    designs/KEY/   mesh and passport.json of each design whose mesh was made

A design's key is the hash of bank, resolved study and target: a row that is there is never computed again. Files are
written aside and renamed, the row comes last, so a run that is killed at any moment goes on where it stopped.
"""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from lampopt.database import Reader, said, writable
from lampopt.errors import InputError
from lampopt.meshfile import FORMATS
from lampopt.reading import brief, path_of, why
from lampopt.rows import (
    read_checks,
    read_conflicts,
    read_provenance,
    read_target,
    written_checks,
    written_conflicts,
)
from lampopt.types import Bank, Design, Mix, Result, Scalar
from lampopt.written import MeshFile, digest_of, replace_text, write_mesh

if TYPE_CHECKING:
    from trimesh import Trimesh

COLUMNS = "key, target, alpha, residual, status, message, conflicts, checks, provenance, mesh, digest"
PAGE = 256  # designs that are held while a run is read
KEY = re.compile(r"[0-9a-f]{24}")  # of a design; nothing else is taken from a database for the name of a folder
ASIDE = re.compile(r"(study\.toml|report\.html|bank(-\w+)?\.lamp)(\.\d+)?\.writing")  # what is being written
ASIDE_DESIGN = re.compile(r"[0-9a-f]{24}(\.\d+\.mesh)?\.writing")
log = logging.getLogger("lampopt")


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

        folder = path_of(folder, "folder")
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

    def write_study(self, text: str, task: str, keys: Iterable[str]) -> None:
        """Keep what was asked, its identity, which its designs have, and their keys in order.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        with _writing(self.folder), said(self._file), self.database:
            self.database.execute("DELETE FROM asked")
            self.database.execute("INSERT INTO asked VALUES (?)", (task,))
            self.database.execute("DELETE FROM sweep")
            self.database.executemany("INSERT INTO sweep (key) VALUES (?)", ((key,) for key in keys))
            replace_text(self.folder / "study.toml", text)

    def asked(self) -> tuple[str, str, list[str]]:
        """What `write_study` was given last."""
        with said(self._file):
            ((task,),) = self.database.execute("SELECT task FROM asked")
            keys = [key for (key,) in self.database.execute("SELECT key FROM sweep ORDER BY number")]
        return (self.folder / "study.toml").read_text(encoding="utf-8"), task, keys

    def write(self, key: str, result: Result, bank: Bank, *, task: str, form: str, seconds: float) -> Result:
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
                "INSERT OR REPLACE INTO designs VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?)",
                (
                    key,
                    json.dumps(dict(design.target)),
                    design.mix.alpha.tobytes(),
                    design.mix.residual.tobytes(),
                    design.mix.status,
                    design.mix.message,
                    written_conflicts(design.mix.conflicts),
                    written_checks(result.checks),
                    int(result.accepted),
                    json.dumps(dict(result.provenance)),
                    f"mesh.{form}" if mesh is not None else None,
                    seconds,
                    digest,
                    task,
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
            row = self.database.execute(f"SELECT {COLUMNS} FROM designs WHERE key = ?", (key,)).fetchone()
        return None if row is None else _read(self.folder, row, bank, rebuild)

    @property
    def _file(self) -> Path:
        return self.folder / "runs.sqlite"

    def _place(self, key: str) -> Path:
        return self.folder / "designs" / key


def recorded(folder: Path, bank: Bank, rebuild: Rebuild, *, every: bool = False) -> Iterator[Result]:
    """The results recorded in `folder`: of the study that was asked last, or of `every` one.

    First come those that were asked for last, in that order, whichever of many workers was done first; then the others
    as they were recorded.

    What is yielded is what was recorded at the beginning, whatever another process writes meanwhile; it is read a page
    at a time, without lock, and without writing. Designs of another bank than `bank` cannot be read with it: they and
    those of other studies are counted in a warning. A design of schema 1 does not know its study, and is yielded.

    Raises
    ------
    InputError
        If no run is recorded there, its database is damaged or of a newer schema, or a row was deleted meanwhile.
    """
    reader = Reader(folder / "runs.sqlite")
    listed = reader.rows(
        "SELECT key, task IN ('', coalesce((SELECT task FROM asked), task)) FROM designs LEFT JOIN "
        "(SELECT key, min(number) AS number FROM sweep GROUP BY key) USING (key) "
        "ORDER BY number IS NULL, number, designs.rowid"
    )
    keys = [key for key, asked in listed if asked or every]
    if others := len(listed) - len(keys):
        log.warning(
            "%s: %d of %d designs are of other studies and left out; results(folder, every=True) has them all",
            folder,
            others,
            len(listed),
        )
    foreign = 0
    for first in range(0, len(keys), PAGE):
        page = keys[first : first + PAGE]
        marks = ",".join("?" * len(page))
        rows = {row[0]: row for row in reader.rows(f"SELECT {COLUMNS} FROM designs WHERE key IN ({marks})", page)}
        for key in page:
            if key not in rows:
                raise InputError(f"{folder}: design {key!r:.80} was deleted while the run is read; read it again")
            if _of(bank, rows[key]):
                yield _read(folder, rows[key], bank, rebuild)
            else:
                foreign += 1
    if foreign:
        log.warning("%s: %d of %d designs are of another bank and left out", folder, foreign, len(listed))


def _read(folder: Path, row: tuple[Any, ...], bank: Bank, rebuild: Rebuild) -> Result:
    try:
        return _decoded(folder, row, bank, rebuild)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(
            f"{folder / 'runs.sqlite'}: the row of design {brief(row[0])} is damaged: {why(error)}; delete that row "
            f"(DELETE FROM designs WHERE key = {row[0]!r:.80}) and it is made anew"
        ) from error


def _decoded(folder: Path, row: tuple[Any, ...], bank: Bank, rebuild: Rebuild) -> Result:
    key, target, alpha, residual, status, message, conflicts, checks, provenance, mesh, digest = row
    if not (isinstance(key, str) and KEY.fullmatch(key)):
        raise ValueError(f"expected a key of 24 hexadecimal digits, got {key!r:.80}")
    if mesh is not None and mesh not in [f"mesh.{form}" for form in FORMATS]:
        raise ValueError(f"expected a mesh file such as mesh.{FORMATS[0]}, got {mesh!r:.80}")
    if not isinstance(message, str):
        raise ValueError(f"expected a text as message, got {message!r:.80}")
    mix = Mix(np.frombuffer(alpha), np.frombuffer(residual), status, message, read_conflicts(conflicts))
    place = folder / "designs" / key
    known = read_provenance(provenance)
    file = None if mesh is None else MeshFile(place / mesh, digest, lambda: _passport(result, bank))
    design = rebuild(read_target(target), mix, file, known)
    result = Result(design, read_checks(checks), known, folder if mesh is None else place)
    return result


def _tidy(folder: Path) -> None:
    """Remove what killed runs were writing."""
    for left in (*folder.glob("*.writing"), *(folder / "designs").glob("*.writing")):
        if not (ASIDE if left.parent == folder else ASIDE_DESIGN).fullmatch(left.name):
            continue  # the user's own
        if left.is_dir() and not left.is_symlink() and left.parent != folder:  # there it is files that are written
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
        write_mesh(mesh, file, form)
        digest = digest_of(file)
        (aside / "passport.json").write_text(text, encoding="utf-8")
        shutil.rmtree(folder, ignore_errors=True)  # no row names it: left by a run that was killed
        os.replace(aside, folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)  # on a full disk it would take what room there is
    return digest


def _of(bank: Bank, row: tuple[Any, ...]) -> bool:
    """Whether a row was made from `bank`; one that is damaged passes, and is named when it is read."""
    alpha, provenance = row[2], row[8]
    try:
        same = json.loads(provenance).get("bank.plan") == bank.provenance.get("plan")
        return (same and len(alpha) == 8 * len(bank)) or len(alpha) % 8 > 0
    except (ValueError, TypeError, AttributeError, RecursionError):
        return True


def _passport(result: Result, bank: Bank) -> str:
    return json.dumps(passport(result, bank), indent=2)


def passport(result: Result, bank: Bank) -> dict[str, Any]:
    """All that is known of a design, as plain JSON: what was asked, what came, the evidence, where it comes from."""
    design = result.design
    return {
        "accepted": result.accepted,
        "target": dict(design.target),
        "status": design.mix.status,
        "message": design.mix.message,
        "conflicts": [list(conflict.names) for conflict in design.mix.conflicts],
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


@contextmanager
def _writing(place: Path) -> Iterator[None]:
    """Say what cannot be written, and that nothing is lost by it."""
    try:
        yield
    except (OSError, UnicodeError) as error:  # UnicodeError: a path with bytes in it that are no text
        raise InputError(f"{place}: cannot be written: {why(error)}; what is recorded there is kept") from error
