"""Mesh files, loaded when they are looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from lampopt.meshfile import load_mesh

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True)
class MeshFiles(Sequence["Trimesh"]):
    """The meshes in `files`, relative to `folder`; every access loads anew and nothing is kept."""

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
        return load_mesh(self.folder / self.files[index])
