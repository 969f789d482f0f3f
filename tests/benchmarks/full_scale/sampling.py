"""Clips of a rollout, with and without memory, compared with the plain pipeline; the codec and the map alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from persist_backbones.cogvideox.codec import Codec, to_uint8
from persist_cli.api.backbone import Sampling
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.benchmarks.full_scale import flops
from tests.benchmarks.full_scale.measuring import Turns, Work
from tests.benchmarks.full_scale.plain import Plain
from tests.benchmarks.full_scale.rows import Row, Target
from tests.benchmarks.full_scale.shapes import ADAPTER, Bench
from tests.support.room_views import observe
from tests.support.rooms import UP, walk

STEPS = (50, 20, 10, 4)

OVERHEAD = 1.1  # target of a clip with memory over one without

FAST, SECONDS = 10, 1.0  # steps of the fast sampling, and its target

CONTEXT = 24  # frames in the map before the clip

CELL = (0.125, 0.5, 0.125)  # metres; half the usual size, so that a clip sees more cells than its token budget

DINO = {"hidden_size": 384, "num_attention_heads": 6, "num_hidden_layers": 12, "image_size": 518, "patch_size": 14}


@dataclass
class Scene:
    """A map of the room, and the clip to imagine.

    Args:
        bench: the model.
        folder: folder into which the encoder's weights may be written.
    """

    bench: Bench
    folder: Path

    def __post_init__(self) -> None:
        bench = self.bench
        self.info = bench.info()
        memory = make_memory("voxel", {"cell": CELL}, self.encoder(), FrameOfReference("room", UP)).to(bench.device)
        memory.write(observe(walk(CONTEXT), *bench.size[1:]).to(bench.device))
        self.memory: Memory = memory
        self.clip = bench.walk()
        self.actions = ["forward", "left"] * ((bench.backbone.frames_per_clip - 1) // 2)

    def encoder(self) -> Encoder:
        """DINOv2-S of random weights for the published sizes, nine frames at once; else a projection of patches."""
        if not self.bench.model.published:
            return make_encoder("patches", {"channels": self.bench.model.channels})
        from transformers import Dinov2Config, Dinov2Model

        Dinov2Model(Dinov2Config(**DINO)).save_pretrained(self.folder)
        return make_encoder("dinov2", {"weights": str(self.folder), "batch": self.bench.size[0]})

    def tokens(self, budget: int) -> int:
        """How many tokens the map gives the clip, at most the budget."""
        world = self.world(1, True)
        agent = world.agents[0]
        return len(self.memory.read(world.clip_path(agent, agent.cameras_after(self.actions)), budget))

    def world(self, steps: int, with_map: bool) -> WorldModel:
        """A world model that stands at the clip's first frame, with the map as its memory or without memory."""
        memory = self.memory.copy() if with_map else None
        model = WorldModel(self.bench.backbone, [Agent(memory)], Sampling(steps))
        model.reset([self.clip[:1]], [self.info])
        return model


def clip_functions(scene: Scene, plain: Plain, steps: int) -> dict[str, Work]:
    """Functions that make a clip: by the plain pipeline, and by a rollout without and with memory."""
    bench = scene.bench
    first_images = plain_images(bench)[:, :, :1]
    camera = bench.backbone.conditions(bench.clips(1, 1), torch.zeros(1).long()).camera
    camera = camera.to(bench.device, bench.precision)

    def roll(world: WorldModel, adapter: str | None) -> None:
        bench.backbone.use_adapter(adapter)
        world.branches(1).step([scene.actions])

    return {
        "plain": partial(plain.generate, first_images, camera, steps),
        "alone": partial(roll, scene.world(steps, False), None),
        "memory": partial(roll, scene.world(steps, True), ADAPTER),
    }


def plain_images(bench: Bench) -> Tensor:
    """The clip's RGB and depth as images, as the plain pipeline takes them: ``[2, 3, frame, height, width]``."""
    clips = bench.clips(1, bench.size[0])
    return bench.backbone.codec.images(clips.rgb, clips.depth).to(bench.precision)


def clip_rows(bench: Bench, folder: Path) -> Iterator[Row]:
    """Rows with the latency of a clip for each number of steps."""
    scene, plain, name = Scene(bench, folder), Plain(bench), bench.model.name
    bench.backbone.use_adapter(ADAPTER)
    tokens = scene.tokens(bench.backbone.token_budget)
    video, more = flops.video_sizes(bench.backbone, 1), flops.memory_sizes(bench.backbone, tokens)
    for steps in STEPS:
        timings = Turns(bench.device, bench.rounds).measure(clip_functions(scene, plain, steps))
        alone, memory = timings["alone"], timings["memory"]
        row = Row(
            name, f"clip, {steps} steps", alone, "plain diffusers", timings["plain"],
            flops=flops.clip(steps, video), peak=bench.peak,
        )  # fmt: skip
        if name == "5b" and steps == FAST:
            row = row.with_targets(Target(f"≤ {SECONDS:g} s", alone.median if alone else None, SECONDS))
        yield row
        row = Row(
            name, f"clip with voxel map, {tokens} tokens, {steps} steps", memory, "without memory", alone,
            flops=flops.clip(steps, video, more), peak=bench.peak,
        )  # fmt: skip
        yield row.with_targets(Target("≤ 10 % more", row.ratio, OVERHEAD)) if bench.model.published else row


def decode(codec: Codec, latents: Tensor) -> tuple[Tensor, Tensor]:
    """RGB in 8 bits and depth of latents."""
    colors, depth = codec.decode_images(latents)
    return to_uint8(colors), depth


def codec_rows(bench: Bench) -> Iterator[Row]:
    """Rows of encoding and decoding a clip of RGB and depth."""
    clips, plain, codec = bench.clips(1, bench.size[0]), Plain(bench), bench.backbone.codec
    images = plain_images(bench)
    with torch.no_grad():
        latents = plain.encode(images)
        functions: dict[str, Work] = {
            "encode": partial(codec.encode, clips.rgb, clips.depth),
            "plain encode": partial(plain.encode, images),
            "decode": lambda: decode(codec, latents),
            "plain decode": partial(plain.decode, latents),
        }
        timings = Turns(bench.device, bench.rounds).measure(functions)
    for what in ("encode", "decode"):
        yield Row(
            bench.model.name, f"VAE, {what} RGB-D clip", timings[what], "plain diffusers", timings[f"plain {what}"]
        )


def map_rows(bench: Bench, folder: Path) -> Iterator[Row]:
    """Rows of writing a clip into a voxel map of the room and of reading it."""
    scene = Scene(bench, folder)
    clip, memory = scene.clip.to(bench.device), scene.memory
    bench.backbone.use_adapter(ADAPTER)
    budget, frames = bench.backbone.token_budget, len(clip)
    functions: dict[str, Work] = {
        "encoder": partial(memory.encoder.encode, clip.rgb),
        "write": lambda: memory.copy().write(clip),
        "read": partial(memory.read, clip.cameras, budget),
    }
    timings = Turns(bench.device, bench.rounds).measure(functions)
    read, cells, encoder = len(memory.read(clip.cameras, budget)), memory.figures().cells, memory.encoder.name
    name = bench.model.name
    yield Row(name, f"map, write {frames} frames ({encoder})", timings["write"], "encoder alone", timings["encoder"])
    yield Row(name, f"map, read {read} of {cells} cells for {frames} cameras", timings["read"])
