"""What makes a training need less memory: each change by itself, and the smallest that makes it fit."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from persist_cli.doctor.machine import Machine
from persist_cli.recipe import Recipe
from persist_cli.viewing.console import watched


@dataclass(frozen=True)
class Change:
    """A change of settings or of the launch.

    Args:
        name: what tables call it.
        settings: as KEY=VALUE.
        cost: how much one would rather not; rounding and time count less than another optimizer, and that less than
            training something else.
        flags: of ``accelerate launch`` beside the number of processes.
        whole: whether it needs a model that is not sharded.
    """

    name: str
    settings: tuple[str, ...]
    cost: int
    flags: tuple[str, ...] = ()
    whole: bool = False


@dataclass(frozen=True)
class Strategy:
    """Some changes made together; none is the recipe as it is."""

    changes: tuple[Change, ...] = ()

    @property
    def name(self) -> str:
        """The changes' names."""
        return " + ".join(change.name for change in self.changes) or "as it is"

    @property
    def settings(self) -> list[str]:
        """All KEY=VALUE."""
        return [setting for change in self.changes for setting in change.settings]

    @property
    def sharded(self) -> bool:
        """Whether one of them is a launch with FSDP2."""
        return any(change.flags for change in self.changes)

    @property
    def flags(self) -> list[str]:
        """All flags of the launch, each once."""
        return list(dict.fromkeys(flag for change in self.changes for flag in change.flags))

    @property
    def cost(self) -> int:
        """Of all of them."""
        return sum(change.cost for change in self.changes)

    @property
    def possible(self) -> bool:
        """Whether the changes work together."""
        return not (self.sharded and any(change.whole for change in self.changes))


SHARDED = "--use_fsdp --fsdp_version 2"  # flags of a launch with FSDP2
OFFLOADED = "--fsdp_offload_params true"
SLICING = Change("VAE slicing", ("training.vae_slicing=true",), 1)
FROZEN = Change("frozen in bf16", ("training.frozen_precision=bf16",), 1)
FROZEN_WHOLE = dataclasses.replace(FROZEN, whole=True)  # what FSDP2 refuses outside of stage 2
AVERAGE = Change("EMA on the CPU", ("training.ema_device=cpu",), 2)
CHECKPOINTING = Change("gradient checkpointing", ("training.gradient_checkpointing=true",), 3)
EIGHT_BIT = Change("8-bit optimizer", ("training.optimizer=adamw-8bit",), 4, whole=True)
OFFLOAD = Change("CPU offload", (), 8, (SHARDED, OFFLOADED))
LORA = Change("LoRA", ("lora.rank=64",), 16)
STAGE2 = Strategy((Change("stage 2 only", (), 0),))  # another recipe, of the weights that come after these


def changes_of(recipe: Recipe, machine: Machine, sharded: bool) -> list[Change]:
    """The changes that can make this recipe need less on this machine and are not in force yet."""
    training, cuda = recipe.training, machine.kind == "cuda"
    deep, averaged = recipe.stage != "codec", training.ema and training.ema_device != "cpu"
    frozen, half = FROZEN if recipe.stage == "2" else FROZEN_WHOLE, training.frozen_precision == "bf16"
    can_shard = deep and training.optimizer == "adamw" and not (half and frozen.whole)
    found: list[tuple[bool, Change]] = [
        (not training.vae_slicing, SLICING),
        (training.precision == "bf16" and not half and not (sharded and frozen.whole), frozen),
        (bool(averaged) and cuda, AVERAGE),
        (training.samples_at_once(machine.devices) > 1, _one_by_one(recipe, machine)),
        (machine.devices > 1 and not sharded and can_shard, Change(f"FSDP over {machine.devices}", (), 2, (SHARDED,))),
        (not training.gradient_checkpointing and deep, CHECKPOINTING),
        (training.optimizer == "adamw" and cuda and not sharded, EIGHT_BIT),
        (cuda and can_shard, OFFLOAD),
        (recipe.stage == "1" and recipe.lora is None, LORA),
    ]
    return [change for able, change in found if able]


def _one_by_one(recipe: Recipe, machine: Machine) -> Change:
    parts = max(1, recipe.training.batch // machine.devices)
    return Change("samples one by one", (f"training.accumulation={parts}",), 2)


def strategies(changes: Sequence[Change]) -> Iterator[Strategy]:
    """All that can be done together, the smallest first."""
    sets = (each for count in range(len(changes) + 1) for each in itertools.combinations(changes, count))
    yield from sorted(filter(lambda each: each.possible, map(Strategy, sets)), key=lambda each: each.cost)


def smallest(changes: Sequence[Change], fits: Callable[[Strategy], bool]) -> Strategy | None:
    """The smallest strategy that fits, ``None`` when none does."""
    return next(filter(fits, watched([*strategies(changes)], "together", "strategy")), None)
