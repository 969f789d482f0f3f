"""CogVideoX at full scale, on a GPU or a CPU, in one table: ``python tests/benchmarks/bench_full_scale.py``.

On a GPU it measures the published sizes at 9×512×512 in bfloat16, on a CPU small twins in float32, both with random
weights: steps of both training stages (samples/s, peak memory, model FLOP utilisation), the latency of a clip with and
without memory, the codec, and the map. The same step and pipeline written plainly on diffusers take turns with them.
Steps begin at latents, without the codec. Weights, gradients and moments have one precision; with
``--precision mixed`` they are float32 under autocast, as in the recipes. No average of weights is kept. FLOPs follow
the formulas of ``full_scale/flops.py``. Targets are those for one H200. It asserts nothing.

    python tests/benchmarks/bench_full_scale.py --models 5b --only steps,clips --json full-scale.json
    python tests/benchmarks/bench_full_scale.py --set training.compile=true
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import diffusers
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.io.files import write_json
from persist_cli.output.console import say
from tests.benchmarks.full_scale.measuring import device_name, peak_flops, release
from tests.benchmarks.full_scale.rows import Row, print_rows
from tests.benchmarks.full_scale.sampling import clip_rows, codec_rows, map_rows
from tests.benchmarks.full_scale.shapes import MODELS, Bench
from tests.benchmarks.full_scale.training import step_rows

PARTS: dict[str, Callable[[Bench, Path], Iterable[Row]]] = {
    "steps": lambda bench, _: step_rows(bench),
    "clips": clip_rows,
    "codec": lambda bench, _: codec_rows(bench),
    "map": map_rows,
}

PUBLISHED, TWINS = ("2b", "5b"), ("tiny", "small")


def read_options(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line; what depends on the device is filled in."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--models", help=f"of {', '.join(MODELS)}; {','.join(PUBLISHED)} on a GPU, else the twins")
    parser.add_argument("--only", default=",".join(PARTS), help="parts to measure (default: all)")
    parser.add_argument("--rounds", type=int, help="measured runs of each work; 5 on a GPU, else 2")
    parser.add_argument("--quick", action="store_true", help="one model, one round")
    parser.add_argument("--set", action="append", default=[], help="change of the recipes, as training.compile=true")
    parser.add_argument("--device", help="cuda or cpu; what is there by default")
    parser.add_argument("--precision", choices=["bfloat16", "float32", "mixed"], help="bfloat16 on a GPU, else float32")
    parser.add_argument("--json", type=Path, help="file for all figures")
    options = parser.parse_args(arguments)
    options.device = torch.device(options.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    on_gpu = options.device.type == "cuda"
    names = options.models.split(",") if options.models else list(PUBLISHED if on_gpu else TWINS)
    options.models = names[:1] if options.quick else names
    options.only = options.only.split(",")
    options.precision = options.precision or ("bfloat16" if on_gpu else "float32")
    options.dtype = torch.float32 if options.precision == "float32" else torch.bfloat16
    options.rounds = 1 if options.quick else options.rounds or (5 if on_gpu else 2)
    for kind, names, known_names in (("model", options.models, MODELS), ("part", options.only, PARTS)):
        for name in names:
            if name not in known_names:
                parser.error(f"unknown {kind} {name!r}; known: {', '.join(known_names)}")
    return options


def conditions(options: argparse.Namespace, peak: float, source: str) -> dict[str, Any]:
    """Device, precision, versions and date of the measurement."""
    return {
        "device": device_name(options.device),
        "precision": options.precision,
        "peak": peak,
        "peak_source": source,
        "date": datetime.now(UTC).date().isoformat(),
        "torch": torch.__version__,
        "diffusers": diffusers.__version__,
        "rounds": options.rounds,
        "changes": options.set,
    }


def measure(options: argparse.Namespace, peak: float) -> list[Row]:
    """The rows of all parts of all models, each also printed to stderr when it is measured."""
    rows: list[Row] = []
    for name in options.models:
        mixed = options.precision == "mixed"
        bench = Bench(MODELS[name], options.device, options.dtype, options.rounds, peak, tuple(options.set), mixed)
        for part in options.only:
            began = time.monotonic()
            with TemporaryDirectory() as folder:
                for row in PARTS[part](bench, Path(folder)):
                    print(
                        " | ".join(filter(None, row.cells())), file=sys.stderr
                    )  # so that a run that is stopped has said something
                    rows.append(row)
            print(f"{name}, {part}: {time.monotonic() - began:.0f} s", file=sys.stderr)
            release(options.device)
        del bench
        release(options.device)
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Measure, print the table and write the JSON file."""
    options = read_options(arguments)
    torch.manual_seed(0)
    peak, source = peak_flops(options.device, options.dtype)
    facts = conditions(options, peak, source)
    rows = measure(options, peak)
    say(
        f"{facts['device']}, {facts['precision']}, {facts['date']}, torch {facts['torch']}, diffusers "
        f"{facts['diffusers']}; utilisation of {peak / 1e12:.4g} TFLOP/s ({source}); medians of {facts['rounds']} "
        "rounds in which the works take turns"
    )
    print_rows("CogVideoX at full scale", rows)
    if options.json:
        write_json(options.json, facts | {"rows": [row.to_json() for row in rows]})


if __name__ == "__main__":
    main()
