"""What writing imagined frames does to a memory: ``python tests/benchmarks/bench_writing.py --data DATA``.

Prints three tables, asserts nothing; without DATA the first one alone, of the sample houses. DATA are walks there and
back through houses that the model was not trained on:

    persist collect miniworld --out DATA --split test --policy there-and-back --frames 97 --scenes 0:10

- Known way: the memory holds the whole walk, which the model then follows. PSNR of the imagined frames to the
  recorded ones, with their frames written into the memory and without.
- Unseen way: the memory is empty. The model goes out ``OUT`` frames and comes back by the same poses. PSNR of a frame
  on the way back to its own frame of the way out at the same pose, and PSNR to the recorded frames.
- Partly known way: the same, but the memory holds the walk up to the frame from which the model goes out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import yaml
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.checkpoint import Checkpoint, find_checkpoint, reference_checkpoint
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations, Trajectory
from persist_cli.checkpoints.load import adapter_memory, load_adapter, load_backbone
from persist_cli.data.clips import interactions_of
from persist_cli.data.reference import sample_data
from persist_cli.data.store import Store
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.output.console import print_table
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.benchmarks.timing import say_conditions

OUT = 16  # frames of the unseen way out, and as many back
LAST = 8  # frames at the end that are also shown alone


@dataclass(frozen=True)
class Bench:
    """A model with an adapter, and the walks along which it goes.

    Args:
        backbone: the model, which uses the adapter.
        factory: makes the memories that the adapter reads.
        sampling: sampling of the clips.
        walks: one walk there and back a house.
        seeds: how many rollouts of each walk.
    """

    backbone: Backbone
    factory: MemoryFactory
    sampling: Sampling
    walks: Sequence[Trajectory]
    seeds: int

    @property
    def houses(self) -> list[str]:
        """The names of the walks."""
        return [walk.name for walk in self.walks]

    def follow(self, walks: Sequence[Trajectory], seen: Sequence[Trajectory], write: bool) -> Tensor:
        """The imagined colours of each walk after its first frame, ``[walk, seed, frame, height, width, 3]``.

        Args:
            walks: the ways to go.
            seen: what the memory of each holds.
            write: whether imagined frames are written.
        """
        agents = [Agent(self.memory(walk), seed, write) for walk in seen for seed in range(self.seeds)]
        each = [walk for walk in walks for _ in range(self.seeds)]
        model = WorldModel(self.backbone, agents, self.sampling)
        model.reset([walk.observations[:1] for walk in each], [walk.info for walk in each])
        cameras = [walk.observations.cameras[1:] for walk in each]
        interactions = [interactions_of(walk.actions[:-1], walk.info.vocabulary) for walk in each]
        clips = list(model.imagine(cameras, interactions))
        videos = [Observations.concatenate(parts).rgb for parts in zip(*clips, strict=True)]
        return torch.stack(videos).unflatten(0, (len(walks), self.seeds))

    def memory(self, walk: Trajectory) -> Memory:
        """A memory of all frames of a walk."""
        memory = self.factory.empty(walk.info)
        memory.write(walk.observations)
        return memory

    def known_way(self) -> list[tuple[str, ...]]:
        """A row for each house, and their mean: PSNR without writing, with writing, and both at the end."""
        truth = torch.stack([walk.observations.rgb[1:] for walk in self.walks])[:, None]
        likeness = [psnr(self.follow(self.walks, self.walks, write), truth).mean(1) for write in (False, True)]
        ends = [values[:, -LAST:] for values in likeness]
        return house_rows(self.houses, [values.mean(1) for values in (*likeness, *ends)])

    def unknown_way(self, seen_before: bool) -> list[tuple[str, ...]]:
        """A row for each house, and their mean: likeness to the own way out and to the truth, without and with."""
        middle = (len(self.walks[0]) - 1) // 2
        out = min(OUT, middle)
        ways = [part(walk, middle - out, middle + out + 1) for walk in self.walks]
        seen = [part(walk, 0, middle - out + 1 if seen_before else 0) for walk in self.walks]
        truth = torch.stack([way.observations.rgb[1:] for way in ways])[:, None]
        videos = [self.follow(ways, seen, write) for write in (False, True)]
        # frame i of the video is at the pose of frame 2 * out - 2 - i; the last one is the observed start again
        own = [psnr(video[:, :, out : 2 * out - 1], video[:, :, : out - 1].flip(2)) for video in videos]
        true = [psnr(video, truth) for video in videos]
        return house_rows(self.houses, [values.mean((1, 2)) for values in (*own, *true)])


def part(walk: Trajectory, first: int, stop: int) -> Trajectory:
    """Some frames of a walk as a walk of its own."""
    return Trajectory(walk.name, walk.observations[first:stop], walk.actions[first:stop], walk.info, first)


def psnr(one: Tensor, other: Tensor) -> Tensor:
    """PSNR in dB of each frame."""
    error = (one.double() - other.double()).square().mean((-3, -2, -1))
    return 10 * torch.log10(255**2 / error)


def house_rows(houses: Sequence[str], columns: Sequence[Tensor]) -> list[tuple[str, ...]]:
    """A row for each house and one of their mean; after each pair of columns the second less the first."""
    table = torch.stack([torch.cat([column, column.mean(0, keepdim=True)]) for column in columns], -1).tolist()
    rows = []
    for name, values in zip([*houses, "mean"], table, strict=True):
        pairs = zip(values[::2], values[1::2], strict=True)
        cells = (
            text for kept, written in pairs for text in (f"{kept:.2f}", f"{written:.2f}", f"{written - kept:+.2f}")
        )
        rows.append((name, *cells))
    return rows


def measure(checkpoint: Checkpoint, adapter: str, options: argparse.Namespace) -> None:
    """Print the tables of one adapter."""
    backbone = load_backbone(checkpoint, adapter=None)
    load_adapter(backbone, checkpoint, adapter)
    chosen = adapter_memory(checkpoint, adapter)
    factory = MemoryFactory.of(replace(chosen, settings=chosen.settings | yaml.safe_load(options.memory_settings)))
    walks = [file.read(slice(0, len(file))) for file in Store(options.data)][: options.houses]
    sampling = checkpoint.sampling_with(SamplingOverrides(steps=options.steps))
    bench = Bench(backbone, factory, sampling, walks, options.seeds)
    columns = ["not written", "written", "gain", "not written", "written", "gain"]
    if "known" in options.only:
        title = f"{adapter}, known way: PSNR dB of all frames, and of the last {LAST}"
        print_table(title, ["house", *columns], bench.known_way())
    for way in ("unseen", "partly known"):
        if way.split()[0] in options.only:
            title = f"{adapter}, {way} way of {OUT} frames and back: PSNR dB to the own way out, and to the truth"
            print_table(title, ["house", *columns], bench.unknown_way(way == "partly known"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables of every memory that is asked for."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--data", type=Path, help="walks there and back; without it the known way in the sample houses")
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--memories", default="voxel,map2d,snapshots")
    parser.add_argument("--houses", type=int, default=10)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--memory-settings", default="{}", help="changes to the memory, as in '{imagined: once}'")
    parser.add_argument("--only", default="known,unseen,partly")
    options = parser.parse_args(arguments)
    if options.data is None:
        options.data, options.only = sample_data(), "known"
    checkpoint = find_checkpoint(options.checkpoint or reference_checkpoint())
    say_conditions(f"{checkpoint.name}, at most {options.houses} houses, {options.seeds} seed(s)")
    for adapter in options.memories.split(","):
        measure(checkpoint, adapter, options)


if __name__ == "__main__":
    main()
