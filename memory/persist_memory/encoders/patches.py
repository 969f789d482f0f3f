"""A fixed linear projection of RGB patches: no weights to fetch, the same on every machine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, UInt8
from pydantic import Field, PositiveInt
from torch import Tensor

from persist_cli.api.encoder import Encoder
from persist_cli.errors import RecipeError

DETAIL_GAIN = 8.0  # brings detail to the order of colour; it is not whitened, so that noise stays small
MOST = 2**26  # numbers of the matrix: 512 MB
EXACT = 2.0**20  # weights are multiples of 1 / EXACT


@dataclass(frozen=True)
class PatchesSettings:
    """Size of the patches and of the features.

    Args:
        patch: pixels along the edge of a patch.
        channels: number of channels; the first three are the mean colour, the others mix the coarsest detail.
        seed: seed of the random mixture.
    """

    patch: PositiveInt = 8
    channels: PositiveInt = 32
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0


class Patches(Encoder):
    """Mean colour and coarse detail of each patch.

    Colours lie in [-1, 1]. Detail is the patch's discrete cosine transform, lowest frequencies first, mixed by a
    random rotation. An image that is no multiple of the patch is resized to the nearest one.
    """

    settings_type = PatchesSettings
    settings: PatchesSettings

    def __init__(self, settings: PatchesSettings) -> None:
        super().__init__(settings)
        if settings.channels > 3 * settings.patch**2:
            raise RecipeError(
                f"encoder {self.name!r}: {settings.channels} channels are more than the "
                f"{3 * settings.patch**2} numbers of a patch of {settings.patch} pixels"
            )
        if 3 * settings.patch**2 * settings.channels > MOST:
            raise RecipeError(
                f"encoder {self.name!r}: {settings.channels} channels of patches of {settings.patch} pixels take a "
                f"matrix of more than {MOST:,} numbers; name smaller patches or fewer channels"
            )
        self._weight = projection(settings)

    @property
    def channels(self) -> int:
        """Number of feature channels."""
        return self.settings.channels

    def encode(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame rows columns channel"]:
        """Return the features of every patch; no other frame and no device changes a bit of them."""
        patch = self.settings.patch
        rgb = _whole_patches(rgb, patch)
        frames, height, width, _ = rgb.shape
        rows, columns = height // patch, width // patch
        patches = rgb.reshape(frames, rows, patch, columns, patch, 3).transpose(2, 3)
        weight = self._weight.to(rgb.device)
        # sums of integers times multiples of a power of two are exact in float64, in any order
        exact = patches.reshape(-1, patch * patch * 3).double() @ weight
        features = exact * (2 / 255) - weight.sum(0)
        return features.float().reshape(frames, rows, columns, self.channels)


def projection(settings: PatchesSettings) -> Float[Tensor, "value channel"]:
    """The matrix that turns the ``[row, column, rgb]`` values of a patch into its features, float64."""
    coarse = _cosines(settings.patch, math.ceil(settings.channels / 3))
    basis = torch.einsum("pf,cd->pcfd", coarse, torch.eye(3, dtype=torch.float64))
    basis = basis.reshape(3 * settings.patch**2, -1)[:, : settings.channels]
    generator = torch.Generator().manual_seed(settings.seed)
    detail = settings.channels - 3
    if detail > 0:
        random = torch.randn(detail, detail, generator=generator, dtype=torch.float64)
        basis[:, 3:] = DETAIL_GAIN * basis[:, 3:] @ torch.linalg.qr(random)[0]
    return (basis * EXACT).round() / EXACT


def _cosines(size: int, count: int) -> Float[Tensor, "pixel frequency"]:
    """The coarsest of the two-dimensional cosines of a patch, scaled so that the first gives the mean."""
    place = (torch.arange(size, dtype=torch.float64) + 0.5) * torch.pi / size
    frequency = torch.arange(size, dtype=torch.float64)
    line = torch.cos(place[:, None] * frequency) * torch.where(frequency > 0, math.sqrt(2), 1.0)
    chosen = (frequency[:, None] ** 2 + frequency**2).flatten().argsort(stable=True)[:count]
    return (line[:, None, chosen // size] * line[None, :, chosen % size]).flatten(0, 1) / size**2


def _whole_patches(rgb: Tensor, patch: int) -> Tensor:
    """The images resized to the nearest multiple of the patch."""
    height, width = rgb.shape[1:3]
    whole = [max(1, round(side / patch)) * patch for side in (height, width)]
    if whole == [height, width]:
        return rgb
    image = rgb.permute(0, 3, 1, 2).float()
    resized = torch.nn.functional.interpolate(image, size=whole, mode="bilinear", antialias=True, align_corners=False)
    return resized.round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)
