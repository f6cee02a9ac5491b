"""Parametric families whose true mesh is known at any parameters, and the flow about wings by AeroSandbox."""

from lampopt import hookimpl


@hookimpl
def lampopt_sources() -> dict[str, str]:
    """Sources by name."""
    return {
        "ahmed": "lampopt_families.ahmed:AhmedSource",
        "bwb": "lampopt_families.bwb:BwbSource",
        "car": "lampopt_families.car:CarSource",
        "frame": "lampopt_families.frame:FrameSource",
        "morph": "lampopt_families.morph:MorphSource",
        "plate": "lampopt_families.plate:PlateSource",
    }


@hookimpl
def lampopt_measures() -> dict[str, str]:
    """Measures by name."""
    return {"aerosandbox": "lampopt_families.wing_flow:WingFlow"}
