"""A first look at a mix in milliseconds: the exemplars' own values on a grid, stored once and mixed.

Mixing values in place of weights is what the mismatch compares a design with (paper, section 3): where a design is
trusted, its preview is the design but for the grid's size. Only blocks of the grid that the surface can reach are
mixed at every node; in which it can be, their centres and the steepest slope between these tell, and the answer is
checked at the blocks' faces.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from lampopt.bank import decoder_of
from lampopt.errors import EmptyMesh, InputError
from lampopt.plugins import Plugins, returned
from lampopt.protocols import Progress
from lampopt.types import Array, Bank, expect_bank, frozen_array
from lampopt.units import whole

if TYPE_CHECKING:
    from trimesh import Trimesh

SIDE = 4  # nodes of a block along each axis
REACH = 1 + 2 * sqrt(3)  # from the node that stands for a block to nodes beside its farthest one [nodes]
MARGIN = 1.25  # over the steepest slope seen
LEAST, MOST = 8, 256  # nodes along the box


@dataclass(frozen=True, eq=False)
class Preview:
    """Looks at mixes of one bank whose decoder tells signed distances.

    Parameters
    ----------
    bank
        The bank.
    origin, pitch
        (3,) the first node, and the distance of neighbours [box].
    """

    bank: Bank
    origin: Array
    pitch: float
    _counts: tuple[int, int, int] = field(repr=False)  # nodes in the box
    _blocks: tuple[int, int, int] = field(repr=False)  # of nodes, of which the last may reach beyond the box
    _values: Array = field(repr=False)  # (blocks, SIDE³, N) float32
    _centres: Array = field(repr=False)  # (blocks, N) of these, the node in the middle

    @classmethod
    def of(
        cls, bank: Bank, resolution: int = 64, *, plugins: Plugins | None = None, progress: Progress | None = None
    ) -> Preview:
        """Evaluate every exemplar of `bank` on `resolution` nodes along the box's longest side, once.

        It takes about 4·N·resolution³ bytes, 105 MB for a hundred exemplars at 64.

        Raises
        ------
        InputError
            If the decoder moves a template (that is as fast as a preview), or for a resolution out of range.
        PluginError
            If the decoder answers with something else than a finite value a point.
        """
        expect_bank(bank, "preview")
        if bank.probe_values.shape[-1] != 1:
            raise InputError(
                f"preview: expected a decoder of signed distances, got {bank.decoder.name!r}, which moves a template: "
                "its meshes take no longer than a preview would"
            )
        resolution = whole(resolution, "resolution", LEAST, MOST)
        decoder = decoder_of(bank, plugins or Plugins.load())
        low, high = np.asarray(decoder.bounds, float)
        pitch = float((high - low).max()) / (resolution - 1)
        counts = np.ceil((high - low) / pitch - 1e-9).astype(int) + 1
        blocks = -(-counts // SIDE)
        parts = [part.ravel() for part in np.meshgrid(*map(np.arange, blocks), indexing="ij")]
        inner = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1).reshape(-1, 3)
        nodes = (SIDE * np.stack(parts, 1)[:, None] + inner).reshape(-1, 3)
        points = np.minimum(low + pitch * nodes, high)  # of blocks that reach beyond the box
        values = np.empty((len(nodes) // SIDE**3, SIDE**3, len(bank)), np.float32)
        for k, weights in enumerate(bank.weights):
            found = decoder.evaluate(bank.shared, np.asarray(weights), points)
            found = returned(f"decoder {bank.decoder.name!r}: evaluate", found, (len(points), 1), np.float32)
            values[..., k] = found.reshape(len(values), SIDE**3)
            if progress:
                progress((k + 1) / len(bank), bank.names[k])
        middle = int(np.flatnonzero((inner == SIDE // 2).all(1))[0])
        return cls(bank, low, pitch, _three(counts), _three(blocks), values, values[:, middle].copy())

    def mesh(self, alpha: Array) -> Trimesh:
        """The mesh [user's unit] of coefficients (N,), closed at the box.

        Raises
        ------
        EmptyMesh
            If there is no surface.
        InputError
            If `alpha` has not one finite coefficient per exemplar.
        """
        from skimage.measure import marching_cubes
        from trimesh import Trimesh

        grid = self.grid(alpha)
        inside = grid < 0
        spans = [np.flatnonzero(inside.any(axis)) for axis in ((1, 2), (0, 2), (0, 1))]
        if not len(spans[0]):
            raise EmptyMesh("preview: the mix does not change sign in the box: there is no surface to show")
        first = np.array([span[0] - 1 for span in spans])  # nodes at the box's sides are outside
        part = tuple(slice(low, span[-1] + 2) for low, span in zip(first.tolist(), spans, strict=True))
        vertices, faces, _, _ = marching_cubes(grid[part], 0.0, allow_degenerate=False)
        return self.bank.frame.to_user(Trimesh(self.origin + self.pitch * (first + vertices), faces, process=False))

    def grid(self, alpha: Array) -> Array:
        """(a, b, c) the mixed values at the nodes [box], away from the surface those of a node nearby.

        Nodes at the box's sides count as outside.

        Raises
        ------
        InputError
            If `alpha` has not one finite coefficient per exemplar.
        """
        with np.errstate(over="ignore"):  # what is too large is refused as not finite
            mix = frozen_array(alpha, "alpha", (len(self.bank),), np.float32)
        centres = self._centres @ mix
        mixed = np.repeat(centres[:, None], SIDE**3, axis=1)
        fresh = near = self._reached(centres)
        while fresh.any():
            mixed[fresh] = self._values[fresh] @ mix
            fresh = self._crossed(mixed) & ~near
            near = near | fresh
        shape = tuple(SIDE * n for n in self._blocks)
        grid = mixed.reshape(*self._blocks, SIDE, SIDE, SIDE).transpose(0, 3, 1, 4, 2, 5).reshape(shape)
        for k in range(3):
            for end in (slice(0, 1), slice(self._counts[k] - 1, None)):
                side = np.moveaxis(grid, k, 0)[end]
                np.maximum(side, np.float32(self.pitch / 2), out=side)
        return grid

    def _reached(self, centres: Array) -> Array:
        """(blocks,) whether the surface may come into a block with this value in its middle."""
        blocks = centres.reshape(self._blocks)
        steepest = [np.abs(np.diff(blocks, axis=k)).max() for k in range(3) if self._blocks[k] > 1]
        return np.asarray(np.abs(centres) <= MARGIN * REACH / SIDE * max([*steepest, SIDE * self.pitch]))

    def _crossed(self, mixed: Array) -> Array:
        """(blocks,) whether the sign changes between a block and one beside it."""
        inside = (mixed < 0).reshape(*self._blocks, SIDE, SIDE, SIDE)
        found = np.zeros(self._blocks, bool)
        for k in range(3):
            last = np.take(np.take(inside, SIDE - 1, axis=3 + k), np.arange(self._blocks[k] - 1), axis=k)
            first = np.take(np.take(inside, 0, axis=3 + k), np.arange(1, self._blocks[k]), axis=k)
            differ = (last != first).any((3, 4))
            one, other = [slice(None)] * 3, [slice(None)] * 3
            one[k], other[k] = slice(0, -1), slice(1, None)
            found[tuple(one)] |= differ
            found[tuple(other)] |= differ
        return found.ravel()


def _three(counts: Array) -> tuple[int, int, int]:
    return int(counts[0]), int(counts[1]), int(counts[2])
