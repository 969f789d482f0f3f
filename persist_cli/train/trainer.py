"""The training loop: batch, loss, backward, clip, step, average, log."""

from __future__ import annotations

import dataclasses
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Final

import torch
from accelerate import Accelerator
from torch.utils.data import DataLoader, Dataset

from persist_cli.api.backbone import Backbone, Clips
from persist_cli.api.checkpoint import TrainingScenes
from persist_cli.data.augment import Augmentation
from persist_cli.data.cameras import vertical_view
from persist_cli.data.clips import ClipDataset, ClipPlan, DistributedBatches
from persist_cli.data.held_out import trained_scene
from persist_cli.data.reference import data_folder
from persist_cli.data.writing_noise import WritingNoise
from persist_cli.errors import PersistError, RecipeError
from persist_cli.memorize.factory import MemoryFactory, with_memory
from persist_cli.recipe import DataSettings, Recipe, TrainingSettings
from persist_cli.train.clip_cache import CachedClips, CacheKeys, ClipCache, ClipEncoder
from persist_cli.train.distributed import Sharding, ZeroState, unflattened, uses_zero
from persist_cli.train.log import StepLog, StepTimes
from persist_cli.train.optimizer import make_average, make_optimizer, requested_savings, update_average
from persist_cli.train.own_writes import OwnWrites
from persist_cli.train.state import TrainingState
from persist_cli.train.tensor_cache import CacheSettings, TensorCache
from persist_cli.viewing.console import add_task, progress

START_BATCHES: Final = 16  # from which fresh weights are set at the beginning of a stage


