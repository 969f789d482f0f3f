"""The bytes that a training step takes beside weights, gradients and optimizer: its activations.

Two shallow copies of the backbone run forward and backward on fake tensors (see ``tracing``). The most bytes of either
pass grow linearly with the number of groups of equal layers: ``a + b·groups``. Without gradient checkpointing ``b`` is
all that a group keeps for the backward pass, in bf16 also the copies of its weights. With it ``b`` is the hidden states
between layers, in the forward pass also those copies, and ``a`` holds what one layer keeps.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import nn

from persist_cli.api.backbone import Backbone, Clips
from persist_cli.api.cameras import Cameras
from persist_cli.api.clips import ClipLatents
from persist_cli.api.scene_model import SceneForm, SceneModel, SceneSamples
from persist_cli.api.tokens import MemoryTokens
from persist_cli.doctor.tracing import LiveBytes, device_kernels, fake_tensors
from persist_cli.recipe import Recipe
from persist_cli.train.optimizer import requested_savings

SHALLOW, DEEPER = 2, 4  # groups of layers; a single group would be first and last at once


@dataclass(frozen=True, kw_only=True)
class StepKind:
    """A kind of step, which decides on its bytes together with backbone and recipe.

    Args:
        batch: samples of a micro-batch.
        cuda: whether operations run in the precisions that they have on CUDA devices.
        sharded: whether weights are in the precision of the computation, as FSDP2 gathers them.
    """

    batch: int
    cuda: bool
    sharded: bool = False


@dataclass(frozen=True)
class Encoding:
    """The memory that encoding a micro-batch takes.

    Args:
        peak: most bytes at once.
        latents: its result, on the meta device, ``None`` where the stage encodes nothing before its step.
    """

    peak: int
    latents: ClipLatents | None = None


@dataclass(frozen=True)
class Activations:
    """The memory that forward and backward pass of a micro-batch take, without gradients.

    Args:
        peak: most bytes at once.
        shallow: bytes that are still taken when all gradients are there.
    """

    peak: int
    shallow: int


class StepCopies(ABC):
    """Runs the steps of a model on fake tensors."""

    @abstractmethod
    def encoding(self, recipe: Recipe, kind: StepKind) -> Encoding:
        """The memory that encoding takes; none where the stage encodes nothing before its step."""

    @abstractmethod
    def activations(self, recipe: Recipe, kind: StepKind, encoding: Encoding) -> Activations:
        """The memory that forward and backward pass take."""


class SceneCopies(StepCopies):
    """Runs a whole model of scenes, whose few layers need no shallow copies.

    Args:
        model: a model on the meta device.
    """

    def __init__(self, model: SceneModel) -> None:
        self.model = model

    def encoding(self, recipe: Recipe, kind: StepKind) -> Encoding:
        """None: cells are encoded in the step itself."""
        return Encoding(0)

    def activations(self, recipe: Recipe, kind: StepKind, encoding: Encoding) -> Activations:
        """The memory that forward and backward pass take."""
        model = copy.deepcopy(self.model)
        with fake_tensors():
            _fill_with_fakes(model)
            parameters = model.trained_parameters(recipe.stage)
            with _counted(model, parameters, kind, recipe) as live:
                samples = _fake_samples(model.form, kind.batch)
                with _autocast(recipe):
                    loss = model(samples, recipe.stage)["loss"]
                forward, live.peak = live.peak, live.now
                loss.backward()
                return Activations(max(forward, live.peak), live.now)


class ShallowCopies(StepCopies):
    """Two copies of a backbone with few layers each, which run on fake tensors.

    Args:
        backbone: a backbone on the meta device.
        channels: the number of channels of the memory's features, ``None`` without a memory.
    """

    def __init__(self, backbone: Backbone, channels: int | None) -> None:
        self.deeper, self.channels = copy.deepcopy(backbone), channels
        self.groups = self.deeper.truncate_layers(DEEPER)
        self.shallow = copy.deepcopy(self.deeper)
        self.shallow.truncate_layers(SHALLOW)

    def encoding(self, recipe: Recipe, kind: StepKind) -> Encoding:
        """The memory that encoding takes; none where the stage encodes nothing before its step."""
        if not self.shallow.encodes(recipe.stage):
            return Encoding(0)
        with self._traced(self.shallow, recipe, kind) as (backbone, live), _autocast(recipe), torch.no_grad():
            clips = _fake_clips(backbone, self.channels, kind.batch)
            latents = backbone.encode(clips)
            return Encoding(live.peak, latents.to("meta"))

    def activations(self, recipe: Recipe, kind: StepKind, encoding: Encoding) -> Activations:
        """The memory that forward and backward pass take with all layers."""
        shallow = self._run(self.shallow, recipe, kind, encoding)
        deeper = self._run(self.deeper, recipe, kind, encoding)
        slopes = [(more - less) / (DEEPER - SHALLOW) for less, more in zip(shallow, deeper, strict=True)]
        peaks = [less + slope * (self.groups - SHALLOW) for less, slope in zip(shallow, slopes, strict=True)]
        return Activations(round(max(peaks)), max(0, round(shallow[1] - slopes[1] * SHALLOW)))

    def _run(self, model: Backbone, recipe: Recipe, kind: StepKind, encoding: Encoding) -> tuple[int, int]:
        """The most bytes of the model's forward and of its backward pass."""
        with self._traced(model, recipe, kind) as (backbone, live):
            clips = _fake_clips(backbone, self.channels, kind.batch)
            if encoding.latents is not None:
                video = torch.zeros_like(encoding.latents.video, device="cpu")
                image = video[:, :1] if backbone.framewise else torch.zeros_like(encoding.latents.image, device="cpu")
                clips = dataclasses.replace(clips, latents=ClipLatents(video, image))
            with _autocast(recipe):
                loss = backbone(clips, recipe.stage)["loss"]
            forward, live.peak = live.peak, live.now
            loss.backward()
            return forward, live.peak

    @contextlib.contextmanager
    def _traced(self, model: Backbone, recipe: Recipe, kind: StepKind) -> Iterator[tuple[Backbone, LiveBytes]]:
        """Within the block there is a fake copy of the model, as the recipe trains it, and a count of its bytes."""
        backbone = copy.deepcopy(model)
        with fake_tensors():
            parameters = _begin(backbone, recipe)
            if kind.sharded:
                _halve(backbone)
            with _counted(backbone, parameters, kind, recipe) as live:
                yield backbone, live


