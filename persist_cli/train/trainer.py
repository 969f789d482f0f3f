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
from typing import Any

import torch
from accelerate import Accelerator
from torch.utils.data import DataLoader, Dataset

from persist_cli.api.backbone import Backbone, Clips
from persist_cli.data.clips import ClipDataset, ClipPlan, DistributedBatches
from persist_cli.data.reference import data_folder
from persist_cli.errors import PersistError, RecipeError
from persist_cli.memorize.factory import MemoryFactory, collate, recall_all
from persist_cli.recipe import Recipe, TrainingSettings
from persist_cli.train.clip_cache import Cache, CachedClips, CacheKeys, CacheSettings, ClipCache, ClipEncoder
from persist_cli.train.distributed import Sharding, ZeroState, unflattened, uses_zero
from persist_cli.train.log import StepLog, StepTimes, timed
from persist_cli.train.optimizer import make_average, make_optimizer, requested_savings, update_average
from persist_cli.train.state import TrainingState
from persist_cli.viewing.console import add_task, progress


@dataclass
class Stop:
    """Whether a signal asked the run to stop at the end of its step."""

    signal: int | None = None
    before: dict[int, Any] = field(default_factory=dict)

    def __enter__(self) -> Stop:
        for number in (signal.SIGINT, signal.SIGTERM):
            self.before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.signal = number


