"""Clips with their conditions, which a backbone is trained on and samples from, and their latents."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens

Interactions = tuple[str | None, ...]  # for each step between two frames the interaction's name, if there is one


@dataclass(frozen=True)
class ClipLatents:
    """Latents of clips, as a backbone's codec encodes them.

    Args:
        video: latents of the whole clips; the frame, height and width axes are those of the codec's latents.
        image: latents of the first frames, each encoded alone.
    """

    video: Float[Tensor, "*batch frame channel height width"]
    image: Float[Tensor, "*batch 1 channel height width"]

    def __getitem__(self, sample: int) -> ClipLatents:
        return ClipLatents(self.video[sample], self.image[sample])

    def to(self, device: torch.device | str) -> ClipLatents:
        """Return these latents on ``device``."""
        return ClipLatents(self.video.to(device), self.image.to(device))

    @staticmethod
    def stack(samples: Sequence[ClipLatents]) -> ClipLatents:
        """Return a batch of the latents of single clips."""
        videos, images = [sample.video for sample in samples], [sample.image for sample in samples]
        return ClipLatents(torch.stack(videos), torch.stack(images))


@dataclass(frozen=True)
class Clip:
    """One RGB-D clip with its conditions.

    Args:
        observations: frames with their cameras; for a clip to predict, the first frame alone with all cameras.
        interactions: interaction of the agent with the world between each two frames.
        seed: seed of all random numbers of the clip.
        tokens: memory tokens read for the cameras, ``None`` without a memory.
        latents: result of ``Backbone.encode``, ``None`` when it was not called; with it, observations may lack images.
    """

    observations: Observations
    interactions: Interactions
    seed: int
    tokens: MemoryTokens | None = None
    latents: ClipLatents | None = None


@dataclass(frozen=True)
class Clips:
    """A batch of RGB-D clips with their conditions; see ``Clip``.

    Args:
        rgb: uint8, 0…255.
        depth: float32 metres, planar z, 0 = missing.
        cameras: axes ``batch frame``, metres in each sample's world.
        interactions: for each sample the interactions between its frames.
        tokens: memory tokens of the batch, ``None`` without a memory.
        seeds: for each sample the seed of all its random numbers.
        latents: result of ``Backbone.encode``, ``None`` when it was not called; with it, rgb and depth may be empty.
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
        """Return a batch of clips of one size, of which all or none have tokens, and all or none have latents."""
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

    def shortened(self, frames: int) -> Clips:
        """Return the first frames of each clip, with their latents and rendered views; other tokens all stay."""
        count = self.cameras.world_from_camera.shape[1]

        def cut(part: Tensor) -> Tensor:  # of latents, whose codec may fold time
            return part[:, : (frames - 1) * (part.shape[1] - 1) // (count - 1) + 1]

        tokens, latents = self.tokens, self.latents
        if tokens is not None and tokens.rendered is not None:
            tokens = dataclasses.replace(tokens, rendered=cut(tokens.rendered))
        return dataclasses.replace(
            self,
            rgb=self.rgb[:, :frames],
            depth=self.depth[:, :frames],
            cameras=self.cameras[:, :frames],
            interactions=[names[: frames - 1] for names in self.interactions],
            tokens=tokens,
            latents=None if latents is None else ClipLatents(cut(latents.video), latents.image),
        )

    def first_frames(self) -> tuple[UInt8[Tensor, "batch 1 height width 3"], Float[Tensor, "batch 1 height width"]]:
        """Return RGB and depth of the first frames, uint8 and float32 metres."""
        return self.rgb[:, :1], self.depth[:, :1]

    def to(self, device: torch.device | str) -> Clips:
        """Return these clips on ``device``."""
        return dataclasses.replace(
            self,
            rgb=self.rgb.to(device),
            depth=self.depth.to(device),
            cameras=self.cameras.to(device),
            tokens=None if self.tokens is None else self.tokens.to(device),
            latents=None if self.latents is None else self.latents.to(device),
        )
