"""What measures are composed of: sections, selections, fits, angles and distances, all with derivatives by vertices.

A function from mesh to named values becomes a measure by a decorator::

    @measure(height="L", length="L")
    def roof(mesh):
        whole = surface(mesh)
        top = section(mesh, "y", at=middle(whole, "y") + 0.01 * extent(whole, "y")).facing("z", within=30)
        return {"height": highest(top) - lowest(whole), "length": extent(top, "x")}

    roof()(mesh), roof().gradient(mesh)

`roof` is then a class whose fields are the function's keyword options, as a plugin registers it. Its values should not
depend on where the mesh lies, so that the plane of the cut moves along with it; and it is cut beside the middle, since
meshes like to have edges there, and a vertex that lies on the plane has a derivative to one side only.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from lampopt.errors import InputError, MeasureError
from lampopt.types import Array

from .axes import oriented
from .basic import with_faces
from .facets import Facets, Shape, enclosed_area, extent, highest, lowest, middle, section, surface, total
from .fits import Circle, Line, Plane, angle, circle, distance, line, plane, slope
from .quantity import Number, Quantity, atan2, maximum, mean, median, minimum, sqrt

if TYPE_CHECKING:
    from trimesh import Trimesh

__all__ = [
    "Circle",
    "Composed",
    "Facets",
    "Line",
    "Number",
    "Plane",
    "Quantity",
    "Shape",
    "angle",
    "atan2",
    "circle",
    "distance",
    "enclosed_area",
    "extent",
    "highest",
    "line",
    "lowest",
    "maximum",
    "mean",
    "measure",
    "median",
    "middle",
    "minimum",
    "oriented",
    "plane",
    "section",
    "slope",
    "sqrt",
    "surface",
    "total",
]
Values = Mapping[str, Number]


class Composed:
    """A measure made of pieces by the decorator `measure`; its options are the fields of the class that it makes."""

    names: ClassVar[tuple[str, ...]]
    units: ClassVar[tuple[str, ...]]
    positions: ClassVar[tuple[str, ...]]
    function: ClassVar[Callable[..., Values]]
    check: ClassVar[Callable[..., None] | None]

    def __post_init__(self) -> None:
        if (check := type(self).check) is not None:
            check(**self._options())

    def _options(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}  # type: ignore[arg-type]

    def __call__(self, mesh: Trimesh) -> Array:
        """Values (p,). Raises EmptyMesh, and MeasureError where a feature is not there."""
        return np.array([float(value) for value in self._values(mesh)])

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (p, V, 3). Raises as a call does, and MeasureError for a value that has none."""
        parts = []
        for name, value in zip(self.names, self._values(mesh), strict=True):
            gradient = value.gradient(len(mesh.vertices)) if isinstance(value, Quantity) else np.full(1, np.nan)
            if not np.isfinite(gradient).all():
                raise MeasureError(f"{type(self).__name__}: {name!r} has no derivative by the vertices of this mesh")
            parts.append(gradient)
        return np.array(parts)

    def _values(self, mesh: Trimesh) -> list[Number]:
        own = type(self).__name__
        try:
            with_faces(mesh)
            found = type(self).function(mesh, **self._options())
        except InputError:
            raise
        except MeasureError as error:
            raise MeasureError(f"{own}: {str(error).removeprefix(f'{own}: ')}") from error
        except (ArithmeticError, ValueError) as error:  # a root of what is negative, a mean of nothing: of this shape
            raise MeasureError(f"{own}: cannot be worked out on this mesh: {error}") from error
        if not isinstance(found, Mapping):
            raise InputError(f"{own}: expected a mapping of names to numbers to be returned, got {found!r:.100}")
        if set(found) != set(self.names):
            raise MeasureError(
                f"{own}: expected values {', '.join(self.names)}, got {', '.join(map(str, found)) or 'none'}"
            )
        for name, value in found.items():
            if not isinstance(value, Quantity | Real):
                raise InputError(f"{own}: {name!r}: expected a quantity or a number, got {value!r:.100}")
            if not np.isfinite(float(value)):
                raise MeasureError(f"{own}: {name!r} is {float(value)} on this mesh")
        return [found[name] for name in self.names]


def measure(
    example: Callable[[], Trimesh] | None = None,
    check: Callable[..., None] | None = None,
    positions: Mapping[str, str] | None = None,
    /,
    **units: str,
) -> Callable[[Callable[..., Values]], Callable[..., Composed]]:
    """Turn a function from mesh to named quantities into a measure class.

    Parameters
    ----------
    example
        Makes a mesh that it measures, where the shapes of `lampopt.testing` are none.
    check
        Raises InputError for options, given by name, that cannot be used: before anything is measured.
    positions
        For each value that is a place in the mesh's own coordinates, and moves with it, its axis: {"top": "z"}.
    units
        The values' names with their units: "L", "L^2", "L^3", "deg", "" or any that pint reads.

    Returns
    -------
    callable
        The decorator. The function takes a mesh and keyword options with plain defaults; it returns one number for each
        name. A `Quantity` has a derivative, a plain float has none. The class is a frozen dataclass of the options,
        satisfies `Measure` and `Gradient`, and can be pickled where the function can be imported.
    """
    if not units:
        raise InputError('measure: expected names with units, as in measure(height="L"), got none')
    for name, unit in units.items():
        if not isinstance(unit, str):
            raise InputError(f"measure: {name}: expected a unit as text, as 'L', 'deg' or '', got {unit!r:.100}")
    places = dict(positions or {})
    for name, axis in places.items():
        if name not in units or axis not in ("x", "y", "z"):
            raise InputError(f"measure: positions: expected a value's name and x, y or z, got {name!r}: {axis!r:.100}")

    def decorated(function: Callable[..., Values]) -> Callable[..., Composed]:
        _, *options = inspect.signature(function).parameters.values()
        for option in options:
            if option.default is inspect.Parameter.empty:
                raise InputError(f"measure {function.__name__}: expected a default for option {option.name!r}")
        namespace: dict[str, Any] = {
            "names": tuple(units),
            "units": tuple(units.values()),
            "positions": tuple(places.get(name, "") for name in units),
            "function": staticmethod(function),
            "check": None if check is None else staticmethod(check),
            "__doc__": function.__doc__,
            "__module__": function.__module__,
            "__qualname__": function.__qualname__,
        }
        if example is not None:
            namespace["example_mesh"] = staticmethod(example)
        return dataclasses.make_dataclass(
            function.__name__,
            [(o.name, o.annotation, dataclasses.field(default=o.default)) for o in options],
            bases=(Composed,),
            namespace=namespace,
            frozen=True,
        )

    return decorated
