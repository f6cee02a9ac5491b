"""From a mix to a design: its weights, the parameters that it should have, its mesh, decoded or read from its file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lampopt.decode import decode
from lampopt.errors import EmptyMesh, InputError
from lampopt.mix import mixed_weights, predicted
from lampopt.protocols import Decoder
from lampopt.types import Bank, Design, Mix, Scalar
from lampopt.written import MeshFile

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class Designer:
    """Makes designs of a bank; `decoder` is asked for only where a mesh has to be decoded."""

    bank: Bank
    decoder: Callable[[], Decoder]
    resolution: int

    def __call__(
        self,
        target: Mapping[str, float],
        mix: Mix,
        file: MeshFile | None = None,
        provenance: Mapping[str, Scalar] | None = None,
    ) -> Design:
        """The design of one mix, its mesh read from `file` if it is there; `provenance` has the resolution it had."""
        weights = mixed_weights(self.bank, mix.alpha)
        resolution = (provenance or {}).get("resolution", self.resolution)
        if not (isinstance(resolution, int) and 4 <= resolution <= 4096):
            raise InputError(f"resolution: expected a whole number from 4 to 4096, got {resolution!r:.80}")

        def make() -> Trimesh | None:
            found = None if file is None else file.read()
            if found is not None:
                found.units = self.bank.frame.unit
                return found
            try:
                made = decode(self.bank, self.decoder(), weights, resolution=resolution)
            except EmptyMesh:
                return None
            if file is not None:
                file.restore(made)
            return made

        return Design(target, mix, predicted(self.bank, mix.alpha), weights, make)
