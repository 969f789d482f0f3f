"""CogVideoX's transformer widened for depth, image condition, cameras, interactions and memory.

The published weights stay in their own module, untouched and loadable by diffusers; what is new stands beside them,
zero-initialised: a second patch embedding added to the first, more output channels, an embedding added to the time
embedding. Sums with exact zeros keep the widened model equal to the original to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from diffusers import CogVideoXTransformer3DModel
from diffusers.models.cache_utils import CacheMixin
from jaxtyping import Float, Int
from torch import Tensor, nn

from persist_backbones.adapters.base import Adapter, PreparedMemory
from persist_backbones.extensions.caches import check_cache, rest_is_cached, with_layers
from persist_backbones.extensions.offload import bring
from persist_backbones.tensors import fold_patches, frames_per_token, tokens_of, unfold_patches, zero_init

OFFSET = 2.0  # what CogVideoX 1.5 image-to-video was trained with as ``ofs``


@dataclass(frozen=True)
class Conditions:
    """What the transformer sees beside the noisy latents.

    Args:
        text: prompt embedding.
        timestep: noise levels.
        interactions: rows of the interaction embedding, 0 for none.
        camera: camera embedding at each video token, for the queries of memory blocks.
        rotary: cosines and sines, for models with rotary positions.
        memory: prepared tokens, with the adapter that made them.
    """

    text: Float[Tensor, "batch word channel"]
    timestep: Int[Tensor, " batch"]
    interactions: Int[Tensor, "batch step"]
    camera: Float[Tensor, "batch token camera"]
    rotary: tuple[Tensor, Tensor] | None = None
    memory: PreparedMemory | None = None


class WorldTransformer(nn.Module, CacheMixin):  # type: ignore[misc]
    """Predicts of RGB and depth latents what the objective asks for (see ``objective``).

    diffusers' caches work with it: ``enable_cache(FirstBlockCacheConfig(threshold=0.1))`` before sampling.

    Args:
        base: diffusers' transformer.
        in_channels: all input channels: noisy RGB, RGB image, noisy depth, depth image, camera.
        out_channels: RGB and depth.
        interactions: rows of the interaction embedding without the first, which is none.
        camera_channels: of the camera embedding at a token.
    """

    def __init__(
        self,
        base: CogVideoXTransformer3DModel,
        in_channels: int,
        out_channels: int,
        interactions: int,
        camera_channels: int,
    ) -> None:
        super().__init__()
        config = base.config
        inner = config.num_attention_heads * config.attention_head_dim
        patch, frames, new = config.patch_size, frames_per_token(config), in_channels - config.in_channels
        self.base = base
        self.extra_in: nn.Module
        if config.patch_size_t is None:
            self.extra_in = nn.Conv2d(new, inner, patch, stride=patch, bias=False)
        else:
            self.extra_in = nn.Linear(new * frames * patch**2, inner, bias=False)
        self.extra_out = nn.Linear(inner, frames * patch**2 * (out_channels - config.out_channels))
        self.interactions = nn.Embedding(1 + interactions, config.time_embed_dim, padding_idx=0)
        self.camera_channels = camera_channels
        self.in_channels, self.out_channels = in_channels, out_channels
        self.timestep = 0  # of the present step, for caches
        zero_init(self.extra_in, self.extra_out, self.interactions)

    @property
    def is_cache_enabled(self) -> bool:
        """Whether the base has a cache."""
        return bool(self.base.is_cache_enabled)

    def enable_cache(self, config: Any) -> None:
        """Skip work that changes little between denoising steps, by one of diffusers' caches.

        Where a cache asks for the timestep (``current_timestep_callback``) and none is given, it is that of sampling.

        Raises:
            PersistError: for a cache that does not work here.
        """
        check_cache(config)
        if getattr(config, "current_timestep_callback", self) is None:
            config.current_timestep_callback = lambda: self.timestep
        self.base.enable_cache(with_layers(config))

    def disable_cache(self) -> None:
        """Compute everything again."""
        self.base.disable_cache()

    def reset_cache(self) -> None:
        """Forget what was kept of the last steps."""
        CacheMixin._reset_stateful_cache(self)

    def forward(
        self,
        latents: Float[Tensor, "batch frame channel height width"],
        given: Conditions,
        adapter: Adapter[Any] | None,
    ) -> Float[Tensor, "batch frame out height width"]:
        """Predictions of RGB and depth latents, concatenated on channels."""
        bring(self.base)
        time = self.embed_time(given, latents.dtype)
        text, video = self.embed_patches(latents, given.text.to(latents.dtype))
        for layer in range(len(self.base.transformer_blocks)):
            video, text = self.recomputed(self.run_layer, layer, video, text, time, given, adapter)
        video = self.base.norm_out(self.base.norm_final(video), temb=time)
        parts = (self.unpatchify(self.base.proj_out(video), latents), self.unpatchify(self.extra_out(video), latents))
        predicted = torch.cat(parts, dim=2)
        if adapter is None or given.memory is None:
            return predicted
        return adapter.correct(predicted, latents, given.memory, time)

    def embed_time(self, given: Conditions, dtype: torch.dtype) -> Float[Tensor, "batch time"]:
        """The time embedding, for CogVideoX 1.5 image-to-video with ``ofs``, and the interactions of the clip added."""
        time: Tensor = self.base.time_embedding(self.base.time_proj(given.timestep).to(dtype))
        if self.base.ofs_embedding is not None:
            offset = torch.full((1,), OFFSET, device=time.device)
            time = time + self.base.ofs_embedding(self.base.ofs_proj(offset).to(dtype))
        done: Tensor = self.interactions(given.interactions).sum(dim=1)
        return time + done.to(time.dtype)

    def embed_patches(self, latents: Tensor, text: Tensor) -> tuple[Tensor, Tensor]:
        """Text and video tokens: diffusers' patch embedding of its own channels plus that of the new ones."""
        known = self.base.config.in_channels
        tokens: Tensor = self.base.patch_embed(text, latents[:, :, :known])
        words = text.shape[1]
        video = tokens[:, words:] + self.embed_new(latents[:, :, known:])
        return tokens[:, :words], self.base.embedding_dropout(video)

    def embed_new(self, latents: Tensor) -> Float[Tensor, "batch token channel"]:
        """The patch embedding of the channels that the published model does not know."""
        config = self.base.config
        if config.patch_size_t is not None:
            embedded: Tensor = self.extra_in(fold_patches(latents, config.patch_size, config.patch_size_t))
            return embedded
        return tokens_of(self.extra_in(latents.flatten(0, 1)).unflatten(0, latents.shape[:2]))

    def recomputed(self, function: Callable[..., Any], *given: Any) -> Any:
        """What the function gives, computed again in the backward pass when checkpointing is on."""
        if torch.is_grad_enabled() and self.base.gradient_checkpointing:
            return self.base._gradient_checkpointing_func(function, *given)
        return function(*given)

    def run_layer(
        self, layer: int, video: Tensor, text: Tensor, time: Tensor, given: Conditions, adapter: Adapter[Any] | None
    ) -> tuple[Tensor, Tensor]:
        """One of diffusers' blocks, and what the adapter has before and after it."""
        memory = None if adapter is None else given.memory
        blocks = self.base.transformer_blocks
        if adapter is not None and memory is not None and not (layer and rest_is_cached(blocks[0])):
            video = adapter.before_block(layer, video, memory)
        video, text = blocks[layer](
            hidden_states=video, encoder_hidden_states=text, temb=time, image_rotary_emb=given.rotary
        )
        if adapter is not None and memory is not None and (layer == len(blocks) - 1 or not rest_is_cached(blocks[0])):
            video = adapter.after_block(layer, video, memory, given.camera, time)
        return video, text

    def unpatchify(self, tokens: Tensor, like: Tensor) -> Tensor:
        """Tokens of patches back to frames of the latents' size."""
        config = self.base.config
        size = (like.shape[1], like.shape[3], like.shape[4])
        return unfold_patches(tokens, size, config.patch_size, frames_per_token(config))
