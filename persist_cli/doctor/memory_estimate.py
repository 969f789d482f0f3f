"""Estimates of the memory that a process of a training needs, in bytes for each purpose."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final

from torch import nn

from persist_cli.api.backbone import Backbone
from persist_cli.api.scene_model import SceneModel
from persist_cli.doctor.step import Activations, Encoding, SceneCopies, ShallowCopies, StepCopies, StepKind
from persist_cli.recipe import Recipe

FLOAT32: Final = 4

HALF: Final = 2

MOMENTS: Final = {
    "adamw": 2 * FLOAT32,
    "adamw-8bit": 2 * (1 + FLOAT32 / 256),  # a byte each, and a scale for every 256
    "muon": 2 * FLOAT32,  # half of it for the matrices that Muon trains: at most
}


@dataclass(frozen=True, kw_only=True)
class Launch:
    """The processes that a training is spread over.

    Args:
        devices: the number of processes, of which each has a device.
        cuda: whether the devices are GPUs.
        sharded: whether FSDP2 shards the model; else each process has all of it.
        offloaded: whether FSDP2 also keeps each share in the memory of the CPU and runs the optimizer there.
    """

    devices: int
    cuda: bool
    sharded: bool = False
    offloaded: bool = False

    @property
    def share(self) -> float:
        """The share of what is sharded that one device holds between steps."""
        return 0.0 if self.offloaded else 1 / self.devices if self.sharded else 1.0


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes of memory on one device.

    Weights, moments and averages are always there. Three peaks follow each other in a step: encoding the clips; the
    activations, which go while the gradients come; the gradients together with the update of the weights. With several
    micro-batches there are gradients from the first one on.

    Args:
        weights: weights and buffers; with FSDP2 also what is gathered from other processes at once.
        gradients: gradients; with DDP also the buckets that are sent.
        optimizer: the moments of AdamW.
        average: the moving average of the weights, where it is on the device.
        update: what the optimizer takes for its step.
        kept: whether gradients stay while the next micro-batch is encoded and run.
        encoding: what the codec takes to encode a micro-batch.
        activations: what forward and backward pass take at most.
        shallow: what of the activations is left when all gradients are there.
        host: bytes in the memory of the CPU instead of the device, for all processes together.
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
        """The most bytes at once."""
        before = self.gradients if self.kept else 0
        step = max(self.activations + before, self.gradients + self.shallow)
        return self.always + max(self.encoding + before, step, self.gradients + self.update)

    @property
    def always(self) -> int:
        """Bytes that a run holds from its second step to its end."""
        return self.weights + self.optimizer + self.average

    def to_json(self) -> dict[str, int | bool]:
        """The estimate and its peak as JSON values."""
        return dataclasses.asdict(self) | {"peak": self.peak}


class Estimator(ABC):
    """Estimates the memory that trainings of one model need with different settings; each kind of step runs once.

    Args:
        model: a model on the meta device.
        copies: what runs its steps.
    """

    def __init__(self, model: Backbone | SceneModel, copies: StepCopies) -> None:
        self.model, self.copies = model, copies
        self._encodings: dict[tuple[object, ...], Encoding] = {}
        self._steps: dict[tuple[object, ...], Activations] = {}

    def estimate(self, recipe: Recipe, launch: Launch) -> MemoryEstimate:
        """The memory that one process of a training needs."""
        training = recipe.training
        batch = training.samples_at_once(launch.devices)
        kind = StepKind(batch=batch, cuda=launch.cuda, sharded=launch.sharded and training.precision == "bf16")
        encoding, step = self.encoding(recipe, kind).peak, self.step(recipe, kind)
        without_step = self.without_step(recipe, launch)
        return dataclasses.replace(without_step, encoding=encoding, activations=step.peak, shallow=step.shallow)

    def without_step(self, recipe: Recipe, launch: Launch) -> MemoryEstimate:
        """A lower bound that is found without running a step: encoding and activations are left out."""
        training = recipe.training
        trained = [parameter.numel() for parameter in self.model.trained_parameters(recipe.stage).values()]
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
        """Bytes of trained weights, moments and averages that GPUs leave in the memory of the CPU."""
        training = recipe.training
        averages = count * FLOAT32 if training.ema else 0
        if launch.offloaded:
            return self.parameter_bytes(recipe)[1] + round(count * (FLOAT32 + MOMENTS[training.optimizer])) + averages
        apart = launch.cuda and training.ema_device == "cpu"
        return averages * (1 if launch.sharded else launch.devices) if apart else 0

    def encoding(self, recipe: Recipe, kind: StepKind) -> Encoding:
        """The memory that encoding takes in a step of this kind."""
        kind, training = dataclasses.replace(kind, sharded=False), recipe.training  # what encodes is not sharded
        key = (kind, training.precision, training.frozen_precision, training.vae_slicing)
        if key not in self._encodings:
            self._encodings[key] = self.copies.encoding(recipe, kind)
        return self._encodings[key]

    def step(self, recipe: Recipe, kind: StepKind) -> Activations:
        """The memory that forward and backward pass take in a step of this kind."""
        training = recipe.training
        kept = training.precision, training.gradient_checkpointing, training.frozen_precision
        key = (kind, *kept, recipe.distill, recipe.adversarial)
        if key not in self._steps:
            self._steps[key] = self.copies.activations(recipe, kind, self.encoding(recipe, kind))
        return self._steps[key]

    @abstractmethod
    def weights(self, recipe: Recipe, launch: Launch) -> int:
        """Bytes of parameters and buffers, with FSDP2 those of this process and what it gathers from others at once."""

    @abstractmethod
    def parameter_bytes(self, recipe: Recipe) -> tuple[int, int]:
        """Bytes of the parameters that FSDP2 never shards, and of all others; frozen ones in their own precision."""

    def buffer_bytes(self) -> int:
        """Bytes of the buffers."""
        return sum(buffer.numel() * buffer.element_size() for buffer in self.model.buffers())


class SceneEstimator(Estimator):
    """Estimates the memory that trainings of a model of scenes need, which is never sharded.

    Args:
        model: a model on the meta device.
    """

    def __init__(self, model: SceneModel) -> None:
        super().__init__(model, SceneCopies(model))

    def weights(self, recipe: Recipe, launch: Launch) -> int:
        """Bytes of parameters and buffers."""
        return self.parameter_bytes(recipe)[1] + self.buffer_bytes()

    def parameter_bytes(self, recipe: Recipe) -> tuple[int, int]:
        """Bytes of all parameters, as those that FSDP2 could shard."""
        return 0, sum(parameter.numel() * FLOAT32 for parameter in self.model.parameters())


class BackboneEstimator(Estimator):
    """Estimates the memory that trainings of a backbone need.

    Args:
        backbone: a backbone on the meta device.
        channels: the number of channels of the memory's features, ``None`` without a memory.
    """

    def __init__(self, backbone: Backbone, channels: int | None) -> None:
        super().__init__(backbone, ShallowCopies(backbone, channels))
        self.backbone = backbone

    def weights(self, recipe: Recipe, launch: Launch) -> int:
        """Bytes of parameters and buffers, with FSDP2 those of this process and what it gathers from others at once."""
        never_sharded, sharded = self.parameter_bytes(recipe)
        gathered = self.gathered(recipe) if launch.sharded else 0
        whole = never_sharded + self.buffer_bytes() + round(sharded * launch.share) + gathered
        return whole + self.teacher_bytes(recipe)

    def teacher_bytes(self, recipe: Recipe) -> int:
        """Bytes of a distillation's teacher; its target has the averaged weights, which are counted as such."""
        if recipe.distill is None:
            return 0
        own = self.backbone.trained_parameters(recipe.stage) if recipe.distill.teacher is None else None
        parameters = self.backbone.parameters() if own is None else own.values()
        return sum(parameter.numel() * FLOAT32 for parameter in parameters)

    def parameter_bytes(self, recipe: Recipe) -> tuple[int, int]:
        """Bytes of the parameters that FSDP2 never shards, and of all others; frozen ones in their own precision."""
        backbone, frozen = self.backbone, HALF if recipe.training.frozen_precision == "bf16" else FLOAT32
        trained = {id(parameter) for parameter in backbone.trained_parameters(recipe.stage).values()}

        def size(parameters: list[nn.Parameter]) -> int:
            return sum(p.numel() * (FLOAT32 if id(p) in trained else frozen) for p in parameters)

        never_sharded = backbone.never_sharded_parameters()
        whole = {id(parameter) for parameter in never_sharded}
        return size(never_sharded), size([p for p in backbone.parameters() if id(p) not in whole])

    def gathered(self, recipe: Recipe) -> int:
        """Bytes that FSDP2 gathers at once.

        These are two blocks, one of them with the gradients that go out in float32, and all that is in no block.
        """
        width = HALF if recipe.training.precision == "bf16" else FLOAT32
        blocks = [module for module in self.backbone.modules() if type(module).__name__ in self.backbone.sharded_blocks]
        largest = max((sum(p.numel() for p in block.parameters()) for block in blocks), default=0)
        apart = {id(p) for p in self.backbone.never_sharded_parameters()}
        apart |= {id(p) for block in blocks for p in block.parameters()}
        rest = sum(p.numel() for p in self.backbone.parameters() if id(p) not in apart)
        return round(rest * width + largest * (2 * width + width + FLOAT32))
