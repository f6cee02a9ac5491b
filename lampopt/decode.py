"""Weights → mesh: one mix, or one after another; and the helper that every implicit decoder shares."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from lampopt.errors import InputError, PluginError
from lampopt.levelset import NarrowBand, field_to_mesh, field_to_mesh_dense
from lampopt.meshfile import indexed
from lampopt.protocols import Decoder, Follow
from lampopt.types import Array, Bank

if TYPE_CHECKING:
    from trimesh import Trimesh

__all__ = ["NarrowBand", "decode", "decoding", "field_to_mesh", "field_to_mesh_dense"]


def decode(bank: Bank, decoder: Decoder, weights: Array, *, resolution: int = 128) -> Trimesh:
    """The mesh of `weights` (D,) in the bank's unit and frame (paper, section 3: Decode).

    Raises
    ------
    EmptyMesh
        If the field has no surface.
    InputError
        If `weights` does not fit the bank.
    PluginError
        If the decoder returns something else than a mesh.
    """
    return _checked(bank, weights, lambda given: decoder.decode(bank.shared, given, resolution=resolution))


def decoding(bank: Bank, decoder: Decoder, *, resolution: int = 128) -> Callable[[Array], Trimesh]:
    """What makes the meshes of one weight vector (D,) after another, each as `decode` does.

    A decoder that can (`Follow`) makes one near the last sooner.
    """
    if not isinstance(decoder, Follow):
        return lambda weights: decode(bank, decoder, weights, resolution=resolution)
    follow = decoder.follow(bank.shared, resolution=resolution)
    if not callable(follow):
        raise PluginError(f"decoder {bank.decoder.name!r}: follow: expected a function of weights, got {follow!r:.80}")
    return lambda weights: _checked(bank, weights, follow)


def _checked(bank: Bank, weights: Array, make: Callable[[Array], object]) -> Trimesh:
    from trimesh import Trimesh

    if weights.shape != bank.weights.shape[1:]:
        raise InputError(f"weights: expected shape {bank.weights.shape[1:]}, got {weights.shape}")
    mesh = make(weights)
    who = f"decoder {bank.decoder.name!r}: decode"
    if not isinstance(mesh, Trimesh):
        raise PluginError(f"{who}: expected a trimesh.Trimesh, got {mesh!r:.80}")
    if not indexed(mesh):
        raise PluginError(
            f"{who}: expected faces whose corners are 0 to {len(mesh.vertices) - 1}, got {mesh.faces.min()} to "
            f"{mesh.faces.max()}"
        )
    return bank.frame.to_user(mesh)
