"""How many people ``persist play`` serves at once: ``python tests/benchmarks/bench_play_server.py``.

Pages without a browser walk side by side over the loopback address: each holds a key for a number of frames, lets go,
waits, and begins again, and draws nothing. Latency is from the key to the arrival of its first frame; it holds the
waiting for the others, since all share one model. Frames a second are those of one page while its key is held, and of
all pages together. Milliseconds of the processor are those of the server for each frame.

What follows ``--`` is given to ``persist play``, as ``-- --memories voxel,none --fps 15``.
"""

from __future__ import annotations

import argparse
import json
import random
import shlex
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import psutil

from persist_cli.output.console import print_table, say
from persist_cli.reproduce.pages import ServedPage, served_page
from tests.support.play_pages import Page, open_page

KEYS = ("left", "right")  # which are never blocked
PAUSES = (0.3, 0.9)  # seconds between two presses, at least and at most


@dataclass(frozen=True)
class Load:
    """What a number of pages got.

    Args:
        sessions: pages that walked at once.
        frames: of all of them.
        latency: median milliseconds from a key to its first frame.
        latency_95: its 95th percentile.
        rate: median frames a second of a page while its key is held.
        rate_5: the 5th percentile.
        together: frames a second of all pages, pauses included.
        processor: milliseconds of the server's processor time for each frame.
        memory: megabytes of the server's resident memory at the end.
    """

    sessions: int
    frames: int
    latency: float
    latency_95: float
    rate: float
    rate_5: float
    together: float
    processor: float
    memory: float


def walk(address: str, number: int, presses: int, hold: int) -> tuple[list[float], list[float], list[int]]:
    """Press keys on one page; the latencies in milliseconds, the frames a second of each press, and all its frames."""
    chance, latencies, rates = random.Random(number), [], []
    with open_page(address) as page:
        page.until("frame")
        for press in range(presses + 1):
            time.sleep(chance.uniform(*PAUSES))
            latency, rate = press_key(page, KEYS[press % len(KEYS)], hold)
            if press:  # the first clip prepares
                latencies.append(latency)
                rates.append(rate)
        page.say("undo")
        page.until("state")
    return latencies, rates, [page.last]


def press_key(page: Page, key: str, hold: int) -> tuple[float, float]:
    """Hold a key for some frames; the latency of the first in milliseconds, and frames a second."""
    began, times = time.perf_counter(), []
    page.say("keys", held=[key])
    while len(times) < hold:
        header, _ = page.until("frame")
        if times or header["action"] == key:
            times.append(time.perf_counter())
    page.say("keys", held=[])
    return 1000 * (times[0] - began), (hold - 1) / (times[-1] - times[0])


def measured(served: ServedPage, sessions: int, presses: int, hold: int) -> Load:
    """Let a number of pages walk at once."""
    server = psutil.Process(served.process)
    before, began = processor_seconds(server), time.perf_counter()
    with ThreadPoolExecutor(sessions) as pool:
        walks = [pool.submit(walk, served.address, number, presses, hold) for number in range(sessions)]
        results = [one.result() for one in walks]
    seconds = time.perf_counter() - began
    latencies, rates, counts = (np.concatenate(values) for values in zip(*results, strict=True))
    frames = int(counts.sum())
    return Load(
        sessions, frames, *np.percentile(latencies, (50, 95)).round(1), *np.percentile(rates, (50, 5)).round(2),
        round(frames / seconds, 2), round(1000 * (processor_seconds(server) - before) / frames, 1),
        round(server.memory_info().rss / 2**20),
    )  # fmt: skip


def processor_seconds(process: psutil.Process) -> float:
    """Return the processor time of a process and its threads."""
    times = process.cpu_times()
    return times.user + times.system


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table, and write it as JSON where that is wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", default="1,2,8", help="numbers of pages at once")
    parser.add_argument("--presses", type=int, default=10, help="of keys, on each page")
    parser.add_argument("--hold", type=int, default=12, help="frames that each is held for")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    parser.add_argument("play", nargs="*", help="after --: arguments of `persist play`")
    options = parser.parse_args(arguments)
    counts = [int(count) for count in options.sessions.split(",")]
    line = shlex.join(["play", "--sessions", str(max(counts)), *options.play])
    with served_page(line) as served:
        loads = [measured(served, count, options.presses, options.hold) for count in counts]
    columns = [
        *("sessions", "frames", "ms to frame", "95%", "frames/s of one", "5%", "frames/s of all"),
        *("processor ms/frame", "MB"),
    ]
    print_table(
        f"pages of `persist {line}`", columns, [[str(value) for value in vars(load).values()] for load in loads]
    )
    if options.json:
        options.json.write_text(json.dumps({"command": line, "loads": [asdict(load) for load in loads]}, indent=2))
        say(f"wrote {options.json}")


if __name__ == "__main__":
    main()