def check_savings(model: Backbone, recipe: Recipe) -> None:
    """Raise ``PersistError`` when a model without weights does not support a saving that its recipe asks for."""
    backbone = copy.deepcopy(model)
    with fake_tensors():
        _begin(backbone, recipe)


def _begin(backbone: Backbone, recipe: Recipe) -> dict[str, nn.Parameter]:
    """Prepare a model on the meta device as the recipe trains it, with fake tensors; return what is trained."""
    _fill_with_fakes(backbone)
    parameters = backbone.trained_parameters(recipe.stage)
    if recipe.distill is not None:
        backbone.distill(recipe.distill, backbone, backbone)  # whose copies would compute the same
    settings = dataclasses.replace(recipe.training, compile=False)  # a count needs no compiler
    backbone.apply_memory_savings(recipe.stage, requested_savings(settings, torch.device("cpu")))
    return parameters


def _fill_with_fakes(model: nn.Module) -> None:
    """Put fake tensors of the CPU in the place of those of the meta device."""
    # to_empty would make two fake tensors for each parameter, one of it as it is and the new one
    model._apply(lambda old: torch.empty(old.shape, dtype=old.dtype, device="cpu"))


@contextlib.contextmanager
def _counted(
    model: nn.Module, parameters: Mapping[str, nn.Parameter], kind: StepKind, recipe: Recipe
) -> Iterator[LiveBytes]:
    """Within the block the bytes of all new tensors are counted, without the parameters' gradients."""
    threads = None if kind.cuda else recipe.training.threads or torch.get_num_threads()
    live = LiveBytes([*model.parameters(), *model.buffers()], threads)
    for parameter in parameters.values():
        parameter.register_post_accumulate_grad_hook(live.set_aside)
    with live, device_kernels(kind.cuda):
        yield live


def _autocast(recipe: Recipe) -> torch.autocast:
    """Mixed precision as accelerate has it."""
    return torch.autocast("cpu", torch.bfloat16, enabled=recipe.training.precision == "bf16")


def _halve(backbone: Backbone) -> None:
    never_sharded = {id(parameter) for parameter in backbone.never_sharded_parameters()}
    for parameter in backbone.parameters():
        if id(parameter) not in never_sharded:
            parameter.data = parameter.data.to(torch.bfloat16)


def _fake_samples(form: SceneForm, batch: int) -> SceneSamples:
    """Windows of a form, of which nothing is given."""
    cells, colors = torch.zeros(batch, *form.shape, dtype=torch.uint8), torch.zeros(batch, 3, dtype=torch.uint8)
    painted = torch.zeros(batch, *form.shape, 3, dtype=torch.uint8)
    rgb, numbers = torch.zeros(batch, *form.image, 3, dtype=torch.uint8), torch.zeros(batch, dtype=torch.long)
    pose, pinhole = torch.eye(4).expand(batch, 4, 4), torch.eye(3).expand(batch, 3, 3)
    return SceneSamples(
        cells, cells, painted, rgb, torch.zeros(batch, *form.image), pose, pinhole, numbers, numbers, colors, numbers,
        cells, painted,
    )  # fmt: skip


def _fake_clips(backbone: Backbone, channels: int | None, batch: int) -> Clips:
    """Clips of the backbone's shape with as many memory tokens as its adapter takes."""
    frames, (height, width) = backbone.frames_per_clip, backbone.image_size
    poses, pinhole = torch.eye(4, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    cameras = Cameras(poses.expand(batch, frames, 4, 4), pinhole.expand(batch, frames, 3, 3), height, width)
    tokens = None if channels is None else _all_tokens(batch, backbone.token_budget, channels)
    if tokens is not None and backbone.reads_frames:
        tokens = dataclasses.replace(
            tokens,
            images=torch.zeros(batch, len(tokens), height, width, 3, dtype=torch.uint8),
            world_from_camera=poses.expand(batch, len(tokens), 4, 4),
            intrinsics=pinhole.expand(batch, len(tokens), 3, 3),
        )
    return Clips(
        rgb=torch.zeros(batch, frames, height, width, 3, dtype=torch.uint8),
        depth=torch.zeros(batch, frames, height, width),
        cameras=cameras,
        interactions=[(None,) * (frames - 1)] * batch,
        tokens=tokens,
        seeds=list(range(batch)),
    )


def _all_tokens(batch: int, count: int, channels: int) -> MemoryTokens:
    features, positions = torch.zeros(batch, count, channels), torch.zeros(batch, count, 3, dtype=torch.float64)
    colors = torch.zeros(batch, count, 3, dtype=torch.uint8)
    return MemoryTokens(features, positions, torch.ones(batch, count, dtype=torch.bool), colors)
