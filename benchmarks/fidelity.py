"""How faithful mixed shapes are: ``python -m benchmarks.fidelity --help`` (docs/performance.md)."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from threadpoolctl import threadpool_limits

from .document import put, show, stamped

TABLES = ("plate", "car", "body", "ablation")


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fidelity", description=__doc__)
    parser.add_argument("--table", choices=(*TABLES, "all"), default="all")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output, nothing else there")
    parser.add_argument(
        "--quick", action="store_true", help="few targets, coarse: does it run at all; no figures to quote"
    )
    parser.add_argument("--body", default="Hybrid", help="of the judge's bodies")
    parser.add_argument("--decoder", default="sdf-mlp")
    parser.add_argument(
        "--decoder-set", action="append", default=[], type=pair, metavar="K=V", help="an option of the decoder"
    )
    parser.add_argument("--resolution", type=int, help="cells along the decoder's box (192; 48 with --quick)")
    parser.add_argument("--seed", type=int, default=0, help="of the fits")
    parser.add_argument("--cache", type=Path, default=Path("runs/benchmarks"), help="where banks and scores are kept")
    parser.add_argument("--out", type=Path, help="folder for the JSON document, one a table")
    parser.add_argument("--judge", help="folder of judge.py (../shared/judge beside the repository)")
    parser.add_argument("--threads", type=int, default=1, help="of BLAS and libigl; torch's are the decoder's business")
    return parser.parse_args(given)


def pair(text: str) -> tuple[str, str | int | float | bool]:
    """An option and its value."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}")
    return name, scalar(value)


def scalar(text: str) -> str | int | float | bool:
    """`text` as the truth value or number that it spells."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def main(given: Sequence[str] | None = None) -> int:
    args = arguments(given)
    os.environ["IGL_NUM_THREADS"] = str(args.threads)  # read by libigl on its first parallel loop
    from lampopt import Spec
    from lampopt.errors import LampoptError

    from . import ablation, body, plate
    from .car import Car
    from .common import Bench

    talk = Console(stderr=True)
    try:
        bench = Bench(
            args.cache / "quick" if args.quick else args.cache,
            Spec(args.decoder, **dict(args.decoder_set)),
            args.resolution or (48 if args.quick else 192),
            args.quick,
            args.seed,
            console=talk,
        )
        judge = body.find_judge(args.judge)
        if judge is not None and args.body not in judge.LENGTH:
            raise LampoptError(f"--body: expected one of {', '.join(judge.LENGTH)}, got {args.body!r}")
        make: dict[str, Callable[[], dict[str, Any]]] = {
            "plate": lambda: plate.table(bench),
            "ablation": lambda: ablation.table(bench, judge, args.body),
        }
        notes = []
        if judge is not None:
            make["body"] = lambda: body.table(body.Body(bench, judge, args.body))
            make["car"] = lambda: body.table(Car(bench, judge, "car"))
        elif args.table != "plate":
            notes.append("no judge.py with its car bodies was found: cars are left out (--judge FOLDER)")
            talk.print(f"[bold]{notes[0]}[/bold]")
        asked = [name for name in TABLES if args.table in (name, "all") and name in make]
        tables = {}
        with threadpool_limits(args.threads, user_api="blas"):
            for name in asked:
                tables[name] = make[name]()
                if not args.json:
                    show(Console(), f"{name}: {bench.decoder}{' (quick)' if args.quick else ''}", tables[name])
    except LampoptError as error:
        talk.print(f"[bold red]error[/bold red] {error}", highlight=False)
        return 2
    settings = {"quick": args.quick, "seed": args.seed, "resolution": bench.resolution, "threads": args.threads}
    decoder = {"name": bench.decoder.name, "options": dict(bench.decoder.options)}
    document = stamped("fidelity", decoder=decoder, **settings)
    document |= {"notes": notes, "tables": tables, "seconds": bench.seconds}
    of = [args.body] if args.table not in ("plate", "car") else []
    name = "-".join([args.table, *of, bench.decoder.name, *(["quick"] if args.quick else [])])
    put(document, args.out and args.out / f"fidelity-{name}.json", out=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
