"""How clips are sampled: by the options of a command, else by the card of a checkpoint, else by our defaults."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from persist_cli.errors import CheckpointError

if TYPE_CHECKING:
    from persist_cli.api.backbone import Sampling

VALUE_TYPES: Final = {"steps": (int,), "sampler": (str,), "memory_guidance": (int, float)}  # a bool is no int here


@dataclass(frozen=True)
class SamplingOverrides:
    """The options of a command that say how to sample; ``None`` leaves a choice to the checkpoint.

    Args:
        steps: denoising steps.
        sampler: the name of one of the backbone's samplers.
        memory_guidance: weight of classifier-free guidance over memory; 1 means none.
    """

    steps: int | None = None
    sampler: str | None = None
    memory_guidance: float | None = None

    def requested(self) -> dict[str, Any]:
        """The options that are not left to the checkpoint, by name."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}

    def over(self, default: Sampling | None) -> Sampling:
        """These options on top of a checkpoint's default, which is 50 steps of DDIM without guidance for ``None``."""
        from persist_cli.api.backbone import Sampling

        return dataclasses.replace(default or Sampling(), **self.requested())


def read_sampling(card: dict[str, Any], path: Path) -> Sampling | None:
    """The default sampling of a checkpoint's card, ``None`` when it has none.

    Args:
        card: the values of ``persist.json``.
        path: that file, which error messages name.

    Raises:
        CheckpointError: when the card's sampling cannot be used.
    """
    from persist_cli.api.backbone import Sampling

    value = card.get("sampling")
    if value is None or value == {}:
        return None
    valid = isinstance(value, dict) and all(type(item) in VALUE_TYPES.get(key, ()) for key, item in value.items())
    if not valid or value.get("steps", 1) < 1 or not 0 <= value.get("memory_guidance", 1) < float("inf"):
        raise CheckpointError(
            f"{path}: its sampling is {value}; it holds steps, at least 1, the name of a sampler and memory_guidance, "
            "at least 0"
        )
    return Sampling(**value)
