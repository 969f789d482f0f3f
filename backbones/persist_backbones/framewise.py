"""CogVideoX's VAE for frames that are coded alone, each as a video of one frame, at the price of an image VAE.

A causal convolution repeats the first frame into the past, so on a single frame all its taps in time see the same
image: it is a plain 2D convolution with the sum of the taps. That is a third of the arithmetic, with diffusers'
weights and layout.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKLCogVideoX
from diffusers.models.autoencoders.autoencoder_kl_cogvideox import CogVideoXCausalConv3d, CogVideoXSafeConv3d
from jaxtyping import Float
from torch import Tensor


class SingleFrameConv(CogVideoXSafeConv3d):  # type: ignore[misc]
    """The convolution inside: under several taps in time a single frame is seen by all of them."""

    def forward(self, input: Tensor) -> Tensor:
        """The convolved video; a method of the module that has the weights, which offloading brings when it is run."""
        if input.shape[2] != 1:
            convolved: Tensor = super().forward(input)
            return convolved
        strides = (self.stride[1:], self.padding[1:], self.dilation[1:])
        return F.conv2d(input[:, :, 0], self.weight.sum(2), self.bias, *strides)[:, :, None]


class FramewiseConv(CogVideoXCausalConv3d):  # type: ignore[misc]
    """diffusers' causal convolution, as a 2D convolution where the video begins with a single frame."""

    def forward(self, inputs: Tensor, conv_cache: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """The convolved video, and what the next piece of it needs: the frames that its first taps see."""
        if inputs.shape[2] != 1 or conv_cache is not None:
            result: tuple[Tensor, Tensor | None] = super().forward(inputs, conv_cache)
            return result
        return self.conv(inputs), inputs.expand(-1, -1, max(1, self.time_kernel_size - 1), -1, -1)


def code_frames_alone(vae: AutoencoderKLCogVideoX) -> None:
    """Make a VAE fast for videos of one frame; its parameters and their names stay as they are."""
    for module in vae.modules():
        if type(module) is CogVideoXCausalConv3d and module.pad_mode != "replicate":
            module.__class__ = FramewiseConv
            module.conv.__class__ = SingleFrameConv


def frames_to_batch(
    videos: Float[Tensor, "batch channel frame height width"],
) -> Float[Tensor, "image channel 1 height width"]:
    """Every frame as a video of its own."""
    return videos.transpose(1, 2).flatten(0, 1)[:, :, None]


def batch_to_frames(
    images: Float[Tensor, "image channel 1 height width"], frames: int
) -> Float[Tensor, "batch channel frame height width"]:
    """The videos that ``frames_to_batch`` took apart, whatever became of channels and sizes."""
    videos: Tensor = torch.movedim(images[:, :, 0].unflatten(0, (-1, frames)), 1, 2)
    return videos
