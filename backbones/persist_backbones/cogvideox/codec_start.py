"""The start of a small codec: weights that make a fresh VAE the principal components of its squares of pixels.

From random weights, thousands of steps go by until a small VAE is as good as a linear code of as many channels. It can
begin there instead: everything in diffusers' VAE that is not linear can be passed round by a pair of channels, since
SiLU(x) − SiLU(−x) = x, and residual blocks are the identity as long as their last convolution is zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from persist_backbones.cogvideox.codec import Codec, fold_pixels, pixel_patch
from persist_backbones.diffusers_models import CogVideoXResnetBlock3D
from persist_cli.errors import CheckpointError

CONSTANT = 8.0  # of two channels in each group, beside which the others hardly change what the group is divided by
SIGNS = (1.0, -1.0)  # of the two channels of a pair


@dataclass(frozen=True)
class Components:
    """Principal components of squares of pixels, softly scaled.

    Args:
        mean: the mean of the squares, pixels and colours as channels.
        directions: unit vectors, those of the largest variance first.
        scales: factor of each coefficient; the standard deviation of a scaled one is proportional to the root of its
            own, and all together have a mean square of 1.
    """

    mean: Float[Tensor, " folded"]
    directions: Float[Tensor, "folded component"]
    scales: Float[Tensor, " component"]

    @staticmethod
    def of(squares: Float[Tensor, "square folded"], count: int) -> Components:
        """The first ``count`` components of these squares."""
        mean = squares.double().mean(0)
        centred = squares.double() - mean
        variances, directions = torch.linalg.eigh(centred.T @ centred / len(squares))
        variances, directions = variances.flip(0)[:count].clamp_min(1e-12), directions.flip(1)[:, :count]
        signs = directions.gather(0, directions.abs().argmax(0, keepdim=True)).sign()  # the solver's own are arbitrary
        scales = variances**-0.25 / variances.sqrt().mean().sqrt()
        return Components(mean.float(), (directions * signs).float(), scales.float())

    def coefficients(self, squares: Float[Tensor, "*shape folded"]) -> Float[Tensor, "*shape component"]:
        """Scaled coefficients of squares."""
        scaled: Tensor = (squares - self.mean) @ self.directions * self.scales
        return scaled


@torch.no_grad()
def start_as_components(codec: Codec, images: Float[Tensor, "image 3 1 height width"]) -> None:
    """Give a fresh VAE the weights with which it codes squares of pixels by their principal components.

    Args:
        codec: has a VAE of one block that codes every frame alone.
        images: images with values in [-1, 1], of which the components are taken.

    Raises:
        CheckpointError: when the VAE has several blocks, or too few channels.
    """
    vae, latents = codec.vae, codec.channels
    widths, groups = vae.config.block_out_channels, vae.config.norm_num_groups
    if len(widths) > 1 or not codec.framewise or not _room(widths[0], groups, latents):
        raise CheckpointError(
            "codec_start components needs a VAE of one block that codes every frame alone, with channels enough: "
            "block_out_channels / norm_num_groups >= 2 + 2 * ceil(latent_channels / norm_num_groups)"
        )
    squares = fold_pixels(images, pixel_patch(vae))[:, :, 0].permute(0, 2, 3, 1)
    components = Components.of(squares.flatten(0, 2), latents)
    for block in vae.modules():
        if isinstance(block, CogVideoXResnetBlock3D):
            nn.init.zeros_(block.conv2.conv.weight)
            nn.init.zeros_(block.conv2.conv.bias)
            if isinstance(block.norm1, nn.GroupNorm):
                nn.init.constant_(block.norm1.weight, CONSTANT / 2)
    _start_encoder(vae.encoder, components, groups)
    _match_coefficients(codec, images, components.coefficients(squares))
    _start_decoder(vae.decoder, components)


def _room(width: int, groups: int, latents: int) -> bool:
    """Whether each group has two constant channels and its share of the pairs, and the decoder all pairs."""
    return width // groups >= 2 + 2 * -(-latents // groups)


def _start_encoder(encoder: Any, components: Components, groups: int) -> None:
    """Pairs of coefficients beside two constants in each group, which the last norm divides by."""
    first, norm, last = encoder.conv_in.conv, encoder.norm_out, encoder.conv_out.conv
    size, latents = first.weight.shape[0] // groups, components.directions.shape[1]
    share = -(-latents // groups)
    nn.init.zeros_(last.weight[:latents])
    nn.init.zeros_(last.bias[:latents])
    for group in range(groups):
        for place, sign in enumerate(SIGNS):
            nn.init.zeros_(first.weight[group * size + place])
            first.bias[group * size + place] = sign * CONSTANT
    for latent in range(latents):
        row = components.directions[:, latent] * components.scales[latent]
        for place, sign in enumerate(SIGNS):
            channel = latent // share * size + 2 + 2 * (latent % share) + place
            _set_middle(first.weight[channel], sign * row)
            first.bias[channel] = -sign * float(row @ components.mean)
            norm.weight[channel] = CONSTANT / 2
            _set_middle(last.weight[latent], F.one_hot(torch.tensor(channel), last.weight.shape[1]) * sign, add=True)


def _match_coefficients(codec: Codec, images: Tensor, wanted: Float[Tensor, "image rows columns latent"]) -> None:
    """Scale each latent so that it is its coefficient in the least-squares sense."""
    given = codec.posterior(images).mean[:, :, 0].permute(0, 2, 3, 1)
    gains = (given * wanted).sum((0, 1, 2)) / given.square().sum((0, 1, 2))
    codec.vae.encoder.conv_out.conv.weight[: len(gains)] *= gains[:, None, None, None, None]


def _start_decoder(decoder: Any, components: Components) -> None:
    """Pairs of the latents themselves, which the last spatial norm adds, and the sum of components."""
    norm, last = decoder.norm_out, decoder.conv_out.conv
    nn.init.zeros_(last.weight)
    last.bias.copy_(components.mean)
    for latent, (direction, scale) in enumerate(zip(components.directions.T, components.scales, strict=True)):
        for place, sign in enumerate(SIGNS):
            channel = 2 * latent + place
            for convolution in (norm.conv_y.conv, norm.conv_b.conv):
                nn.init.zeros_(convolution.weight[channel])
                nn.init.zeros_(convolution.bias[channel : channel + 1])
            norm.conv_b.conv.weight[channel, latent] = sign
            last.weight[:, channel, -1, 1, 1] = sign * direction / scale


def _set_middle(kernel: Float[Tensor, "in time height width"], values: Tensor, add: bool = False) -> None:
    """Let a convolution's output channel be a weighted sum of the inputs at the same place."""
    if not add:
        nn.init.zeros_(kernel)
    kernel[:, -1, kernel.shape[-2] // 2, kernel.shape[-1] // 2] += values.to(kernel)
