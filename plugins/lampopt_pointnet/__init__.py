"""Measures learned from meshes: fixed random functions pooled over a surface, then LASSO or kernel ridge regression."""

from lampopt import hookimpl


@hookimpl
def lampopt_surrogates() -> dict[str, str]:
    """Surrogates by name."""
    return {
        "fourier-ridge": "lampopt_pointnet.surrogates:FourierRidge",
        "pointnet-lasso": "lampopt_pointnet.surrogates:PointNetLasso",
    }
