"""What a training step takes in bytes beside weights, gradients and optimizer: its activations, by running it unseen.

Two shallow twins of the backbone run forward and backward on tensors without values (see ``tracing``). What either
pass takes at most, ``a + b·groups``, is a line in the number of groups of like layers. Without gradient checkpointing
``b`` is all that a group keeps for the backward pass, in bf16 also the copies of its weights. With it ``b`` is the
hidden states between layers, in the forward pass also those copies, and ``a`` has what one layer keeps.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from persist_cli.api.backbone import Backbone, ClipLatents, Clips
from persist_cli.api.cameras import Cameras
from persist_cli.api.tokens import MemoryTokens
from persist_cli.doctor.tracing import LiveBytes, imagined, kernels
from persist_cli.recipe import Recipe
from persist_cli.train.optimizer import requested_savings

SHALLOW, DEEPER = 2, 4  # groups of layers; one alone is first and last at once


@dataclass(frozen=True)
class StepKind:
    """What a step's bytes depend on besides backbone and recipe.

    Args:
        batch: samples of a micro-batch.
        cuda: whether precisions are those of CUDA devices.
        sharded: whether weights come in the precision of the computation, as FSDP gathers them.
    """

    batch: int
    cuda: bool
    sharded: bool = False


@dataclass(frozen=True)
class Encoding:
    """What encoding a micro-batch takes.

    Args:
        peak: most bytes at once.
        latents: on the meta device, ``None`` where the stage encodes nothing before its step.
    """

    peak: int
    latents: ClipLatents | None = None


@dataclass(frozen=True)
class Activations:
    """What forward and backward pass of a micro-batch take, gradients not counted.

    Args:
        peak: most bytes at once.
        shallow: when all gradients are there.
    """

    peak: int
    shallow: int


class Twins:
    """Shallow copies of a plan, to run unseen.

    Args:
        backbone: a plan, on the meta device.
        channels: of the memory's features, ``None`` without a memory.
    """

    def __init__(self, backbone: Backbone, channels: int | None) -> None:
        self.deeper, self.channels = copy.deepcopy(backbone), channels
        self.groups = self.deeper.truncate_layers(DEEPER)
        self.shallow = copy.deepcopy(self.deeper)
        self.shallow.truncate_layers(SHALLOW)

    def encoding(self, recipe: Recipe, kind: StepKind) -> Encoding:
        """What encoding takes; nothing where the stage encodes nothing before its step."""
        if not self.shallow.encodes(recipe.stage):
            return Encoding(0)
        with self.imagined(self.shallow, recipe, kind) as (backbone, live), autocast(recipe), torch.no_grad():
            clips = imagined_clips(backbone, self.channels, kind.batch)
            latents = backbone.encode(clips)
            return Encoding(live.peak, latents.to("meta"))

    def activations(self, recipe: Recipe, kind: StepKind, encoding: Encoding) -> Activations:
        """What forward and backward pass take."""
        shallow = self.run(self.shallow, recipe, kind, encoding)
        deeper = self.run(self.deeper, recipe, kind, encoding)
        slopes = [(more - less) / (DEEPER - SHALLOW) for less, more in zip(shallow, deeper, strict=True)]
        grown = [less + slope * (self.groups - SHALLOW) for less, slope in zip(shallow, slopes, strict=True)]
        return Activations(round(max(grown)), max(0, round(shallow[1] - slopes[1] * SHALLOW)))

    def run(self, twin: Backbone, recipe: Recipe, kind: StepKind, encoding: Encoding) -> tuple[int, int]:
        """Most bytes of a twin's forward and backward pass."""
        with self.imagined(twin, recipe, kind) as (backbone, live):
            clips = imagined_clips(backbone, self.channels, kind.batch)
            if encoding.latents is not None:
                video = torch.zeros_like(encoding.latents.video, device="cpu")
                image = video[:, :1] if backbone.framewise else torch.zeros_like(encoding.latents.image, device="cpu")
                clips = dataclasses.replace(clips, latents=ClipLatents(video, image))
            with autocast(recipe):
                loss = backbone(clips, recipe.stage)["loss"]
            forward, live.peak = live.peak, live.now
            loss.backward()
            return forward, live.peak

    @contextlib.contextmanager
    def imagined(self, twin: Backbone, recipe: Recipe, kind: StepKind) -> Iterator[tuple[Backbone, LiveBytes]]:
        """Within the block a copy of the twin, as the recipe trains it, and a count of what lives."""
        backbone = copy.deepcopy(twin)
        settings = dataclasses.replace(recipe.training, compile=False)
        with imagined():
            backbone.to_empty(device="cpu")
            parameters = backbone.trained_parameters(recipe.stage)
            backbone.apply_memory_savings(recipe.stage, requested_savings(settings, torch.device("cpu")))
            if kind.sharded:
                _halve(backbone)
            threads = None if kind.cuda else settings.threads or torch.get_num_threads()
            live = LiveBytes([*backbone.parameters(), *backbone.buffers()], threads)
            for parameter in parameters.values():
                parameter.register_post_accumulate_grad_hook(live.set_aside)
            with live, kernels(kind.cuda):
                yield backbone, live


def autocast(recipe: Recipe) -> torch.autocast:
    """Mixed precision as accelerate has it."""
    return torch.autocast("cpu", torch.bfloat16, enabled=recipe.training.precision == "bf16")


def _halve(backbone: Backbone) -> None:
    whole = {id(each) for each in backbone.never_sharded_parameters()}
    for parameter in backbone.parameters():
        if id(parameter) not in whole:
            parameter.data = parameter.data.to(torch.bfloat16)


def imagined_clips(backbone: Backbone, channels: int | None, batch: int) -> Clips:
    """Clips of the backbone's shape with all memory tokens that its adapter asks for."""
    frames, (height, width) = backbone.frames_per_clip, backbone.image_size
    poses, pinhole = torch.eye(4, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    cameras = Cameras(poses.expand(batch, frames, 4, 4), pinhole.expand(batch, frames, 3, 3), height, width)
    tokens = None if channels is None else _all_tokens(batch, backbone.token_budget, channels)
    return Clips(
        rgb=torch.zeros(batch, frames, height, width, 3, dtype=torch.uint8),
        depth=torch.zeros(batch, frames, height, width),
        cameras=cameras,
        interactions=[(None,) * (frames - 1)] * batch,
        tokens=tokens,
        seeds=list(range(batch)),
    )


def _all_tokens(batch: int, count: int, channels: int) -> MemoryTokens:
    positions = torch.zeros(batch, count, 3, dtype=torch.float64)
    return MemoryTokens(torch.zeros(batch, count, channels), positions, torch.ones(batch, count, dtype=torch.bool))
