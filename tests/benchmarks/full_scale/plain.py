"""The baseline: the same model, training step and sampling loop written plainly on diffusers, without ``persist``."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from diffusers import CogVideoXDDIMScheduler, CogVideoXTransformer3DModel
from diffusers.models.embeddings import get_3d_rotary_pos_embed
from torch import Tensor

from tests.benchmarks.full_scale.shapes import Bench


class Plain:
    """diffusers' transformer with as many channels as RGB-D and cameras need, its VAE and its scheduler.

    It computes with the very blocks and the VAE of the model that it is compared with, so that both fit on one device.

    Args:
        bench: the model that it is compared with.
    """

    def __init__(self, bench: Bench) -> None:
        ours = bench.backbone.transformer
        config = dict(ours.base.config) | {
            "num_layers": 0, "in_channels": ours.in_channels, "out_channels": ours.out_channels,
        }  # fmt: skip
        with bench.built_on_device():
            self.transformer = CogVideoXTransformer3DModel.from_config(config)
        torch.nn.Module.to(self.transformer, bench.device, bench.precision)  # buffers; diffusers' own warns of nothing
        self.transformer.transformer_blocks = ours.base.transformer_blocks
        self.vae = bench.backbone.codec.vae
        self.scheduler = CogVideoXDDIMScheduler.from_config(bench.backbone.scheduler.config)
        self.scale = self.vae.config.scaling_factor
        self.prompt = bench.backbone.prompt
        self.precision, self.mixed = bench.precision, bench.mixed

    def rotary(self, latents: Tensor) -> tuple[Tensor, Tensor] | None:
        """Cosines and sines, for models with rotary positions."""
        config = self.transformer.config
        if not config.use_rotary_positional_embeddings:
            return None
        grid = latents.shape[-2] // config.patch_size, latents.shape[-1] // config.patch_size
        cosines, sines = get_3d_rotary_pos_embed(
            config.attention_head_dim, ((0, 0), grid), grid, latents.shape[1], device=latents.device
        )
        return cosines, sines

    def predict(self, latents: Tensor, timesteps: Tensor, rotary: Any) -> Tensor:
        """The velocity of noisy latents, with image and camera beside them on channels."""
        prompt = self.prompt.expand(len(latents), -1, -1)
        predicted: Tensor = self.transformer(
            latents, prompt, timesteps, image_rotary_emb=rotary, return_dict=False
        )[0]  # fmt: skip
        return predicted

    def step(self, batch: tuple[Tensor, Tensor, Tensor], optimizer: torch.optim.Optimizer, clip: float) -> float:
        """Take a training step on latents, image latents and camera latents; returns the loss."""
        latents, image, camera = batch
        noise = torch.randn_like(latents)
        timesteps = torch.randint(0, self.scheduler.config.num_train_timesteps, (len(latents),), device=latents.device)
        noisy = self.scheduler.add_noise(latents, noise, timesteps)
        target = self.scheduler.get_velocity(latents, noise, timesteps)
        with torch.autocast(latents.device.type, torch.bfloat16, enabled=self.mixed):
            predicted = self.predict(torch.cat([noisy, image, camera], dim=2), timesteps, self.rotary(latents))
        loss = F.mse_loss(predicted.float(), target.float())
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.transformer.parameters(), clip)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        return float(loss.detach())

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Latents of RGB and depth clips, stacked on the batch axis, concatenated on channels."""
        latents = self.vae.encode(images).latent_dist.mode() * self.scale
        return torch.cat(latents.transpose(1, 2).chunk(2), dim=2)

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """The clips of latents that ``encode`` gave, stacked, in 8 bits."""
        stacked = torch.cat(latents.chunk(2, dim=2)).transpose(1, 2) / self.scale
        decoded = self.vae.decode(stacked).sample
        return ((decoded.float() + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)

    @torch.no_grad()
    def generate(self, first: Tensor, camera: Tensor, steps: int) -> Tensor:
        """A clip by DDIM from the first frames of RGB and depth, ``[2, 3, 1, height, width]``, on the CPU."""
        first_latents = self.encode(first)
        later = first_latents.new_zeros(len(first_latents), camera.shape[1] - 1, *first_latents.shape[2:])
        image = torch.cat([first_latents, later], dim=1)
        latents, rotary = torch.randn_like(image), self.rotary(image)
        self.scheduler.set_timesteps(steps)
        for timestep in self.scheduler.timesteps:
            joined = torch.cat([latents, image, camera], dim=2)
            predicted = self.predict(joined, timestep.expand(len(latents)).to(latents.device), rotary)
            latents = self.scheduler.step(predicted, timestep, latents, return_dict=False)[0].to(self.precision)
        return self.decode(latents).cpu()


def share_moments(ours: Mapping[Any, Any], plain: MutableMapping[Any, Any], shared: Sequence[Tensor]) -> None:
    """Let the plain optimizer use our moments of the weights that both train, so that they are stored once."""
    for parameter in shared:
        if parameter in ours:
            plain[parameter] = ours[parameter]
