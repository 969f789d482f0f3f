"""The part "speed" of the benchmark: what it costs to complete a region, against the number of its unknown cells."""

from __future__ import annotations

import time
from typing import Any, Final

import torch

from persist_cli.bench.figure_text import FigureColumn
from persist_cli.bench.scenes.scene_bench import SceneBench
from persist_cli.bench.scenes.views import Region, View
from persist_cli.bench.scenes.walk_part import walked
from persist_cli.output.console import add_task, progress

PART: Final = "speed"

RADII: Final = (1.0, 2.0, 3.0, 5.0, 8.0)  # metres

COLUMNS: Final = {
    "cells": FigureColumn("unknown cells", None, False, "unknown cells of the region that was asked for"),
    "seconds": FigureColumn("seconds", "lower", False, "seconds of a completion"),
    "rate": FigureColumn("cells/s", "higher", False, "unknown cells by seconds"),
}


def run_speed(bench: SceneBench) -> None:
    """Complete regions of several sizes around some of the views, but where the journal has them."""
    todo = [view for view in walked(bench) if not bench.journal.has(PART, view.name)]
    with progress() as bar:
        task = add_task(bar, "timing completions", len(todo) * len(RADII), "regions")
        for view in todo:
            bench.scenes.after(view).complete(view.region.box(view.truth), 0)  # the first one warms up
            records = []
            for radius in RADII:
                records.append(timed(bench, view, radius))
                bar.advance(task)
            bench.journal.write(PART, view.name, {"regions": records, "threads": torch.get_num_threads()})


def timed(bench: SceneBench, view: View, radius: float) -> dict[str, float]:
    """Return unknown cells and seconds of one completion."""
    scene = bench.scenes.after(view)
    region = Region.around(view.house, view.frame.cameras.world_from_camera[0], radius)
    begun = time.perf_counter()
    cells = scene.complete(region.box(view.house), 0)
    return {"radius": radius, "cells": float(cells), "seconds": time.perf_counter() - begun}


def speed_json(bench: SceneBench) -> dict[str, Any]:
    """Return the means over views, as JSON values."""
    records = [bench.journal.read(PART, view.name) for view in walked(bench)]
    rows = {}
    for number, radius in enumerate(RADII):
        regions = [record["regions"][number] for record in records]
        cells, seconds = (sum(region[name] for region in regions) / len(regions) for name in ("cells", "seconds"))
        values = {"cells": cells, "seconds": seconds, "rate": cells / seconds}
        rows[f"{radius:g} m"] = {name: {"mean": value, "low": None, "high": None} for name, value in values.items()}
    return {
        "columns": {name: column.definition for name, column in COLUMNS.items()},
        "threads": records[0]["threads"],
        "rows": rows,
    }
