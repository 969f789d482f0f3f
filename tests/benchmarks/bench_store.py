"""How fast clips are read from the store: ``python tests/benchmarks/bench_store.py``; prints tables, asserts nothing.

Clips of nine frames at random places of walks through the furnished room. The store is compared with decoding the
same frames' PNGs from memory.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.observations import Observations
from persist_cli.data.clips import ClipDataset, ClipPlan
from persist_cli.data.images import decode_depth, decode_rgb, encode_depth, encode_rgb
from persist_cli.data.store import Store
from persist_cli.output.console import print_table
from tests.benchmarks.timing import Times, alternate, say_conditions
from tests.support.room_views import write_room_walks

FRAMES, CLIPS = 9, 8  # frames a clip, clips a run
ALONE = "the same frames' PNGs alone"
CONTEXT = "ClipDataset, with up to 48 frames before"


def images_of(observations: Observations) -> list[tuple[bytes, bytes]]:
    """The PNGs of these frames, as the store has them."""
    pairs = zip(observations.rgb.numpy(), observations.depth.numpy(), strict=True)
    return [(encode_rgb(rgb), encode_depth(depth)) for rgb, depth in pairs]


def decode(images: list[tuple[bytes, bytes]]) -> tuple[np.ndarray, np.ndarray]:
    """Decode the PNGs, which is the least that any loader must do."""
    rgb, depth = zip(*((decode_rgb(rgb_png), decode_depth(depth_png)) for rgb_png, depth_png in images), strict=True)
    return np.stack(rgb), np.stack(depth)


def readers(folder: Path, size: int) -> dict[str, Callable[[], Any]]:
    """Functions that read the clips, by name; the first three decode the same number of images."""
    store, random = Store(folder), np.random.default_rng(0)
    files = [store[int(number)] for number in random.integers(len(store), size=CLIPS)]
    spans = [
        (file, slice(start, start + FRAMES)) for file in files for start in random.integers(len(file) - FRAMES, size=1)
    ]
    images = [images_of(file.read(span).observations) for file, span in spans]

    def dataset(strides: tuple[int, ...], context: int) -> ClipDataset:
        return ClipDataset(
            [folder], ClipPlan(frames=FRAMES, strides=strides, context_frames=context, seed=0, image_size=(size, size))
        )

    plain, strided, remembered = dataset((1,), 0), dataset((1, 2, 3), 0), dataset((1,), 48)
    return {
        ALONE: lambda: [decode(clip_images) for clip_images in images],
        "Store, nine frames in a row": lambda: [file.read(span) for file, span in spans],
        "ClipDataset, stride 1": lambda: [plain[number] for number in range(CLIPS)],
        "ClipDataset, strides 1, 2, 3": lambda: [strided[number] for number in range(CLIPS)],
        CONTEXT: lambda: [remembered[number] for number in range(CLIPS)],
    }


def table_rows(times: Times) -> list[tuple[str, ...]]:
    """Clips a second, milliseconds a clip, and the ratio to the time of the PNGs alone."""
    rows = []
    for name in times.seconds:
        clip = times.median(name) / CLIPS
        rows.append((name, f"{1 / clip:,.0f}", f"{1e3 * clip:.2f}", f"{times.ratio(name, ALONE):.2f}×"))
    return rows


if __name__ == "__main__":
    say_conditions(f"clips of {FRAMES} frames, one process")
    for size in (64, 256):
        with TemporaryDirectory() as folder:
            times = alternate(readers(write_room_walks(Path(folder), size), size))
        print_table(f"store, {size}×{size} images", ["clips", "clips/s", "ms a clip", "time"], table_rows(times))
