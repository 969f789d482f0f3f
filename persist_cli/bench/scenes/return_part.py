"""The part "return" of the benchmark: walks into the unknown and back, rendered.

An agent walks out as in the part "walk", each row in the world that it imagines itself: where its own memory or depth
says that a wall is in the way, it turns. Then it goes back along the very poses of the way out. The frames of the way
back are compared with the row's own frames at these poses. Only the first image is true.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.observations import Observations
from persist_cli.bench.figure_text import FigureColumn
from persist_cli.bench.scenes.rendering import RenderedRow, Renderer, RendererLoader, rendered_rows
from persist_cli.bench.scenes.scene_bench import RenderingPlan, SceneBench
from persist_cli.bench.scenes.views import View
from persist_cli.bench.scenes.walk_part import Wanderer, walk_name, walked
from persist_cli.data.reference import parse_reference
from persist_cli.evaluate.statistics import Array, Draws, curve_figure, mean, mean_figure, number
from persist_cli.evaluate.windows import least, window_bounds, window_values
from persist_cli.metrics.fvd import LEAST_FRAMES, WEIGHTS
from persist_cli.metrics.fvd_pieces import fvd_of_rows, pieces
from persist_cli.metrics.lpips import ALEX, LpipsAlex, perceptual_distance, tensor_shapes
from persist_cli.metrics.networks import missing_weights, network_weights, run_network
from persist_cli.metrics.sharpness import LAPLACIAN, energy
from persist_cli.output.console import add_task, progress
from persist_cli.rollout.world_model import WorldModel

PART: Final = "return"

MOST_TRIES: Final = 4  # actions for each frame of the way out; an agent that is shut in stops there

WINDOW: Final = 16  # frames

ALONG: Final = ("sharpness", "psnr")  # figures of each window

COLUMNS: Final = {
    "psnr": FigureColumn(
        "PSNR to own first visit", "higher", False,
        "dB of each frame of the way back to the row's own frame at the very pose on the way out, where more than one "
        "clip lies between them; an exact copy counts as 100",
    ),
    "lpips": FigureColumn("LPIPS to own first visit", "lower", False, "LPIPS-Alex of the same pairs"),
    "psnr_start": FigureColumn("PSNR at the start", "higher", False, "dB of the last frame to the given image"),
    "sharpness": FigureColumn(
        "sharpness", "higher", False,
        "mean energy of the Laplacian of the walk's imagined frames over that of the true frames of the measured "
        "houses' trajectories, which show other places",
    ),
    "sharpness_least": FigureColumn(
        "sharpness, worst window", "higher", False,
        f"the least of the means over windows of {WINDOW} frames, of the mean curve of all walks; fog is stable too",
    ),
    "fvd": FigureColumn(
        "FVD", "lower", False,
        f"of pieces of {LEAST_FRAMES} frames of all walks to as many pieces of the data's own trajectories, whose "
        "agents walk otherwise; the count is the same for all rows, so compare them with each other only",
    ),
    "metres": FigureColumn("metres", None, False, "length of the way out"),
    "rate": FigureColumn("frames/s", "higher", False, "frames by the seconds that they took, memory and all"),
}  # fmt: skip


def run_returns(bench: SceneBench, plan: RenderingPlan) -> None:
    """Walk there and back from some of the views in every row, once for each seed, but where the journal has it."""
    loader, rows = RendererLoader(bench, plan, "return"), rendered_rows(plan)
    with progress() as bar:
        units = {row.name: list(missing_units(bench, row)) for row in rows}
        task = add_task(bar, "walking there and back", sum(map(len, units.values())), "walks")
        for row in rows:
            bar.update(task, note=row.name)
            renderer = loader.load(row) if units[row.name] else None
            for view, seed in units[row.name]:
                if renderer is not None:
                    frames = there_and_back(bench, renderer, view, seed, plan.steps)
                    bench.journal.write_samples(f"{PART} {row.name}", walk_name(view, seed), frames)
                bar.advance(task)


def missing_units(bench: SceneBench, row: RenderedRow) -> Iterator[tuple[View, int]]:
    """Yield the walks of a row that the journal lacks."""
    for view in walked(bench):
        for seed in range(bench.plan.seeds):
            if not bench.journal.has(f"{PART} {row.name}", walk_name(view, seed)):
                yield view, seed


def there_and_back(bench: SceneBench, renderer: Renderer, view: View, seed: int, steps: int) -> dict[str, Tensor]:
    """Return frames and poses of a walk, the first one given: ``steps`` frames out and as many back.

    Fewer where the agent is shut in.
    """
    begun = time.perf_counter()
    world = renderer.world(renderer.memory(view, seed), view, seed, True, bench)
    wanderer = Wanderer(view.info.vocabulary, np.random.default_rng([seed, 1]))
    out = walk_out(world, wanderer, view, steps)
    back = out.cameras[torch.arange(len(out) - 2, -1, -1)] if len(out) > 1 else out.cameras[:0]
    parts = [out]
    if len(back):
        parts += [seen for [seen] in world.imagine([back], [(None,) * len(back)])]
    whole = Observations.concatenate(parts)
    figures = {"out": torch.tensor(len(out)), "seconds": torch.tensor(time.perf_counter() - begun)}
    return {"rgb": whole.rgb, "poses": whole.cameras.world_from_camera} | figures


def walk_out(world: WorldModel, wanderer: Wanderer, view: View, steps: int) -> Observations:
    """Return the view's frame and those of the way out, without those of blocked steps."""
    parts, count, stopped, length = [view.frame], 0, False, world.clip_frames - 1
    for _ in range(MOST_TRIES * steps):
        if count >= steps:
            break
        actions = [wanderer.next(stopped)]
        actions += [wanderer.next(False) for _ in range(min(length, steps - count) - 1)]
        result = world.step([actions])[0]
        stopped = not bool(result.free[-1])
        parts.append(result.seen[result.free])
        count += len(parts[-1])
    return Observations.concatenate(parts)


