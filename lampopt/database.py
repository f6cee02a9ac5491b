"""The database of a run folder: its schema, older ones migrated, opened to write or only to read.

Rows are written ahead (WAL) without waiting for the disk at each, which would cost more than a design. A kill loses
none; a power cut may lose the last, and they are computed again.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

from lampopt.errors import InputError

SCHEMA = 2  # the database's user_version
TABLE = """
CREATE TABLE designs (
    key TEXT PRIMARY KEY, target TEXT NOT NULL, alpha BLOB NOT NULL, residual BLOB NOT NULL, status TEXT NOT NULL,
    message TEXT NOT NULL, conflicts TEXT NOT NULL, checks TEXT NOT NULL, accepted INTEGER NOT NULL,
    provenance TEXT NOT NULL, mesh TEXT, seconds REAL NOT NULL, digest TEXT
)"""
MIGRATIONS: Mapping[int, str] = {1: "ALTER TABLE designs ADD COLUMN digest TEXT"}  # schema → to the next


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
                database.executescript(f"BEGIN; {TABLE}; PRAGMA user_version = {SCHEMA}; COMMIT")
            else:
                _migrate(database, schema)
            database.execute("PRAGMA journal_mode = WAL")
            database.execute("PRAGMA synchronous = NORMAL")
        yield database


@contextmanager
def readable(path: Path) -> Iterator[sqlite3.Connection]:
    """The database at `path`, left as it is: where it is older, a migrated copy in memory.

    Raises
    ------
    InputError
        If it is not there, damaged, of a newer schema, or cannot be read.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file: expected the folder of a run, such as `lampopt sweep` leaves")
    # Only a database that was left in the middle of a run needs more than itself, and a folder that can be written.
    left = path.with_name(path.name + "-wal").exists()
    with said(path):
        database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{'' if left else '&immutable=1'}", uri=True)
    with closing(database):
        with said(path):
            schema = _schema(database, path)
        if schema == SCHEMA:
            yield database
            return
        if schema is None:
            raise InputError(f"{path}: is empty: expected the database of a run")
        with closing(sqlite3.connect(":memory:")) as copy:
            with said(path):
                database.backup(copy)
                _migrate(copy, schema)
            yield copy


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
    (tables,) = database.execute("SELECT count(*) FROM sqlite_master").fetchone()
    if not (schema or tables):
        return None
    if not 1 <= schema <= SCHEMA:
        raise InputError(
            f"{path}: has schema {schema}, this lampopt reads 1 to {SCHEMA}: name another folder, or use the lampopt "
            "that wrote it"
        )
    return int(schema)


def _migrate(database: sqlite3.Connection, schema: int) -> None:
    for step in range(schema, SCHEMA):
        database.executescript(f"BEGIN; {MIGRATIONS[step]}; PRAGMA user_version = {step + 1}; COMMIT")
