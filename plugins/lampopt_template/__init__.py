"""Decoders that move a template, so that every design has one connectivity: `mesh-template` and its kin."""

from lampopt import hookimpl


@hookimpl
def lampopt_decoders() -> dict[str, type | str]:
    """Offer `mesh-template`, `point-template` and `vertex-template`."""
    return {
        "mesh-template": "lampopt_template.mesh_template:MeshTemplate",
        "point-template": "lampopt_template.point_template:PointTemplate",
        "vertex-template": "lampopt_template.vertex_template:VertexTemplate",
    }
