"""The codec: RGB-D clips to latents and back by diffusers' CogVideoX VAE, separately for RGB and depth."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from persist_backbones.diffusers_models import (
    AutoencoderKLCogVideoX,
    CogVideoXCausalConv3d,
    CogVideoXSafeConv3d,
    DiagonalGaussianDistribution,
)
from persist_backbones.noise_levels import draw_noise
from persist_backbones.tensors import push_pull
from persist_cli.errors import CheckpointError

HALF_RANGE = 2.0  # the depth in metres whose code is 0
NEAREST = 0.05  # metres; a nearer decoded depth counts as missing
IMPULSE = 5  # latent pixels along the edge of the image in which the middle one is changed
MOST_VALUES = 2**30  # of a convolution's input that diffusers' CogVideoXSafeConv3d does not split


def encode_depth(depth: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Convert metres to [-1, 1); missing depth, 0 m, becomes -1."""
    return (depth - HALF_RANGE) / (depth + HALF_RANGE)


def decode_depth(code: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Convert [-1, 1) to metres, the inverse of ``encode_depth``; depth under 5 cm becomes 0, missing."""
    code = code.clamp(-1.0, 0.998)
    depth = HALF_RANGE * (1 + code) / (1 - code)
    return torch.where(depth < NEAREST, torch.zeros_like(depth), depth)


def fill_missing(depth: Float[Tensor, "frame height width"]) -> Float[Tensor, "frame height width"]:
    """Fill holes in depth (0) with the mean of nearby depth, coarse to fine; a frame without any depth stays 0.

    The border of an unfilled hole would be decoded as points that float between the surface and the camera.
    """
    known = (depth > 0).to(depth.dtype)
    if bool(known.all()):
        return depth
    return torch.where(known > 0, depth, push_pull((depth * known)[:, None], known[:, None])[:, 0])


class SingleFrameConv(CogVideoXSafeConv3d):  # type: ignore[misc]
    """The convolution inside ``FramewiseConv``: on a single frame, all taps in time take that same frame."""

    _flat: tuple[Tensor, tuple[object, ...], Tensor] | None = None  # the weight, its state, and its sum over time

    def flat_weight(self) -> Tensor:
        """Return the sum of the taps in time, which is made again after the weight was changed or moved."""
        weight: Tensor = self.weight
        if torch.is_grad_enabled() or weight.is_meta:
            return weight.sum(2)
        state = (weight.data_ptr(), weight._version, weight.dtype)
        if self._flat is None or self._flat[0] is not weight or self._flat[1] != state:
            self._flat = weight, state, weight.sum(2)
        return self._flat[2]

    def forward(self, input: Tensor) -> Tensor:
        """Convolve the video, here in the module with the weights, which offloading moves when it is called."""
        if input.shape[2] != 1:
            convolved: Tensor = super().forward(input)
            return convolved
        strides = (self.stride[1:], self.padding[1:], self.dilation[1:])
        return F.conv2d(input[:, :, 0], self.flat_weight(), self.bias, *strides)[:, :, None]


class FramewiseConv(CogVideoXCausalConv3d):  # type: ignore[misc]
    """diffusers' causal convolution, run as a 2D convolution when the video's first part is a single frame."""

    def forward(self, inputs: Tensor, conv_cache: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Return the convolved video and the cache for its next part: the frames that the first taps take there."""
        if inputs.shape[2] != 1 or conv_cache is not None:
            result: tuple[Tensor, Tensor | None] = super().forward(inputs, conv_cache)
            return result
        return self.conv(inputs), inputs.expand(-1, -1, max(1, self.time_kernel_size - 1), -1, -1)


def make_framewise(vae: AutoencoderKLCogVideoX) -> None:
    """Make a VAE fast for videos of one frame, without a change of its parameters and their names."""
    for module in vae.modules():
        if type(module) is CogVideoXCausalConv3d and module.pad_mode != "replicate":
            module.__class__ = FramewiseConv
            module.conv.__class__ = SingleFrameConv


def frames_to_batch(
    videos: Float[Tensor, "batch channel frame height width"],
) -> Float[Tensor, "image channel 1 height width"]:
    """Turn every frame into a video of its own."""
    return videos.transpose(1, 2).flatten(0, 1)[:, :, None]


def batch_to_frames(
    images: Float[Tensor, "image channel 1 height width"], frames: int
) -> Float[Tensor, "batch channel frame height width"]:
    """Undo ``frames_to_batch``; channels and sizes may have changed between."""
    videos: Tensor = torch.movedim(images[:, :, 0].unflatten(0, (-1, frames)), 1, 2)
    return videos


def pixel_patch(vae: AutoencoderKLCogVideoX) -> int:
    """Return the edge of the square of pixels that is folded into the VAE's input channels, 1 for CogVideoX's own."""
    return max(1, math.isqrt(vae.config.in_channels // 3))


def spatial_compression(vae: AutoencoderKLCogVideoX) -> int:
    """Return the number of pixels along the edge of a latent pixel."""
    return pixel_patch(vae) * int(2 ** (len(vae.config.block_out_channels) - 1))


def check_vae(vae: AutoencoderKLCogVideoX) -> None:
    """Raise ``CheckpointError`` for a VAE that is not for RGB, or whose blocks do not fit its compression."""
    config, patch = vae.config, pixel_patch(vae)
    if not config.in_channels == config.out_channels == 3 * patch**2:
        raise CheckpointError(
            f"a VAE of {config.in_channels} input and {config.out_channels} output channels; both must be 3 p², RGB "
            "with p×p pixels folded"
        )
    blocks = (config.block_out_channels, config.down_block_types, config.up_block_types)
    stages = [len(names) for names in blocks]
    if len(set(stages)) > 1:
        raise CheckpointError(f"a VAE of {stages[0]} block_out_channels, {stages[1]} down and {stages[2]} up blocks")
    ratios = [2**halvings for halvings in range(stages[0])]
    if config.temporal_compression_ratio not in ratios:
        raise CheckpointError(
            f"a VAE of {stages[0]} blocks cannot compress time by {config.temporal_compression_ratio}, only by "
            f"{', '.join(map(str, ratios))}"
        )


def in_parts(run: Callable[[Tensor], Tensor], samples: Tensor, most: int) -> Tensor:
    """Run a function on at most ``most`` samples at a time and concatenate the results."""
    return run(samples) if len(samples) <= most else torch.cat([run(part) for part in samples.split(most)])


def fold_pixels(
    videos: Float[Tensor, "batch channel frame height width"], patch: int
) -> Float[Tensor, "batch folded frame rows columns"]:
    """Fold squares of pixels into channels."""
    return F.pixel_unshuffle(videos.transpose(1, 2), patch).transpose(1, 2)


def unfold_pixels(
    videos: Float[Tensor, "batch folded frame rows columns"], patch: int
) -> Float[Tensor, "batch channel frame height width"]:
    """Undo ``fold_pixels``."""
    return F.pixel_shuffle(videos.transpose(1, 2), patch).transpose(1, 2)


def to_uint8(
    colors: Float[Tensor, "batch 3 frame height width"],
) -> UInt8[Tensor, "batch frame height width 3"]:
    """Convert colours in [-1, 1] to RGB frames of 0 to 255; values outside are clipped."""
    return ((colors.permute(0, 2, 3, 4, 1) + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)


class Codec(nn.Module):
    """The VAE with the conversions from clips and back to them.

    Depth goes through the VAE as a grey image (see ``encode_depth``). Latents are the posterior's mean times the
    scaling factor, in training and in sampling; in the image condition they are also multiplied by ``image_scale``.

    A VAE that does not compress time (``temporal_compression_ratio`` 1) codes every frame alone. A VAE of 3 p² input
    channels takes p×p pixels folded into channels, which is much cheaper than convolutions at full size.

    Args:
        vae: diffusers' autoencoder.

    Raises:
        CheckpointError: for a VAE that is not for RGB, or whose blocks do not fit its compression.
    """

    def __init__(self, vae: AutoencoderKLCogVideoX) -> None:
        super().__init__()
        check_vae(vae)
        self.vae = vae
        self._fingerprint: tuple[object, str] | None = None  # state of the VAE, and its hash
        self._pixel_weights: Tensor | None = None
        if self.framewise:
            make_framewise(vae)

    @property
    def channels(self) -> int:
        """Number of latent channels of RGB, and as many of depth."""
        return int(self.vae.config.latent_channels)

    @property
    def spatial(self) -> int:
        """Factor of the compression in height and width."""
        return spatial_compression(self.vae)

    @property
    def temporal(self) -> int:
        """Factor of the compression in time."""
        return int(self.vae.config.temporal_compression_ratio)

    @property
    def image_scale(self) -> float:
        """Factor of the latents in the image condition.

        CogVideoX 1.5 was trained with image latents divided by the scaling factor (``invert_scale_latents``), all
        other models with image latents multiplied by it.
        """
        return float(self.vae.config.scaling_factor**-2) if self.vae.config.invert_scale_latents else 1.0

    @property
    def framewise(self) -> bool:
        """Whether the latents of a frame depend on that frame only."""
        return self.temporal == 1

    def fingerprint(self) -> str:
        """Return the SHA-256 of the VAE's weights and configuration, on which ``encode`` depends besides the clips.

        It is computed again only after a weight was changed or moved.
        """
        config = {name: value for name, value in self.vae.config.items() if not name.startswith("_")}
        settings, weights = json.dumps(config, sort_keys=True), sorted(self.vae.state_dict().items())
        state = (settings, *((tensor.data_ptr(), tensor._version, tensor.dtype) for _, tensor in weights))
        if self._fingerprint is None or self._fingerprint[0] != state:
            digest = hashlib.sha256(settings.encode())
            for name, tensor in weights:
                digest.update(f"{name} {tensor.dtype}".encode())
                digest.update(tensor.cpu().reshape(-1).view(torch.uint8).numpy())
            self._fingerprint = state, digest.hexdigest()
        return self._fingerprint[1]

    def images(
        self, rgb: UInt8[Tensor, "batch frame height width 3"], depth: Float[Tensor, "batch frame height width"]
    ) -> Float[Tensor, "stacked 3 frame height width"]:
        """Stack RGB clips, then depth clips as grey images, on the batch axis, with values in [-1, 1]."""
        color = rgb.permute(0, 4, 1, 2, 3).float() / 127.5 - 1
        filled = fill_missing(depth.float().flatten(0, 1)).unflatten(0, depth.shape[:2])
        grey = encode_depth(filled)[:, None].expand(-1, 3, -1, -1, -1)
        return torch.cat([color, grey])

    def encode(self, rgb: Tensor, depth: Tensor) -> Float[Tensor, "batch frame channel height width"]:
        """Encode clips to scaled latents of RGB and depth, concatenated on channels."""
        mean: Tensor = self.posterior(self.images(rgb, depth)).mode()
        color, grey = (mean * self.vae.config.scaling_factor).transpose(1, 2).chunk(2)
        return torch.cat([color, grey], dim=2)

    def decode_images(
        self, latents: Float[Tensor, "batch frame channel height width"], depth: bool = True
    ) -> tuple[Float[Tensor, "batch 3 frame height width"], Float[Tensor, "batch frame height width"]]:
        """Decode latents to colours, [-1, 1] and beyond, and to depth in metres, which is 0 without ``depth``."""
        parts = latents.chunk(2, dim=2)[: 2 if depth else 1]
        stacked = torch.cat(parts).transpose(1, 2) / self.vae.config.scaling_factor
        color, *grey = self.images_of(stacked).float().chunk(len(parts))
        return color, decode_depth(grey[0].mean(dim=1)) if depth else torch.zeros_like(color[:, 0])

    @torch.no_grad()
    def pixel_weights(self) -> Float[Tensor, " channel"]:
        """Return the squared change of decoded pixels by each channel about latents of zero; their mean is 1."""
        if self._pixel_weights is None:
            latents = torch.zeros(self.channels + 1, self.channels, 1, IMPULSE, IMPULSE, device=self.vae.device)
            latents[range(self.channels), range(self.channels), 0, IMPULSE // 2, IMPULSE // 2] = 1.0
            images = self.images_of(latents / self.vae.config.scaling_factor).float()
            changes = (images[:-1] - images[-1]).square().sum(dim=(1, 2, 3, 4))
            self._pixel_weights = changes / changes.mean()
        return self._pixel_weights

    def posterior(self, images: Float[Tensor, "stacked 3 frame height width"]) -> DiagonalGaussianDistribution:
        """Return the distribution of the unscaled latents ``[stacked, channel, latent_frame, rows, columns]``."""
        folded = fold_pixels(images, pixel_patch(self.vae)).to(self.vae.dtype)
        if not self.framewise:
            most = self.samples_at_once(self.vae.config.block_out_channels[0], folded.shape[-2:])
            return DiagonalGaussianDistribution(
                in_parts(lambda part: self.vae.encode(part).latent_dist.parameters, folded, most)
            )
        framewise = self.vae.encode(frames_to_batch(folded)).latent_dist
        return DiagonalGaussianDistribution(batch_to_frames(framewise.parameters, images.shape[2]))

    def samples_at_once(self, channels: int, size: Sequence[int]) -> int:
        """Return how many samples the VAE takes at once, so that diffusers does not split its convolutions in time.

        It splits inputs of more than ``MOST_VALUES`` values, and fails where a part is shorter than the kernel.

        Args:
            channels: largest number of input channels of a convolution at full size.
            size: full height and width in pixels of the VAE.
        """
        frames = 2 * self.temporal + 1 + 2  # the VAE codes together, with the kernel's past
        return max(1, MOST_VALUES // (channels * frames * math.prod(size)))

    def images_of(
        self, latents: Float[Tensor, "stacked channel latent_frame rows columns"]
    ) -> Float[Tensor, "stacked 3 frame height width"]:
        """Decode unscaled latents to images."""
        latents = latents.to(self.vae.dtype)
        if self.framewise:
            folded = batch_to_frames(self.vae.decode(frames_to_batch(latents)).sample, latents.shape[2])
        else:
            scale = self.spatial // pixel_patch(self.vae)
            size = [scale * side for side in latents.shape[-2:]]
            most = self.samples_at_once(max(self.vae.config.block_out_channels[:2]), size)
            folded = in_parts(lambda part: self.vae.decode(part).sample, latents, most)
        return unfold_pixels(folded, pixel_patch(self.vae))

    def loss(
        self,
        rgb: Tensor,
        depth: Tensor,
        window: tuple[int, int, int] | None,
        kl_weight: float,
        generators: list[torch.Generator],
    ) -> dict[str, Tensor]:
        """Return loss (mean absolute and squared error, and prior), prior and PSNR of clips, or a window of each."""
        if window:
            rgb, depth = self.windows(rgb, depth, window, generators)
        images = self.images(rgb, depth)
        posterior = self.posterior(images)
        shape = posterior.mean.shape[1:]
        noise = draw_noise((2, *shape), generators, images.device).transpose(0, 1).flatten(0, 1)
        decoded = self.images_of(posterior.mean + posterior.std * noise.to(posterior.mean))
        error = (decoded.float() - images).abs()
        reconstruction = error.mean() + error.square().mean()
        prior = posterior.kl().mean()
        psnr = -10 * torch.log10((error[: len(rgb)] / 2).square().mean())
        return {"loss": reconstruction + kl_weight * prior, "kl": prior, "psnr": psnr}

    def windows(
        self, rgb: Tensor, depth: Tensor, size: tuple[int, int, int], generators: list[torch.Generator]
    ) -> tuple[Tensor, Tensor]:
        """Cut a window of frames × height × width at a random place out of each clip.

        Raises:
            CheckpointError: when a window is larger than the clips.
        """
        room = [whole - part for whole, part in zip(depth.shape[1:], size, strict=True)]
        if min(room) < 0:
            raise CheckpointError(f"codec_window {size} is larger than the clips, {tuple(depth.shape[1:])}")
        corners = [[int(torch.randint(0, free + 1, (1,), generator=draw)) for free in room] for draw in generators]
        places = [tuple(slice(low, low + part) for low, part in zip(corner, size, strict=True)) for corner in corners]
        pairs = [(rgb[number][place], depth[number][place]) for number, place in enumerate(places)]
        return torch.stack([pair[0] for pair in pairs]), torch.stack([pair[1] for pair in pairs])

    @torch.no_grad()
    def measure_scale(self, rgb: Tensor, depth: Tensor) -> float:
        """Return one over the standard deviation of the clips' unscaled latents."""
        latents = self.encode(rgb, depth) / self.vae.config.scaling_factor
        return float(1 / latents.std().clamp_min(1e-6))

    def take_scale(self, clips: Iterable[tuple[Tensor, Tensor]]) -> None:
        """Set the scaling factor to the mean of ``measure_scale`` over batches of RGB and depth."""
        for module in self.vae.modules():
            if isinstance(module, SingleFrameConv):
                module._flat = None  # averaged weights are written through `.data`, which it cannot notice
        scales = [self.measure_scale(rgb, depth) for rgb, depth in clips]
        self.vae.register_to_config(scaling_factor=sum(scales) / len(scales))
