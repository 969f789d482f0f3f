"""The backbone ``cogvideox``: CogVideoX that predicts RGB-D from cameras, interactions and memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from persist_backbones.adapters.base import Adapter, PreparedMemory, memory_of
from persist_backbones.adapters.forms import load_adapter, make_adapter, save_adapter
from persist_backbones.cogvideox.build import check_fit, starting_parts, video_shape, widen
from persist_backbones.cogvideox.checkpoint import load_whole, save_change, save_whole
from persist_backbones.cogvideox.codec import Codec
from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.diffusion import (
    SAMPLERS,
    check_sampling,
    denoise,
    draw_timesteps,
    generators_of,
    loss_weights,
    make_denoiser,
    noise_like,
    predicted_target,
    squared_error,
)
from persist_backbones.cogvideox.inputs import (
    camera_latents,
    camera_tokens,
    clip_shape,
    interaction_rows,
    model_input,
    rotary_positions,
)
from persist_backbones.cogvideox.model import Conditions
from persist_backbones.cogvideox.parameter_groups import group_parameters, truncate_layers
from persist_backbones.cogvideox.pretrained import DiffusersParts, origin_of
from persist_backbones.cogvideox.prompt import ORIGINS, starting_prompt
from persist_backbones.extensions.lora import add_lora, train_lora
from persist_backbones.extensions.savings import FrozenWeights, apply_memory_savings
from persist_cli.api.backbone import Backbone, Clips, Sampling
from persist_cli.api.inference import InferenceOptions
from persist_cli.api.stages import Lora, MemorySavings, ParameterGroup, Stage
from persist_cli.errors import CheckpointError

if TYPE_CHECKING:
    from persist_backbones.pipeline.pipeline import WorldPipeline


class CogVideoX(Backbone):
    """diffusers' CogVideoX image-to-video, widened to RGB-D, cameras, interactions and memory (PEWM).

    Args:
        settings: preset or pretrained directory, and sizes.
    """

    settings_type = CogVideoXSettings
    sharded_blocks = ("CogVideoXBlock", "MemoryBlock", "CanvasBlock")
    never_sharded = ("codec",)
    settings: CogVideoXSettings
    prompt: Tensor

    def __init__(self, settings: CogVideoXSettings) -> None:
        super().__init__(settings)
        self.adapters = nn.ModuleDict()
        self.adapter_name: str | None = None
        self.offloaded: WorldPipeline | None = None
        self.frozen = FrozenWeights(self, None)
        self.set_parts(starting_parts(settings))
        self.prompt = starting_prompt(settings, self.prompt)

    def set_parts(self, parts: DiffusersParts) -> None:
        """Build the model around diffusers' parts; what is new starts at zero."""
        check_fit(parts, self.settings)
        self.codec = Codec(parts.vae)
        self.transformer = widen(parts, self.settings)
        self.scheduler = parts.scheduler
        self.shape = clip_shape(parts.transformer, parts.vae, self.settings)
        config = parts.transformer.config
        self.register_buffer("prompt", torch.zeros(1, config.max_text_seq_length, config.text_embed_dim))

    @property
    def device(self) -> torch.device:
        """Where the conditions are, wherever weights rest that are not in use."""
        return self.prompt.device

    @property
    def frames_per_clip(self) -> int:
        """Frames of a clip, the given first one included."""
        return self.settings.frames

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.settings.height, self.settings.width

    @property
    def samplers(self) -> tuple[str, ...]:
        """Those of diffusers that keep to the noise levels of training."""
        return tuple(SAMPLERS)

    def check_sampling(self, sampling: Sampling) -> None:
        """Raise ``PersistError`` also for more steps than the training has noise levels."""
        super().check_sampling(sampling)
        check_sampling(self.scheduler, sampling.sampler, sampling.steps)

    @property
    def gives_depth(self) -> bool:
        """What the settings say."""
        return self.settings.depth

    def prepare_inference(self, placement: InferenceOptions) -> None:
        """Get ready to sample, as diffusers' pipelines do; weights that are offloaded rest on the CPU between clips."""
        from persist_backbones.extensions.offload import place  # a pipeline is made around this class

        self.offloaded = place(self, placement, placement.device())

    @property
    def adapter(self) -> Adapter[Any] | None:
        """The memory adapter in use."""
        return None if self.adapter_name is None else self.adapters[self.adapter_name]  # type: ignore[return-value]

    @property
    def token_budget(self) -> int:
        """Tokens that the adapter in use asks for; none without one."""
        return self.adapter.settings.token_budget if self.adapter else 0

    def parameter_groups(self) -> list[ParameterGroup]:
        """VAE, transformer, what widens it, and memory adapters."""
        return group_parameters(self.named_parameters())

    def truncate_layers(self, groups: int) -> float:
        """Keep the first transformer blocks, with the adapter's."""
        return truncate_layers(self.transformer.base.transformer_blocks, self.adapter, groups)

    def trained_parameters(self, stage: Stage) -> dict[str, nn.Parameter]:
        """The VAE's, the transformer's, or the adapter's, everything else frozen."""
        self.requires_grad_(False)
        modules: dict[Stage, nn.Module | None] = {"codec": self.codec, "1": self.transformer, "2": self.adapter}
        module = modules[stage]
        if module is None:
            raise CheckpointError("stage 2 trains a memory adapter; add one first")
        module.requires_grad_(True)
        if stage == "1":
            train_lora(self.transformer.base)
        return {name: each for name, each in self.named_parameters() if each.requires_grad}

    def apply_memory_savings(self, stage: Stage, savings: MemorySavings) -> None:
        """As asked; exact values of frozen weights are kept where the stage saves them."""
        self.frozen = apply_memory_savings(self, stage, savings)

    def forward(self, clips: Clips, stage: Stage) -> dict[str, Tensor]:
        """The codec's loss, or that of denoising RGB and depth latents."""
        generators = generators_of(clips.seeds)
        if stage == "codec":
            window, weight = self.settings.codec_window, self.settings.kl_weight
            return self.codec.loss(clips.rgb, clips.depth, window, weight, generators)
        kept = self.encode(clips) if clips.latents is None else clips.latents
        latents, first = (kept, kept[:, :1]) if self.framewise else (kept[:, :-1], kept[:, -1:])
        latents, image = self.shape.pad(latents), self.image_condition(first)
        timesteps = draw_timesteps(self.scheduler, generators).to(latents.device)
        noise = noise_like(latents, generators)
        target = predicted_target(self.scheduler, latents, noise, timesteps)
        noisy = self.scheduler.add_noise(latents, noise, timesteps)
        memory = self.prepare_memory(clips)
        if memory is not None and self.adapter is not None:
            memory = self.adapter.dropped(memory, generators)
        predicted = self.predict(noisy, image, self.conditions(clips, timesteps, memory))
        weights = loss_weights(self.scheduler, timesteps, self.settings.weighting, self.settings.snr_gamma)
        return squared_error(predicted, target, weights, self.settings.depth)

    def encodes(self, stage: Stage) -> bool:
        """In all stages but the codec's own."""
        return stage != "codec"

    def encoding(self) -> str:
        """The codec's fingerprint."""
        return self.codec.fingerprint()

    @property
    def framewise(self) -> bool:
        """The codec's."""
        return self.codec.framewise

    @torch.no_grad()
    def encode(self, clips: Clips) -> Float[Tensor, "batch frame channel height width"]:
        """Latents of the clips, behind them those of the first image alone where the first latent frame is not that."""
        whole = self.codec.encode(clips.rgb, clips.depth)
        if self.framewise:
            return whole
        return torch.cat([whole, self.codec.encode(clips.rgb[:, :1], clips.depth[:, :1])], dim=1)

    @torch.no_grad()
    def generate(self, first: Clips, sampling: Sampling) -> tuple[Tensor, Tensor]:
        """Clips denoised from each sample's own noise; the first frame is the given one."""
        self.check_sampling(sampling)
        generators = generators_of(first.seeds)
        image = self.encode_first(first).expand(len(generators), -1, -1, -1, -1)
        predict = make_denoiser(self, first, image, lambda: sampling.memory_guidance)
        noise = noise_like(image, generators)
        latents = denoise(predict, noise, self.scheduler.config, sampling.sampler, sampling.steps, generators)
        self.transformer.reset_cache()
        rgb, depth = self.codec.decode(self.shape.drop_padding(latents), self.settings.depth)
        if self.offloaded is not None:
            self.offloaded.maybe_free_model_hooks()
        rgb[:, 0], depth[:, 0] = first.rgb[:, 0], first.depth[:, 0]
        return rgb, depth

    @torch.no_grad()
    def reconstruct(self, clips: Clips) -> tuple[Tensor, Tensor]:
        """RGB and depth after encoding and decoding; no depth (0) from a model without."""
        return self.codec.decode(self.codec.encode(clips.rgb, clips.depth), self.settings.depth)

    def encode_first(self, clips: Clips) -> Float[Tensor, "batch frame channel height width"]:
        """The image condition of the clips' first frames, float32 whatever precision the model computes in."""
        return self.image_condition(self.codec.encode(clips.rgb[:, :1], clips.depth[:, :1]).float())

    def image_condition(self, first: Float[Tensor, "batch 1 channel height width"]) -> Tensor:
        """Latents of the first frame alone as the model takes them, followed by zeros for all other latent frames."""
        return self.shape.image_condition(first if self.codec.image_scale == 1 else first * self.codec.image_scale)

    def prepare_memory(self, clips: Clips) -> PreparedMemory | None:
        """The batch's tokens embedded by the adapter in use, ``None`` without adapter."""
        if self.adapter is None:
            return None
        prepared: PreparedMemory = memory_of(self.adapter, f"adapter {self.adapter_name!r}", clips, self.device)
        return prepared

    def conditions(self, clips: Clips, timesteps: Tensor, memory: PreparedMemory | None) -> Conditions:
        """Prompt, interactions, cameras and memory of a batch."""
        steps = self.settings.frames - 1
        return Conditions(
            text=self.prompt.expand(len(clips.seeds), -1, -1),
            timestep=timesteps,
            interactions=interaction_rows(clips.interactions, self.settings.interactions, steps).to(self.device),
            camera=self.camera_latents(clips),
            rotary=rotary_positions(self.transformer.base.config, self.shape.tokens, self.device),
            memory=memory,
        )

    def camera_latents(self, clips: Clips) -> Float[Tensor, "batch frame channel height width"]:
        """Plücker rays at the latents' size."""
        cameras, printed = clips.cameras.to(self.device), self.settings.rays == "printed"
        return camera_latents(cameras, self.codec.spatial, self.codec.temporal, printed, self.shape.token_frames)

    def predict(self, noisy: Tensor, image: Tensor, given: Conditions) -> Tensor:
        """What the objective asks for."""
        latents = model_input(noisy, image, given.camera, self.settings.depth)
        seen = camera_tokens(given.camera, self.shape.patch, self.shape.token_frames)
        given = dataclasses.replace(given, camera=seen)
        predicted: Tensor = self.transformer(latents, given, self.adapter)
        return predicted

    def finish_stage(self, stage: Stage, clips: Iterable[Clips]) -> None:
        """After the codec's stage, measure the scale of its latents on these clips."""
        if stage == "codec":
            self.codec.take_scale((each.rgb, each.depth) for each in clips)

    def add_adapter(self, name: str, channels: int, settings: Mapping[str, Any]) -> None:
        """Add a fresh memory adapter and use it."""
        shape = video_shape(self.transformer, self.codec)
        self._take_adapter(name, make_adapter(channels, settings, shape, f"adapter {name!r}"))

    def use_adapter(self, name: str | None) -> None:
        """Use one of the adapters, or none: plain stage 1."""
        if name is not None and name not in self.adapters:
            raise CheckpointError(f"no memory adapter {name!r}; there are: {', '.join(self.adapters) or 'none'}")
        self.adapter_name = name

    def checkpoint_settings(self) -> dict[str, Any]:
        """The settings without where the weights and the prompt once came from, and with what they predict."""
        predicts = self.scheduler.config.prediction_type
        return super().checkpoint_settings() | dict.fromkeys(ORIGINS) | {"prediction": predicts}

    def save_base(self, folder: Path) -> None:
        """Write diffusers' parts, each loadable by diffusers alone, and ``world.safetensors`` with what is ours."""
        save_whole(self, folder)

    def load_base(self, folder: Path) -> None:
        """Take diffusers' parts and ours from a folder that ``save_base`` or ``save_lora`` wrote."""
        load_whole(self, folder)

    def origin(self) -> dict[str, Any]:
        """The pretrained directory, wherever one stands."""
        return origin_of(self.settings.pretrained)

    def add_lora(self, lora: Lora) -> None:
        """PEFT's layers in the transformer; what of it is new trains whole."""
        add_lora(self.transformer.base, lora)

    def save_lora(self, folder: Path) -> None:
        """Write LoRA as diffusers' pipelines load it, and ``world.safetensors`` with what is ours."""
        save_change(self, folder)

    def save_adapter(self, folder: Path) -> None:
        """Write the adapter in use."""
        if self.adapter is None:
            raise CheckpointError("no memory adapter is in use, so none can be saved")
        save_adapter(self.adapter, folder)

    def load_adapter(self, name: str, folder: Path) -> None:
        """Add the adapter that ``save_adapter`` wrote, and use it."""
        self._take_adapter(name, load_adapter(folder, video_shape(self.transformer, self.codec)))

    def _take_adapter(self, name: str, adapter: Adapter[Any]) -> None:
        self.adapters[name] = adapter.to(self.device)
        self.adapter_name = name
