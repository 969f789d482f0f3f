"""What the form ``rendered`` starts from and what it gains: a remembered view as it is, through the codec, by a model.

    persist collect miniworld --out runs/test/path --scenes 0:12 --frames 129 --split test --policy path
    python tests/benchmarks/bench_rendered.py --data runs/test/path --adapters runs/voxel --out runs/rendered.json

Rows, on the same clips of held-out houses, whose memory holds all true frames before them: the warp of true frames,
the views that the adapter draws, both through the codec, the encoded views in place of the prediction of stage 1 where
at least half of a latent pixel is covered (no network), a fresh adapter, and adapters that were trained. Target frames
near a frame in memory are not counted. Prints a table with CPU seconds a clip, asserts nothing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_backbones.adapters.rendered import Views, render_views
from persist_cli.api.backbone import Backbone, Clip, Clips, Sampling
from persist_cli.api.checkpoint import find_checkpoint, reference_checkpoint
from persist_cli.api.geometry import near_poses
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_cli.checkpoints.load import adapter_memory, load_backbone
from persist_cli.data.store import Store
from persist_cli.evaluate.rows.controls import pose_distances
from persist_cli.evaluate.rows.warp import Surface, warp
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.metrics import METRICS
from persist_cli.metrics.metric import Prediction
from persist_cli.output.console import print_table, say
from persist_cli.recipe import MemoryConfig

FRESH = "a fresh adapter"


@dataclass(frozen=True)
class Example:
    """A clip to predict, and the true frames before it, its first one included."""

    earlier: Observations
    truth: Observations
    clip: Clip
    info: Any

    @property
    def counted(self) -> Tensor:
        """The numbers of the frames to score: predicted ones that are no near copy of an earlier frame."""
        near = near_poses(self.truth.cameras.world_from_camera, self.earlier.cameras.world_from_camera).any(1)
        near[0] = True  # given
        return (~near).nonzero()[:, 0]


def examples(folders: list[Path], frames: int, each: int) -> Iterator[Example]:
    """Clips of the second half of each trajectory, evenly spread."""
    for folder in folders:
        for file in Store(folder):
            last = len(file) - frames
            for number in range(each):
                start = last // 2 + number * (last - last // 2) // max(1, each - 1)
                truth = file.read(range(start, start + frames)).observations
                first = dataclasses.replace(truth, rgb=truth.rgb[:1], depth=truth.depth[:1])
                clip = Clip(first, (None,) * (frames - 1), seed=start)
                yield Example(file.read(range(start + 1)).observations, truth, clip, file.info)


Row = Callable[[Example], tuple[Tensor, Tensor]]  # RGB and depth of the clip


def warped(example: Example) -> tuple[Tensor, Tensor]:
    """The warp of all earlier true frames, as the control of ``persist eval`` has it."""
    surface, views = Surface.of(example.earlier), example.truth.cameras
    pairs = [
        warp(surface, views[[number]], pose_distances(example.earlier.cameras, views[number]))
        for number in range(len(views))
    ]
    return torch.stack([rgb for rgb, _ in pairs]), torch.stack([depth for _, depth in pairs])


def through_codec(row: Row, backbone: Backbone) -> Row:
    """A row's frames, encoded and decoded."""

    def coded(example: Example) -> tuple[Tensor, Tensor]:
        rgb, depth = row(example)
        clip = dataclasses.replace(example.clip, observations=Observations(rgb, depth, example.truth.cameras))
        colors, metres = backbone.reconstruct(Clips.stack([clip]))
        return colors[0], metres[0]

    return coded


class Model:
    """A backbone with a memory configuration, which predicts clips."""

    def __init__(self, backbone: Backbone, memory: MemoryConfig, adapter: str, sampling: Sampling) -> None:
        self.backbone, self.adapter, self.sampling = backbone, adapter, sampling
        self.factory = MemoryFactory.of(memory)
        self.kept: tuple[int, Memory] = (-1, self.factory.empty)  # type: ignore[assignment]

    def tokens(self, example: Example) -> MemoryTokens:
        """The tokens of the memory of the earlier frames, for the clip's cameras."""
        if self.kept[0] != id(example):
            self.kept = id(example), self.remembered(example)
        return self.kept[1].read(example.truth.cameras, self.backbone.token_budget)

    def remembered(self, example: Example) -> Memory:
        """A memory of the earlier frames."""
        memory = self.factory.empty(example.info)
        memory.write(example.earlier)
        return memory

    def use(self) -> None:
        """Use this model's adapter."""
        self.backbone.use_adapter(self.adapter)

    def __call__(self, example: Example) -> tuple[Tensor, Tensor]:
        self.use()
        clip = dataclasses.replace(example.clip, tokens=self.tokens(example))
        rgb, depth = self.backbone.generate(Clips.stack([clip]), self.sampling)
        return rgb[0], depth[0]

    def views(self, example: Example) -> Views:
        """What the adapter draws."""
        self.use()
        adapter: Any = self.backbone.adapter
        tokens, cameras = MemoryTokens.stack([self.tokens(example)]), Clips.stack([example.clip]).cameras
        return render_views(tokens, cameras, adapter.settings)

    def drawn(self, example: Example) -> tuple[Tensor, Tensor]:
        """The drawn frames."""
        views = self.views(example)
        return views.rgb[0], views.depth[0]

    def without_network(self, example: Example) -> tuple[Tensor, Tensor]:
        """Encoded views where at least half of a latent pixel is covered, elsewhere the prediction of stage 1."""
        backbone: Any = self.backbone
        views = self.views(example)
        backbone.use_adapter(None)
        first = Clips.stack([example.clip])
        latents = backbone.sample(first, self.sampling)
        encoded = backbone.codec.encode(views.rgb, views.depth)
        covered = F.avg_pool2d(views.covered.sum(2), backbone.codec.spatial)[:, :, None] >= 0.5
        colors, depth = backbone.decode(torch.where(covered, encoded, latents), first)
        return ((colors[0].movedim(0, -1) + 1) * 127.5).round().clamp(0, 255).to(torch.uint8), depth[0]


