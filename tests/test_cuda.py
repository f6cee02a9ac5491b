"""`sdf-mlp` on a graphics card: one code path, the same answers; these run where CUDA is present."""

import numpy as np
import pytest
import torch

from lampopt.testing import shapes
from lampopt_sdf.sdf_mlp import SdfMlp

# What runs on the processor is tested in test_sdf.py; these need a card, which most machines and CI have not.
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
OPTIONS = {"width": 48, "depth": 3, "octaves": 2, "start_steps": 400, "steps": 100, "points": 1024, "samples": 8000}
MESHES = [shapes.ellipsoid(radii) for radii in ([0.5, 0.3, 0.25], [0.6, 0.35, 0.2], [0.4, 0.4, 0.3])]


@pytest.fixture(scope="module")
def fitted():
    """By device: shared arrays, weights and errors."""
    found = {}
    for device in ("cpu", "cuda"):
        decoder = SdfMlp(device=device, **OPTIONS)
        shared = decoder.prepare(MESHES, mean=MESHES[0], seed=0)
        found[device] = decoder, shared, *decoder.fit(shared, MESHES, seed=0)
    return found


def test_fits_are_as_good(fitted):
    errors = {device: error.mean() for device, (_, _, _, error) in fitted.items()}
    assert errors["cuda"] == pytest.approx(errors["cpu"], rel=0.3)


def test_values_and_meshes_are_the_same(fitted):
    _, shared, weights, _ = fitted["cpu"]
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    values, meshes = {}, {}
    for device, (decoder, *_) in fitted.items():
        values[device] = decoder.evaluate(shared, weights, points)
        meshes[device] = decoder.decode(shared, weights[0], resolution=48)
    np.testing.assert_allclose(values["cuda"], values["cpu"], atol=1e-4)
    assert meshes["cuda"].is_watertight
    assert meshes["cuda"].volume == pytest.approx(meshes["cpu"].volume, rel=1e-3)


def test_what_was_fitted_there_is_plain_numbers(fitted):
    _, shared, weights, error = fitted["cuda"]
    assert isinstance(weights, np.ndarray) and weights.dtype == np.float32
    assert isinstance(shared["start"], np.ndarray) and error.dtype == float