def return_json(bench: SceneBench, plan: RenderingPlan) -> dict[str, Any]:
    """Return the figures of all rows, as JSON values."""
    views, rows = walked(bench), rendered_rows(plan)
    draws = Draws.of_scenes(view.scene for view in views)
    true = true_pieces(bench)
    detail = true_detail(true)
    length = RendererLoader(bench, plan, "return").load(rows[0]).backbone.frames_per_clip - 1
    figures: dict[str, dict[str, Any]] = {}
    windows, videos = {}, {}
    for row in rows:
        walks = [
            [bench.journal.samples(f"{PART} {row.name}", walk_name(view, seed)) for view in views]
            for seed in range(bench.plan.seeds)
        ]
        along = [[frame_values(walk, length, detail) for walk in of_seed] for of_seed in walks]
        values = [
            [walk_values(walk, frames, length) for walk, frames in zip(*of_seed, strict=True)]
            for of_seed in zip(walks, along, strict=True)
        ]
        windows[row.name], least_sharp = window_figures(along, draws)
        figures[row.name] = {
            name: mean_figure(np.array([[[value[name] for value in seed] for seed in values]]), draws).to_json()
            for name in values[0][0]
        } | {"sharpness_least": least_sharp}
        videos[row.name] = [piece for of_seed in walks for walk in of_seed for piece in pieces(walk["rgb"])]
    for name, distance in fvd_of_rows(videos, true).items():
        figures[name]["fvd"] = {"mean": number(distance), "low": None, "high": None}
    return {
        "columns": {name: column.definition for name, column in COLUMNS.items()},
        "views": [view.name for view in views],
        "steps": plan.steps,
        "missing": obstacles(true),
        "rows": figures,
        "windows": windows,
    }


def walk_values(walk: dict[str, Tensor], along: dict[str, Array], length: int) -> dict[str, float]:
    """Return the figures of one walk; NaN where nothing is compared.

    Args:
        walk: as ``there_and_back`` returns it.
        along: the figures of each of its frames, as ``frame_values`` returns them.
        length: frames that are predicted at once; frames of one clip are not compared.
    """
    rgb, out = walk["rgb"], int(walk["out"])
    back, first = compared_frames(walk, length)
    moved = walk["poses"][:out, :3, 3].diff(dim=0).norm(dim=1).sum()
    last = len(rgb) > out
    return {
        "psnr": float(mean(along["psnr"])),
        "lpips": float(lpips(rgb[back], rgb[first]).mean()) if back and not lpips_obstacle(rgb) else float("nan"),
        "psnr_start": float(psnr(rgb[-1:], rgb[:1])) if last else float("nan"),
        "sharpness": float(mean(along["sharpness"])),
        "metres": float(moved),
        "rate": (len(rgb) - 1) / float(walk["seconds"]),
    }


def compared_frames(walk: dict[str, Tensor], length: int) -> tuple[list[int], list[int]]:
    """Return the frames of the way back that are compared, and those at the same poses on the way out."""
    out = int(walk["out"])
    back = [frame for frame in range(out, len(walk["rgb"])) if frame - first_visit(frame, out) > length]
    return back, [first_visit(frame, out) for frame in back]


