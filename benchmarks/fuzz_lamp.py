"""A coverage-guided fuzzer for the reader of banks (atheris, libFuzzer's for Python).

    pip install -e ".[fuzz]"
    python -m benchmarks.fuzz_lamp [CORPUS] -atheris_runs=200000 -max_len=8192

An input is tried as it is, and once more with its seals and hashes made to fit, so that what comes behind them is
reached too. Anything but a bank or a LampoptError is a finding.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from .mutate import BLIND, lamp_body, lamp_header, opened, sealed


def main() -> int:
    """Fuzz until told to stop; libFuzzer's options are passed on."""
    try:
        import atheris
    except ImportError:
        sys.stderr.write('this needs atheris: pip install -e ".[fuzz]"\n')
        return 2
    with atheris.instrument_imports(include=["lampopt"]):
        import lampopt.lamp
        from lampopt.errors import LampoptError

    from .hostile import seeds

    folder = Path(tempfile.mkdtemp(prefix="lampopt-fuzz-"))
    corpus = [Path(word) for word in sys.argv[1:] if not word.startswith("-")] or [folder / "corpus"]
    corpus[0].mkdir(parents=True, exist_ok=True)
    (corpus[0] / "seed.lamp").write_bytes(seeds()[".lamp"])
    file = folder / "hostile.lamp"

    def tried(data: bytes) -> None:
        file.write_bytes(data)
        try:
            lampopt.lamp.load_bank(file)
        except LampoptError:
            return

    def one(data: bytes) -> None:
        tried(data)
        try:
            again = sealed(*opened(data))
        except Exception:  # noqa: BLE001  # no bank's file any more: the first try was all
            return
        tried(again)

    def other(data: bytes, longest: int, seed: int) -> bytes:
        """libFuzzer's own changes in every other turn, ours in the rest: they know what is sealed."""
        rng = np.random.default_rng(seed)
        if rng.integers(2):
            return bytes(atheris.Mutate(data, longest))
        try:
            return (lamp_header, lamp_body, BLIND[seed % len(BLIND)])[rng.integers(3)](bytes(data), rng)[:longest]
        except Exception:  # noqa: BLE001  # no bank's file any more
            return bytes(atheris.Mutate(data, longest))

    options = [word for word in sys.argv[1:] if word.startswith("-")]
    atheris.Setup([sys.argv[0], *options, str(corpus[0])], one, custom_mutator=other)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
