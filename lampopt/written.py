"""Files of a design, each written in one step; the mesh of a recorded one is made anew where it is gone."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.errors import InputError, StudyError
from lampopt.meshfile import FORMATS, load_mesh
from lampopt.reading import LARGEST, plain_file
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

PRECISE = 1e-3  # of a shape's size: what a file may lose
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
            if self.digest is not None and digest_of(self.path) != self.digest:
                raise InputError(f"mesh {self.path}: is not what was written")
            return load_mesh(self.path)
        except (OSError, InputError) as error:
            log.warning("%s; it is decoded again", error)
            return None

    def restore(self, mesh: Trimesh) -> None:
        """Write the file and the passport beside it anew; says so where that cannot be."""
        aside = self.path.parent.with_name(f"{self.path.parent.name}.{os.getpid()}.mesh.writing")
        try:
            write_mesh(mesh, aside, self.path.suffix[1:])
            if self.digest not in (None, digest_of(aside)):
                log.warning("%s: decodes to another mesh than was recorded, by other versions; not written", self.path)
                return
            self.path.parent.mkdir(exist_ok=True)
            os.replace(aside, self.path)
            replace_text(self.path.with_name("passport.json"), self.passport())
        except (OSError, InputError) as error:
            log.warning("%s: cannot be written anew: %s", self.path, error)
        finally:
            with suppress(OSError):
                aside.unlink(missing_ok=True)


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
    if len(mesh.faces) and (off := lost(form, np.asarray(mesh.bounds, float))) > PRECISE:
        raise InputError(f"{path}: {_imprecise(form, off)}")
    aside = path.with_name(path.name + ".writing")
    try:
        write_mesh(mesh, aside, form)
        os.replace(aside, path)
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise InputError(f"{path}: cannot be written: {error}") from error
    finally:
        with suppress(OSError, ValueError):
            aside.unlink(missing_ok=True)
    return path


def lost(form: str, bounds: Array) -> float:
    """What a mesh within `bounds` (2, 3) loses in a file of this format, of its size: most have single precision."""
    if form == "obj":
        return 0.0
    return float(np.spacing(np.float32(np.abs(bounds).max())) / max(float(np.ptp(bounds, axis=0).max()), 1e-300))


def expect_precise(form: str, bounds: Array) -> None:
    """Raise StudyError where meshes within `bounds` (2, 3) would not be in their files what they are."""
    if (off := lost(form, bounds)) > PRECISE:
        raise StudyError(f"format: {_imprecise(form, off)}")


def _imprecise(form: str, off: float) -> str:
    return (
        f"a .{form} file has single precision, so far from the origin {off:.2g} of the shape's size: take format "
        "'obj', or move the shapes nearer"
    )


def write_mesh(mesh: Trimesh, path: Path, form: str) -> None:
    """Write `mesh` as `form` [its unit]. Raises OSError where that cannot be."""
    data: Any = mesh.export(file_type=form)  # not to the path itself: trimesh leaves that open where the disk is full
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def digest_of(path: Path) -> str:
    """A hash of a file's bytes. Raises InputError where there is no file: a pipe would not answer, a device not end."""
    try:
        plain_file(path, kind="mesh file", largest=LARGEST)
    except InputError as error:
        raise InputError(f"mesh {path}: {error}") from error
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def replace_text(path: Path, text: str) -> None:
    """Write `text` to `path` in one step. Raises OSError where that cannot be."""
    aside = path.with_name(path.name + ".writing")
    aside.unlink(missing_ok=True)  # a link that somebody put there would be followed
    aside.write_bytes(text.encode())
    os.replace(aside, path)
