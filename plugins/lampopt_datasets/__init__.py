"""Exemplars from files: a table beside a folder of meshes."""

from lampopt import hookimpl


@hookimpl
def lampopt_sources() -> dict[str, str]:
    """Sources by name."""
    return {"run": "lampopt_datasets.run:Run", "table": "lampopt_datasets.table:Table"}
