"""What every parametric family keeps: its meshes are its true ones, also in another process; its parameters numbers."""

import pickle

import numpy as np
import pytest

from lampopt.errors import InputError
from lampopt_families.ahmed import AhmedSource
from lampopt_families.bwb import BwbSource
from lampopt_families.car import CarSource
from lampopt_families.frame import FrameSource
from lampopt_families.plate import PlateSource

SOURCES = {
    "plate": PlateSource(count=2, design="sobol", segments=16),
    "car": CarSource(count=2, design="sobol", edge=60.0),
    "ahmed": AhmedSource(count=2, design="sobol", edge=40.0),
    "ahmed without stilts": AhmedSource(count=2, design="sobol", edge=40.0, stilts=False),
    "bwb": BwbSource(count=2, design="sobol", chordwise=12, spanwise=20),
    "whole bwb": BwbSource(count=2, design="sobol", chordwise=12, spanwise=20, half=False),
    "frame": FrameSource(count=2, design="sobol", segments=16, edge=60.0),
}
of_all = pytest.mark.parametrize("source", SOURCES.values(), ids=SOURCES)


@of_all
def test_meshes_are_the_true_ones_bit_for_bit(source):
    exemplars = source()
    again = pickle.loads(pickle.dumps(exemplars.mesh_at))  # for a sweep in other processes
    for parameters, mesh in zip(exemplars.parameters, exemplars.meshes, strict=True):
        np.testing.assert_array_equal(mesh.vertices, again(parameters).vertices)
        np.testing.assert_array_equal(mesh.faces, again(parameters).faces)


@of_all
@pytest.mark.parametrize("given", [["1"] * 6, [1, [2, 3]], {"stack": 560}, np.full(6, 1j), None, [True] * 6])
def test_parameters_are_real_numbers(source, given):
    exemplars = source()
    with pytest.raises(InputError, match=rf"^{exemplars.names[0].rpartition('_')[0]}: expected .*parameters"):
        exemplars.mesh_at(given)
