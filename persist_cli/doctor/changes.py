"""Changes that make a training need less memory: the single ones, and the smallest combination that makes it fit."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from persist_cli.doctor.machine import Machine
from persist_cli.output.console import watched
from persist_cli.recipe import Recipe, network_of, of_the_whole_model


@dataclass(frozen=True)
class Change:
    """A change of settings or of the launch.

    Args:
        name: its name in tables.
        settings: the settings that it changes, as KEY=VALUE.
        cost: how little one wants it. Rounding and a slower step cost less than another optimizer, and that less than
            training something else.
        flags: the flags of ``accelerate launch`` that it adds.
        unsharded_only: whether it works only without FSDP2.
    """

    name: str
    settings: tuple[str, ...]
    cost: int
    flags: tuple[str, ...] = ()
    unsharded_only: bool = False


@dataclass(frozen=True)
class Strategy:
    """Changes that are made together; without any it is the recipe as it is."""

    changes: tuple[Change, ...] = ()

    @property
    def name(self) -> str:
        """The names of the changes."""
        return " + ".join(change.name for change in self.changes) or "as it is"

    @property
    def settings(self) -> list[str]:
        """All changed settings, as KEY=VALUE."""
        return [setting for change in self.changes for setting in change.settings]

    @property
    def sharded(self) -> bool:
        """Whether one of the changes is a launch with FSDP2."""
        return any(change.flags for change in self.changes)

    @property
    def flags(self) -> list[str]:
        """All flags of the launch, each once."""
        return list(dict.fromkeys(flag for change in self.changes for flag in change.flags))

    @property
    def cost(self) -> int:
        """The cost of all changes."""
        return sum(change.cost for change in self.changes)

    @property
    def possible(self) -> bool:
        """Whether the changes work together."""
        return not (self.sharded and any(change.unsharded_only for change in self.changes))


SHARDED: Final = "--use_fsdp --fsdp_version 2"  # flags of a launch with FSDP2
OFFLOADED: Final = "--fsdp_offload_params true"

SLICING: Final = Change("VAE slicing", ("training.vae_slicing=true",), 1)
FROZEN: Final = Change("frozen in bf16", ("training.frozen_precision=bf16",), 1)
FROZEN_UNSHARDED: Final = dataclasses.replace(FROZEN, unsharded_only=True)  # in stages where FSDP2 refuses it
AVERAGE: Final = Change("EMA on the CPU", ("training.ema_device=cpu",), 2)
CHECKPOINTING: Final = Change("gradient checkpointing", ("training.gradient_checkpointing=true",), 3)
EIGHT_BIT: Final = Change("8-bit optimizer", ("training.optimizer=adamw-8bit",), 4, unsharded_only=True)
BITSANDBYTES: Final = "bitsandbytes"  # the package of the 8-bit optimizer, and the extra that installs it
OFFLOAD: Final = Change("CPU offload", (), 8, (SHARDED, OFFLOADED))
LORA: Final = Change("LoRA", ("lora.rank=64",), 16)

SAVINGS: Final = (SLICING, FROZEN, FROZEN_UNSHARDED, CHECKPOINTING)  # which a backbone may not support

STAGE2: Final = Strategy((Change("stage 2 only", (), 0),))  # no change but another recipe, that of the next stage


def available_changes(recipe: Recipe, machine: Machine, sharded: bool) -> list[Change]:
    """The changes that can make this recipe need less on this machine and are not in force yet."""
    training, cuda = recipe.training, machine.kind == "cuda"
    of_a_backbone = network_of(recipe) is None
    transformer, averaged = of_a_backbone and recipe.stage != "codec", training.ema and training.ema_device != "cpu"
    mixed = of_a_backbone and training.precision == "bf16"
    frozen, half = FROZEN if recipe.stage == "2" else FROZEN_UNSHARDED, training.frozen_precision == "bf16"
    distilled = recipe.distill is not None  # by averages that stay on the device, and without LoRA
    can_shard = transformer and training.optimizer == "adamw" and not (half and frozen.unsharded_only)
    can_shard = can_shard and not of_the_whole_model(recipe)
    fsdp = Change(f"FSDP over {machine.devices}", (), 2, (SHARDED,))
    changes: list[tuple[bool, Change]] = [
        (of_a_backbone and not training.vae_slicing, SLICING),
        (mixed and not half and not (sharded and frozen.unsharded_only), frozen),
        (bool(averaged) and cuda and not distilled, AVERAGE),
        (training.samples_at_once(machine.devices) > 1, _single_samples(recipe, machine)),
        (machine.devices > 1 and not sharded and can_shard, fsdp),
        (not training.gradient_checkpointing and transformer, CHECKPOINTING),
        (training.optimizer == "adamw" and cuda and not sharded, EIGHT_BIT),
        (cuda and can_shard, OFFLOAD),
        (recipe.stage == "1" and recipe.lora is None and not distilled and training.optimizer != "muon", LORA),
    ]
    return [change for available, change in changes if available]


def _single_samples(recipe: Recipe, machine: Machine) -> Change:
    micro_batches = max(1, recipe.training.batch // machine.devices)
    return Change("samples one by one", (f"training.accumulation={micro_batches}",), 2)


def strategies(changes: Sequence[Change]) -> Iterator[Strategy]:
    """All combinations of changes that work together, those of the lowest cost first."""
    counts = range(len(changes) + 1)
    combined = [Strategy(combination) for count in counts for combination in itertools.combinations(changes, count)]
    yield from sorted((strategy for strategy in combined if strategy.possible), key=lambda strategy: strategy.cost)


def smallest_fitting(changes: Sequence[Change], fits: Callable[[Strategy], bool]) -> Strategy | None:
    """The strategy of the lowest cost that fits, ``None`` when none does."""
    return next(filter(fits, watched([*strategies(changes)], "together", "strategies")), None)
