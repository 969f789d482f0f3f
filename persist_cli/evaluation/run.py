"""``persist eval``: memories compared on clips that return to places seen before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from persist_cli import __version__
from persist_cli.checkpoints import find_checkpoint, load_backbone
from persist_cli.evaluation.revisits import LEAST_RECALLED, Revisit, RevisitClip, find_revisits, read_revisit
from persist_cli.evaluation.rows import Row, make_rows, row_seeds
from persist_cli.evaluation.scores import Scores, table_columns, table_row
from persist_cli.metrics import METRICS
from persist_cli.trajectories.clips import check_size
from persist_cli.trajectories.store import Store
from persist_cli.viewing.console import add_task, print_json, print_table, progress, say
from persist_cli.viewing.sheet import write_sheet
from persist_cli.world.backbone import Backbone, Sampling
from persist_cli.world.errors import PersistError
from persist_cli.world.files import write_json

SHOWN = 3  # clips on the contact sheet


@dataclass(frozen=True)
class EvalPlan:
    """The options of ``persist eval``; see its help."""

    memories: str
    seeds: int
    clips: int
    steps: int
    sampler: str
    batch: int


def run_eval(paths: Sequence[Path], data: Path, plan: EvalPlan, out: Path, json: bool) -> None:
    """Compare rows and leave a table, ``metrics.json`` and a contact sheet; see ``persist eval --help``."""
    checkpoints = [find_checkpoint(path) for path in paths]
    memories = [name.strip() for name in plan.memories.split(",") if name.strip()]
    rows = make_rows(checkpoints, memories, Sampling(plan.steps, plan.sampler))
    if not memories:
        raise PersistError("name at least one memory, as in --memories none,voxel")
    backbone = load_backbone(checkpoints[0])
    if plan.sampler not in backbone.samplers:
        raise PersistError(f"unknown sampler {plan.sampler!r}; this backbone has {', '.join(backbone.samplers)}")
    store = Store(data)
    for file in store:
        check_size(file.info, backbone.image_size, f"{data}#{file.name}")
    revisits = find_revisits(store, backbone.frames_per_clip, plan.clips)
    scores, shown = score_rows(rows, revisits, plan, backbone)
    report = describe(paths, data, plan, revisits, scores)
    write_json(out / "metrics.json", report)
    for number, clip in enumerate(shown):
        write_sheet(out / f"clip-{number}.png", clip)
    if json:
        print_json(report)
    else:
        show(report, scores, out)


def score_rows(
    rows: Sequence[Row], revisits: Sequence[Revisit], plan: EvalPlan, backbone: Backbone
) -> tuple[list[Scores], list[list[tuple[str, Tensor]]]]:
    """Scores of every row, and the labelled videos of the first clips for the contact sheets."""
    loaded = rows[0].base.fingerprint
    shown = [
        [("ground truth", read_revisit(each, backbone.frames_per_clip).observations.rgb)] for each in revisits[:SHOWN]
    ]
    scores = []
    with progress() as bar:
        total = sum(len(revisits) * (plan.seeds if row.random else 1) for row in rows)
        task = add_task(bar, "eval", total, "clip")
        for row in rows:
            if row.base.fingerprint != loaded:
                backbone, loaded = load_backbone(row.base), row.base.fingerprint
            row.prepare(backbone)
            bar.update(task, note=row.name)
            by_seed = []
            for seed in range(plan.seeds if row.random else 1):
                parts = []
                for first, videos, values in score_batches(row, backbone, revisits, seed, plan.batch):
                    parts.append(values)
                    bar.advance(task, len(videos))
                    for number in range(first, min(first + len(videos), SHOWN)) if seed == 0 else ():
                        shown[number].append((row.name, videos[number - first].cpu()))
                by_seed.append(torch.cat(parts))
            values = torch.stack(by_seed)
            scores.append(Scores(row.name, {name: values[..., column] for column, name in enumerate(METRICS)}))
    return scores, shown


def score_batches(
    row: Row, backbone: Backbone, revisits: Sequence[Revisit], seed: int, batch: int
) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Number of the first clip, videos and figures ``[clip, frame, metric]`` of each batch."""
    for first in range(0, len(revisits), batch):
        clips = [read_revisit(each, backbone.frames_per_clip) for each in revisits[first : first + batch]]
        rgb, depth = row.frames(backbone, clips, row_seeds(seed, first, len(clips)))
        yield first, rgb, torch.stack([measure(*each) for each in zip(rgb, depth, clips, strict=True)])


def measure(rgb: Tensor, depth: Tensor, clip: RevisitClip) -> Tensor:
    """Figures ``[frame, metric]`` of one clip, the given first frame left out."""
    truth = clip.observations
    return torch.stack(
        [each.measure(rgb[1:].cpu(), depth[1:].cpu(), truth.rgb[1:], truth.depth[1:]) for each in METRICS.values()],
        dim=-1,
    )


def describe(
    paths: Sequence[Path], data: Path, plan: EvalPlan, revisits: Sequence[Revisit], scores: Sequence[Scores]
) -> dict[str, Any]:
    """The figures with all that is needed to measure them again, JSON values."""
    return {
        "persist": __version__,
        "torch": torch.__version__,
        "checkpoints": [{"path": str(path), "fingerprint": find_checkpoint(path).fingerprint} for path in paths],
        "data": str(data),
        "plan": vars(plan),
        "protocol": f"revisit: at least {LEAST_RECALLED:.0%} of the last view seen only by frames before the clip",
        "clips": [{"trajectory": each.file.name, "start": each.start, "recalled": each.recalled} for each in revisits],
        "metrics": {name: {"better": each.better, "definition": each.definition} for name, each in METRICS.items()},
        "rows": {each.name: each.to_json() for each in scores},
    }


def show(report: dict[str, Any], scores: Sequence[Scores], out: Path) -> None:
    """The table, with what it says."""
    clips = report["clips"]
    recalled = sum(each["recalled"] for each in clips) / len(clips)
    title = f"{len(clips)} clips, {report['plan']['seeds']} seeds, {report['plan']['steps']} steps"
    print_table(title, table_columns(list(METRICS)), [table_row(each) for each in scores])
    say(f"clips recall {recalled:.0%} of their last view on average; mean ± standard deviation over seeds")
    for metric in METRICS.values():
        say(f"{metric.title}: {metric.definition}")
    say(f"written to {out}")