def frame_values(walk: dict[str, Tensor], length: int, detail: float) -> dict[str, Array]:
    """Return the figures ``ALONG`` of each frame of a walk, NaN where there is none.

    Args:
        walk: as ``there_and_back`` returns it.
        length: frames that are predicted at once; frames of one clip are not compared.
        detail: mean energy of the Laplacian of true frames; NaN without any.
    """
    rgb = walk["rgb"]
    back, first = compared_frames(walk, length)
    values = {name: np.full(len(rgb), np.nan) for name in ALONG}
    values["psnr"][back] = psnr(rgb[back], rgb[first]).numpy()
    if len(rgb) > int(walk["out"]) and detail:
        values["sharpness"][1:] = energy(rgb[1:], LAPLACIAN).numpy() / detail
    return values


def window_figures(
    walks: Sequence[Sequence[dict[str, Array]]], draws: Draws
) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Return the figures of each window of frames, and the sharpness of the worst, as JSON values.

    Args:
        walks: the figures of each frame, of each seed's walks; those of shorter walks end earlier.
        draws: of the walks' houses.
    """
    frames = max(2, *(len(walk["psnr"]) for of_seed in walks for walk in of_seed))
    bounds = window_bounds(frames, WINDOW)
    curves = {name: window_means(walks, name, frames) for name in ALONG}
    figures = {
        f"{first}-{last}": {name: mean_figure(curve[0][..., place], draws).to_json() for name, curve in curves.items()}
        for place, (first, last) in enumerate(bounds)
    }
    return figures, curve_figure(*curves["sharpness"], least, draws).to_json()


def window_means(walks: Sequence[Sequence[dict[str, Array]]], name: str, frames: int) -> tuple[Array, Array]:
    """Return means ``[1, seed, walk, window]`` of a figure over windows of frames, and how many frames have it."""
    numbers = [np.arange(first, last + 1, dtype=np.int64) for first, last in window_bounds(frames, WINDOW)]
    values = np.full((1, len(walks), len(walks[0]), frames), np.nan)
    for seed, of_seed in enumerate(walks):
        for place, walk in enumerate(of_seed):
            values[0, seed, place, : len(walk[name])] = walk[name]
    return window_values(values, np.ones_like(values), numbers)


def first_visit(frame: int, out: int) -> int:
    """Return the number of the frame at the same pose on the way out, of which there are ``out`` frames."""
    return 2 * (out - 1) - frame


def psnr(
    one: UInt8[Tensor, "frame height width 3"], two: UInt8[Tensor, "frame height width 3"]
) -> Float[Tensor, " frame"]:
    """Return dB of each frame, at most 100."""
    error = (one.double() - two.double()).square().mean((1, 2, 3))
    return (10 * torch.log10(255.0**2 / error)).clamp_max(100.0)


def lpips_obstacle(rgb: UInt8[Tensor, "frame height width 3"]) -> str | None:
    """Return the reason why frames have no LPIPS: they are too small, or weights are missing."""
    if min(rgb.shape[1:3]) < LpipsAlex.least_size:
        return f"frames have less than {LpipsAlex.least_size} pixels"
    return missing_weights(LpipsAlex.name)


def lpips(
    one: UInt8[Tensor, "frame height width 3"], two: UInt8[Tensor, "frame height width 3"]
) -> Float[Tensor, " frame"]:
    """Return LPIPS-Alex of each frame."""
    weights = network_weights(LpipsAlex.name, tensor_shapes(ALEX))
    return run_network(lambda a, b: perceptual_distance(weights, ALEX, a, b), one, two)


def true_pieces(bench: SceneBench) -> list[UInt8[Tensor, "frame height width 3"]]:
    """Return pieces of the measured houses' own trajectories; none where all of these are too short."""
    wanted, scenes = {view.scene for view in bench.views}, []
    for file in parse_reference(bench.plan.data).trajectories():
        if file.info.scene in wanted and len(file) > LEAST_FRAMES:
            scenes += pieces(file.read().observations.rgb)
    return scenes


def true_detail(true: Sequence[UInt8[Tensor, "frame height width 3"]]) -> float:
    """Return the mean energy of the Laplacian of true frames; NaN without any."""
    return float(energy(torch.cat([*true]), LAPLACIAN).mean()) if true else float("nan")


def obstacles(true: Sequence[Tensor]) -> list[str]:
    """Return the reasons why walks have no LPIPS, FVD or sharpness."""
    short = f"no trajectory of the measured houses has more than {LEAST_FRAMES} frames, so no sharpness and no FVD"
    weights = [reason for name in (LpipsAlex.name, WEIGHTS) if (reason := missing_weights(name))]
    return weights + [short] * (not true)
