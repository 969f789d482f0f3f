"""How clips are sampled: where and how precisely, and which steps, sampler and guidance a command wants."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

from persist_cli.errors import PersistError, hint

if TYPE_CHECKING:
    import torch

Precision = Literal["float32", "bfloat16", "float16"]

Offload = Literal["none", "model", "sequential"]

SAVINGS = ("model-offload", "sequential-offload", "vae-slicing", "vae-tiling")


@dataclass(frozen=True)
class InferenceOptions:
    """How a backbone is placed for sampling.

    Args:
        dtype: of weights and activations; ``None`` leaves the checkpoint's.
        offload: weights rest on the CPU: ``model`` brings a whole part to the accelerator when its turn comes,
            ``sequential`` one layer at a time, for far less memory and far slower.
        slicing: the codec takes one video at a time.
        tiling: the codec takes a large image in overlapping tiles; where they meet, results differ slightly.
    """

    dtype: Precision | None = None
    offload: Offload = "none"
    slicing: bool = False
    tiling: bool = False

    @classmethod
    def of(cls, dtype: str | None, save_memory: str | None) -> Self:
        """What the options ``--dtype`` and ``--save-memory`` ask for.

        Args:
            dtype: a ``Precision`` by name.
            save_memory: some of ``SAVINGS``, separated by commas.

        Raises:
            PersistError: for an unknown word, and for both ways of offloading at once.
        """
        words = [word.strip() for word in (save_memory or "").split(",") if word.strip()]
        known = {"dtype": ([dtype] if dtype else [], get_args(Precision)), "save-memory": (words, SAVINGS)}
        for option, (given, allowed) in known.items():
            for word in given:
                if word not in allowed:
                    raise PersistError(f"unknown --{option} {word!r}; {hint(word, allowed)}")
        if {"model-offload", "sequential-offload"} <= set(words):
            raise PersistError("--save-memory has model-offload and sequential-offload; give one of them")
        ways: dict[str, Offload] = {"model-offload": "model", "sequential-offload": "sequential"}
        offload = next((way for word, way in ways.items() if word in words), "none")
        return cls(dtype, offload, "vae-slicing" in words, "vae-tiling" in words)  # type: ignore[arg-type]

    def changes(self) -> dict[str, Any]:
        """What of it changes results, JSON values; empty for a checkpoint as it is."""
        asked = {"dtype": self.dtype, "tiling": self.tiling}
        return {name: value for name, value in asked.items() if value}

    def device(self) -> torch.device:
        """The accelerator of this process, else the CPU.

        Raises:
            PersistError: when there is no accelerator that weights could be brought to.
        """
        import torch

        if torch.cuda.is_available():
            return torch.device("cuda", torch.cuda.current_device())
        if self.offload != "none":
            raise PersistError(
                f"--save-memory {self.offload}-offload keeps weights on the CPU for an accelerator, and there is none; "
                "leave it out"
            )
        return torch.device("cpu")


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
