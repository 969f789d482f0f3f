"""The training loop, which is one for all that is trained: batch, loss, backward, clip, step, average, log."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import torch
from accelerate import Accelerator
from torch import nn
from torch.utils.data import Dataset

from persist_cli.api.promises import check_losses, check_parameters
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.lineage import Lineage
from persist_cli.data.clips import DistributedBatches
from persist_cli.errors import PersistError
from persist_cli.output.console import add_task, progress
from persist_cli.recipe import Recipe
from persist_cli.train.distributed import Sharding, ZeroState, is_sharded, unflattened, uses_zero
from persist_cli.train.log import StepLog, StepTimes
from persist_cli.train.optimizer import Opponent, make_average, make_optimizer, set_learning_rate, update_average
from persist_cli.train.reading import explain_lost_readers, read_batches
from persist_cli.train.state import TrainingState
from persist_cli.train.stopping import StopSignal
from persist_cli.training_settings import TrainingSettings

Model = TypeVar("Model", bound=nn.Module)


class TrainingLoop(ABC, Generic[Model]):
    """Trains a model; subclasses say what its samples are.

    They set ``scenes`` and ``dataset``, and call ``prepare`` at the end of their ``__init__``.

    Args:
        recipe: the run's recipe.
        accelerator: accelerate for this process, which may be one of many.
    """

    scenes: TrainingScenes  # that are trained on
    dataset: Dataset[Any]
    state: TrainingState

    def __init__(self, recipe: Recipe, accelerator: Accelerator) -> None:
        self.recipe, self.accelerator = recipe, accelerator
        self.times = StepTimes(accelerator.device, recipe.training.batch, enabled=False)
        self.sharding: Sharding | None = None

    def prepare(self, model: Model, parameters: dict[str, nn.Parameter], opponent: Opponent | None = None) -> None:
        """Make optimizer, average and state, and let accelerate prepare the model.

        Args:
            model: its ``forward`` takes a batch of ``to_batch`` and the stage, and returns the losses.
            parameters: those that are trained, by name.
            opponent: what the model is trained against, if anything; its parameters are among the others.
        """
        check_parameters(parameters, type(model).__name__)
        self.whole, settings = model, self.recipe.training
        optimizer = make_optimizer(parameters.values(), settings, opponent)
        self.sharding = self.make_sharding()
        self.model, self.optimizer = self.accelerator.prepare(model, optimizer)
        if self.sharding is not None:
            parameters = self.sharding.parameters()
        average = make_average(parameters.values(), settings) if settings.ema else None
        moments: Any = optimizer.state
        self.zero = uses_zero(self.accelerator)
        if self.zero:
            moments = ZeroState(self.optimizer.optimizer, [*parameters.values()])
        self.state = TrainingState(parameters, moments, average)

    @abstractmethod
    def make_sharding(self) -> Sharding | None:
        """What prepares the model for FSDP2, ``None`` where nothing is sharded.

        Raises:
            PersistError: where it is to be sharded and cannot.
        """

    @abstractmethod
    def to_batch(self, samples: list[Any]) -> Any:
        """Make a batch of samples of ``dataset`` on the device."""

    @abstractmethod
    def write_model(self, model: Model, folder: Path, home: Path, lineage: Lineage) -> None:
        """Write the trained model into a folder, in the main process alone.

        Args:
            model: the model that ``model_to_save`` yields.
            folder: the folder, which is empty and becomes ``home`` when all is written.
            home: where it will be.
            lineage: where it comes from, which is written beside its weights.
        """

    def figures(self) -> dict[str, Any]:
        """Figures for ``speed.jsonl`` beside the speed."""
        return {}

    def encoded(self, batch: Any) -> Any:
        """The batch as the model takes it in this step, which may be shorter than it was read."""
        return batch

    def loader(self) -> Generator[Any, None, None]:
        """Batches of this process from the state's step to the last.

        Raises:
            PersistError: when a sample cannot be read, whichever process reads it.
        """
        settings = self.recipe.training
        batches = DistributedBatches(
            self.state.step, settings.steps, settings.batch, settings.accumulation,
            self.accelerator.process_index, self.accelerator.num_processes,
        )  # fmt: skip
        with closing(read_batches(self.dataset, batches, settings.workers)) as remaining:
            while True:
                with self.times.part("data"):
                    samples = next(remaining, None)
                    if samples is None:
                        return
                yield self.to_batch(samples)

    def first_batches(self, count: int) -> Iterator[Any]:
        """So many batches of the first samples, of which something is measured before or after training."""
        size = self.recipe.training.batch
        for number in range(count):
            yield self.to_batch([self.dataset[number * size + row] for row in range(size)])

    def steps(self) -> Iterator[dict[str, float]]:
        """Train to the last step; yields the logged values of each optimizer step."""
        with explain_lost_readers(), closing(self.loader()) as batches:
            while self.state.step < self.recipe.training.steps:
                with self.times.step():
                    values = self.step(batches)
                self.state.step += 1
                yield values

    def step(self, batches: Iterator[Any]) -> dict[str, float]:
        """Take an optimizer step; returns its losses, which are means over micro-batches and processes.

        Raises:
            PersistError: when the loss or a gradient is not finite; the parameters are then unchanged, unless they are
                DeepSpeed's, which takes its step within the backward pass.
        """
        settings, accelerator, times = self.recipe.training, self.accelerator, self.times
        set_learning_rate(self.optimizer, learning_rate(settings, self.state.step))
        totals: dict[str, torch.Tensor] = {}
        for number in range(1, settings.accumulation + 1):
            batch = self.encoded(next(batches))
            with self.synchronized(last=number == settings.accumulation):
                with times.part("forward"), accelerator.autocast():  # accelerate leaves it out when it shards
                    losses = self.model(batch, self.recipe.stage)
                    check_losses(losses, type(self.whole).__name__)
                with times.part("backward"):  # DeepSpeed divides the loss itself
                    accelerator.backward(losses["loss"] / (1 if self.zero else settings.accumulation))
            for name, loss in losses.items():
                totals[name] = totals.get(name, 0) + loss.detach() / settings.accumulation
            del batch, losses  # nothing of a batch stays on the device while the optimizer works
        means = {name: float(accelerator.reduce(total, "mean")) for name, total in totals.items()}
        self.check_finite("loss", means["loss"])
        with times.part("optimizer"):
            norm: Any = accelerator.clip_grad_norm_(self.state.parameters.values(), settings.clip)
            if norm is not None:  # DeepSpeed may have none
                self.check_finite("norm of the gradients", float(norm.full_tensor() if is_sharded(norm) else norm))
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            if self.state.average is not None:
                update_average(self.state.average, self.state.parameters.values())
        return means

    def check_finite(self, name: str, value: float) -> None:
        """Raise ``PersistError`` when a value of the step is NaN or infinite."""
        if not math.isfinite(value):
            raise PersistError(
                f"the {name} is {value} at step {self.state.step}; lower training.learning_rate or train with "
                "training.precision=no"
            )

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
    def model_to_save(self) -> Iterator[Model]:
        """Within the block the main process has the whole model, with averaged weights where these are kept.

        All processes must enter.
        """
        main = self.accelerator.is_main_process
        if self.sharding is not None:
            with self.sharding.gathered(self.state.averages(), main) as gathered:
                yield cast("Model", gathered)
        elif not main:
            yield self.whole
        else:
            parameters = self.state.parameters.values()
            with unflattened(parameters) if self.zero else nullcontext(), self.state.averaged():
                yield self.whole

    def agreed(self, due: bool, signal: int | None) -> tuple[bool, int | None]:
        """Whether a checkpoint is due for any process, and the signal that any got: they save and stop together."""
        if self.accelerator.num_processes == 1:
            return due, signal
        flags = torch.tensor([[int(due), signal or 0]], device=self.accelerator.device)
        any_due, any_signal = self.accelerator.gather(flags).amax(0).tolist()
        return bool(any_due), any_signal or None

    def train(self, log: StepLog | None, save: Callable[[], None], stop: StopSignal) -> int | None:
        """Train to the last step or to a signal.

        Args:
            log: gets the values of each step; ``None`` on a process that logs nothing.
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
                if log is not None:
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
    """The learning rate of a step: it rises linearly, stays or follows a cosine, and falls linearly in the end."""
    rising = (step + 1) / max(1, settings.warmup)
    falling = (settings.steps - step) / (settings.cooldown + 1)
    after = (step - settings.warmup) / max(1, settings.steps - settings.warmup)
    cosine = (1 + math.cos(math.pi * min(1.0, max(0.0, after)))) / 2 if settings.schedule == "cosine" else 1.0
    return settings.learning_rate * min(1.0, rising, falling, cosine)
