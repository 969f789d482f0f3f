"""Floating-point operations of CogVideoX with memory blocks, by formula: two for each multiply-add of a matrix product.

Norms, activations, rotary positions and softmax are left out, as is usual for model FLOP utilisation, and so is what
gradient checkpointing computes again. A product Y = X W costs as much as the forward pass for the gradient of X, where
any is wanted, and once more for that of W, where it is trained; attention's two products cost twice their forward pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class VideoSizes:
    """Sizes of a pass through the transformer.

    Args:
        batch: number of clips.
        text: tokens of the prompt.
        text_channels: channels of the prompt's embedding.
        video: tokens of the latents.
        channels: channels of the hidden states.
        layers: number of transformer blocks.
        time: channels of the time embedding.
        inputs: numbers that go into a video token, over the time and area of its patch.
        outputs: numbers that come out of a video token.
    """

    batch: int
    text: int
    text_channels: int
    video: int
    channels: int
    layers: int
    time: int
    inputs: int
    outputs: int

    @property
    def tokens(self) -> int:
        """Tokens of text and video together."""
        return self.text + self.video


@dataclass(frozen=True)
class MemorySizes:
    """Sizes of memory blocks of the form ``cross``.

    Args:
        tokens: tokens of the memory, padding included.
        embedded: channels of a token with its position code.
        width: channels of the attention.
        hidden: hidden channels of the feed-forward.
        camera: channels of the camera embedding beside the hidden states in the query.
        layers: the transformer blocks after which they stand.
    """

    tokens: int
    embedded: int
    width: int
    hidden: int
    camera: int
    layers: tuple[int, ...]


def product(rows: int, inner: int, outer: int) -> int:
    """FLOPs of a matrix product [rows, inner] [inner, outer]."""
    return 2 * rows * inner * outer


def attention(batch: int, queries: int, keys: int, channels: int) -> int:
    """FLOPs of Q Kᵀ and of its product with V."""
    return 2 * batch * product(queries, channels, keys)


def modulation(video: VideoSizes) -> int:
    """FLOPs of the two adaptive norms of a transformer block."""
    return 2 * product(video.batch, video.time, 6 * video.channels)


def block_products(video: VideoSizes) -> int:
    """FLOPs of queries, keys, values, output and feed-forward (four times the width) of a transformer block."""
    rows, width = video.batch * video.tokens, video.channels
    return 4 * product(rows, width, width) + 2 * product(rows, width, 4 * width)


def block_attention(video: VideoSizes) -> int:
    """FLOPs of the joint attention of text and video in a transformer block."""
    return attention(video.batch, video.tokens, video.tokens, video.channels)


def entrance(video: VideoSizes) -> int:
    """FLOPs of the first layers: prompt, patches and time embedding; their inputs need no gradient."""
    text = product(video.batch * video.text, video.text_channels, video.channels)
    patches = product(video.batch * video.video, video.inputs, video.channels)
    return text + patches + product(video.batch, video.channels, video.time)


def rest_of_ends(video: VideoSizes) -> int:
    """FLOPs of the second layer of the time embedding and of the modulation of the last norm."""
    return product(video.batch, video.time, video.time) + product(video.batch, video.time, 2 * video.channels)


def exit_product(video: VideoSizes) -> int:
    """FLOPs of the projection to latents."""
    return product(video.batch * video.video, video.channels, video.outputs)


def memory_products(video: VideoSizes, memory: MemorySizes) -> int:
    """FLOPs of queries, keys, values, output and the feed-forward of a memory block."""
    rows, width = video.batch * video.video, video.channels
    query = product(rows, width + memory.camera, memory.width) + product(rows, memory.width, width)
    return (
        query
        + 2 * product(video.batch * memory.tokens, memory.width, memory.width)
        + 2 * product(rows, width, memory.hidden)
    )


def memory_attention(video: VideoSizes, memory: MemorySizes) -> int:
    """FLOPs of the cross-attention of a memory block."""
    return attention(video.batch, video.video, memory.tokens, memory.width)


def memory_modulation(video: VideoSizes, memory: MemorySizes) -> int:
    """FLOPs of the expert adaptive norm of a memory block."""
    return product(video.batch, video.time, 4 * video.channels + 2 * memory.width)


def embedding(video: VideoSizes, memory: MemorySizes) -> int:
    """FLOPs of the embedding of the memory's tokens, once a clip."""
    return product(video.batch * memory.tokens, memory.embedded, memory.width)


def forward(video: VideoSizes, memory: MemorySizes | None = None) -> int:
    """FLOPs of one pass, the embedding of the memory's tokens included."""
    block = modulation(video) + block_products(video) + block_attention(video)
    total = entrance(video) + rest_of_ends(video) + exit_product(video) + video.layers * block
    if memory is None:
        return total
    memory_block = memory_products(video, memory) + memory_attention(video, memory) + memory_modulation(video, memory)
    return total + embedding(video, memory) + len(memory.layers) * memory_block


def clip(steps: int, video: VideoSizes, memory: MemorySizes | None = None) -> int:
    """FLOPs of the passes of a clip, of which the first embeds the memory's tokens; the codec is not counted."""
    again = 0 if memory is None else embedding(video, memory)
    return steps * forward(video, memory) - (steps - 1) * again


def stage1_step(video: VideoSizes) -> int:
    """FLOPs of the forward and backward pass when the whole transformer is trained."""
    return 3 * forward(video) - entrance(video)


def stage2_step(video: VideoSizes, memory: MemorySizes) -> int:
    """FLOPs of both passes when only memory blocks are trained: gradients end at the first of them."""
    later = video.layers - 1 - memory.layers[0]
    through = later * (block_products(video) + 2 * block_attention(video)) + exit_product(video)
    trained = 2 * (memory_products(video, memory) + memory_attention(video, memory))
    own = len(memory.layers) * (trained + memory_modulation(video, memory)) + embedding(video, memory)
    return forward(video, memory) + through + own


def video_sizes(backbone: Any, batch: int) -> VideoSizes:
    """The sizes of a CogVideoX backbone's passes over a batch."""
    transformer, codec, settings = backbone.transformer, backbone.codec, backbone.settings
    config = transformer.base.config
    depth = config.patch_size_t or 1
    latent_frames = -(-((settings.frames - 1) // codec.temporal + 1) // depth)
    rows, columns = (side // codec.spatial // config.patch_size for side in (settings.height, settings.width))
    values = config.patch_size**2 * depth
    return VideoSizes(
        batch=batch,
        text=config.max_text_seq_length,
        text_channels=config.text_embed_dim,
        video=latent_frames * rows * columns,
        channels=config.num_attention_heads * config.attention_head_dim,
        layers=config.num_layers,
        time=config.time_embed_dim,
        inputs=values * transformer.in_channels,
        outputs=values * transformer.out_channels,
    )


def memory_sizes(backbone: Any, tokens: int) -> MemorySizes:
    """The sizes of the backbone's memory adapter in use, of the form ``cross``."""
    adapter = backbone.adapter
    block = next(iter(adapter.blocks.values()))
    return MemorySizes(
        tokens=tokens,
        embedded=adapter.embed.in_features,
        width=adapter.embed.out_features,
        hidden=block.ff[0].out_features,
        camera=backbone.transformer.camera_channels,
        layers=tuple(sorted(int(layer) for layer in adapter.blocks)),
    )
