"""RGB-D clips to latents and back: diffusers' CogVideoX VAE, for RGB and depth separately."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Sequence

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKLCogVideoX
from diffusers.models.autoencoders.autoencoder_kl_cogvideox import CogVideoXCausalConv3d, CogVideoXSafeConv3d
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from persist_cli.errors import CheckpointError

HALF_RANGE = 2.0  # metres that map to 0

NEAREST = 0.05  # metres; anything decoded nearer is missing


def encode_depth(depth: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Metres to [-1, 1); 0 m, missing, is -1."""
    return (depth - HALF_RANGE) / (depth + HALF_RANGE)


def decode_depth(code: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """[-1, 1) to metres, the inverse of ``encode_depth``; values under 5 cm are missing, 0."""
    code = code.clamp(-1.0, 0.998)
    depth = HALF_RANGE * (1 + code) / (1 - code)
    return torch.where(depth < NEAREST, torch.zeros_like(depth), depth)


def fill_missing(depth: Float[Tensor, "frame height width"]) -> Float[Tensor, "frame height width"]:
    """Depth whose holes (0) hold the mean of what is near, coarse to fine; a frame without any depth stays 0.

    A hole's border would otherwise be decoded as points that float between the surface and the camera.
    """
    known = (depth > 0).to(depth.dtype)
    if bool(known.all()):
        return depth
    return torch.where(known > 0, depth, _push_pull(depth * known, known))


def _push_pull(total: Tensor, weight: Tensor) -> Tensor:
    """Mean of known values at every pixel, from the finest scale that knows any (Gortler et al., push-pull)."""
    mean = total / weight.clamp_min(1e-6)
    height, width = total.shape[-2:]
    if height == 1 and width == 1:
        return mean
    pooled = (F.avg_pool2d(part[:, None], 2, ceil_mode=True)[:, 0] for part in (total, weight))
    coarse = F.interpolate(_push_pull(*pooled)[:, None], size=(height, width), mode="bilinear")[:, 0]
    return torch.where(weight > 0, mean, coarse)


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


def make_framewise(vae: AutoencoderKLCogVideoX) -> None:
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


WHOLE = 2**30  # values, as CogVideoXSafeConv3d has it


def pixel_patch(vae: AutoencoderKLCogVideoX) -> int:
    """Edge of the square of pixels that is folded into the VAE's input channels, 1 for CogVideoX's own."""
    return max(1, math.isqrt(vae.config.in_channels // 3))


def spatial_compression(vae: AutoencoderKLCogVideoX) -> int:
    """Pixels along the edge of a latent pixel."""
    return pixel_patch(vae) * int(2 ** (len(vae.config.block_out_channels) - 1))


def check_vae(vae: AutoencoderKLCogVideoX) -> None:
    """Raise ``CheckpointError`` when a VAE does not take and give RGB, or compresses otherwise than it says."""
    config, patch = vae.config, pixel_patch(vae)
    if not config.in_channels == config.out_channels == 3 * patch**2:
        raise CheckpointError(
            f"a VAE of {config.in_channels} input and {config.out_channels} output channels; both must be 3 p², RGB "
            "with p×p pixels folded"
        )
    stages = [len(each) for each in (config.block_out_channels, config.down_block_types, config.up_block_types)]
    if len(set(stages)) > 1:
        raise CheckpointError(f"a VAE of {stages[0]} block_out_channels, {stages[1]} down and {stages[2]} up blocks")
    ratios = [2**halvings for halvings in range(stages[0])]
    if config.temporal_compression_ratio not in ratios:
        raise CheckpointError(
            f"a VAE of {stages[0]} blocks cannot compress time by {config.temporal_compression_ratio}, only by "
            f"{', '.join(map(str, ratios))}"
        )


def in_parts(run: Callable[[Tensor], Tensor], samples: Tensor, most: int) -> Tensor:
    """What becomes of samples, so many at a time."""
    return run(samples) if len(samples) <= most else torch.cat([run(part) for part in samples.split(most)])


def fold_pixels(
    videos: Float[Tensor, "batch channel frame height width"], patch: int
) -> Float[Tensor, "batch folded frame rows columns"]:
    """Squares of pixels folded into channels."""
    return F.pixel_unshuffle(videos.transpose(1, 2), patch).transpose(1, 2)


def unfold_pixels(
    videos: Float[Tensor, "batch folded frame rows columns"], patch: int
) -> Float[Tensor, "batch channel frame height width"]:
    """The pixels that ``fold_pixels`` folded."""
    return F.pixel_shuffle(videos.transpose(1, 2), patch).transpose(1, 2)


def to_uint8(
    colors: Float[Tensor, "batch 3 frame height width"],
) -> UInt8[Tensor, "batch frame height width 3"]:
    """RGB frames of colours in [-1, 1]; what is beyond is clipped."""
    return ((colors.permute(0, 2, 3, 4, 1) + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)


class Codec(nn.Module):
    """The VAE with the conversions around it.

    Depth goes through the same VAE as a grey image of its code (see ``depth_code``). Latents are the posterior's
    mean, times the scaling factor, in training and in sampling alike; in the image condition times ``image_scale`` too.

    A VAE that does not compress time (``temporal_compression_ratio`` 1) codes every frame alone. One of 3 p² input
    channels sees p×p pixels folded into channels, which costs a small codec far less than convolutions at full size.

    Args:
        vae: diffusers' autoencoder.

    Raises:
        CheckpointError: for a VAE that is none of RGB, or compresses otherwise than it says.
    """

    def __init__(self, vae: AutoencoderKLCogVideoX) -> None:
        super().__init__()
        check_vae(vae)
        self.vae = vae
        self._fingerprint: tuple[object, str] | None = None  # with what tells whether it still holds
        if self.framewise:
            make_framewise(vae)

    @property
    def channels(self) -> int:
        """Latent channels of RGB, and of depth."""
        return int(self.vae.config.latent_channels)

    @property
    def spatial(self) -> int:
        """Compression in height and width."""
        return spatial_compression(self.vae)

    @property
    def temporal(self) -> int:
        """Compression in time."""
        return int(self.vae.config.temporal_compression_ratio)

    @property
    def image_scale(self) -> float:
        """What latents are multiplied by where they are the image condition.

        CogVideoX 1.5 was trained with image latents divided by the scaling factor (``invert_scale_latents``), all
        others with image latents as any.
        """
        return float(self.vae.config.scaling_factor**-2) if self.vae.config.invert_scale_latents else 1.0

    @property
    def framewise(self) -> bool:
        """Whether the latents of a frame depend on that frame only."""
        return self.temporal == 1

    def fingerprint(self) -> str:
        """SHA-256 of the VAE's weights and configuration: what ``encode`` depends on besides the clips.

        Computed again only when one of them was changed or moved.
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
        """RGB clips, then depth clips, on the batch axis, in [-1, 1]."""
        color = rgb.permute(0, 4, 1, 2, 3).float() / 127.5 - 1
        filled = fill_missing(depth.float().flatten(0, 1)).unflatten(0, depth.shape[:2])
        grey = encode_depth(filled)[:, None].expand(-1, 3, -1, -1, -1)
        return torch.cat([color, grey])

    def encode(self, rgb: Tensor, depth: Tensor) -> Float[Tensor, "batch frame channel height width"]:
        """Scaled latents of RGB and depth, concatenated on channels."""
        mean: Tensor = self.posterior(self.images(rgb, depth)).mode()
        color, grey = (mean * self.vae.config.scaling_factor).transpose(1, 2).chunk(2)
        return torch.cat([color, grey], dim=2)

    def decode_images(
        self, latents: Float[Tensor, "batch frame channel height width"], depth: bool = True
    ) -> tuple[Float[Tensor, "batch 3 frame height width"], Float[Tensor, "batch frame height width"]]:
        """Colours, [-1, 1] and beyond, and depth in metres; without ``depth`` none (0), and none is decoded."""
        parts = latents.chunk(2, dim=2)[: 2 if depth else 1]
        stacked = torch.cat(parts).transpose(1, 2) / self.vae.config.scaling_factor
        color, *grey = self.images_of(stacked).float().chunk(len(parts))
        return color, decode_depth(grey[0].mean(dim=1)) if depth else torch.zeros_like(color[:, 0])

    def posterior(self, images: Float[Tensor, "stacked 3 frame height width"]) -> DiagonalGaussianDistribution:
        """Distribution of the unscaled latents ``[stacked, channel, latent_frame, rows, columns]``."""
        folded = fold_pixels(images, pixel_patch(self.vae)).to(self.vae.dtype)
        if not self.framewise:
            most = self.samples_at_once(self.vae.config.block_out_channels[0], folded.shape[-2:])
            return DiagonalGaussianDistribution(
                in_parts(lambda part: self.vae.encode(part).latent_dist.parameters, folded, most)
            )
        found = self.vae.encode(frames_to_batch(folded)).latent_dist
        return DiagonalGaussianDistribution(batch_to_frames(found.parameters, images.shape[2]))

    def samples_at_once(self, channels: int, size: Sequence[int]) -> int:
        """How many samples go through the VAE together, so that diffusers does not split its convolutions in time.

        It splits those whose input has more than ``WHOLE`` values, and fails where a part is shorter than the kernel.

        Args:
            channels: most that a convolution at full size takes.
            size: the full height and width, as the VAE sees them.
        """
        frames = 2 * self.temporal + 1 + 2  # that it codes at once, and the kernel's past
        return max(1, WHOLE // (channels * frames * math.prod(size)))

    def images_of(
        self, latents: Float[Tensor, "stacked channel latent_frame rows columns"]
    ) -> Float[Tensor, "stacked 3 frame height width"]:
        """The images of unscaled latents."""
        latents = latents.to(self.vae.dtype)
        if self.framewise:
            folded = batch_to_frames(self.vae.decode(frames_to_batch(latents)).sample, latents.shape[2])
        else:
            larger = self.spatial // pixel_patch(self.vae)
            size = [larger * each for each in latents.shape[-2:]]
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
        """Reconstruction error (mean absolute plus squared) and prior of a batch of clips, or of a window of each."""
        if window:
            rgb, depth = self.windows(rgb, depth, window, generators)
        images = self.images(rgb, depth)
        posterior = self.posterior(images)
        shape = posterior.mean.shape[1:]
        noise = torch.stack([torch.randn(2, *shape, generator=each) for each in generators], dim=1).flatten(0, 1)
        decoded = self.images_of(posterior.mean + posterior.std * noise.to(posterior.mean))
        error = (decoded.float() - images).abs()
        reconstruction = error.mean() + error.square().mean()
        prior = posterior.kl().mean()
        psnr = -10 * torch.log10((error[: len(rgb)] / 2).square().mean())
        return {"loss": reconstruction + kl_weight * prior, "kl": prior, "psnr": psnr}

    def windows(
        self, rgb: Tensor, depth: Tensor, size: tuple[int, int, int], generators: list[torch.Generator]
    ) -> tuple[Tensor, Tensor]:
        """A window of frames × height × width at a random place of each clip.

        Raises:
            CheckpointError: when a window is larger than the clips.
        """
        room = [whole - part for whole, part in zip(depth.shape[1:], size, strict=True)]
        if min(room) < 0:
            raise CheckpointError(f"codec_window {size} is larger than the clips, {tuple(depth.shape[1:])}")
        corners = [[int(torch.randint(0, free + 1, (1,), generator=each)) for free in room] for each in generators]
        places = [tuple(slice(low, low + part) for low, part in zip(corner, size, strict=True)) for corner in corners]
        pairs = [(rgb[number][place], depth[number][place]) for number, place in enumerate(places)]
        return torch.stack([pair[0] for pair in pairs]), torch.stack([pair[1] for pair in pairs])

    @torch.no_grad()
    def measure_scale(self, rgb: Tensor, depth: Tensor) -> float:
        """One over the standard deviation of the unscaled latents of these clips."""
        latents = self.encode(rgb, depth) / self.vae.config.scaling_factor
        return float(1 / latents.std().clamp_min(1e-6))

    def take_scale(self, clips: Iterable[tuple[Tensor, Tensor]]) -> None:
        """Scale latents from now on by the mean of what is measured on these clips of RGB and depth."""
        scales = [self.measure_scale(rgb, depth) for rgb, depth in clips]
        self.vae.register_to_config(scaling_factor=sum(scales) / len(scales))
