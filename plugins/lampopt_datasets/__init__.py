"""Exemplars from files: a table beside a folder of meshes, a run, and datasets as they are published."""

from lampopt import hookimpl


@hookimpl
def lampopt_sources() -> dict[str, str]:
    """Sources by name."""
    return {
        "blendednet": "lampopt_datasets.blendednet:BlendedNet",
        "drivaerml": "lampopt_datasets.drivaerml:DrivAerML",
        "drivaernet": "lampopt_datasets.drivaernet:DrivAerNet",
        "drivaernet++": "lampopt_datasets.drivaernet:DrivAerNetPlus",
        "run": "lampopt_datasets.run:Run",
        "table": "lampopt_datasets.table:Table",
    }
