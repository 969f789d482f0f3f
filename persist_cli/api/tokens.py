"""The tokens that a backbone reads from a memory, with features, positions, colours and origins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from persist_cli.api.observations import Origin


@dataclass(frozen=True)
class MemoryTokens:
    """Memory tokens of one sample, or of a batch of samples.

    A token is a point with features, or a whole frame: then it has an image and a camera, and stands at its centre.

    Args:
        features: float32 features of the memory's encoder.
        positions: world metres, float64; the backbone moves them into the frame of the clip's first camera.
        mask: true for tokens, false for padding.
        colors: uint8 RGB, 0…255, of the surface at each token; ``None`` for a memory that knows no colours.
        origins: the ``Origin`` of each token, 0 for padding; without it all are observed.
        distances: float32 metres from which each token's surface was seen, where several times the nearest of them;
            ``None`` for a memory that does not know them.
        images: uint8 RGB, 0…255, of tokens that are frames; ``None`` for points.
        world_from_camera: the pose of each image, float64, metres.
        intrinsics: the intrinsics of each image in its pixels, float64.
        latents: what a backbone made of the images, which it then needs no longer.
        rendered: what ``Backbone.keep_tokens`` made of all tokens for the cameras of a clip, and which then stands for
            those that are not here; ``None`` for tokens as a memory gives them.
    """

    features: Float[Tensor, "*batch token channel"]
    positions: Float[Tensor, "*batch token 3"]
    mask: Bool[Tensor, "*batch token"]
    colors: UInt8[Tensor, "*batch token 3"] | None = None
    origins: UInt8[Tensor, "*batch token"] = None  # type: ignore[assignment]  # set below
    distances: Float[Tensor, "*batch token"] | None = None
    images: UInt8[Tensor, "*batch token height width 3"] | None = None
    world_from_camera: Float[Tensor, "*batch token 4 4"] | None = None
    intrinsics: Float[Tensor, "*batch token 3 3"] | None = None
    latents: Float[Tensor, "*batch token channel rows columns"] | None = None
    rendered: Float[Tensor, "*batch frame channel height width"] | None = None

    def __post_init__(self) -> None:
        if self.origins is None:
            object.__setattr__(self, "origins", torch.full_like(self.mask, Origin.OBSERVED, dtype=torch.uint8))

    def __len__(self) -> int:
        return self.features.shape[-2]

    def __getitem__(self, sample: int | slice) -> MemoryTokens:
        return MemoryTokens(**{name: tensor[sample] for name, tensor in self.tensors().items()})

    @property
    def bytes(self) -> int:
        """The bytes of one sample's tokens as a memory gives them: numbers of 4 bytes, colours and pixels of 1."""
        parts = [tensor for name, tensor in self.tensors().items() if name not in ("mask", "latents", "rendered")]
        sizes = [tensor[0].numel() * min(tensor.element_size(), 4) for tensor in parts if len(self)]
        return int(self.mask.sum()) * sum(sizes)

    @property
    def shared(self) -> bool:
        """Whether the samples of this batch, more than one, have the same tokens in the same place of the processor."""
        return len(self.positions) > 1 and all(tensor.stride(0) == 0 for tensor in self.tensors().values())

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name, without those that are ``None``; ``MemoryTokens`` takes them back."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: tensor for name, tensor in named.items() if tensor is not None}

    def first(self, count: int) -> MemoryTokens:
        """Return a batch of the first sample alone, ``count`` times in one place of the processor."""
        parts = {name: tensor[:1] for name, tensor in self.tensors().items()}
        return MemoryTokens(**{name: one.expand(count, *one.shape[1:]) for name, one in parts.items()})

    def to(self, device: torch.device | str) -> MemoryTokens:
        """Return these tokens on ``device``."""
        if self.shared:  # moving them would copy every sample
            return self.first(1).to(device).first(len(self.positions))
        return MemoryTokens(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    @staticmethod
    def of(
        features: Float[Tensor, "token channel"],
        positions: Float[Tensor, "token 3"],
        colors: UInt8[Tensor, "token 3"] | None = None,
        origins: UInt8[Tensor, " token"] | None = None,
        distances: Float[Tensor, " token"] | None = None,
    ) -> MemoryTokens:
        """Return tokens of one sample without padding; positions and distances are in world metres."""
        mask = torch.ones(len(features), dtype=torch.bool, device=features.device)
        distances = None if distances is None else distances.float()
        return MemoryTokens(features.float(), positions.double(), mask, colors, origins, distances)  # type: ignore[arg-type]

    @staticmethod
    def empty(channels: int) -> MemoryTokens:
        """Return one sample without tokens, whose features would have ``channels`` channels."""
        colors, distances = torch.zeros(0, 3, dtype=torch.uint8), torch.zeros(0)
        return MemoryTokens.of(torch.zeros(0, channels), torch.zeros(0, 3), colors, distances=distances)

    @staticmethod
    def stack(samples: Sequence[MemoryTokens]) -> MemoryTokens:
        """Return a batch of unbatched samples, padded to the longest one and to at least one token.

        The batch has colours, and distances, when all its samples have them; all samples or none are rendered. A sample
        that is there several times and is the only one is not copied: see ``shared``.
        """
        if len(samples[0]) and all(sample is samples[0] for sample in samples):
            batch = {name: tensor[None] for name, tensor in samples[0].tensors().items()}
            return MemoryTokens(**batch).first(len(samples))
        width = max(1, *(len(sample) for sample in samples))
        parts = [sample.tensors() for sample in samples]
        rendered = [part.pop("rendered") for part in parts if "rendered" in part]
        names = [name for name in parts[0] if all(name in part for part in parts)]
        padded = {name: _padded([part[name] for part in parts], width) for name in names}
        return MemoryTokens(**padded, rendered=torch.stack(rendered) if rendered else None)


def _padded(rows: Sequence[Tensor], width: int) -> Tensor:
    """Stack tensors whose first axis is filled up with zeros to ``width``."""
    stacked = rows[0].new_zeros(len(rows), width, *rows[0].shape[1:])
    for sample, row in zip(stacked, rows, strict=True):
        sample[: len(row)] = row
    return stacked
