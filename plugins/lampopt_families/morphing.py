"""A body under deformations: the mesh at any values, refused where it would fold over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array

from .body import Body
from .deformation import Deformation
from .field import Field, Places

if TYPE_CHECKING:
    from trimesh import Trimesh

BLAMED = 0.25  # of what the worst parameter does where the body folds


@dataclass(frozen=True, eq=False)
class Morph:
    """A body and the fields that deform it: the mesh at any values, faces and their order kept.

    Parameters
    ----------
    body
        The mesh as it is.
    fields
        One a parameter.
    """

    body: Body
    fields: tuple[Field, ...]

    @classmethod
    def of(cls, body: Body, deformations: Sequence[Deformation]) -> Morph:
        """That of `body` by `deformations`.

        Raises
        ------
        InputError
            If a tilt finds no surface, or two deformations have one name.
        """
        names = [d.name for d in deformations]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"morph: deformations: expected distinct names, got {', '.join(twice)} twice")
        return cls(body, tuple(Field.of(d, body) for d in deformations))

    def __call__(self, parameters: Array) -> Trimesh:
        """The true mesh at `parameters` (d,); at 0 it is the body, bit for bit.

        Raises
        ------
        InputError
            If a value is not finite, or the deformation folds the body over itself anywhere on its surface (the
            Jacobian determinant is not positive): the parameters to lower are named.
        """
        from trimesh import Trimesh

        values = np.asarray(parameters, float)
        names = [field.deformation.name for field in self.fields]
        if values.shape != (len(names),) or not np.isfinite(values).all():
            raise InputError(f"morph: expected {len(names)} finite parameters, {', '.join(names)}, got {parameters!r}")
        moving = [(field, float(value)) for field, value in zip(self.fields, values, strict=True) if value]
        with np.errstate(over="ignore", invalid="ignore"):  # a volume that is no number is refused as well
            vertices = self._moved(moving) if moving else self.body.vertices.copy()
        return Trimesh(vertices, self.body.faces.copy(), process=False)

    def _moved(self, moving: Sequence[tuple[Field, float]]) -> Array:
        """The vertices, moved by each field at its value; refused where they would fold over."""
        points = np.concatenate([self.body.vertices, self.body.centroids])
        places = Places.of(self.body, points)
        moved, jacobian = _still(len(points))
        for field, value in moving:
            field.add(value, places, moved, jacobian)
        (a, b, c), (d, e, f), (g, h, i) = jacobian
        volume = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if not (volume > 0).all():
            self._refuse(moving, points[[int(volume.argmin())]])
        return self.body.moved(moved[:, : len(self.body.vertices)].T)

    def _refuse(self, moving: Sequence[tuple[Field, float]], point: Array) -> None:
        """Say where it folds and which parameters press there most."""
        press = []  # what each adds to the volume there, to first order
        for field, value in moving:
            moved, jacobian = _still(1)
            field.add(value, Places.of(self.body, point), moved, jacobian)
            press.append(float(np.trace(jacobian[:, :, 0])) - 3)
        most = min(press)
        blamed = [
            f"{field.deformation.name} = {value:g}"
            for (field, value), share in zip(moving, press, strict=True)
            if share <= BLAMED * most or not most < 0  # where none presses straight, all of them do it together
        ]
        raise InputError(
            f"morph: {', '.join(blamed)}: too much at once, the body folds over itself at "
            f"({', '.join(f'{x:.4g}' for x in point[0])}); expected values nearer to 0"
        )


@dataclass(frozen=True, eq=False)
class Morphs(Sequence["Trimesh"]):
    """The meshes of `morph` at `parameters` (N, d), made on access."""

    morph: Morph
    parameters: Array

    def __len__(self) -> int:
        return len(self.parameters)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> Morphs: ...
    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return Morphs(self.morph, self.parameters[index])
        return self.morph(self.parameters[index])


def _still(count: int) -> tuple[Array, Array]:
    """No displacements (3, count), and the Jacobian of that (3, 3, count)."""
    return np.zeros((3, count)), np.repeat(np.eye(3)[:, :, None], count, axis=2)
