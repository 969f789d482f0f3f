"""The abstract backbone: a video model that predicts RGB-D clips and is trained in stages."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from persist_cli.api.cameras import Cameras
from persist_cli.api.clips import Clip as Clip  # what a backbone takes, for its plugins to import from here
from persist_cli.api.clips import ClipLatents as ClipLatents
from persist_cli.api.clips import Clips as Clips
from persist_cli.api.clips import Interactions as Interactions
from persist_cli.api.inference import InferenceOptions
from persist_cli.api.inference import Sampling as Sampling
from persist_cli.api.stages import Adversarial, Distill, Lora, MemorySavings, ParameterGroup, Stage
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.setting_docs import Setting
from persist_cli.io.settings import NoSettings


class Backbone(nn.Module, ABC):
    """A video diffusion model over RGB-D clips; ``forward`` is the training loss of a stage.

    On torch's meta device it has the shapes of its configuration but reads no weights; estimates use that.

    Args:
        settings: an instance of ``settings_type``, a dataclass of the recipe's settings.
    """

    settings_type: ClassVar[type] = NoSettings
    sharded_blocks: ClassVar[tuple[str, ...]] = ()  # class names of blocks that a sharded model gathers one by one
    never_sharded: ClassVar[tuple[str, ...]] = ()  # submodules that work outside of ``forward`` and are never sharded
    built_by: ClassVar[tuple[str, ...]] = ()  # settings that say how it is built, which a base has its own of
    of_weights: ClassVar[tuple[str, ...]] = ()  # settings of a checkpoint's video model that a fresh one has not
    video_model: ClassVar[tuple[str, ...]] = ()  # files and folders of ``save_base`` that an export keeps of a guide
    for_training: ClassVar[tuple[str, ...]] = ()  # settings of losses, in which a guide may differ from its model
    name: str = ""  # set by the registry

    def __init__(self, settings: Any) -> None:
        super().__init__()
        self.settings = settings
        self.own_sampling: Sampling | None = None  # that its checkpoint asks for, ``None`` for that of all models
        self.guide_folder: Path | None = None  # with the guide's ``video_model``, where its checkpoint has one
        self.on_denoised: Callable[[], None] | None = None  # called in `generate` after a denoising step, for progress

    @property
    def device(self) -> torch.device:
        """The device of its parameters, on which it computes."""
        return next(self.parameters()).device

    @property
    @abstractmethod
    def frames_per_clip(self) -> int:
        """The number of frames of a clip in training, the first one included, which is an input.

        ``generate`` may make shorter clips; see ``check_clip_frames``.
        """

    @property
    @abstractmethod
    def image_size(self) -> tuple[int, int]:
        """Height and width in pixels of the images that it takes and generates."""

    @property
    @abstractmethod
    def samplers(self) -> tuple[str, ...]:
        """The names that ``Sampling.sampler`` may have."""

    def check_sampling(self, sampling: Sampling) -> None:
        """Raise ``PersistError`` with one line when ``generate`` cannot sample with these settings."""
        if sampling.sampler not in self.samplers:
            raise PersistError(f"unknown sampler {sampling.sampler!r}; known: {', '.join(self.samplers)}")
        sampling.check()
        if sampling.autoguidance != 1 and self.guide_folder is None:
            raise PersistError(
                f"autoguidance of {sampling.autoguidance:g}: this checkpoint has no guide; persist export --guide "
                "puts a weaker version of the model beside it"
            )

    def known_noise(self, adapter: Path | None = None) -> float:
        """Return the highest noise level that the model was trained to be told; infinite if it was not counted.

        Args:
            adapter: folder of ``save_adapter``: that of this adapter, not of the model without one.
        """
        return math.inf

    def check_clip_frames(self, frames: int) -> None:
        """Raise ``PersistError`` with one line when ``generate`` cannot make clips of so many frames.

        A clip has as many frames as cameras, the given one included. By default it must have ``frames_per_clip``.
        """
        if frames != self.frames_per_clip:
            raise PersistError(
                f"clips of {frames} frames, the given one included; backbone {self.name!r} makes clips of "
                f"{self.frames_per_clip} frames only"
            )

    def makes_clips(self, frames: int) -> bool:
        """Return whether ``generate`` can make clips of so many frames, the given one included."""
        if frames == self.frames_per_clip:
            return True
        try:
            self.check_clip_frames(frames)
        except PersistError:
            return False
        return True

    def shortest_clip(self, actions: int) -> int:
        """Return the frames of the shortest clip that shows so many actions, of the longest one when none does."""
        longest = self.frames_per_clip
        return next(frames for frames in range(min(actions + 1, longest), longest + 1) if self.makes_clips(frames))

    @property
    def gives_depth(self) -> bool:
        """Whether generated frames have depth; else their depth is 0."""
        return True

    def prepare_inference(self, placement: InferenceOptions) -> None:
        """Get ready to sample, on the accelerator if there is one; a second call, also with other adapters, is allowed.

        Raises:
            PersistError: when this backbone has no such way to save memory, or there is no accelerator for it.
        """
        device = placement.device()
        if placement.offload != "none" or placement.slicing or placement.tiling:
            raise PersistError(f"backbone {self.name!r} cannot save memory; leave out --save-memory")
        if placement.dtype is not None:
            self.to(getattr(torch, placement.dtype))
        self.to(device).eval()

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return every parameter in exactly one group, in the order of a table for people."""
        return [ParameterGroup(self.name, dict(self.named_parameters()))]

    def never_sharded_parameters(self) -> list[nn.Parameter]:
        """Return the parameters of the submodules that are never sharded."""
        return [parameter for name in self.never_sharded for parameter in self.get_submodule(name).parameters()]

    def truncate_layers(self, groups: int) -> float:
        """Keep the first ``groups`` groups of like layers, for estimates, and return how many there were.

        Memory and time of a step must grow linearly with the groups. By default there is one group, which stays.
        """
        return float(groups)

    @abstractmethod
    def trained_parameters(self, stage: Stage) -> dict[str, nn.Parameter]:
        """Freeze all parameters that the stage does not train, and return the others by name."""

    def apply_memory_savings(self, stage: Stage, savings: MemorySavings) -> None:
        """Make the steps of a stage cheaper; ``trained_parameters`` of the stage is called before.

        Raises:
            PersistError: when this backbone does not support one of the savings.
        """
        if savings != MemorySavings():
            raise PersistError(f"backbone {self.name!r} has no cheaper steps; leave out what training.* asks of it")

    @abstractmethod
    def forward(self, clips: Clips, stage: Stage) -> dict[str, Tensor]:
        """Return scalar tensors of one training step by name; ``"loss"`` is minimised, the others are logged."""

    def encodes(self, stage: Stage) -> bool:
        """Return whether clips can be encoded before a step of this stage, because it does not train the codec."""
        return False

    def encoding(self) -> str:
        """Return a hash of everything but the clips that ``encode`` depends on; ``NotImplementedError`` without it."""
        raise NotImplementedError(f"backbone {self.name!r} keeps nothing of a clip")

    def check_guide(self, folder: Path) -> None:
        """Raise ``CheckpointError`` when the ``video_model`` in a folder cannot guide this one."""
        raise NotImplementedError(f"backbone {self.name!r} has no autoguidance")

    def encode(self, clips: Clips) -> ClipLatents:
        """Return the clips' latents, which ``forward`` takes as ``Clips.latents``; needed where ``encodes`` is true."""
        raise NotImplementedError(f"backbone {self.name!r} keeps nothing of a clip")

    @property
    def framewise(self) -> bool:
        """Whether ``encode`` makes one latent frame of each frame, independent of the other frames.

        The latents of a trajectory are then computed once for all its clips, and ``image`` is the start of ``video``.
        """
        return False

    @classmethod
    def compute_once(cls, settings: Any, folder: Path, begun: Path | None) -> dict[str, Any]:
        """Compute what takes long, into files, and return the plain settings that name them; by default nothing.

        The main process of a training calls it; then every process makes its backbone with what is returned.

        Args:
            settings: an instance of ``settings_type``.
            folder: the run's folder, into which such files are written.
            begun: of a run that goes on, the folder of its newest model, which has what the run began with.

        Raises:
            PersistError: one line when it cannot be computed.
        """
        return {}

    def begin_stage(self, stage: Stage, clips: Iterable[Clips]) -> None:
        """Begin a stage that has no base by setting fresh weights from some clips; nothing by default."""

    def predict_once(self, clips: Clips) -> tuple[Tensor, Tensor]:
        """Return the clips as the model predicts them in a single step from a random noise level, without gradients.

        A model that is distilled predicts them as it will be sampled, from noise alone.

        Training on own writes puts such frames in the place of true ones, as a rollout would.

        Args:
            clips: clips as for ``forward``, with the noise of their seeds.

        Returns:
            rgb and depth on the CPU, in the form of ``generate``'s result; the first frame is predicted too.

        Raises:
            PersistError: when this backbone cannot.
        """
        raise PersistError(f"backbone {self.name!r} predicts no clips in training; set data.own_writes=0")

    def distill(self, settings: Distill, teacher: Backbone, target: Backbone) -> None:
        """Let ``forward`` return the loss of a distillation from now on, in the place of the loss of denoising.

        Args:
            settings: levels, guidance and loss.
            teacher: the frozen model whose denoising is learned, with its adapter in use.
            target: this model with the moving average of its trained weights, which follows the training.

        Raises:
            PersistError: when this backbone cannot be distilled, or not from that teacher.
        """
        raise PersistError(f"backbone {self.name!r} cannot be distilled; leave distill out")

    def train_adversarially(self, settings: Adversarial) -> list[nn.Parameter]:
        """Let ``forward`` return the loss of adversarial training from now on.

        Args:
            settings: noise levels, weights and size of the discriminator, which is fresh.

        Returns:
            The discriminator's parameters, which ``trained_parameters`` has too from now on.

        Raises:
            PersistError: when this backbone cannot be trained so.
        """
        raise PersistError(f"backbone {self.name!r} cannot be trained adversarially; leave adversarial out")

    def finish_stage(self, stage: Stage, clips: Iterable[Clips]) -> None:
        """End a stage by measuring on some clips what training does not learn, such as a scale; nothing by default."""

    @abstractmethod
    def generate(self, first: Clips, sampling: Sampling) -> tuple[Tensor, Tensor]:
        """Generate clips from their first frames.

        Args:
            first: clips whose rgb and depth hold the first frame only and whose cameras hold all frames. When all clips
                share their first frame, its rgb and depth may be a batch of one, which is encoded once.
            sampling: steps, sampler and guidance, which ``check_sampling`` accepts.

        Returns:
            rgb uint8 ``[batch, frame, height, width, 3]`` and depth float32 ``[batch, frame, height, width]``, planar z
            in metres; the first frame is that of ``first``. Other frames have depth 0 unless ``gives_depth``.
        """

    def generate_frame(
        self, first: Clips, sampling: Sampling, frames: Sequence[int]
    ) -> tuple[UInt8[Tensor, "batch height width 3"], Float[Tensor, "batch height width"]]:
        """Generate clips, and return a single frame of each, which planning judges.

        A backbone overrides this when it can leave the other frames undecoded.

        Args:
            first: as for ``generate``.
            sampling: as for ``generate``.
            frames: for each clip the number of the frame, 0 is the given one.
        """
        rgb, depth = self.generate(first, sampling)
        rows = torch.arange(len(frames))
        return rgb[rows, list(frames)], depth[rows, list(frames)]

    @abstractmethod
    def reconstruct(self, clips: Clips) -> tuple[Tensor, Tensor]:
        """Return the clips encoded and decoded, in the form of ``generate``'s result: the limit of its quality."""

    @abstractmethod
    def add_adapter(self, name: str, channels: int, settings: Mapping[str, Any]) -> None:
        """Add a fresh memory adapter for tokens of ``channels`` channels, with settings of the recipe, and use it."""

    @classmethod
    def adapter_settings(cls, chosen: Mapping[str, Any]) -> list[Setting]:
        """Return the settings that ``add_adapter`` knows, for ``persist recipes NAME``; by default it tells none.

        Args:
            chosen: the settings of the recipe, on which others and their defaults may depend.

        Raises:
            PersistError: one line when ``add_adapter`` would refuse these settings.
        """
        return []

    @abstractmethod
    def use_adapter(self, name: str | None) -> None:
        """Use the adapter of this name, or none, as in stage 1; ``CheckpointError`` for an unknown name."""

    @property
    @abstractmethod
    def token_budget(self) -> int:
        """The number of memory tokens that the adapter in use reads at most."""

    @property
    def reads_frames(self) -> bool:
        """Whether the adapter in use reads memories whose tokens are whole frames, and no others."""
        return False

    @property
    def draws_tokens(self) -> bool:
        """Whether the adapter in use draws tokens into the views of a clip, which other tokens do not change."""
        return False

    def keep_tokens(self, clips: Clips) -> MemoryTokens:
        """Return what the adapter in use needs of the tokens of clips, which a cache keeps; by default all of them."""
        assert clips.tokens is not None
        return clips.tokens

    def token_encoding(self) -> str:
        """Return a text with all that ``keep_tokens`` depends on besides the clips; empty when it keeps all tokens."""
        return ""

    def count_tokens(self, tokens: MemoryTokens, cameras: Cameras) -> int:
        """Return how many tokens the adapter in use makes of one sample's memory tokens for a path of cameras."""
        return int(tokens.mask.sum())

    def checkpoint_settings(self) -> dict[str, Any]:
        """Return the settings, as JSON values, of a backbone into which ``load_base`` loads this one's weights."""
        return dataclasses.asdict(self.settings)

    @abstractmethod
    def save_base(self, folder: Path) -> None:
        """Write all but the adapters into an existing folder, as safetensors and JSON files only."""

    @abstractmethod
    def save_adapter(self, folder: Path) -> None:
        """Write the adapter in use into an existing folder."""

    def origin(self) -> dict[str, Any]:
        """Return the settings that name the pretrained weights it started from; empty when there are none."""
        return {}

    def add_lora(self, lora: Lora) -> None:
        """Let stage 1 train a low-rank change of the pretrained weights, and the new parameters in full.

        Raises:
            PersistError: when this backbone or this installation has no LoRA.
        """
        raise PersistError(f"backbone {self.name!r} has no LoRA; leave lora out")

    def save_lora(self, folder: Path) -> None:
        """Write the parameters that stage 1 trains with LoRA, not the pretrained ones, into an existing folder."""
        raise NotImplementedError(f"backbone {self.name!r} has no LoRA")

    @abstractmethod
    def load_base(self, folder: Path) -> None:
        """Load the weights that ``save_base`` wrote, or merge those of ``save_lora`` into the weights that they change.

        Under torch's meta device only shapes are loaded.

        Raises:
            CheckpointError: when a file is missing or corrupt, or a tensor has another shape.
        """

    def load_codec(self, folder: Path) -> None:
        """Load the codec alone of what ``save_base`` wrote; all else stays fresh.

        Raises:
            CheckpointError: as ``load_base`` does, and when this backbone cannot.
        """
        raise CheckpointError(f"{folder}: backbone {self.name!r} takes no codec alone; leave its own settings out")

    @abstractmethod
    def load_adapter(self, name: str, folder: Path) -> None:
        """Add the adapter that ``save_adapter`` wrote and use it; ``CheckpointError`` when its files do not fit."""
