"""Drag and lift by OpenFOAM: a real flow around any mesh that encloses something, with its uncertainty."""

from lampopt import hookimpl


@hookimpl
def lampopt_measures() -> dict[str, str]:
    """Measures by name."""
    return {"openfoam-drag": "lampopt_openfoam.drag:OpenFoamDrag"}
