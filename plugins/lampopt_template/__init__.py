"""Decoders that move a template, so that every design has one connectivity: `point-template` and `mesh-template`."""

from lampopt import hookimpl


@hookimpl
def lampopt_decoders() -> dict[str, type | str]:
    """Offer `mesh-template` and `point-template`."""
    return {
        "mesh-template": "lampopt_template.mesh_template:MeshTemplate",
        "point-template": "lampopt_template.point_template:PointTemplate",
    }
