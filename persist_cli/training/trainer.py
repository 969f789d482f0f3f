"""The training loop: batch, loss, backward, clip, step, average, log."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from accelerate import Accelerator
from diffusers.training_utils import EMAModel
from torch.utils.data import DataLoader, Dataset

from persist_cli.memorizing.recall import MemoryMaker, collate
from persist_cli.recipe import Recipe
from persist_cli.training.cache import Cache
from persist_cli.training.keeping import Dependencies, Keeper, KeptClips
from persist_cli.training.log import StepLog
from persist_cli.training.state import TrainingState
from persist_cli.trajectories.clips import ClipDataset, ClipPlan, ClipSample, SharedBatches
from persist_cli.viewing.console import add_task, progress
from persist_cli.world.backbone import Backbone, Clips
from persist_cli.world.errors import PersistError


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
    """

    def __init__(
        self,
        recipe: Recipe,
        backbone: Backbone,
        maker: MemoryMaker | None,
        accelerator: Accelerator,
        cache: Cache | None = None,
    ) -> None:
        self.recipe, self.backbone, self.accelerator = recipe, backbone, accelerator
        self.maker = maker
        self.clips = self.clip_source(cache)
        parameters = backbone.trained_parameters(recipe.stage)
        settings = recipe.training
        optimizer = torch.optim.AdamW(
            parameters.values(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        average = EMAModel(parameters.values(), decay=settings.ema, use_ema_warmup=True) if settings.ema else None
        self.model, self.optimizer = accelerator.prepare(backbone, optimizer)
        if average is not None:
            average.to(accelerator.device)
        self.state = TrainingState(parameters, optimizer, average)
        self.keeper = Keeper.of(recipe, backbone, maker, accelerator, cache)

    def clip_source(self, cache: Cache | None) -> Dataset[ClipSample]:
        """The recipe's clips, with what a cache has of them."""
        recipe, backbone = self.recipe, self.backbone
        plan = ClipPlan(
            frames=backbone.frames_per_clip,
            strides=recipe.data.strides,
            context_frames=recipe.data.context_frames if self.maker else 0,
            seed=recipe.training.seed,
            image_size=backbone.image_size,
            clips_per_trajectory=recipe.data.clips_per_trajectory,
        )
        clips = ClipDataset(Path(recipe.data.path), plan)
        if cache is None:
            return clips
        given = Dependencies.of(recipe, backbone, self.maker, self.accelerator.device)
        return KeptClips(clips, cache, given, whole=backbone.frames_alone)

    def loader(self) -> Iterator[Clips]:
        """Batches of this process from the state's step to the last."""
        settings = self.recipe.training
        batches = SharedBatches(
            self.state.step, settings.steps, settings.batch, settings.accumulation,
            self.accelerator.process_index, self.accelerator.num_processes,
        )  # fmt: skip
        loader: DataLoader[ClipSample] = DataLoader(
            self.clips,
            batch_sampler=batches,
            num_workers=settings.workers,
            collate_fn=list,
            generator=torch.Generator(),  # of its own: the loader must not draw from the run's random state
        )
        for samples in loader:
            yield self.to_batch(samples)

    def to_batch(self, samples: list[ClipSample]) -> Clips:
        """Samples as a batch with memory tokens, on the training device."""
        device = self.accelerator.device
        if self.keeper is not None:
            samples = [self.keeper.complete(sample) for sample in samples]
        clips = collate(samples, self.maker, self.backbone.token_budget)
        return Clips(
            rgb=clips.rgb.to(device),
            depth=clips.depth.to(device),
            cameras=clips.cameras,
            interactions=clips.interactions,
            tokens=clips.tokens,
            seeds=clips.seeds,
            latents=None if clips.latents is None else clips.latents.to(device),
        )

    def learning_rate(self, step: int) -> float:
        """The recipe's rate after a linear warm-up, until a linear cool-down to zero."""
        settings = self.recipe.training
        rising = (step + 1) / max(1, settings.warmup)
        falling = (settings.steps - step) / (settings.cooldown + 1)
        return settings.learning_rate * min(1.0, rising, falling)

    def steps(self) -> Iterator[dict[str, float]]:
        """Train; after each optimizer step its logged values."""
        settings = self.recipe.training
        batches = self.loader()
        while self.state.step < settings.steps:
            for group in self.optimizer.param_groups:
                group["lr"] = self.learning_rate(self.state.step)
            values = self.accumulate(batches)
            self.accelerator.clip_grad_norm_(self.state.parameters.values(), settings.clip)
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            if self.state.average is not None:
                self.state.average.step(self.state.parameters.values())
            self.state.step += 1
            yield values

    def accumulate(self, batches: Iterator[Clips]) -> dict[str, float]:
        """Gradients of one optimizer step; the mean of its logged values over micro-batches and processes."""
        parts = self.recipe.training.accumulation
        totals: dict[str, torch.Tensor] = {}
        for _ in range(parts):
            losses = self.model(next(batches), self.recipe.stage)
            self.accelerator.backward(losses["loss"] / parts)
            for name, value in losses.items():
                totals[name] = totals.get(name, torch.zeros_like(value)) + value.detach() / parts
        values = {name: float(self.accelerator.reduce(value, "mean")) for name, value in totals.items()}
        if not math.isfinite(values["loss"]):
            raise PersistError(
                f"the loss is {values['loss']} at step {self.state.step}; lower training.learning_rate or train with "
                "training.precision=no"
            )
        return values

    def train(self, log: StepLog, save: Any, stop: Stop) -> None:
        """Run to the last step, to a signal, saving now and then."""
        settings = self.recipe.training
        saved = time.monotonic()
        with progress() as bar:
            bar.disable = not self.accelerator.is_main_process
            task = add_task(bar, f"stage {self.recipe.stage}", settings.steps * settings.batch, "sample")
            bar.advance(task, self.state.step * settings.batch)
            for values in self.steps():
                bar.update(task, advance=settings.batch, note=f"loss {values['loss']:.4f}")
                if self.accelerator.is_main_process:
                    log.add(self.state.step, values | {"learning_rate": self.learning_rate(self.state.step - 1)})
                self.accelerator.log(values, step=self.state.step)
                due = time.monotonic() - saved > 60 * settings.checkpoint_minutes
                if stop.signal is not None or due or self.state.step % settings.checkpoint_every == 0:
                    save()
                    saved = time.monotonic()
                if stop.signal is not None:
                    return
