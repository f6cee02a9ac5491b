"""The database of a run folder: its schema, older ones migrated, opened to write or only to read.

Rows are written ahead (WAL) without waiting for the disk at each, which would cost more than a design. A kill loses
none; a power cut may lose the last, and they are computed again.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from lampopt.errors import InputError
from lampopt.reading import brief

SCHEMA = 2  # the database's user_version
TABLES = """
CREATE TABLE designs (
    key TEXT PRIMARY KEY, target TEXT NOT NULL, alpha BLOB NOT NULL, residual BLOB NOT NULL, status TEXT NOT NULL,
    message TEXT NOT NULL, conflicts TEXT NOT NULL, checks TEXT NOT NULL, accepted INTEGER NOT NULL,
    provenance TEXT NOT NULL, mesh TEXT, seconds REAL NOT NULL, digest TEXT, task TEXT NOT NULL DEFAULT ''
);
CREATE TABLE asked (task TEXT NOT NULL);
CREATE TABLE sweep (number INTEGER PRIMARY KEY, key TEXT NOT NULL)"""  # asked last: by which study, for which designs
MIGRATIONS: Mapping[int, str] = {  # schema → to the next
    1: """
ALTER TABLE designs ADD COLUMN digest TEXT;
ALTER TABLE designs ADD COLUMN task TEXT NOT NULL DEFAULT '';
CREATE TABLE asked (task TEXT NOT NULL);
CREATE TABLE sweep (number INTEGER PRIMARY KEY, key TEXT NOT NULL)"""
}
VIEWS: Mapping[int, str] = {  # schema → what makes it look like the present one, beside it in memory
    1: """
CREATE TEMP VIEW designs AS SELECT rowid, *, NULL AS digest, '' AS task FROM main.designs;
CREATE TEMP TABLE asked (task TEXT NOT NULL);
CREATE TEMP TABLE sweep (number INTEGER PRIMARY KEY, key TEXT NOT NULL)"""
}
OURS = {  # the index is the key's
    *(("table", name) for name in ("designs", "asked", "sweep")),
    ("index", "sqlite_autoindex_designs_1"),
}
ANALYSED = {("table", f"sqlite_stat{number}") for number in (1, 2, 3, 4)}  # what SQLite's ANALYZE leaves
ATTEMPTS = 20  # at a statement while another process opens and closes the database


@contextmanager
def writable(path: Path) -> Iterator[sqlite3.Connection]:
    """The database at `path`, made if it is not there, migrated if it is older.

    Raises
    ------
    InputError
        If it is damaged, of a newer schema, or cannot be written.
    """
    with said(path):
        database = sqlite3.connect(path)
    with closing(database):
        with said(path):
            schema = _schema(database, path)
            if schema is None:
                database.executescript(f"BEGIN; {TABLES}; PRAGMA user_version = {SCHEMA}; COMMIT")
            else:
                _migrate(database, schema)
            database.execute("PRAGMA journal_mode = WAL")
            database.execute("PRAGMA synchronous = NORMAL")
        yield database


class Reader:
    """A database that is left as it is, while another process may be writing it.

    Each statement opens it anew and is answered in full, as of one moment.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    InputError
        By `rows`, if it is not there, damaged, of a newer schema, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def rows(self, statement: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows that `statement` finds."""
        for attempt in range(1, ATTEMPTS + 1):
            before = self._state()
            try:
                found = self._found(statement, values, shared=before[0])
            except InputError:  # half of it written meanwhile looks like damage
                if attempt == ATTEMPTS or self._state() == before:
                    raise
            else:
                if before[0] or self._state() == before:
                    return found
        raise InputError(f"{self._path}: is written again and again while it is read; try again later")

    def _state(self) -> tuple[bool, int, int, int]:
        """Whether a writer has it, or has left it in the middle of a run; and what changes when it is written."""
        try:
            found = self._path.stat()
        except OSError as error:
            raise InputError(
                f"{self._path}: no such file: expected the folder of a run, such as `lampopt sweep` leaves"
            ) from error
        log = self._path.with_name(self._path.name + "-wal")
        return log.exists(), found.st_mtime_ns, found.st_size, found.st_ino

    def _found(self, statement: str, values: Sequence[object], *, shared: bool) -> list[tuple[Any, ...]]:
        # Only a database that is shared needs locks, and with them files beside it in a folder that can be written.
        # One that is not is read without: whether it was altered meanwhile is looked at afterwards.
        where = f"{self._path.absolute().as_uri()}?mode=ro{'' if shared else '&immutable=1'}"
        with said(self._path):
            database = sqlite3.connect(where, uri=True)
        with closing(database), said(self._path):
            schema = _schema(database, self._path)
            if schema is None:
                raise InputError(f"{self._path}: is empty: expected the database of a run")
            if schema < SCHEMA:
                database.executescript(VIEWS[schema])
            return database.execute(statement, values).fetchall()


@contextmanager
def said(path: Path) -> Iterator[None]:
    """Turn what SQLite raises in the block into InputError, telling a place that cannot be used from a damaged file."""
    try:
        yield
    except sqlite3.OperationalError as error:  # locked, read-only, no room: nothing is wrong with what is there
        if "no such" in str(error):
            raise InputError(f"{path}: is damaged or no database of a run: {error}") from error
        raise InputError(f"{path}: cannot be used: {error}; what is recorded there is kept") from error
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: is damaged or no database: {error}") from error


def _schema(database: sqlite3.Connection, path: Path) -> int | None:
    """The schema of a database that can be read; None if it is fresh."""
    (schema,) = database.execute("PRAGMA user_version").fetchone()
    found = set(database.execute("SELECT type, name FROM sqlite_master")) - ANALYSED
    if not (schema or found):
        return None
    if not 1 <= schema <= SCHEMA:
        raise InputError(
            f"{path}: has schema {schema}, this lampopt reads 1 to {SCHEMA}: name another folder, or use the lampopt "
            "that wrote it"
        )
    if odd := sorted(found - OURS, key=str):  # a trigger would run, a second unique index delete, at the next design
        raise InputError(
            f"{path}: expected the tables designs and asked and no more, got {brief(odd)}: no database of a run"
        )
    return int(schema)


def _migrate(database: sqlite3.Connection, schema: int) -> None:
    for step in range(schema, SCHEMA):
        database.executescript(f"BEGIN; {MIGRATIONS[step]}; PRAGMA user_version = {step + 1}; COMMIT")
