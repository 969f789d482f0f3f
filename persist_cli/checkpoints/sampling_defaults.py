"""How clips are sampled: what a command was asked for, what a checkpoint's card means."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from persist_cli.errors import CheckpointError

if TYPE_CHECKING:
    from persist_cli.api.backbone import Sampling


KINDS = {"steps": (int,), "sampler": (str,), "memory_guidance": (int, float)}


@dataclass(frozen=True)
class SamplingOverrides:
    """What a command was asked for; ``None`` leaves it to the checkpoint.

    Args:
        steps: denoising steps.
        sampler: one of the backbone's.
        memory_guidance: weight of guidance over memory, 1 for none.
    """

    steps: int | None = None
    sampler: str | None = None
    memory_guidance: float | None = None

    def given(self) -> dict[str, Any]:
        """What is not left to the checkpoint."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}

    def over(self, default: Sampling | None) -> Sampling:
        """What was asked for, the rest from a checkpoint's default, else 50 steps of DDIM without guidance."""
        from persist_cli.api.backbone import Sampling

        return dataclasses.replace(default or Sampling(), **self.given())


def read_sampling(card: dict[str, Any], path: Path) -> Sampling | None:
    """What a card means when nothing is asked for, ``None`` when it says nothing.

    Raises:
        CheckpointError: one line naming the file when it is no sampling.
    """
    from persist_cli.api.backbone import Sampling

    value = card.get("sampling")
    if value is None or value == {}:
        return None
    known = isinstance(value, dict) and all(type(each) in KINDS.get(key, ()) for key, each in value.items())
    if not known or value.get("steps", 1) < 1 or not 0 <= value.get("memory_guidance", 1) < float("inf"):
        raise CheckpointError(
            f"{path}: its sampling is {value}; it holds steps, at least 1, the name of a sampler and memory_guidance, "
            "at least 0"
        )
    return Sampling(**value)
