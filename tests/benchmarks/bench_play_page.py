"""How quickly ``persist play`` answers keys in a browser: ``python tests/benchmarks/bench_play_page.py``.

A headless browser opens the page and presses keys as somebody does who looks, turns, and walks on: each press comes
after a pause, and is held for some frames. Latency is from the event of the key to the first picture of its action on
the screen (of an animation frame in which it is drawn), as the page itself measures it; frames a second are those
drawn while a key is held. Milliseconds of the processor are those of the server for each frame, whatever else the
machine does.

With ``--after 5000`` the same is measured again when so many frames were walked. What follows ``--`` is given to
``persist play``, as ``-- --memories voxel --memory house.safetensors``.
"""

from __future__ import annotations

import argparse
import json
import random
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import psutil

from persist_cli.errors import PersistError
from persist_cli.output.console import print_table, say
from persist_cli.reproduce.pages import CHROMIUM, ServedPage, driven_chromium, served_page, split_arguments
from persist_cli.reproduce.play_picture import READY, frame_number

if TYPE_CHECKING:
    from playwright.sync_api import Page

KEYS = ("a", "w", "d", "s", "d", "w")  # no two alike in a row, so that no late frame of one counts for the next
PAUSES = (300, 900)  # milliseconds between two presses, at least and at most
STILL = 400  # milliseconds without a frame after which the agent stands
STUCK = 30.0  # seconds after which frames that do not come are given up
LOOK = 20  # milliseconds between two looks at the page

# The times at which frames were drawn, and the latencies of keys, kept for this program.
WATCH_PAGE = """
window.drawn = []; window.latencies = [];
new MutationObserver(() => drawn.push(performance.now()))
  .observe(document, {subtree: true, attributes: true, attributeFilter: ["data-number"]});
new PerformanceObserver(list => latencies.push(...list.getEntriesByName("key to picture").map(entry => entry.duration)))
  .observe({type: "measure"});
"""


@dataclass(frozen=True)
class Answers:
    """What a number of presses gave.

    Args:
        after: frames that had been walked before.
        presses: number of presses.
        answered: those whose picture came; the others have no latency.
        latency: median milliseconds from a key to its picture.
        latency_95: its 95th percentile.
        rate: median frames a second while a key is held.
        rate_5: the 5th percentile.
        processor: milliseconds of the server's processor time for each frame, pauses included.
        memory: megabytes of the server's resident memory at the end.
    """

    after: int
    presses: int
    answered: int
    latency: float
    latency_95: float
    rate: float
    rate_5: float
    processor: float
    memory: float


def measure(page: Page, server: psutil.Process, presses: int, hold: int) -> Answers:
    """Press keys, hold each for some frames, and return what that gave."""
    wait_until_still(page)  # an answer to a press before is not counted
    chance, after = random.Random(0), frame_number(page)
    page.evaluate("() => { latencies.length = 0; }")
    began, rates = processor_seconds(server), []
    for number in range(presses):
        page.wait_for_timeout(chance.uniform(*PAUSES))
        rates.append(press(page, KEYS[number % len(KEYS)], hold))
        wait_until_still(page)
    rates = [rate for rate in rates if rate is not None]
    latencies, walked = page.evaluate("latencies"), frame_number(page) - after
    seconds = processor_seconds(server) - began
    return Answers(
        after, presses, len(latencies), *np.percentile(latencies, (50, 95)).round(1),
        *np.percentile(rates, (50, 5)).round(2),
        round(1000 * seconds / walked, 1), round(server.memory_info().rss / 2**20),
    )  # fmt: skip


def press(page: Page, key: str, hold: int) -> float | None:
    """Hold a key until some frames are drawn, and return how many a second; ``None`` where the way ends before.

    Raises:
        PersistError: when no frame is drawn.
    """
    page.evaluate("() => { drawn.length = 0; }")
    page.keyboard.down(key)
    waited = 0
    while (drawn := page.evaluate("drawn.length")) < hold and waited < 1000 * STUCK:
        if drawn and page.locator("#stage.blocked").count():
            break
        page.wait_for_timeout(LOOK)
        waited += LOOK
    page.keyboard.up(key)
    if not drawn:
        raise PersistError(f"the page has drawn no frame in {STUCK:g} s; it says: {page.inner_text('#state')}")
    times = page.evaluate(f"drawn.slice(0, {hold})")
    return 1000 * (hold - 1) / (times[-1] - times[0]) if len(times) == hold else None


def wait_until_still(page: Page) -> None:
    """Wait until no more frames come.

    Raises:
        PersistError: when they do not end.
    """
    last = -1
    for _ in range(round(1000 * STUCK / STILL)):
        if last == (last := frame_number(page)):
            return
        page.wait_for_timeout(STILL)
    raise PersistError(f"the page draws frames although no key is held; it says: {page.inner_text('#state')}")


def walk(page: Page, frames: int, hold: int = 40) -> None:
    """Walk about until a frame of this number or a later one is drawn."""
    chance = random.Random(1)
    while (number := frame_number(page)) < frames:
        press(page, chance.choice(KEYS), min(hold, max(4, frames - number)))


def processor_seconds(process: psutil.Process) -> float:
    """Return the processor time of a process and its threads."""
    times = process.cpu_times()
    return times.user + times.system


def measured(served: ServedPage, presses: int, hold: int, after: int) -> list[Answers]:
    """Open the page and measure at the start, and again after a number of frames, unless it is 0."""
    server = psutil.Process(served.process)
    with driven_chromium() as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(WATCH_PAGE)
        page.goto(served.address)
        page.wait_for_selector("#stage[data-number]", timeout=READY)
        press(page, "w", 2)  # the first clip prepares
        answers = [measure(page, server, presses, hold)]
        if after:
            walk(page, after)
            answers.append(measure(page, server, presses, hold))
    return answers


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table, and write it as JSON where that is wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presses", type=int, default=40, help="of keys, each of which is a latency")
    parser.add_argument("--hold", type=int, default=12, help="frames that each is held for")
    parser.add_argument("--after", type=int, default=0, help="frames to walk before it is measured again")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    own, passed = split_arguments(sys.argv[1:] if arguments is None else arguments)
    options = parser.parse_args(own)
    if CHROMIUM is None:
        say("no Chromium on this machine: nothing was measured")
        return
    line = shlex.join(["play", *passed])
    with served_page(line) as served:
        answers = measured(served, options.presses, options.hold, options.after)
    columns = [
        *("after frames", "presses", "answered", "ms to picture", "95%", "frames/s", "5%"),
        *("processor ms/frame", "MB"),
    ]
    print_table(
        f"keys in `persist {line}`", columns, [[str(value) for value in asdict(row).values()] for row in answers]
    )
    if options.json:
        options.json.write_text(json.dumps({"command": line, "answers": [asdict(row) for row in answers]}, indent=2))
        say(f"wrote {options.json}")


if __name__ == "__main__":
    main()
