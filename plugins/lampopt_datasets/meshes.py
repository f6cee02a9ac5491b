"""Mesh files, loaded when they are looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from lampopt.errors import InputError
from lampopt.meshfile import load_mesh
from lampopt.reading import brief

from .vtk import load_vtk

if TYPE_CHECKING:
    from trimesh import Trimesh


def inside(folder: Path, file: str) -> bool:
    """Whether `file` of `folder` is in it, wherever links may lead."""
    try:
        return (folder / file).resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # links in a circle; a name too long, or one with a NUL
        return False


@dataclass(frozen=True)
class MeshFiles(Sequence["Trimesh"]):
    """The meshes in `files`, relative to `folder`; every access loads anew and nothing is kept.

    "" stands for an exemplar without a mesh: its parameters and labels can be used, its mesh is an error.
    """

    folder: Path
    files: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.files)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> MeshFiles: ...
    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return MeshFiles(self.folder, self.files[index])
        file = self.files[index]
        if not file:
            raise InputError("this exemplar has no mesh: it serves for models, which tell labels from parameters alone")
        if not inside(self.folder, file):  # again: a link may have been put there since the table was read
            raise InputError(f"mesh {brief(file)}: leads out of the folder {self.folder}")
        path = self.folder / file
        return load_vtk(path) if path.suffix.lower() == ".vtk" else load_mesh(path)
