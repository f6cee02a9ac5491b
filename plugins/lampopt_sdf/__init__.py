"""Decoder `sdf-mlp`: the paper's signed distance network, all exemplars of a batch fitted at once."""

from lampopt import hookimpl


@hookimpl
def lampopt_decoders() -> dict[str, type | str]:
    """Offer `sdf-mlp`."""
    return {"sdf-mlp": "lampopt_sdf.sdf_mlp:SdfMlp"}
