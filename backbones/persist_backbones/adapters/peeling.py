"""Depth peeling (Everitt 2001): the first surfaces along each ray, one behind the other, and their embedding.

A rendered view shows what is nearest. The layers behind it tell the model how a place goes on where its own view does
not reach, and class and depth tell what a colour alone does not. PERSIST (2603.03482) feeds its pixel transformer this
way: an embedding of classes and sinusoids of depth for each layer, reduced by a convolution over layers.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from persist_backbones.adapters.memory_block import position_code
from persist_backbones.adapters.projected import OCTAVES, WAVELENGTHS
from persist_backbones.adapters.splat import Splats
from persist_cli.api.geometry import nearest_at
from persist_cli.api.observations import Origin
from persist_cli.api.tokens import MemoryTokens

VALUES = 6  # of a surface: kind; red, green and blue of 0…1; log₂ of its depth in metres; the share that was observed
FREQUENCIES = 8  # of the sinusoids of a surface's depth


def peel(
    tokens: MemoryTokens, splats: Splats, shape: tuple[int, int, int, int], layers: int, gap: float, classes: int
) -> Float[Tensor, "batch frame layer value height width"]:
    """Return the first surfaces behind each pixel, nearest first: ``VALUES`` of each, zeros where there is none.

    A surface is all that lies less than ``gap`` behind the nearest that is left. Its values are means, and its kind is
    1 + the class of most of its tokens, or 1 without classes.

    Args:
        tokens: the tokens of a batch, with colours.
        splats: the tokens that fall into each pixel.
        shape: batch, frames, height and width of the pixels.
        layers: number of surfaces.
        gap: metres.
        classes: number of classes that the features begin with, one-hot; 0 for none.
    """
    count = shape[0] * shape[1] * shape[2] * shape[3]
    values, surfaces = _token_values(tokens), []
    features = tokens.features[..., :classes] if classes else tokens.mask[..., None]
    kinds = features.float().argmax(dim=-1).flatten()
    for _ in range(layers):
        nearest = nearest_at(splats.pixel, splats.depth, count)
        front = splats.depth < nearest[splats.pixel] + gap
        surface = Splats(*(column[front] for column in splats))
        surfaces.append(_means(surface, values, kinds, (count, max(1, classes))))
        splats = Splats(*(column[~front] for column in splats))
    drawn = torch.stack(surfaces, dim=1).unflatten(0, shape)
    result: Tensor = drawn.permute(0, 1, 4, 5, 2, 3)
    return result


def _token_values(tokens: MemoryTokens) -> Float[Tensor, "token 4"]:
    """Return the values of tokens that do not depend on a view: colour, and whether it was observed."""
    assert tokens.colors is not None
    observed = (tokens.origins == Origin.OBSERVED)[..., None].float()
    return torch.cat([tokens.colors.float() / 255, observed], dim=-1).flatten(0, 1)


def _means(
    surface: Splats, values: Float[Tensor, "token 4"], kinds: Int64[Tensor, " token"], shape: tuple[int, int]
) -> Float[Tensor, "pixel value"]:
    """Return kind and mean values of the tokens at each pixel, zeros without any; shape counts pixels and classes."""
    pixels, classes = shape
    pixel, token = surface.pixel, surface.token
    parts = torch.cat([values[token], surface.depth.float().log2()[:, None]], dim=1)
    total = parts.new_zeros(pixels, parts.shape[1]).index_add(0, pixel, parts)
    votes = parts.new_zeros(pixels * classes).index_add(0, pixel * classes + kinds[token], parts.new_ones(len(pixel)))
    votes = votes.unflatten(0, (pixels, classes))
    count = votes.sum(dim=1, keepdim=True)
    colors, observed, depth = (total / count.clamp_min(1)).split([3, 1, 1], dim=1)
    kind = (votes.argmax(dim=1, keepdim=True) + 1) * (count > 0)
    return torch.cat([kind.float(), colors, depth, observed], dim=1)


class LayerEmbedding(nn.Module):
    """The embedding of the surfaces behind each pixel; it is zero where there is none.

    Args:
        layers: number of surfaces.
        classes: number of classes; 0 when surfaces have none.
        class_channels: channels of the embedding of a class.
        width: channels of the result.
    """

    def __init__(self, layers: int, classes: int, class_channels: int, width: int) -> None:
        super().__init__()
        self.classes = nn.Embedding(max(1, classes), class_channels)
        self.reduce = nn.Conv1d(class_channels + 5 + 2 * FREQUENCIES, width, layers, bias=False)

    def forward(self, surfaces: Float[Tensor, "pixel layer value"]) -> Float[Tensor, "pixel width"]:
        """Return the embedding of what ``peel`` returned, pixels on the batch axis."""
        kind, colors, depth, observed = surfaces.split([1, 3, 1, 1], dim=-1)
        present: Bool[Tensor, "pixel layer 1"] = kind > 0
        classes = self.classes((kind[..., 0].round().long() - 1).clamp_min(0))
        code = position_code(depth / OCTAVES, FREQUENCIES, *WAVELENGTHS)
        parts = torch.cat([2 * colors - 1, code, observed, 1 - observed], dim=-1).to(classes.dtype)
        parts = torch.cat([classes, parts], dim=-1) * present
        reduced: Tensor = self.reduce(parts.transpose(1, 2))
        return F.gelu(reduced[..., 0], approximate="tanh")
