"""The abstract backbone: a video model that predicts RGB-D clips, trained in stages."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from persist_cli.api.cameras import Cameras
from persist_cli.api.inference import InferenceOptions
from persist_cli.api.observations import Observations
from persist_cli.api.stages import Lora, MemorySavings, ParameterGroup, Stage
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import PersistError
from persist_cli.io.settings import NoSettings

Interactions = tuple[str | None, ...]  # one for each step between two frames of a clip


@dataclass(frozen=True)
class ClipLatents:
    """What a backbone's codec makes of clips.

    Args:
        video: latents of the whole clips.
        image: latents of their first frames alone.
    """

    video: Float[Tensor, "*batch frame channel height width"]
    image: Float[Tensor, "*batch 1 channel height width"]

    def __getitem__(self, sample: int) -> ClipLatents:
        return ClipLatents(self.video[sample], self.image[sample])

    def to(self, device: torch.device | str) -> ClipLatents:
        """The same latents on ``device``."""
        return ClipLatents(self.video.to(device), self.image.to(device))

    @staticmethod
    def stack(samples: Sequence[ClipLatents]) -> ClipLatents:
        """A batch of the latents of single clips."""
        videos, images = [sample.video for sample in samples], [sample.image for sample in samples]
        return ClipLatents(torch.stack(videos), torch.stack(images))


@dataclass(frozen=True)
class Clip:
    """One RGB-D clip with what conditions it.

    Args:
        observations: its frames with their cameras. To be predicted: the first frame alone, with the cameras of all.
        interactions: what the agent did to the world between the frames.
        seed: everything random about the clip is drawn from this.
        tokens: what a memory says to the cameras, ``None`` without a memory.
        latents: what ``Backbone.encode`` gave of this clip, if it was encoded before; the observations may then have no
            images.
    """

    observations: Observations
    interactions: Interactions
    seed: int
    tokens: MemoryTokens | None = None
    latents: ClipLatents | None = None


@dataclass(frozen=True)
class Clips:
    """A batch of RGB-D clips with what conditions them; see ``Clip``.

    Args:
        rgb: uint8.
        depth: float32 metres, planar z, 0 = missing.
        cameras: in each sample's world.
        interactions: for each sample, what the agent did to the world between the frames.
        tokens: memory tokens of the batch, ``None`` without a memory.
        seeds: one for each sample; everything random about it is drawn from this.
        latents: of the batch, where it was encoded before; rgb and depth may then have no frames.
    """

    rgb: UInt8[Tensor, "batch frame height width 3"]
    depth: Float[Tensor, "batch frame height width"]
    cameras: Cameras
    interactions: Sequence[Interactions]
    tokens: MemoryTokens | None
    seeds: Sequence[int]
    latents: ClipLatents | None = None

    @staticmethod
    def stack(clips: Sequence[Clip]) -> Clips:
        """A batch of clips of one size, of which all or none have tokens, and all or none latents."""
        tokens = [clip.tokens for clip in clips if clip.tokens is not None]
        latents = [clip.latents for clip in clips if clip.latents is not None]
        return Clips(
            rgb=torch.stack([clip.observations.rgb for clip in clips]),
            depth=torch.stack([clip.observations.depth for clip in clips]),
            cameras=Cameras.stack([clip.observations.cameras for clip in clips]),
            interactions=[clip.interactions for clip in clips],
            tokens=MemoryTokens.stack(tokens) if tokens else None,
            seeds=[clip.seed for clip in clips],
            latents=ClipLatents.stack(latents) if latents else None,
        )

    def first_frames(self) -> tuple[UInt8[Tensor, "batch 1 height width 3"], Float[Tensor, "batch 1 height width"]]:
        """RGB and depth of the first frames."""
        return self.rgb[:, :1], self.depth[:, :1]

    def to(self, device: torch.device | str) -> Clips:
        """The same clips on ``device``."""
        return dataclasses.replace(
            self,
            rgb=self.rgb.to(device),
            depth=self.depth.to(device),
            cameras=self.cameras.to(device),
            tokens=None if self.tokens is None else self.tokens.to(device),
            latents=None if self.latents is None else self.latents.to(device),
        )


@dataclass(frozen=True)
class Sampling:
    """How a clip is drawn.

    Args:
        steps: denoising steps.
        sampler: one of the backbone's samplers.
        memory_guidance: weight of classifier-free guidance over memory; 1 means none.
    """

    steps: int = 50
    sampler: str = "ddim"
    memory_guidance: float = 1.0


class Backbone(nn.Module, ABC):
    """A video diffusion model over RGB-D clips; ``forward`` is the training loss of a stage.

    Made on torch's meta device it is a plan: it has the shapes of its configuration and reads no weights.

    Args:
        settings: an instance of ``settings_type``.
    """

    settings_type: ClassVar[type] = NoSettings
    sharded_blocks: ClassVar[tuple[str, ...]] = ()  # classes of blocks that a sharded model puts together one by one
    never_sharded: ClassVar[tuple[str, ...]] = ()  # submodules that work outside of ``forward`` and are never sharded
    name: str = ""  # set by the registry

    def __init__(self, settings: Any) -> None:
        super().__init__()
        self.settings = settings

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return next(self.parameters()).device

    @property
    @abstractmethod
    def frames_per_clip(self) -> int:
        """Frames of a clip, the given first one included."""

    @property
    @abstractmethod
    def image_size(self) -> tuple[int, int]:
        """Height and width in pixels of the images it takes."""

    @property
    @abstractmethod
    def samplers(self) -> tuple[str, ...]:
        """Names that ``Sampling.sampler`` may have."""

    def check_sampling(self, sampling: Sampling) -> None:
        """Raise ``PersistError``, one line, when ``generate`` cannot draw a clip like that."""
        if sampling.sampler not in self.samplers:
            raise PersistError(f"unknown sampler {sampling.sampler!r}; known: {', '.join(self.samplers)}")
        if sampling.steps < 1:
            raise PersistError(f"{sampling.steps} denoising steps; it must be at least 1")
        if not 0 <= sampling.memory_guidance < math.inf:
            raise PersistError(f"guidance over memory of {sampling.memory_guidance}; it must be a number of at least 0")

    @property
    def gives_depth(self) -> bool:
        """Whether clips have depth after their first frame."""
        return True

    def prepare_inference(self, placement: InferenceOptions) -> None:
        """Get ready to sample, on the accelerator where there is one; it may be placed again, also with other adapters.

        Raises:
            PersistError: when memory cannot be saved so.
        """
        device = placement.device()
        if placement.offload != "none" or placement.slicing or placement.tiling:
            raise PersistError(f"backbone {self.name!r} cannot save memory; leave out --save-memory")
        if placement.dtype is not None:
            self.to(getattr(torch, placement.dtype))
        self.to(device).eval()

    def parameter_groups(self) -> list[ParameterGroup]:
        """Every parameter, each in one part, in the order in which people think of them."""
        return [ParameterGroup(self.name, dict(self.named_parameters()))]

    def never_sharded_parameters(self) -> list[nn.Parameter]:
        """Those of the submodules that are never sharded."""
        return [each for name in self.never_sharded for each in self.get_submodule(name).parameters()]

    def truncate_layers(self, groups: int) -> float:
        """Keep so many groups of like layers of what is trained in depth, for estimates; returns how many there were.

        What a step takes must grow linearly with the groups. By default there is one and it stays.
        """
        return float(groups)

    @abstractmethod
    def trained_parameters(self, stage: Stage) -> dict[str, nn.Parameter]:
        """Freeze all that the stage does not train and return the rest by name."""

    def apply_memory_savings(self, stage: Stage, savings: MemorySavings) -> None:
        """Make the steps of a stage cheaper, once ``trained_parameters`` has frozen what it does not train.

        Raises:
            PersistError: when this backbone cannot.
        """
        if savings != MemorySavings():
            raise PersistError(f"backbone {self.name!r} has no cheaper steps; leave out what training.* asks of it")

    @abstractmethod
    def forward(self, clips: Clips, stage: Stage) -> dict[str, Tensor]:
        """Scalars of one training step; ``"loss"`` is minimised, the others are logged."""

    def encodes(self, stage: Stage) -> bool:
        """Whether clips can be encoded before a step of this stage, which then does not train what encodes them."""
        return False

    def encoding(self) -> str:
        """A fingerprint of what ``encode`` depends on besides the clips."""
        raise NotImplementedError(f"backbone {self.name!r} keeps nothing of a clip")

    def encode(self, clips: Clips) -> ClipLatents:
        """What of the clips can be kept between steps; ``forward`` takes it as ``Clips.latents``."""
        raise NotImplementedError(f"backbone {self.name!r} keeps nothing of a clip")

    @property
    def framewise(self) -> bool:
        """Whether ``encode`` gives one latent frame a frame, each of its frame alone.

        The latents of a whole trajectory then serve all clips of it, and those of the first frame stand in the video's.
        """
        return False

    def finish_stage(self, stage: Stage, clips: Iterable[Clips]) -> None:
        """Last act of a stage: measure on some clips what training cannot learn; nothing by default."""

    @abstractmethod
    def generate(self, first: Clips, sampling: Sampling) -> tuple[Tensor, Tensor]:
        """Clips that begin with the given frames.

        Args:
            first: clips whose rgb and depth hold the first frame only, whose cameras hold all frames. One that all
                clips begin with may be given once, as a batch of one, and is then encoded once.
            sampling: steps, sampler and guidance.

        Returns:
            rgb uint8 ``[batch, frame, height, width, 3]`` and depth float32 metres, the first frame as given; where
            the backbone does not give depth, 0 after it.
        """

    @abstractmethod
    def reconstruct(self, clips: Clips) -> tuple[Tensor, Tensor]:
        """RGB and depth after the codec alone: the ceiling of what can be generated; 0 depth where none is given."""

    @abstractmethod
    def add_adapter(self, name: str, channels: int, settings: Mapping[str, Any]) -> None:
        """Add a fresh memory adapter for tokens of ``channels`` channels and use it."""

    @abstractmethod
    def use_adapter(self, name: str | None) -> None:
        """Use one of the adapters, or none: plain stage 1."""

    @property
    @abstractmethod
    def token_budget(self) -> int:
        """How many memory tokens the adapter in use asks for."""

    def checkpoint_settings(self) -> dict[str, Any]:
        """Plain settings to make this backbone again and then ``load_base`` into it."""
        return dataclasses.asdict(self.settings)

    @abstractmethod
    def save_base(self, folder: Path) -> None:
        """Write all but the adapters into an existing folder, safetensors and JSON only."""

    @abstractmethod
    def save_adapter(self, folder: Path) -> None:
        """Write the adapter in use into an existing folder."""

    def origin(self) -> dict[str, Any]:
        """Those of its settings that bring the pretrained weights it began with; none when it began fresh."""
        return {}

    def add_lora(self, lora: Lora) -> None:
        """Let stage 1 train a change of low rank of the weights that are there, and what beside them is new.

        Raises:
            PersistError: when this backbone or this installation cannot.
        """
        raise PersistError(f"backbone {self.name!r} has no LoRA; leave lora out")

    def save_lora(self, folder: Path) -> None:
        """Write what stage 1 trains with LoRA, and nothing of the weights that it changes, into an existing folder."""
        raise NotImplementedError(f"backbone {self.name!r} has no LoRA")

    @abstractmethod
    def load_base(self, folder: Path) -> None:
        """Take the weights that ``save_base`` wrote; under torch's meta device only their shapes.

        In a folder that ``save_lora`` wrote, they are those that it changes, changed.

        Raises:
            CheckpointError: when a file is missing, corrupt or of another shape.
        """

    @abstractmethod
    def load_adapter(self, name: str, folder: Path) -> None:
        """Add the adapter that ``save_adapter`` wrote, and use it."""