@dataclass
class StopSignal:
    """Within the block, SIGINT and SIGTERM are noted here, so that a run can stop at the end of its step."""

    signal: int | None = None
    previous_handlers: dict[int, Any] = field(default_factory=dict)

    def __enter__(self) -> StopSignal:
        for number in (signal.SIGINT, signal.SIGTERM):
            self.previous_handlers[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self.previous_handlers.items():
            signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.signal = number


def outlive_signals(_worker: int) -> None:
    """Let a process that reads data go on when all processes get a signal: the run ends it, after its checkpoint."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


class Trainer:
    """Trains one stage of a backbone.

    Args:
        recipe: the run's recipe.
        backbone: the backbone; in stage 2 it uses the adapter to train.
        factory: makes the memories that the adapter reads, in stage 2.
        accelerator: accelerate for this process, which may be one of many.
        cache: where latents and memory tokens of clips that come again are kept; ``None`` keeps none.

    Raises:
        PersistError: when there are no clips, or a cache would never be read.
    """

    def __init__(
        self,
        recipe: Recipe,
        backbone: Backbone,
        factory: MemoryFactory | None,
        accelerator: Accelerator,
        cache: CacheSettings | None = None,
    ) -> None:
        self.recipe, self.backbone, self.accelerator = recipe, backbone, accelerator
        self.factory = factory
        self.times = StepTimes(accelerator.device, recipe.training.batch, enabled=False)
        parameters, settings = backbone.trained_parameters(recipe.stage), recipe.training
        backbone.apply_memory_savings(recipe.stage, requested_savings(settings, accelerator.device))
        clips = self.all_clips()
        self.scenes = scenes_of(clips)
        self.clips: Dataset[Any] = clips
        self.encoder = self.clip_encoder(cache)
        if self.encoder is not None:
            self.clips = CachedClips(clips, self.encoder.cache)
        self.own_writes: OwnWrites | None = None
        if recipe.data.own_writes and self.encoder is not None:
            check_own_writes(accelerator)
            self.own_writes = OwnWrites(self.encoder, WritingNoise.of(recipe.data))
        if recipe.base is None:
            backbone.begin_stage(recipe.stage, self.first_batches(START_BATCHES))
        optimizer = make_optimizer(parameters.values(), settings)
        self.sharding = Sharding(backbone, recipe, accelerator) if accelerator.is_fsdp2 else None
        self.model, self.optimizer = accelerator.prepare(backbone, optimizer)
        if self.sharding is not None:
            parameters = self.sharding.parameters()
        average = make_average(parameters.values(), settings) if settings.ema else None
        moments: Any = optimizer.state
        self.zero = uses_zero(accelerator)
        if self.zero:
            moments = ZeroState(self.optimizer.optimizer, [*parameters.values()])
        self.state = TrainingState(parameters, moments, average)

    def all_clips(self) -> ClipDataset:
        """All clips of the recipe's data sets."""
        recipe, backbone = self.recipe, self.backbone
        plan = ClipPlan(
            frames=backbone.frames_per_clip,
            strides=recipe.data.strides,
            context_frames=recipe.data.context_frames if self.factory else 0,
            seed=recipe.training.seed,
            image_size=backbone.image_size,
            clips_per_trajectory=recipe.data.clips_per_trajectory,
            exclude_targets=recipe.data.exclude_targets,
            exclude_metres=recipe.data.exclude_metres,
            exclude_degrees=recipe.data.exclude_degrees,
            augmentation=augmentation_of(recipe.data),
            own_writes=recipe.data.own_writes,
            own_after=recipe.data.own_warmup * recipe.training.batch,
            segments=recipe.data.own_segments,
            noise=WritingNoise.of(recipe.data),
        )
        return ClipDataset([data_folder(path) for path in recipe.data.path], plan)

    def clip_encoder(self, settings: CacheSettings | None) -> ClipEncoder | None:
        """The encoder of clips that come again or are chained, with a cache where there is one; else ``None``."""
        recipe, backbone = self.recipe, self.backbone
        repeats = recipe.data.clips_per_trajectory > 0
        if settings is None and not repeats and not recipe.data.own_writes:
            return None
        encodes = backbone.encodes(recipe.stage)
        if recipe.data.own_writes and not encodes:
            raise RecipeError(f"backbone {backbone.name!r} predicts no clips in training; set data.own_writes=0")
        if settings is None:
            return ClipEncoder(backbone, self.factory, self.accelerator, None) if encodes else None
        if not encodes:
            raise RecipeError(
                f"--cache: in stage {recipe.stage} backbone {backbone.name!r} keeps nothing of a clip; leave it out"
            )
        keeps_features = self.factory is not None and self.factory.encoder.costly
        if not repeats and not keeps_features and not backbone.framewise:
            raise RecipeError(
                "--cache: with data.clips_per_trajectory=0 hardly a clip comes twice; give it, as in "
                "data.clips_per_trajectory=32, or leave --cache out"
            )
        if not repeats and augmentation_of(recipe.data) != Augmentation():
            raise RecipeError(
                "--cache: with data.crop, data.mirror or data.color_jitter no view of a clip comes twice; give "
                "data.clips_per_trajectory, as in data.clips_per_trajectory=32, or leave --cache out"
            )
        keys = CacheKeys.of(recipe, backbone, self.factory, self.accelerator.device.type)
        kept = ClipCache.of(TensorCache(settings), keys, self.factory)
        return ClipEncoder(backbone, self.factory, self.accelerator, kept)

    def first_batches(self, count: int) -> Iterator[Clips]:
        """So many batches of the first samples, of which something is measured before or after training."""
        size = self.recipe.training.batch
        for number in range(count):
            yield self.to_batch([self.clips[number * size + row] for row in range(size)])

    def loader(self) -> Iterator[Clips]:
        """Batches of this process from the state's step to the last."""
        settings = self.recipe.training
        batches = DistributedBatches(
            self.state.step, settings.steps, settings.batch, settings.accumulation,
            self.accelerator.process_index, self.accelerator.num_processes,
        )  # fmt: skip
        loader: DataLoader[Any] = DataLoader(
            self.clips,
            batch_sampler=batches,
            num_workers=settings.workers,
            collate_fn=list,
            worker_init_fn=outlive_signals,
            generator=torch.Generator(),  # of its own: the loader must not draw from the run's random state
        )
        remaining = iter(loader)
        while True:
            with self.times.part("data"):
                samples = next(remaining, None)
            if samples is None:
                return
            yield self.to_batch(samples)

    def to_batch(self, samples: list[Any]) -> Clips:
        """Make a batch of samples of ``clips``, with memory tokens in stage 2 and latents where clips come again."""
        if self.encoder is None:
            with self.times.part("memory"):
                clips = [with_memory(sample, self.factory, self.backbone.token_budget) for sample in samples]
        else:
            with self.times.part("encode"):
                encoded = [self.encoder.with_latents(sample) for sample in samples]
            with self.times.part("memory"):
                if self.own_writes is not None:
                    encoded = self.own_writes.written(encoded)
                clips = [self.encoder.with_tokens(sample) for sample in encoded]
        return Clips.stack(clips).to(self.accelerator.device)

    def encoded(self, clips: Clips) -> Clips:
        """The clips; when times are taken with their latents, which the model would else make in its forward pass."""
        if not self.times.enabled or clips.latents is not None or not self.backbone.encodes(self.recipe.stage):
            return clips
        with self.times.part("encode"), torch.no_grad(), self.accelerator.autocast():
            return dataclasses.replace(clips, latents=self.backbone.encode(clips))

    def steps(self) -> Iterator[dict[str, float]]:
        """Train to the last step; yields the logged values of each optimizer step."""
        batches = self.loader()
        while self.state.step < self.recipe.training.steps:
            with self.times.step():
                values = self.step(batches)
            self.state.step += 1
            yield values

    def step(self, batches: Iterator[Clips]) -> dict[str, float]:
        """Take an optimizer step; returns its losses, which are means over micro-batches and processes.

        Raises:
            PersistError: when the loss is not finite; the parameters are then unchanged.
        """
        settings, accelerator, times = self.recipe.training, self.accelerator, self.times
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(settings, self.state.step)
        totals: dict[str, torch.Tensor] = {}
        for number in range(1, settings.accumulation + 1):
            clips = self.encoded(next(batches))
            with self.synchronized(last=number == settings.accumulation):
                with times.part("forward"), accelerator.autocast():  # accelerate leaves it out when it shards
                    losses = self.model(clips, self.recipe.stage)
                with times.part("backward"):  # DeepSpeed divides the loss itself
                    accelerator.backward(losses["loss"] / (1 if self.zero else settings.accumulation))
            for name, loss in losses.items():
                totals[name] = totals.get(name, 0) + loss.detach() / settings.accumulation
            del clips, losses  # nothing of a batch stays on the device while the optimizer works
        means = {name: float(accelerator.reduce(total, "mean")) for name, total in totals.items()}
        if not math.isfinite(means["loss"]):
            raise PersistError(
                f"the loss is {means['loss']} at step {self.state.step}; lower training.learning_rate or train with "
                "training.precision=no"
            )
        with times.part("optimizer"):
            accelerator.clip_grad_norm_(self.state.parameters.values(), settings.clip)
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            if self.state.average is not None:
                update_average(self.state.average, self.state.parameters.values())
        return means

    def synchronized(self, last: bool) -> AbstractContextManager[None]:
        """Within the block of the last micro-batch, processes add up their gradients.

        Before that each keeps its own, which FSDP2 cannot: unsharded gradients might not fit.
        """
        if self.zero:
            self.accelerator.gradient_state._set_sync_gradients(last)  # DeepSpeed then takes a step after the last
        if last or self.zero or self.sharding is not None:
            return nullcontext()
        unsynchronized: AbstractContextManager[None] = self.accelerator.no_sync(self.model)
        return unsynchronized

    @contextmanager
    def model_to_save(self) -> Iterator[Backbone]:
        """Within the block the main process has the whole backbone, with averaged weights where these are kept.

        All processes must enter.
        """
        main = self.accelerator.is_main_process
        if self.sharding is not None:
            with self.sharding.gathered(self.state.averages(), main) as backbone:
                yield backbone
        elif not main:
            yield self.backbone
        else:
            parameters = self.state.parameters.values()
            with unflattened(parameters) if self.zero else nullcontext(), self.state.averaged():
                yield self.backbone

    def agreed(self, due: bool, signal: int | None) -> tuple[bool, int | None]:
        """Whether a checkpoint is due for any process, and the signal that any got: they save and stop together."""
        if self.accelerator.num_processes == 1:
            return due, signal
        flags = torch.tensor([[int(due), signal or 0]], device=self.accelerator.device)
        any_due, any_signal = self.accelerator.gather(flags).amax(0).tolist()
        return bool(any_due), any_signal or None

    def train(self, log: StepLog, save: Callable[[], None], stop: StopSignal) -> int | None:
        """Train to the last step or to a signal.

        Args:
            log: gets the values of each step.
            save: writes a checkpoint; called as often as the recipe says.
            stop: the signal that asked this process to stop, once there is one.

        Returns:
            The signal that ended the training, ``None`` when none did.
        """
        settings = self.recipe.training
        saved = time.monotonic()
        with progress() as bar:
            task = add_task(bar, "training", settings.steps, "steps", done=self.state.step)
            for values in self.steps():
                bar.update(task, advance=1, note=f"loss {values['loss']:.4f}")
                if self.accelerator.is_main_process:
                    log.add(self.state.step, values | {"learning_rate": learning_rate(settings, self.state.step - 1)})
                self.accelerator.log(values, step=self.state.step)
                late = time.monotonic() - saved > 60 * settings.checkpoint_minutes
                due, signal = self.agreed(late, stop.signal)
                if signal is not None:
                    return signal
                if due or self.state.step % settings.checkpoint_every == 0:
                    save()
                    saved = time.monotonic()
        return None


def scenes_of(clips: ClipDataset) -> TrainingScenes:
    """The scenes of all clips, and the views that cameras have in random windows too."""
    names = frozenset(trained_scene(file.info) for file in clips.files)
    views = [vertical_view(file.info, share) for file in clips.files for share in (clips.plan.augmentation.crop, 1.0)]
    return TrainingScenes(names, fov=(min(views), max(views)) if views else None)


def augmentation_of(data: DataSettings) -> Augmentation:
    """The random views that a recipe asks for."""
    return Augmentation(data.crop, data.mirror, data.color_jitter)


def check_own_writes(accelerator: Accelerator) -> None:
    """Raise ``RecipeError`` where a process does not have the whole model, with which it could predict by itself."""
    if accelerator.is_fsdp2 or uses_zero(accelerator):
        raise RecipeError(
            "data.own_writes needs the whole model in each process; launch with --multi_gpu, or set it to 0"
        )


def learning_rate(settings: TrainingSettings, step: int) -> float:
    """The learning rate of a step: it rises linearly, stays, and at the end falls linearly to zero."""
    rising = (step + 1) / max(1, settings.warmup)
    falling = (settings.steps - step) / (settings.cooldown + 1)
    return settings.learning_rate * min(1.0, rising, falling)
