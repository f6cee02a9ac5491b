"""Results → a run folder that loses nothing.

    study.toml     what was asked last
    runs.sqlite    a row per design: targets, alpha, checks, status, time
    designs/KEY/   mesh and passport.json of each design whose mesh was made

A design's key is the hash of bank, resolved study and target: a row that is there is never computed again. Files are
written aside and renamed, the row comes last, so a run that is killed at any moment goes on where it stopped.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.errors import InputError
from lampopt.meshfile import FORMATS
from lampopt.types import Bank, Check, Conflict, Design, Mix, Result

if TYPE_CHECKING:
    from trimesh import Trimesh

SCHEMA = 1  # the database's user_version
TABLE = """
CREATE TABLE designs (
    key TEXT PRIMARY KEY, target TEXT NOT NULL, alpha BLOB NOT NULL, residual BLOB NOT NULL, status TEXT NOT NULL,
    message TEXT NOT NULL, conflicts TEXT NOT NULL, checks TEXT NOT NULL, accepted INTEGER NOT NULL,
    provenance TEXT NOT NULL, mesh TEXT, seconds REAL NOT NULL
)"""


@dataclass(frozen=True)
class RunFolder:
    """An open run folder; only one process at a time has it."""

    folder: Path
    database: sqlite3.Connection

    @classmethod
    @contextmanager
    def open(cls, folder: str | Path) -> Iterator[RunFolder]:
        """Open or create `folder` under a lock.

        Raises
        ------
        InputError
            If another process has it, it cannot be written, or its database has another schema.
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
            with closing(sqlite3.connect(folder / "runs.sqlite")) as database:
                _prepare(database, folder / "runs.sqlite")
                yield cls(folder, database)
        except sqlite3.OperationalError as error:  # locked, read-only, no room: nothing is wrong with what is there
            raise InputError(f"{folder / 'runs.sqlite'}: cannot be used: {error}") from error
        except sqlite3.DatabaseError as error:
            raise InputError(f"{folder / 'runs.sqlite'}: is damaged or no database: {error}") from error
        finally:
            lock.release()

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
        design, folder = result.design, self.folder
        mesh = design.__dict__.get("mesh")  # only a mesh that was made: recording decodes nothing
        if mesh is not None:
            folder = self._place(key)
            aside = folder.with_name(folder.name + ".writing")
            with _writing(folder):
                shutil.rmtree(aside, ignore_errors=True)
                aside.mkdir()
                mesh.export(aside / f"mesh.{form}")
                _replace(aside / "passport.json", json.dumps(passport(result, bank), indent=2))
                shutil.rmtree(folder, ignore_errors=True)
                os.replace(aside, folder)
        self.database.execute(
            "INSERT OR REPLACE INTO designs VALUES (?,?,?,?,?,?,?,?,?,?,?,?)",
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
            ),
        )
        self.database.commit()
        return replace(result, folder=folder)

    def read(self, key: str, rebuild: Callable[[Mapping[str, float], Mix, Path | None], Design]) -> Result | None:
        """The result recorded under `key`, its design made by `rebuild` (target, mix, mesh file), or None.

        Raises
        ------
        InputError
            If what is recorded there is damaged.
        """
        row = self.database.execute(
            "SELECT target, alpha, residual, status, message, conflicts, checks, provenance, mesh FROM designs "
            "WHERE key = ?",
            (key,),
        ).fetchone()
        if row is None:
            return None
        try:
            return self._decoded(key, row, rebuild)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError(
                f"{self.folder / 'runs.sqlite'}: the row of design {key} is damaged: {error}; delete that row (DELETE "
                f"FROM designs WHERE key = '{key}') and it is made anew"
            ) from error

    def _decoded(
        self, key: str, row: tuple[Any, ...], rebuild: Callable[[Mapping[str, float], Mix, Path | None], Design]
    ) -> Result:
        target, alpha, residual, status, message, conflicts, checks, provenance, mesh = row
        clashes = tuple(Conflict(tuple(names), np.array(amounts)) for names, amounts in json.loads(conflicts))
        mix = Mix(np.frombuffer(alpha), np.frombuffer(residual), status, message, clashes)
        place = self._place(key)
        design = rebuild(json.loads(target), mix, place / mesh if mesh else None)
        found = tuple(_from_row(check) for check in json.loads(checks))
        return Result(design, found, json.loads(provenance), place if mesh and place.is_dir() else self.folder)

    def _place(self, key: str) -> Path:
        return self.folder / "designs" / key


def _prepare(database: sqlite3.Connection, path: Path) -> None:
    """Make the table in a fresh database; refuse one of another schema.

    Rows are written ahead (WAL) without waiting for the disk at each, which would cost more than a design. A kill
    loses none; a power cut may lose the last, and they are computed again.
    """
    (schema,) = database.execute("PRAGMA user_version").fetchone()
    (tables,) = database.execute("SELECT count(*) FROM sqlite_master").fetchone()
    if not (schema or tables):
        database.executescript(f"BEGIN; {TABLE}; PRAGMA user_version = {SCHEMA}; COMMIT")
    elif schema != SCHEMA:
        raise InputError(
            f"{path}: has schema {schema}, this lampopt reads {SCHEMA}: name another folder, or use the lampopt that "
            "wrote it"
        )
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = NORMAL")


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
        mesh.export(aside, file_type=form)
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


def _replace(path: Path, text: str) -> None:
    aside = path.with_name(path.name + ".writing")
    aside.write_text(text, encoding="utf-8")
    os.replace(aside, path)
