"""The names and shapes of the tensors in NoMaD's published file, as the modules of its authors' code have them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch

Shapes = Iterator[tuple[str, tuple[int, ...]]]

B0 = ((1, 16, 1, 3), (6, 24, 2, 3), (6, 40, 2, 5), (6, 80, 3, 3), (6, 112, 3, 5), (6, 192, 4, 5), (6, 320, 1, 3))


def published_tensors() -> dict[str, torch.Tensor]:
    """One different number in every tensor, which takes no room on a disk."""
    return {name: torch.tensor(float(number) / 4096).expand(shape) for number, (name, shape) in enumerate(shapes())}


def shapes() -> Shapes:
    """Every tensor of the file."""
    for encoder, channels in (("obs", 3), ("goal", 6)):
        yield from efficientnet(f"vision_encoder.{encoder}_encoder", channels)
    for name in ("obs", "goal"):
        yield from linear(f"vision_encoder.compress_{name}_enc", 256, 1280)
    yield "vision_encoder.positional_encoding.pos_enc", (1, 5, 256)
    yield from attention("vision_encoder.sa_layer")
    for layer in range(4):
        yield from attention(f"vision_encoder.sa_encoder.layers.{layer}")
    yield from unet("noise_pred_net", (64, 128, 256))
    for place, (outputs, inputs) in zip((0, 2, 4), ((64, 256), (16, 64), (1, 16)), strict=True):
        yield from linear(f"dist_pred_net.network.{place}", outputs, inputs)


def efficientnet(name: str, channels: int) -> Shapes:
    """EfficientNet-B0 of the package efficientnet-pytorch, its batch norms replaced by group norms."""
    yield f"{name}._conv_stem.weight", (32, channels, 3, 3)
    yield from norm(f"{name}._bn0", 32)
    block, inputs = 0, 32
    for expansion, outputs, repeats, kernel in B0:
        for _ in range(repeats):
            yield from inverted_residual(f"{name}._blocks.{block}", inputs, expansion, outputs, kernel)
            block, inputs = block + 1, outputs
    yield f"{name}._conv_head.weight", (1280, 320, 1, 1)
    yield from norm(f"{name}._bn1", 1280)
    yield from linear(f"{name}._fc", 1000, 1280)


def inverted_residual(name: str, inputs: int, expansion: int, outputs: int, kernel: int) -> Shapes:
    """One of its blocks."""
    width = inputs * expansion
    if expansion > 1:
        yield f"{name}._expand_conv.weight", (width, inputs, 1, 1)
        yield from norm(f"{name}._bn0", width)
    yield f"{name}._depthwise_conv.weight", (width, 1, kernel, kernel)
    yield from norm(f"{name}._bn1", width)
    yield f"{name}._se_reduce.weight", (inputs // 4, width, 1, 1)
    yield f"{name}._se_reduce.bias", (inputs // 4,)
    yield f"{name}._se_expand.weight", (width, inputs // 4, 1, 1)
    yield f"{name}._se_expand.bias", (width,)
    yield f"{name}._project_conv.weight", (outputs, width, 1, 1)
    yield from norm(f"{name}._bn2", outputs)


def attention(name: str) -> Shapes:
    """A layer of torch's transformer encoder."""
    yield f"{name}.self_attn.in_proj_weight", (768, 256)
    yield f"{name}.self_attn.in_proj_bias", (768,)
    yield from linear(f"{name}.self_attn.out_proj", 256, 256)
    yield from linear(f"{name}.linear1", 1024, 256)
    yield from linear(f"{name}.linear2", 256, 1024)
    for number in (1, 2):
        yield from norm(f"{name}.norm{number}", 256)


def unet(name: str, sizes: Sequence[int]) -> Shapes:
    """The conditional U-Net of the package diffusion_policy."""
    yield from linear(f"{name}.diffusion_step_encoder.1", 1024, 256)
    yield from linear(f"{name}.diffusion_step_encoder.3", 256, 1024)
    for number in range(2):
        yield from residual(f"{name}.mid_modules.{number}", sizes[-1], sizes[-1])
    pairs = [*zip((2, *sizes[:-1]), sizes, strict=True)]
    for number, (inputs, outputs) in enumerate(pairs):
        yield from residual(f"{name}.down_modules.{number}.0", inputs, outputs)
        yield from residual(f"{name}.down_modules.{number}.1", outputs, outputs)
        if number < len(pairs) - 1:
            yield from convolution(f"{name}.down_modules.{number}.2.conv", outputs, outputs, 3)
    for number, (inputs, outputs) in enumerate(reversed(pairs[1:])):
        yield from residual(f"{name}.up_modules.{number}.0", 2 * outputs, inputs)
        yield from residual(f"{name}.up_modules.{number}.1", inputs, inputs)
        yield from convolution(f"{name}.up_modules.{number}.2.conv", inputs, inputs, 4)
    yield from convolution(f"{name}.final_conv.0.block.0", sizes[0], sizes[0], 3)
    yield from norm(f"{name}.final_conv.0.block.1", sizes[0])
    yield from convolution(f"{name}.final_conv.1", 2, sizes[0], 1)


def residual(name: str, inputs: int, outputs: int) -> Shapes:
    """One of its residual blocks, whose condition has 512 channels."""
    for number, width in enumerate((inputs, outputs)):
        yield from convolution(f"{name}.blocks.{number}.block.0", outputs, width, 3)
        yield from norm(f"{name}.blocks.{number}.block.1", outputs)
    yield from linear(f"{name}.cond_encoder.1", outputs, 512)
    if inputs != outputs:
        yield from convolution(f"{name}.residual_conv", outputs, inputs, 1)


def convolution(name: str, outputs: int, inputs: int, kernel: int) -> Shapes:
    yield f"{name}.weight", (outputs, inputs, kernel)
    yield f"{name}.bias", (outputs,)


def linear(name: str, outputs: int, inputs: int) -> Shapes:
    yield f"{name}.weight", (outputs, inputs)
    yield f"{name}.bias", (outputs,)


def norm(name: str, channels: int) -> Shapes:
    yield f"{name}.weight", (channels,)
    yield f"{name}.bias", (channels,)
