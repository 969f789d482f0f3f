"""RGB-D clips to latents and back: diffusers' CogVideoX VAE, for RGB and depth separately."""

from __future__ import annotations

import hashlib
import json

import torch
from diffusers import AutoencoderKLCogVideoX
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from persist_backbones.depth_code import decode_depth, encode_depth, fill_missing
from persist_cli.world.errors import CheckpointError


class Codec(nn.Module):
    """The VAE with the conversions around it.

    Depth goes through the same VAE as a grey image of its code (see ``depth_code``). Latents are the posterior's
    mean, times the scaling factor: in training, in the image condition and in sampling alike.

    Args:
        vae: diffusers' autoencoder.
    """

    def __init__(self, vae: AutoencoderKLCogVideoX) -> None:
        super().__init__()
        self.vae = vae

    @property
    def channels(self) -> int:
        """Latent channels of RGB, and of depth."""
        return int(self.vae.config.latent_channels)

    @property
    def spatial(self) -> int:
        """Compression in height and width."""
        return int(2 ** (len(self.vae.config.block_out_channels) - 1))

    @property
    def temporal(self) -> int:
        """Compression in time."""
        return int(self.vae.config.temporal_compression_ratio)

    def fingerprint(self) -> str:
        """SHA-256 of the VAE's weights and configuration: what ``encode`` depends on besides the clips."""
        config = {name: value for name, value in self.vae.config.items() if not name.startswith("_")}
        digest = hashlib.sha256(json.dumps(config, sort_keys=True).encode())
        for name, tensor in sorted(self.vae.state_dict().items()):
            digest.update(f"{name} {tensor.dtype}".encode())
            digest.update(tensor.cpu().reshape(-1).view(torch.uint8).numpy())
        return digest.hexdigest()

    def images(
        self, rgb: UInt8[Tensor, "batch frame height width 3"], depth: Float[Tensor, "batch frame height width"]
    ) -> Float[Tensor, "stacked 3 frame height width"]:
        """RGB clips, then depth clips, on the batch axis, in [-1, 1], on the codec's device."""
        rgb, depth = rgb.to(self.vae.device), depth.to(self.vae.device)
        color = rgb.permute(0, 4, 1, 2, 3).float() / 127.5 - 1
        filled = fill_missing(depth.float().flatten(0, 1)).unflatten(0, depth.shape[:2])
        grey = encode_depth(filled)[:, None].expand(-1, 3, -1, -1, -1)
        return torch.cat([color, grey])

    def encode(self, rgb: Tensor, depth: Tensor) -> Float[Tensor, "batch frame channel height width"]:
        """Scaled latents of RGB and depth, concatenated on channels."""
        mean: Tensor = self.vae.encode(self.images(rgb, depth)).latent_dist.mode()
        color, grey = (mean * self.vae.config.scaling_factor).transpose(1, 2).chunk(2)
        return torch.cat([color, grey], dim=2)

    def decode(self, latents: Float[Tensor, "batch frame channel height width"]) -> tuple[Tensor, Tensor]:
        """RGB uint8 ``[batch, frame, height, width, 3]`` and depth in metres of latents that ``encode`` gave."""
        stacked = torch.cat(latents.chunk(2, dim=2)).transpose(1, 2) / self.vae.config.scaling_factor
        color, grey = self.vae.decode(stacked).sample.float().chunk(2)
        rgb = ((color.permute(0, 2, 3, 4, 1) + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
        return rgb, decode_depth(grey.mean(dim=1))

    def loss(
        self, rgb: Tensor, depth: Tensor, kl_weight: float, generators: list[torch.Generator]
    ) -> dict[str, Tensor]:
        """Reconstruction error (mean absolute plus squared) and prior of a batch of clips."""
        images = self.images(rgb, depth)
        posterior = self.vae.encode(images).latent_dist
        shape = posterior.mean.shape[1:]
        noise = torch.stack([torch.randn(2, *shape, generator=each) for each in generators], dim=1).flatten(0, 1)
        sample = posterior.mean + posterior.std * noise.to(posterior.mean)
        decoded = self.vae.decode(sample).sample
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
