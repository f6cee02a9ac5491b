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
        "hole": "lampopt_measure.holes:Hole",
        "holes": "lampopt_measure.holes:Holes",
        "wall": "lampopt_measure.wall:Wall",
        "centroid": "lampopt_measure.mass:Centroid",
        "inertia": "lampopt_measure.mass:Inertia",
        "vehicle": "lampopt_measure.vehicle:vehicle",
        "wheels": "lampopt_measure.wheels:wheels",
        "ramp": "lampopt_measure.panels:ramp",
        "diffuser": "lampopt_measure.panels:diffuser",
        "hood": "lampopt_measure.panels:hood",
        "windscreen": "lampopt_measure.panels:windscreen",
        "rear-window": "lampopt_measure.panels:rear_window",
        "trunk-lid": "lampopt_measure.panels:trunk_lid",
        "greenhouse": "lampopt_measure.panels:greenhouse",
        "frontal-area": "lampopt_measure.silhouette:FrontalArea",
        "wetted-area": "lampopt_measure.wetted:WettedArea",
        "wing": "lampopt_measure.aircraft:Wing",
        "stations": "lampopt_measure.aircraft:Stations",
        "bwb": "lampopt_measure.aircraft:Bwb",
        "learned": "lampopt_measure.learned:Learned",
    }


@hookimpl
def lampopt_surrogates() -> dict[str, str]:
    """Surrogates by name."""
    return {"calibrated": "lampopt_measure.calibrated:Calibrated"}
