"""What a process of a training needs in bytes, by what for."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

from torch import nn

from persist_cli.api.backbone import Backbone
from persist_cli.doctor.step import Activations, Encoding, StepKind, Twins
from persist_cli.recipe import Recipe

FLOAT32: Final = 4

HALF: Final = 2

MOMENTS: Final = {
    "adamw": 2 * FLOAT32,
    "adamw-8bit": 2 * (1 + FLOAT32 / 256),  # a byte each, and a scale for every 256
}


@dataclass(frozen=True)
class Launch:
    """How processes share the work.

    Args:
        devices: processes, a device each.
        cuda: whether they are GPUs.
        sharded: FSDP2; else each has the whole model.
        offloaded: sharded, and each share rests in the memory of the CPU, where the optimizer works too.
    """

    devices: int
    cuda: bool
    sharded: bool = False
    offloaded: bool = False

    @property
    def share(self) -> float:
        """Of what is sharded, the part that rests on one device."""
        return 0.0 if self.offloaded else 1 / self.devices if self.sharded else 1.0


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes on one device.

    Weights, moments and averages are always there. Beside them there are at most, one after the other: what encoding
    the clips takes; activations, with gradients coming while they go; gradients with what the update of the weights
    takes. With several micro-batches gradients are there from the first one on.

    Args:
        weights: and buffers; with FSDP also what is gathered of other processes at once.
        gradients: and with DDP the buckets that are sent.
        optimizer: moments of AdamW.
        average: EMA, where it is on the device.
        update: of the optimizer's step.
        kept: whether gradients stay while the next micro-batch is encoded and run.
        encoding: of the codec.
        activations: in forward and backward pass, most at once.
        shallow: of these, what is left when all gradients are there.
        host: beside the device, in the memory of the CPU, for all processes together.
    """

    weights: int
    gradients: int
    optimizer: int
    average: int
    update: int
    kept: bool
    host: int
    encoding: int = 0
    activations: int = 0
    shallow: int = 0

    @property
    def peak(self) -> int:
        """Most bytes at once."""
        before = self.gradients if self.kept else 0
        step = max(self.activations + before, self.gradients + self.shallow)
        return self.always + max(self.encoding + before, step, self.gradients + self.update)

    @property
    def always(self) -> int:
        """Bytes that a run holds from its second step to its end."""
        return self.weights + self.optimizer + self.average

    def to_json(self) -> dict[str, int | bool]:
        """Plain values."""
        return dataclasses.asdict(self) | {"peak": self.peak}


