"""Measures read off the mesh itself: sizes, topology, and the plate with a hole (paper, appendix R)."""

from lampopt import hookimpl


@hookimpl
def lampopt_measures() -> dict[str, str]:
    """Measures by name."""
    return {
        "extents": "lampopt_measure.basic:Extents",
        "volume": "lampopt_measure.basic:Volume",
        "area": "lampopt_measure.basic:Area",
        "genus": "lampopt_measure.basic:Genus",
        "plate": "lampopt_measure.plate:Plate",
    }
