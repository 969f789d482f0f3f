"""The settings of recipes for data and for the training loop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import BeforeValidator, Field

from persist_cli.api.nearness import NEAR_DEGREES, NEAR_METRES

CHANGEABLE: Final = "a run may be resumed with another value"
Value = TypeVar("Value")
Changeable = Annotated[Value, CHANGEABLE]

Count = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
PositiveNumber = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Amount = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Precision = Annotated[  # YAML reads the word no as false
    Literal["no", "bf16"], BeforeValidator(lambda value: "no" if value is False else value)
]


@dataclass(frozen=True)
class TrainingSettings:
    """The settings of the training loop.

    Args:
        steps: optimizer steps.
        batch: samples an optimizer step, over all processes and accumulated micro-batches.
        accumulation: micro-batches that a step is split into.
        learning_rate: learning rate of the optimizer after the warm-up.
        warmup: steps over which the learning rate rises linearly.
        cooldown: steps at the end over which the learning rate falls linearly to zero.
        schedule: of the learning rate after the warm-up: ``constant`` up to the cooldown, or ``cosine``, which falls to
            zero over all steps.
        weight_decay: weight decay of the optimizer.
        clip: largest norm of all gradients together.
        ema: decay of the moving average of the weights, which is what is saved; 0 saves the last weights.
        precision: of the computation: ``no`` for float32, ``bf16`` for mixed precision.
        seed: seed of everything random: fresh weights, the choice of clips, noise.
        checkpoint_every: steps between checkpoints.
        checkpoint_minutes: most minutes between checkpoints.
        keep_checkpoints: how many of the newest checkpoints the run keeps. One that ended a recipe, or that another
            run stands on, is always kept.
        workers: processes that read data.
        threads: CPU threads of torch; 0 leaves the number to torch.
        tracker: where losses are logged beside ``log.jsonl``: ``none`` for nowhere, or ``tensorboard``.
        optimizer: ``adamw``; ``adamw-8bit`` of the package bitsandbytes, whose moments take a quarter of the bytes; or
            ``muon``: Muon for matrices of at least 128 rows and columns, AdamW for all else.
        gradient_checkpointing: keep only the hidden states between blocks and compute the rest again in the backward
            pass; this takes far fewer bytes and about a third more time.
        compile: compile the blocks with ``torch.compile``; the first steps then take minutes.
        ema_device: where the averaged weights are: with the ``model`` on its device, or in the memory of the ``cpu``.
        frozen_precision: of the weights that a stage does not train: ``no`` for theirs, ``bf16`` for half the bytes;
            what is saved stays exact.
        vae_slicing: encode clips one by one, which takes fewer bytes.
    """

    steps: Changeable[Positive] = 1000
    batch: Positive = 16
    accumulation: Changeable[Positive] = 1
    learning_rate: Annotated[float, Field(gt=0, le=1000)] = 1e-4
    warmup: Count = 50
    cooldown: Changeable[Count] = 0
    schedule: Literal["constant", "cosine"] = "constant"
    weight_decay: Amount = 1e-4
    clip: PositiveNumber = 1.0
    ema: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.999
    precision: Precision = "bf16"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # what numpy takes
    checkpoint_every: Changeable[Positive] = 500
    checkpoint_minutes: Changeable[Amount] = 5.0
    keep_checkpoints: Changeable[Positive] = 1
    workers: Changeable[Count] = 1
    threads: Changeable[Count] = 0
    tracker: Changeable[Literal["none", "tensorboard"]] = "none"
    optimizer: Literal["adamw", "adamw-8bit", "muon"] = "adamw"
    gradient_checkpointing: Changeable[bool] = False
    compile: Changeable[bool] = False
    ema_device: Changeable[Literal["model", "cpu"]] = "model"
    frozen_precision: Precision = "no"
    vae_slicing: Changeable[bool] = False

    def samples_at_once(self, processes: int) -> int:
        """The most samples of a micro-batch that one of so many processes computes at once."""
        return math.ceil(self.batch / (self.accumulation * processes))


def _as_list(value: Any) -> Any:
    """Make a list of a single path; pydantic checks all other values."""
    if isinstance(value, str):
        return [value] if value else []
    return value


@dataclass(frozen=True)
class DataSettings:
    """The choice of the clips to train on.

    Args:
        path: one data set folder or several; ``--data`` replaces them.
        strides: one is drawn for each clip: with 3 it has every third frame of its trajectory. With a negative stride
            the clip plays backwards and its context is what was seen on the way there.
        context_frames: the most earlier frames that a clip's memory is made of (stage 2).
        clips_per_trajectory: how many fixed clips, with fixed contexts, each trajectory offers, so that clips come
            again and can be cached; 0 draws from all possible clips.
        exclude_targets: share of the clips whose context has no frame near a frame to predict, so that memory does not
            hold the answer; with strides of -1 and 0 here it holds the whole clip.
        exclude_metres: such a frame is near when the two cameras are less than this apart …
        exclude_degrees: … and turned by less than this. The clip's first frame always stays.
        crop: smallest height of a random window of the images, relative to the largest one that has the model's aspect;
            clip and memory are cut alike, and intrinsics follow. Below 1, images may be larger than the model's.
        mirror: share of the clips whose room is mirrored, with its cameras.
        color_jitter: largest relative change of the brightness, and as much of each colour, of clip and memory alike.
        own_writes: share of the samples that begin where the model's own prediction of the frames before ends: these
            are written into the memory (stage 2), and the last of them is the given frame (stages 1 and 2), as in a
            rollout. The prediction is made in one step from a random noise level, in a distillation from noise alone.
            The field has related forms of it: scheduled sampling, self-forcing.
        own_warmup: steps of the training before the first such sample.
        own_segments: clips of such a sample, one after the other; the last one counts, the others are predicted.
        pose_drift: standard deviation in metres of a step of the drift of poses along each axis, from one written
            frame to the next; after 100 frames it is ten times as much. The newest frame has its true pose.
        pose_drift_degrees: the same for rotation about each axis, in degrees.
        depth_noise: standard deviation of the error of written depth as a share of it, smooth over the image.
        detour: of a policy's samples (stage policy): they lead to a later frame only where the walk came to it in at
            most so many times the frames of the direct way, which turns to it, goes straight and turns to its heading;
            of others they tell the distance alone; with ``null`` they lead to every later frame.
        true_cells: share of the clips whose memory, a scene, holds the data's own cells, all of them known, in the
            place of what the context's frames show.
        clip_frames: lengths of the clips of stages 1 and 2 in frames with the given one, such as 2, 3, 5 and 9; one is
            drawn for each step. Without any all clips have the model's. Shorter ones cost less, and a model that knows
            them can be walked in step by step.
    """

    path: Annotated[tuple[str, ...], BeforeValidator(_as_list)] = ()
    strides: tuple[int, ...] = (1, 2, 3)
    context_frames: Count = 48
    clips_per_trajectory: Count = 0
    exclude_targets: Share = 0.0
    exclude_metres: PositiveNumber = NEAR_METRES
    exclude_degrees: PositiveNumber = NEAR_DEGREES
    crop: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 1.0
    mirror: Share = 0.0
    color_jitter: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.0
    own_writes: Share = 0.0
    own_warmup: Count = 0
    own_segments: Annotated[int, Field(ge=2)] = 2
    pose_drift: Amount = 0.0
    pose_drift_degrees: Amount = 0.0
    depth_noise: Amount = 0.0
    detour: Annotated[float, Field(ge=1, allow_inf_nan=False)] | None = None
    true_cells: Share = 0.0
    clip_frames: tuple[int, ...] = ()