class Estimator:
    """Estimates what runs of one plan need under different settings; steps that it knows it does not run again.

    Args:
        backbone: a plan, on the meta device.
        channels: of the memory's features, ``None`` without a memory.
    """

    def __init__(self, backbone: Backbone, channels: int | None) -> None:
        self.backbone, self.twins = backbone, Twins(backbone, channels)
        self._encodings: dict[tuple[object, ...], Encoding] = {}
        self._steps: dict[tuple[object, ...], Activations] = {}

    def need(self, recipe: Recipe, launch: Launch) -> MemoryEstimate:
        """What one process of a run needs."""
        training = recipe.training
        batch = training.samples_at_once(launch.devices)
        kind = StepKind(batch, launch.cuda, launch.sharded and training.precision == "bf16")
        encoding, step = self.encoding(recipe, kind).peak, self.step(recipe, kind)
        least = self.at_least(recipe, launch)
        return dataclasses.replace(least, encoding=encoding, activations=step.peak, shallow=step.shallow)

    def at_least(self, recipe: Recipe, launch: Launch) -> MemoryEstimate:
        """The same without what a step takes, which need not be run for that."""
        training = recipe.training
        trained = [each.numel() for each in self.backbone.trained_parameters(recipe.stage).values()]
        count, largest = sum(trained), max(trained, default=0)
        share = launch.share
        buckets = 2 if launch.devices > 1 and not launch.sharded else 1
        averaged = training.ema and not (launch.cuda and training.ema_device == "cpu")
        at_once = count * share if launch.cuda and training.optimizer == "adamw" else 2 * largest * share
        return MemoryEstimate(
            weights=self.weights(recipe, launch),
            gradients=round(count * FLOAT32 * share * buckets),
            optimizer=round(count * MOMENTS[training.optimizer] * share),
            average=round(count * FLOAT32 * share) if averaged else 0,
            update=round(at_once * FLOAT32),  # torch takes roots of all second moments at once on a GPU
            kept=training.accumulation > 1,
            host=self.host(recipe, launch, count),
        )

    def host(self, recipe: Recipe, launch: Launch, count: int) -> int:
        """Bytes of what is trained that rest in the memory of the CPU, where the devices are others."""
        training = recipe.training
        averages = count * FLOAT32 if training.ema else 0
        if launch.offloaded:
            return self.weights_of(recipe)[1] + round(count * (FLOAT32 + MOMENTS[training.optimizer])) + averages
        apart = launch.cuda and training.ema_device == "cpu"
        return averages * (1 if launch.sharded else launch.devices) if apart else 0

    def encoding(self, recipe: Recipe, kind: StepKind) -> Encoding:
        """What encoding takes in a step of this kind."""
        kind, training = dataclasses.replace(kind, sharded=False), recipe.training  # what encodes is not sharded
        key = (kind, training.precision, training.frozen_precision, training.vae_slicing)
        if key not in self._encodings:
            self._encodings[key] = self.twins.encoding(recipe, kind)
        return self._encodings[key]

    def step(self, recipe: Recipe, kind: StepKind) -> Activations:
        """What forward and backward pass take in a step of this kind."""
        training = recipe.training
        key = (kind, training.precision, training.gradient_checkpointing, training.frozen_precision)
        if key not in self._steps:
            self._steps[key] = self.twins.activations(recipe, kind, self.encoding(recipe, kind))
        return self._steps[key]

    def weights(self, recipe: Recipe, launch: Launch) -> int:
        """Bytes of parameters and buffers.

        With FSDP those of this process and what it gathers at once: two blocks, one of them with the gradients that
        go out in float32, and all that stands in no block.
        """
        whole, shared = self.weights_of(recipe)
        gathered = self.gathered(recipe) if launch.sharded else 0
        buffers = sum(each.numel() * each.element_size() for each in self.backbone.buffers())
        return whole + buffers + round(shared * launch.share) + gathered

    def weights_of(self, recipe: Recipe) -> tuple[int, int]:
        """Bytes of the parameters that FSDP leaves whole, and of the rest; the frozen ones in their own precision."""
        backbone, frozen = self.backbone, HALF if recipe.training.frozen_precision == "bf16" else FLOAT32
        trained = {id(each) for each in backbone.trained_parameters(recipe.stage).values()}

        def size(parameters: list[nn.Parameter]) -> int:
            return sum(each.numel() * (FLOAT32 if id(each) in trained else frozen) for each in parameters)

        whole = backbone.never_sharded_parameters()
        kept = {id(each) for each in whole}
        return size(whole), size([each for each in backbone.parameters() if id(each) not in kept])

    def gathered(self, recipe: Recipe) -> int:
        """Bytes that FSDP puts together at once."""
        kept = {id(each) for each in self.backbone.never_sharded_parameters()}
        width = HALF if recipe.training.precision == "bf16" else FLOAT32
        blocks = [each for each in self.backbone.modules() if type(each).__name__ in self.backbone.sharded_blocks]
        sizes = [sum(each.numel() for each in block.parameters()) for block in blocks]
        inside = {id(each) for block in blocks for each in block.parameters()}
        rest = sum(each.numel() for each in self.backbone.parameters() if id(each) not in inside | kept)
        most = max(sizes, default=0)
        return round(rest * width + most * (2 * width + width + FLOAT32))
