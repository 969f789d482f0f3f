"""Options of sampling: device and precision on one side; steps, sampler and guidance on the other."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

from persist_cli.errors import PersistError, hint

if TYPE_CHECKING:
    import torch

Precision = Literal["float32", "bfloat16", "float16"]
Offload = Literal["none", "model", "sequential"]
SAVINGS = ("model-offload", "sequential-offload", "vae-slicing", "vae-tiling")


@dataclass(frozen=True, kw_only=True)
class InferenceOptions:
    """Precision and memory savings of a backbone that samples.

    Args:
        dtype: precision of weights and activations; ``None`` keeps the checkpoint's.
        offload: ``model`` keeps weights on the CPU and moves one part, such as the codec, to the accelerator when it
            is needed; ``sequential`` moves one layer at a time, with far less memory and far slower.
        slicing: whether the codec takes one video at a time.
        tiling: whether the codec takes large images in overlapping tiles, whose seams change results slightly.
    """

    dtype: Precision | None = None
    offload: Offload = "none"
    slicing: bool = False
    tiling: bool = False

    @classmethod
    def of(cls, dtype: str | None, save_memory: str | None) -> Self:
        """Return what the texts of ``--dtype`` and ``--save-memory`` mean.

        Args:
            dtype: name of a ``Precision``.
            save_memory: names of ``SAVINGS``, separated by commas.

        Raises:
            PersistError: for an unknown name, and for both kinds of offloading at once.
        """
        words = [word.strip() for word in (save_memory or "").split(",") if word.strip()]
        known = {"dtype": ([dtype] if dtype else [], get_args(Precision)), "save-memory": (words, SAVINGS)}
        for option, (names, allowed) in known.items():
            for word in names:
                if word not in allowed:
                    raise PersistError(f"unknown --{option} {word!r}; {hint(word, allowed)}")
        if {"model-offload", "sequential-offload"} <= set(words):
            raise PersistError("--save-memory has model-offload and sequential-offload; give one of them")
        offloads: dict[str, Offload] = {"model-offload": "model", "sequential-offload": "sequential"}
        offload = next((offload for word, offload in offloads.items() if word in words), "none")
        return cls(dtype=dtype, offload=offload, slicing="vae-slicing" in words, tiling="vae-tiling" in words)  # type: ignore[arg-type]

    def changes(self) -> dict[str, Any]:
        """Return the options that change results as JSON values; empty for a checkpoint as it is."""
        options = {"dtype": self.dtype, "tiling": self.tiling}
        return {name: value for name, value in options.items() if value}

    def device(self) -> torch.device:
        """Return the accelerator of this process, or the CPU when there is none.

        Raises:
            PersistError: when there is no accelerator, but ``offload`` needs one.
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


CONSISTENCY = "consistency"  # the sampler of distilled models
PROTOCOLS = ("revisit", "later", "return", "long", "unseen")  # of evaluation; a card may have a sampling for each


@dataclass(frozen=True)
class Sampling:
    """Settings by which clips are sampled.

    Args:
        steps: number of denoising steps, at least 1.
        sampler: name of one of the backbone's samplers.
        memory_guidance: weight of classifier-free guidance over memory, at least 0; 1 means none.
        context_noise: noise level that given frame and memory are declared to have, at least 0; each at most that of
            its training. Nothing is added.
        autoguidance: weight of guidance away from the checkpoint's guide, a weaker version of the video model, at the
            noisier half of the noise levels, at least 1; 1 means none (https://arxiv.org/abs/2406.02507).
    """

    steps: int = 50
    sampler: str = "ddim"
    memory_guidance: float = 1.0
    context_noise: float = 0.0
    autoguidance: float = 1.0

    @property
    def words(self) -> str:
        """These settings in a few words, as in ``4 steps of unipc with guidance 1.5``."""
        words = f"{self.steps} step{'s' * (self.steps != 1)} of {self.sampler} with guidance {self.memory_guidance:g}"
        noise = f" and context noise {self.context_noise:g}" * (self.context_noise > 0)
        return words + noise + f" and autoguidance {self.autoguidance:g}" * (self.autoguidance != 1)

    def check(self) -> None:
        """Raise ``PersistError`` with one line for a number that is not in its range."""
        if self.steps < 1:
            raise PersistError(f"{self.steps} denoising steps; it must be at least 1")
        weights = {
            "guidance over memory": (self.memory_guidance, 0),
            "context noise": (self.context_noise, 0),
            "autoguidance": (self.autoguidance, 1),
        }
        for name, (weight, least) in weights.items():
            if not least <= weight < math.inf:
                raise PersistError(f"{name} of {weight}; it must be a number of at least {least}")


@dataclass(frozen=True)
class SamplingOverrides:
    """The options of a command that say how to sample; ``None`` keeps the checkpoint's.

    Args:
        steps: number of denoising steps, at least 1.
        sampler: name of one of the backbone's samplers.
        memory_guidance: weight of classifier-free guidance over memory, at least 0; 1 means none.
        context_noise: noise level that given frame and memory are declared to have, at least 0.
        autoguidance: weight of guidance away from the checkpoint's guide, at least 1; 1 means none.
    """

    steps: int | None = None
    sampler: str | None = None
    memory_guidance: float | None = None
    context_noise: float | None = None
    autoguidance: float | None = None

    def requested(self) -> dict[str, Any]:
        """Return the options that are not ``None`` by name."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}

    @classmethod
    def by_protocol(cls, texts: Iterable[str]) -> dict[str, Self]:
        """Return what texts such as ``return:steps=20,sampler=ddim,guidance=1`` mean, by protocol.

        Raises:
            PersistError: for an unknown protocol or setting, and for a value that is no number where one is wanted.
        """
        named = cls._by_name(texts, "--sampling-for")
        for protocol in named:
            if protocol not in PROTOCOLS:
                raise PersistError(f"--sampling-for: unknown protocol {protocol!r}; {hint(protocol, PROTOCOLS)}")
        return named

    @classmethod
    def by_memory(cls, texts: Iterable[str]) -> dict[str, Self]:
        """Return what texts such as ``voxel:steps=4,guidance=1.5`` mean, by memory.

        Raises:
            PersistError: for an unknown setting, and for a value that is no number where one is wanted.
        """
        return cls._by_name(texts, "--sampling-of")

    @classmethod
    def _by_name(cls, texts: Iterable[str], option: str) -> dict[str, Self]:
        """Return what texts mean by the name before the colon, which may stand in one of them alone."""
        named: dict[str, Self] = {}
        for name, settings in (cls._named(text, option) for text in texts):
            if name in named:
                raise PersistError(f"{option}: {name} is named twice; put its settings into one, with commas")
            named[name] = settings
        return named

    @classmethod
    def _named(cls, text: str, option: str) -> tuple[str, Self]:
        """Return the name before the colon, and the settings behind it."""
        name, _, settings = text.partition(":")
        kinds: dict[str, tuple[str, Any]] = {
            "steps": ("steps", int), "sampler": ("sampler", str), "guidance": ("memory_guidance", float),
            "context-noise": ("context_noise", float), "autoguidance": ("autoguidance", float),
        }  # fmt: skip
        values: dict[str, Any] = {}
        for setting in settings.split(","):
            key, _, value = setting.partition("=")
            if key not in kinds:
                raise PersistError(f"{option} {text}: unknown setting {key!r}; {hint(key, kinds)}")
            field, kind = kinds[key]
            try:
                values[field] = kind(value)
            except ValueError as error:
                raise PersistError(f"{option} {text}: {key} is {value!r}, which is no number") from error
        return name, cls(**values)