class Trainer:
    """One stage of training a backbone.

    Args:
        recipe: the run.
        backbone: with the adapter to train in use, in stage 2.
        maker: of the memories that the adapter reads, in stage 2.
        accelerator: one process or many.
        cache: of latents and tokens, for clips that come again.

    Raises:
        PersistError: when there are no clips, or a cache would never be read.
    """

    def __init__(
        self,
        recipe: Recipe,
        backbone: Backbone,
        maker: MemoryFactory | None,
        accelerator: Accelerator,
        cache: CacheSettings | None = None,
    ) -> None:
        self.recipe, self.backbone, self.accelerator = recipe, backbone, accelerator
        self.maker = maker
        self.times: StepTimes | None = None
        parameters, settings = backbone.trained_parameters(recipe.stage), recipe.training
        backbone.apply_memory_savings(recipe.stage, requested_savings(settings, accelerator.device))
        clips = self.all_clips()
        self.scenes = frozenset(file.info.scene for file in clips.files)
        self.clips: Dataset[Any] = clips
        self.encoder = self.clip_encoder(cache)
        if self.encoder is not None:
            self.clips = CachedClips(clips, self.encoder.cache)
        optimizer = make_optimizer(parameters.values(), settings)
        self.sharding = Sharding(backbone, recipe, accelerator) if accelerator.is_fsdp2 else None
        self.model, self.optimizer = accelerator.prepare(backbone, optimizer)
        if self.sharding is not None:
            parameters = self.sharding.parameters()
        average = make_average(parameters.values(), settings) if settings.ema else None
        moments: Any = optimizer.state
        if uses_zero(accelerator):
            moments = ZeroState(self.optimizer.optimizer, [*parameters.values()])
        self.state = TrainingState(parameters, moments, average)

    def all_clips(self) -> ClipDataset:
        """The recipe's clips."""
        recipe, backbone = self.recipe, self.backbone
        plan = ClipPlan(
            frames=backbone.frames_per_clip,
            strides=recipe.data.strides,
            context_frames=recipe.data.context_frames if self.maker else 0,
            seed=recipe.training.seed,
            image_size=backbone.image_size,
            clips_per_trajectory=recipe.data.clips_per_trajectory,
        )
        return ClipDataset([data_folder(each) for each in recipe.data.path], plan)

    def clip_encoder(self, settings: CacheSettings | None) -> ClipEncoder | None:
        """What encodes clips that come again, with a cache where there is one; ``None`` when none comes again."""
        recipe, backbone = self.recipe, self.backbone
        again = recipe.data.clips_per_trajectory > 0
        if settings is None and not again:
            return None
        encodes = backbone.encodes(recipe.stage)
        if settings is None:
            return ClipEncoder(backbone, self.maker, self.accelerator, None) if encodes else None
        if not encodes:
            raise RecipeError(
                f"--cache: in stage {recipe.stage} backbone {backbone.name!r} keeps nothing of a clip; leave it out"
            )
        if not again and (recipe.stage == "2" or not backbone.framewise):
            raise RecipeError(
                "--cache: with data.clips_per_trajectory=0 hardly a clip comes twice; give it, as in "
                "data.clips_per_trajectory=32, or leave --cache out"
            )
        keys = CacheKeys.of(recipe, backbone, self.maker, self.accelerator.device.type)
        return ClipEncoder(backbone, self.maker, self.accelerator, ClipCache(Cache(settings), keys))

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
            generator=torch.Generator(),  # of its own: the loader must not draw from the run's random state
        )
        found = iter(loader)
        while True:
            with timed(self.times, "data"):
                samples = next(found, None)
            if samples is None:
                return
            yield self.to_batch(samples)

    def to_batch(self, samples: list[Any]) -> Clips:
        """Samples of ``clips`` as a batch with memory tokens, on the training device."""
        device = self.accelerator.device
        if self.encoder is not None:
            with timed(self.times, "encode"):
                latents = self.encoder.all_latents(samples)
            with timed(self.times, "memory"):
                tokens = self.encoder.all_tokens(samples)
            clips = collate(self.encoder.without_images(samples), tokens, latents)
        else:
            with timed(self.times, "memory"):
                tokens = recall_all(samples, self.maker, self.backbone.token_budget)
            clips = collate(samples, tokens)
        return Clips(
            rgb=clips.rgb.to(device),
            depth=clips.depth.to(device),
            cameras=clips.cameras,
            interactions=clips.interactions,
            tokens=clips.tokens,
            seeds=clips.seeds,
            latents=None if clips.latents is None else clips.latents.to(device),
        )

    def encoded(self, clips: Clips) -> Clips:
        """The clips with their latents, which the model would make by itself, so that they are timed apart."""
        if self.times is None or clips.latents is not None or not self.backbone.encodes(self.recipe.stage):
            return clips
        with self.times.part("encode"), torch.no_grad(), self.accelerator.autocast():
            return dataclasses.replace(clips, latents=self.backbone.encode(clips))

    def steps(self) -> Iterator[dict[str, float]]:
        """Train; after each optimizer step its logged values."""
        settings = self.recipe.training
        batches = self.loader()
        while self.state.step < settings.steps:
            with nullcontext() if self.times is None else self.times.step():
                for group in self.optimizer.param_groups:
                    group["lr"] = learning_rate(settings, self.state.step)
                values = self.accumulate(batches)
                with timed(self.times, "optimizer"):
                    self.optimize()
            self.state.step += 1
            yield values

    def optimize(self) -> None:
        """Change the parameters by their gradients, and their average by them."""
        self.accelerator.clip_grad_norm_(self.state.parameters.values(), self.recipe.training.clip)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        if self.state.average is not None:
            update_average(self.state.average, self.state.parameters.values())

    def accumulate(self, batches: Iterator[Clips]) -> dict[str, float]:
        """Gradients of one optimizer step; the mean of its logged values over micro-batches and processes."""
        parts = self.recipe.training.accumulation
        totals: dict[str, torch.Tensor] = {}
        for part in range(parts):
            clips = self.encoded(next(batches))
            with self.unsynced(last=part == parts - 1):
                with timed(self.times, "forward"), self.accelerator.autocast():  # left out by accelerate if it shards
                    losses = self.model(clips, self.recipe.stage)
                with timed(self.times, "backward"):
                    self.accelerator.backward(losses["loss"] / (1 if uses_zero(self.accelerator) else parts))
            for name, value in losses.items():
                totals[name] = totals.get(name, torch.zeros_like(value)) + value.detach() / parts
        values = {name: float(self.accelerator.reduce(value, "mean")) for name, value in totals.items()}
        if not math.isfinite(values["loss"]):
            raise PersistError(
                f"the loss is {values['loss']} at step {self.state.step}; lower training.learning_rate or train with "
                "training.precision=no"
            )
        return values

    def unsynced(self, last: bool) -> AbstractContextManager[None]:
        """Gradients stay with their process until the last micro-batch, but sharded ones: whole, they might not fit."""
        if uses_zero(self.accelerator):
            self.accelerator.gradient_state._set_sync_gradients(last)  # DeepSpeed steps when they are synced
        if last or self.sharding is not None or uses_zero(self.accelerator):
            return nullcontext()
        waiting: AbstractContextManager[None] = self.accelerator.no_sync(self.model)
        return waiting

    @contextmanager
    def model_to_save(self) -> Iterator[Backbone]:
        """The backbone, whole, with averaged weights where they are kept; all processes must enter."""
        main = self.accelerator.is_main_process
        if self.sharding is not None:
            with self.sharding.gathered(self.state.averages(), main) as whole:
                yield whole
        elif not main:
            yield self.backbone
        else:
            parameters = self.state.parameters.values()
            with unflattened(parameters) if uses_zero(self.accelerator) else nullcontext(), self.state.averaged():
                yield self.backbone

    def agreed(self, due: bool, signal: int | None) -> tuple[bool, int | None]:
        """What one process finds due, or what signal it got, as all of them see it: they save and stop together."""
        if self.accelerator.num_processes == 1:
            return due, signal
        found = torch.tensor([[int(due), signal or 0]], device=self.accelerator.device)
        all_due, all_signal = self.accelerator.gather(found).amax(0).tolist()
        return bool(all_due), all_signal or None

    def train(self, log: StepLog, save: Callable[[], None], stop: Stop) -> int | None:
        """Run to the last step or to a signal, saving now and then; returns the signal that a process got."""
        settings = self.recipe.training
        saved = time.monotonic()
        with progress() as bar:
            bar.disable = not self.accelerator.is_main_process
            task = add_task(bar, f"stage {self.recipe.stage}", settings.steps * settings.batch, "sample")
            bar.advance(task, self.state.step * settings.batch)
            for values in self.steps():
                bar.update(task, advance=settings.batch, note=f"loss {values['loss']:.4f}")
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


def learning_rate(settings: TrainingSettings, step: int) -> float:
    """The rate of a step: a linear warm-up, then a constant, at the end a linear cool-down to zero."""
    rising = (step + 1) / max(1, settings.warmup)
    falling = (settings.steps - step) / (settings.cooldown + 1)
    return settings.learning_rate * min(1.0, rising, falling)