def sharpness(rgb: Tensor, truth: Tensor) -> Tensor:
    """Energy of the Laplacian of each frame's luminance, relative to the truth's."""
    kernel = torch.tensor([[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]])[None, None]
    energies = [F.conv2d(part.float().mean(-1)[:, None], kernel).square().mean((1, 2, 3)) for part in (rgb, truth)]
    return energies[0] / energies[1].clamp_min(1e-6)


def measure(example: Example, rgb: Tensor, depth: Tensor) -> dict[str, float]:
    """Figures of one clip over its counted frames."""
    rgb = rgb.clone()
    rgb[0] = example.truth.rgb[0]
    visits = torch.full((len(rgb),), -1)
    prediction = Prediction(rgb, depth.float(), example.truth, visits)
    counted = example.counted
    figures = {name: METRICS[name].measure(prediction) for name in ("psnr", "lpips-alex")}  # type: ignore[attr-defined]
    figures["sharpness"] = sharpness(rgb, example.truth.rgb)
    means = {name: float(values[counted].mean()) for name, values in figures.items()}
    return means | {"last": float(figures["psnr"][counted[-1]])}


def build_rows(arguments: argparse.Namespace) -> dict[str, Row]:
    """The rows to measure, by name."""
    base = find_checkpoint(arguments.checkpoint or reference_checkpoint())
    backbone = load_backbone(base)
    backbone.eval()
    sampling = Sampling(arguments.steps, arguments.sampler, arguments.guidance)
    settings = json.loads(arguments.settings)
    memory = MemoryConfig(
        "voxel",
        {"cell": [arguments.cell] * 3, "pooling": "mean"},
        "patches",
        {"patch": 1, "channels": 3},
    )
    backbone.add_adapter("fresh", 3, {"form": "rendered", "attention_tokens": 0} | settings)
    fresh = Model(backbone, memory, "fresh", sampling)
    rows: dict[str, Row] = {"warp": warped, "warp, codec": through_codec(warped, backbone)}
    rows |= {"truth, codec": through_codec(lambda example: (example.truth.rgb, example.truth.depth), backbone)}
    rows |= {"drawn": fresh.drawn, "drawn, codec": through_codec(fresh.drawn, backbone)}
    rows |= {"no network": fresh.without_network, FRESH: fresh}
    for folder in arguments.adapters:
        checkpoint = find_checkpoint(folder)
        name = str(checkpoint.default_adapter())
        backbone.load_adapter(f"trained-{len(rows)}", checkpoint.adapter_folder(name))
        rows[str(folder)] = Model(backbone, adapter_memory(checkpoint, name), f"trained-{len(rows)}", sampling)
    if arguments.packaged:
        name = "voxel"
        backbone.load_adapter(name, base.adapter_folder(name))
        packaged = dataclasses.replace(sampling, memory_guidance=1.5)
        rows["packaged voxel, guidance 1.5"] = Model(backbone, adapter_memory(base, name), name, packaged)
    return {name: row for name, row in rows.items() if not arguments.rows or name in arguments.rows.split(";")}


def main() -> None:
    """Measure all rows on all clips."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--checkpoint", type=Path, help="by default the packaged model")
    parser.add_argument("--adapters", type=Path, nargs="*", default=[], help="stage-2 runs of that checkpoint")
    parser.add_argument("--packaged", action="store_true", help="the checkpoint's adapter voxel, too")
    parser.add_argument("--each", type=int, default=2, help="clips of each trajectory")
    parser.add_argument("--cell", type=float, default=0.02)
    parser.add_argument("--settings", default="{}", help="settings of the fresh adapter, JSON")
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--sampler", default="unipc")
    parser.add_argument("--guidance", type=float, default=1.0)
    parser.add_argument("--rows", default="", help="only these, separated by semicolons")
    parser.add_argument("--out", type=Path, help="figures of each clip, JSON, written after each of them")
    arguments = parser.parse_args()
    rows = build_rows(arguments)
    figures: dict[str, list[dict[str, float]]] = {name: [] for name in rows}
    with torch.no_grad():
        for example in examples(arguments.data, 9, arguments.each):
            if not len(example.counted):
                continue
            for name, row in rows.items():
                began = time.process_time()
                video = row(example)
                seconds = time.process_time() - began
                figures[name].append(measure(example, *video) | {"seconds": seconds})
            if arguments.out:
                arguments.out.write_text(json.dumps(figures))
    say(f"{len(next(iter(figures.values())))} clips")
    columns = ["psnr", "last", "lpips-alex", "sharpness", "seconds"]
    table = []
    for name, clips in figures.items():
        means = [sum(clip[column] for clip in clips) / len(clips) for column in columns]
        table.append([name, *(f"{mean:.3f}" for mean in means)])
    print_table("", ["row", *columns], table)


if __name__ == "__main__":
    main()
