"""The diffusion transformer over the latents of a window, with a noise level for each token."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from persist_memory.scene_models.codec import folded_tokens, unfold
from persist_memory.scene_models.conditions import coordinates_of_tokens
from persist_memory.scene_models.settings import SceneDiffusionSettings

LEVEL_WAVES = 64  # sines of a noise level, and as many cosines
MODULATIONS = 6  # shift, scale and gate of the attention, and of the layers after it
LONGEST = 100.0  # of the wavelengths of rotary positions, in tokens over 2π


class Attention(nn.Module):
    """Attention with normalised queries and keys, among tokens or to others.

    Args:
        width: channels of a token.
        heads: number of heads.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_q, self.to_kv = nn.Linear(width, width), nn.Linear(width, 2 * width)
        self.norm_q, self.norm_k = (nn.Parameter(torch.ones(width // heads)) for _ in range(2))
        self.to_out = nn.Linear(width, width)

    def forward(self, tokens: Tensor, others: Tensor, rotary: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """Return what tokens read from others; rotary positions are those of both."""
        query = self.to_q(tokens).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        key, value = self.to_kv(others).unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        query, key = normalised(query, self.norm_q), normalised(key, self.norm_k)
        if rotary is not None:
            query, key = rotate(query, rotary), rotate(key, rotary)
        attended: Tensor = self.to_out(F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2))
        return attended


class Block(nn.Module):
    """Attention among the window's tokens, to the view's, and two layers; shift, scale and gate are each token's own.

    Args:
        width: channels of a token.
        heads: number of heads.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(width, elementwise_affine=affine) for affine in (False, True, False))
        self.own, self.view = Attention(width, heads), Attention(width, heads)
        self.layers = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU(approximate="tanh"), nn.Linear(4 * width, width)
        )  # fmt: skip
        self.modulation = nn.Parameter(torch.zeros(MODULATIONS, width))

    def forward(self, tokens: Tensor, view: Tensor, level: Tensor, rotary: tuple[Tensor, Tensor]) -> Tensor:
        """Return the changed tokens; ``level`` has ``MODULATIONS`` vectors for each of them."""
        shift, scale, gate, shift_after, scale_after, gate_after = (level + self.modulation).unbind(-2)
        norm, norm_view, norm_after = self.norms
        changed = norm(tokens) * (1 + scale) + shift
        tokens = tokens + gate * self.own(changed, changed, rotary)
        tokens = tokens + self.view(norm_view(tokens), view)
        after: Tensor = tokens + gate_after * self.layers(norm_after(tokens) * (1 + scale_after) + shift_after)
        return after


class SceneTransformer(nn.Module):
    """Predicts the velocity of each latent, ε - x, from noisy latents and the conditions.

    Args:
        settings: sizes of windows and transformer.
    """

    positions: Tensor

    def __init__(self, settings: SceneDiffusionSettings) -> None:
        super().__init__()
        own = settings.transformer
        self.settings, width = settings, own.width
        folded = settings.components * own.patch ** len(settings.tokens)
        self.inputs = nn.Linear(folded, width)
        self.places = nn.Parameter(0.02 * torch.randn(math.prod(settings.tokens), width))
        self.level = nn.Sequential(nn.Linear(2 * LEVEL_WAVES, width), nn.SiLU(), nn.Linear(width, width))
        self.modulation = nn.Linear(width, MODULATIONS * width)
        self.blocks = nn.ModuleList(Block(width, own.heads) for _ in range(own.layers))
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.outputs = nn.Linear(width, folded)
        for layer in (self.modulation, self.outputs):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(
        self,
        latents: Float[Tensor, "batch channel *latent"],
        levels: Float[Tensor, "batch token"],
        given: Float[Tensor, "batch token channel"],
        view: Float[Tensor, "batch view channel"],
        action: Float[Tensor, "batch channel"],
    ) -> Float[Tensor, "batch channel *latent"]:
        """Return the velocities.

        Args:
            latents: noisy ones.
            levels: noise level of each token, 0…1.
            given: embeddings of what is given of its cells.
            view: tokens of the view.
            action: embedding of action and camera.
        """
        patch = self.settings.transformer.patch
        tokens = self.inputs(folded_tokens(latents, patch)) + given + self.places
        time = self.level(waves_of(levels).to(tokens.dtype)) + action[:, None]
        level = self.modulation(F.silu(time)).unflatten(-1, (MODULATIONS, -1))
        rotary = rotary_positions(self.settings, tokens.device)
        for block in self.blocks:
            tokens = block(tokens, view, level, rotary)
        shift, scale = level[..., 0, :], level[..., 1, :]
        predicted = self.outputs(self.norm(tokens) * (1 + scale) + shift)
        return unfold(predicted.transpose(1, 2).unflatten(2, self.settings.tokens), patch)


def normalised(heads: Float[Tensor, "batch head token channel"], scale: Float[Tensor, " channel"]) -> Tensor:
    """Return channels divided by their root mean square and scaled, in their own precision."""
    return F.rms_norm(heads, heads.shape[-1:], scale.to(heads.dtype))


def waves_of(levels: Float[Tensor, "batch token"]) -> Float[Tensor, "batch token wave"]:
    """Return sines and cosines of noise levels, as of 1,000 timesteps."""
    rates = torch.exp(-math.log(10_000) * torch.arange(LEVEL_WAVES, device=levels.device) / LEVEL_WAVES)
    angles = 1000 * levels.float()[..., None] * rates
    return torch.cat([angles.cos(), angles.sin()], dim=-1)


def rotary_positions(
    settings: SceneDiffusionSettings, device: torch.device
) -> tuple[Float[Tensor, "token half"], Float[Tensor, "token half"]]:
    """Return cosines and sines of the tokens' positions; the axes share the channels of a head in equal parts."""
    half = settings.transformer.width // settings.transformer.heads // 2
    places = coordinates_of_tokens(settings).to(device).float()
    axes = torch.arange(half, device=device) % places.shape[1]
    rates = LONGEST ** (-torch.arange(half, device=device) / half)
    angles = places[:, axes] * rates
    return angles.cos(), angles.sin()


def rotate(heads: Float[Tensor, "batch head token channel"], rotary: tuple[Tensor, Tensor]) -> Tensor:
    """Turn the two halves of each head's channels by the tokens' positions."""
    cosines, sines = (part.to(heads.dtype) for part in rotary)
    first, second = heads.chunk(2, dim=-1)
    return torch.cat([first * cosines - second * sines, second * cosines + first * sines], dim=-1)
