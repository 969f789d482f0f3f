"""The backbone ``cogvideox``: CogVideoX that predicts RGB-D from cameras, interactions and memory.

Start reading here: ``forward`` is the training loss, ``sample`` the sampling loop, ``predict`` one prediction.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from persist_backbones.adapters.base import AdapterCondition, MemoryCondition, VideoShape
from persist_backbones.adapters.forms import trained_noise
from persist_backbones.cogvideox.adapted import AdaptedBackbone
from persist_backbones.cogvideox.codec import Codec, frames_to_batch, to_uint8
from persist_backbones.cogvideox.codec_start import start_as_components
from persist_backbones.cogvideox.config import LOSS_SETTINGS, CogVideoXSettings
from persist_backbones.cogvideox.diffusion import (
    SAMPLERS,
    DrawTimesteps,
    NoisedClips,
    NoisedPrediction,
    SamplingSchedule,
    SamplingStep,
    check_steps,
    draw_timesteps,
    loss_parts,
    loss_weights,
    noise_level,
    noise_like,
    prediction_target,
    sample_generators,
)
from persist_backbones.cogvideox.given_view import views_of_given
from persist_backbones.cogvideox.inputs import (
    ClipShape,
    camera_latents,
    check_clip_frames,
    check_fit,
    clip_shape,
    fit_positions,
    interaction_rows,
    rotary_grid,
    rotary_positions,
)
from persist_backbones.cogvideox.model import NO_MEMORY, Conditions, widen
from persist_backbones.cogvideox.parameter_groups import group_parameters, truncate_layers
from persist_backbones.cogvideox.parts import (
    WORLD,
    DiffusersParts,
    load_part,
    load_parts,
    load_world,
    merge_lora,
    origin_of,
    save_parts,
    save_world,
    starting_parts,
)
from persist_backbones.cogvideox.prompt import ORIGINS, starting_prompt
from persist_backbones.noise_levels import add_level, draw_levels
from persist_cli.api.backbone import Clips, Sampling
from persist_cli.api.checkpoint import lora_base
from persist_cli.api.clips import ClipLatents
from persist_cli.api.inference import CONSISTENCY
from persist_cli.api.stages import ParameterGroup, Stage
from persist_cli.errors import CheckpointError


class CogVideoX(AdaptedBackbone):
    """diffusers' CogVideoX image-to-video, widened to RGB-D, cameras, interactions and memory (PEWM).

    Args:
        settings: the preset or pretrained directory, and sizes.
    """

    settings_type = CogVideoXSettings
    sharded_blocks = ("CogVideoXBlock", "MemoryBlock", "CanvasBlock")
    never_sharded = ("codec",)
    built_by = ("transformer", "prediction", "vae", "pretrained")
    of_weights = ("rotary_grid", "prompt")
    video_model = ("transformer", WORLD)
    for_training = LOSS_SETTINGS
    settings: CogVideoXSettings
    prompt: Tensor

    def __init__(self, settings: CogVideoXSettings) -> None:
        super().__init__(settings)
        self.current_timestep: Tensor | None = None  # of the prediction, while clips are sampled
        self.set_parts(starting_parts(settings))
        self.prompt = starting_prompt(settings, self.prompt)

    def set_parts(self, parts: DiffusersParts) -> None:
        """Build the model from diffusers' parts; the weights that widen them start at zero."""
        self.codec, self.scheduler = Codec(parts.vae), parts.scheduler
        check_fit(parts, self.settings)
        self.shape = clip_shape(parts.transformer, parts.vae, self.settings)
        self.rotary_grid = self.settings.rotary_grid or rotary_grid(parts.transformer.config)
        fit_positions(parts.transformer, (self.shape.padded_frames, self.shape.height, self.shape.width))
        self.transformer = widen(parts.transformer, parts.vae, self.settings, self.shape)
        config = parts.transformer.config
        self.register_buffer("prompt", torch.zeros(1, config.max_text_seq_length, config.text_embed_dim))

    def forward(self, clips: Clips, stage: Stage) -> dict[str, Tensor]:
        """Return the training loss: of the codec, or of denoising RGB and depth latents (stages 1 and 2)."""
        generators, clips = sample_generators(clips.seeds), clips.to(self.device)
        if stage == "codec":
            window, kl_weight = self.settings.codec_window, self.settings.kl_weight
            return self.codec.loss(clips.rgb, clips.depth, window, kl_weight, generators)

        return loss_parts(self.weighted_error(self.predict_noised(clips, generators)), self.settings.depth)

    def weighted_error(self, prediction: NoisedPrediction) -> Float[Tensor, "batch frame channel height width"]:
        """Return the squared error of a prediction of training, weighted by noise level and channel."""
        levels = prediction.noised.timesteps
        weights = loss_weights(self.scheduler, levels, self.settings.weighting, self.settings.snr_gamma)
        error = (prediction.predicted.float() - prediction.target.float()).square()
        return error * weights[:, None, None, None, None] * self.channel_weights()

    def channel_weights(self) -> Float[Tensor, "channel 1 1"]:
        """Return the weight of the error of each channel of latents of RGB and depth; their mean is 1."""
        if self.settings.channel_weights == "equal":
            return torch.ones(2 * self.codec.channels, 1, 1, device=self.device)
        weights = self.codec.pixel_weights()
        if self.settings.channel_weights == "root-pixels":
            weights = weights.sqrt() / weights.sqrt().mean()
        return weights.repeat(2)[:, None, None].to(self.device)

    def predict_noised(
        self, clips: Clips, generators: list[torch.Generator], draw: DrawTimesteps | None = None
    ) -> NoisedPrediction:
        """Predict from the clips' latents with noise of a random level; the arguments are those of ``add_noise``."""
        noised = self.add_noise(clips, generators, draw or partial(draw_timesteps, self.scheduler))
        target = prediction_target(self.scheduler, noised.clean, noised.noise, noised.timesteps)
        # condition
        memory = self.memory_condition(clips, generators)
        conditions = self.conditions(clips, noised.timesteps, memory, noised.image_noise)
        # predict
        with self.transformer.kernel_for_training(noised.noisy):
            predicted = self.predict(noised.noisy.to(noised.image.dtype), noised.image, conditions)
        return NoisedPrediction(predicted, target, noised)

    def add_noise(self, clips: Clips, generators: list[torch.Generator], draw: DrawTimesteps) -> NoisedClips:
        """Add noise to the clips' latents, each sample's from its own generator; ``draw`` draws the timesteps."""
        latents = clips.latents or self.encode(clips)
        image_noise = draw_levels(generators, self.settings.image_noise)
        shape, known = self.shape.of(clips), self.known_latents(latents.image, clips)
        if image_noise.any():
            known = add_level(known, image_noise, generators) * known.any(dim=2, keepdim=True)
        image = self.image_condition(known, shape)
        clean = shape.pad(latents.video).float()  # in bfloat16 the weakest noise levels would have no noise
        timesteps = draw(generators).to(self.device)
        noise = noise_like(clean, generators)
        noisy = self.scheduler.add_noise(clean, noise, timesteps)
        return NoisedClips(clean, noise, noisy, timesteps, image, image_noise)

    @torch.no_grad()
    def predict_once(self, clips: Clips, draw: DrawTimesteps | None = None) -> tuple[Tensor, Tensor]:
        """Return the clips as predicted in one step from the noise levels of training, or others; see ``Backbone``."""
        generators, clips = sample_generators(clips.seeds), clips.to(self.device)
        shown = self.shape.of(clips).drop_padding(self.predict_noised(clips, generators, draw).clean(self.scheduler))
        colors, depth = self.codec.decode_images(shown, self.settings.depth)
        return to_uint8(colors).cpu(), depth.float().cpu()

    @torch.no_grad()
    def sample(
        self,
        first: Clips,
        sampling: Sampling,
        on_step: Callable[[SamplingStep], None] | None = None,
        generators: list[torch.Generator] | None = None,
        noise: Tensor | None = None,
    ) -> Float[Tensor, "batch frame channel height width"]:
        """Denoise latents of clips from noise, including the frames that ``ClipShape.pad`` puts in front.

        Args:
            first: clips whose first frame is known, as for ``generate``.
            sampling: steps, sampler and guidance.
            on_step: function that is called after each step.
            generators: generators of the noise, one a sample; by default with the clips' seeds.
            noise: latents to begin with; by default drawn from the generators.
        """
        self.check_sampling(sampling)
        first = first.to(self.device)
        generators = generators or sample_generators(first.seeds)
        image = self.encode_first(first).expand(len(first.seeds), -1, -1, -1, -1)
        latents = noise_like(image, generators) if noise is None else noise.to(image)
        schedule = SamplingSchedule(self.scheduler.config, sampling.sampler, sampling.steps, generators)
        unset = torch.zeros(len(first.seeds), dtype=torch.long)
        declared = torch.full((len(first.seeds),), sampling.context_noise)
        memory = self.memory_condition(first, level=declared)
        conditions = self.conditions(first, unset, memory, declared.clamp(max=self.settings.image_noise))
        guidance = sampling.memory_guidance
        for number, timestep in enumerate(schedule.timesteps):
            self.current_timestep = timestep
            timesteps = timestep.expand(len(latents)).to(self.device)
            level = noise_level(self.scheduler, timesteps)
            conditions = dataclasses.replace(conditions, timestep=timesteps, level=level)
            predicted = self.predict_guided(latents, image, conditions, guidance)
            latents = schedule.step(predicted, timestep, latents)
            if on_step is not None:
                step = SamplingStep(number, timestep, latents, guidance)
                on_step(step)
                latents, guidance = step.latents, step.guidance
                if step.stop:
                    break
        self.current_timestep = None
        return latents

    def predict_guided(self, noisy: Tensor, image: Tensor, conditions: Conditions, guidance: float) -> Tensor:
        """Predict with classifier-free guidance over memory, in the latents' precision."""
        precision = self.prompt.dtype
        low, image = noisy.to(precision), image.to(precision)
        predicted = self.predict(low, image, conditions).to(noisy.dtype)
        if guidance == 1.0 or not isinstance(conditions.memory, AdapterCondition):
            return predicted
        emptied = dataclasses.replace(conditions, memory=conditions.memory.emptied())
        without = self.predict(low, image, emptied, branch="uncond").to(noisy.dtype)
        return without + guidance * (predicted - without)

    def predict(self, noisy: Tensor, image: Tensor, conditions: Conditions, branch: str = "cond") -> Tensor:
        """Predict velocities or clean latents from noisy latents.

        Args:
            noisy: noisy latents of RGB and depth.
            image: latents of the image condition.
            conditions: all other inputs of the transformer.
            branch: name of this prediction among those of a step, for caches from step to step.
        """
        return self.transformer.predict(noisy, image, conditions, self.shape, self.settings.depth)

    def generate(self, first: Clips, sampling: Sampling) -> tuple[Tensor, Tensor]:
        """Generate clips from each sample's own noise; the first frame is that of ``first``."""
        colors, depth = self.decode(self.sample_noticed(first, sampling), first)
        return to_uint8(colors), depth

    @torch.no_grad()
    def generate_frame(self, first: Clips, sampling: Sampling, frames: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Generate clips and return a frame of each; a codec that codes every frame alone decodes no others."""
        if not self.framewise or 0 in frames:
            return super().generate_frame(first, sampling, frames)
        latents = self.shape.of(first).drop_padding(self.sample_noticed(first, sampling))
        chosen = latents[torch.arange(len(frames)), list(frames)][:, None]
        colors, depth = self.codec.decode_images(chosen, self.settings.depth)
        return to_uint8(colors)[:, 0], depth[:, 0]

    def sample_noticed(self, first: Clips, sampling: Sampling) -> Float[Tensor, "batch frame channel height width"]:
        """Denoise latents and call ``on_denoised``, if it is set, after each step."""
        denoised = self.on_denoised
        return self.sample(first, sampling, None if denoised is None else lambda _: denoised())

    @torch.no_grad()
    def decode(
        self, latents: Float[Tensor, "batch frame channel height width"], first: Clips
    ) -> tuple[Float[Tensor, "batch 3 frame height width"], Float[Tensor, "batch frame height width"]]:
        """Decode sampled latents to colours, [-1, 1] and beyond, and depth in metres; frame 0 is that of ``first``."""
        shown = self.shape.of(first).drop_padding(latents)
        shown = shown[:, 1:] if self.framewise else shown  # the first one is given
        colors, depth = self.codec.decode_images(shown, self.settings.depth)
        skipped = 0 if self.framewise else 1
        given = first.rgb[:, :1].movedim(-1, 1).to(colors) / 127.5 - 1
        colors = torch.cat([given.expand(len(colors), -1, -1, -1, -1), colors[:, :, skipped:]], dim=2)
        depth = torch.cat([first.depth[:, :1].to(depth).expand(len(depth), -1, -1, -1), depth[:, skipped:]], dim=1)
        return colors, depth

    @torch.no_grad()
    def reconstruct(self, clips: Clips) -> tuple[Tensor, Tensor]:
        """Encode and decode clips; the depth of a model without depth is 0."""
        clips = clips.to(self.device)
        colors, depth = self.codec.decode_images(self.codec.encode(clips.rgb, clips.depth), self.settings.depth)
        return to_uint8(colors), depth

    @torch.no_grad()
    def encode(self, clips: Clips) -> ClipLatents:
        """Encode the clips, and their first frames alone."""
        clips = clips.to(self.device)
        video = self.codec.encode(clips.rgb, clips.depth)
        return ClipLatents(video, video[:, :1] if self.framewise else self.codec.encode(*clips.first_frames()))

    def encode_first(self, clips: Clips) -> Float[Tensor, "batch frame channel height width"]:
        """Encode the clips' first frames as the image condition, float32 also for a model in lower precision."""
        first = self.codec.encode(*clips.first_frames()).float()
        return self.image_condition(self.known_latents(first, clips), self.shape.of(clips))

    def known_latents(self, first: Float[Tensor, "batch 1 channel height width"], clips: Clips) -> Tensor:
        """Return latents of the first frames alone, or of what they show in all views, as the settings say."""
        return first if self.settings.given == "alone" else views_of_given(self.codec, first, clips.cameras)

    def image_condition(self, known: Float[Tensor, "batch known channel height width"], shape: ClipShape) -> Tensor:
        """Scale latents of what is known for the model, and add zeros for latent frames of which nothing is."""
        return shape.image_condition(known if self.codec.image_scale == 1 else known * self.codec.image_scale)

    def conditions(
        self,
        clips: Clips,
        timesteps: Tensor,
        memory: MemoryCondition = NO_MEMORY,
        image_noise: Tensor | None = None,
    ) -> Conditions:
        """Collect prompt, interactions, cameras, memory and the noise level of the given frames of a batch."""
        printed, steps = self.settings.rays == "printed", clips.cameras.world_from_camera.shape[1] - 1
        grid = self.shape.of(clips).tokens
        rays = (self.codec.spatial, self.codec.temporal, printed, self.shape.token_frames)
        return Conditions(
            text=self.prompt.expand(len(clips.seeds), -1, -1),
            timestep=timesteps,
            level=noise_level(self.scheduler, timesteps),
            interactions=interaction_rows(clips.interactions, self.settings.interactions, steps).to(self.device),
            camera=camera_latents(clips.cameras, *rays),
            rotary=rotary_positions(self.transformer.base.config, grid, self.rotary_grid, self.device),
            memory=memory,
            image_noise=None if image_noise is None else image_noise.to(self.device),
        )

    @property
    def device(self) -> torch.device:
        """The device of the conditions and of all computation; offloaded weights may be elsewhere."""
        return self.prompt.device

    @property
    def frames_per_clip(self) -> int:
        """Number of frames of a clip, including the given first frame."""
        return self.settings.frames

    def check_clip_frames(self, frames: int) -> None:
        """Raise ``PersistError`` for clips that are longer than trained, or that the codec cannot code."""
        check_clip_frames(frames, self.settings.frames, self.codec.temporal)

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the images in pixels."""
        return self.settings.height, self.settings.width

    @property
    def samplers(self) -> tuple[str, ...]:
        """Names of the diffusers samplers that use the noise levels of training, and of that of distilled models."""
        return (*SAMPLERS, CONSISTENCY)

    def check_sampling(self, sampling: Sampling) -> None:
        """Raise ``PersistError`` for an unknown sampler, bad guidance, or more steps than training has noise levels."""
        super().check_sampling(sampling)
        check_steps(sampling.steps, self.scheduler.config.num_train_timesteps)

    def known_noise(self, adapter: Path | None = None) -> float:
        """Return the highest noise level of the given frame in training, or of the memory of an adapter."""
        return self.settings.image_noise if adapter is None else trained_noise(adapter)

    @property
    def gives_depth(self) -> bool:
        """Whether generated clips have depth after their first frame."""
        return self.settings.depth

    @property
    def framewise(self) -> bool:
        """Whether the codec encodes every frame alone."""
        return self.codec.framewise

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return the parameters of VAE, transformer, LoRA, widening and each memory adapter, in this order."""
        return group_parameters(self.named_parameters())

    def truncate_layers(self, groups: int) -> float:
        """Keep the first groups of transformer blocks, with the adapter's; return how many groups there were."""
        return truncate_layers(self.transformer.base.transformer_blocks, self.adapter, groups)

    def trained_parameters(self, stage: Stage) -> dict[str, nn.Parameter]:
        """Return the parameters of VAE, transformer or adapter by name, and freeze all others."""
        self.requires_grad_(False)
        codec = self.codec.vae.decoder if self.settings.codec_trains == "decoder" else self.codec
        modules: dict[Stage, nn.Module | None] = {"codec": codec, "1": self.transformer, "2": self.adapter}
        module = modules[stage]
        if module is None:
            raise CheckpointError("stage 2 trains a memory adapter; add one first")
        module.requires_grad_(True)
        return {name: parameter for name, parameter in self.named_parameters() if parameter.requires_grad}

    def encodes(self, stage: Stage) -> bool:
        """Whether clips can be encoded before a step, which is so in all stages but the codec's own."""
        return stage != "codec"

    def encoding(self) -> str:
        """Return a fingerprint of the codec."""
        return self.codec.fingerprint()

    def begin_stage(self, stage: Stage, clips: Iterable[Clips]) -> None:
        """Let a fresh codec begin as the settings say, before the codec's stage only."""
        if stage == "codec" and self.settings.codec_start == "components":
            images = [self.codec.images(batch.rgb, batch.depth) for batch in clips]
            start_as_components(self.codec, torch.cat([frames_to_batch(image) for image in images]).to(self.device))

    def finish_stage(self, stage: Stage, clips: Iterable[Clips]) -> None:
        """Measure the scale of the latents on these clips, after a codec's stage that trained its encoder."""
        if stage == "codec" and self.settings.codec_trains == "all":
            self.codec.take_scale((batch.rgb.to(self.device), batch.depth.to(self.device)) for batch in clips)

    def checkpoint_settings(self) -> dict[str, Any]:
        """Return the settings without the sources of weights and prompt, and with what the weights were trained for."""
        rotary = self.transformer.base.config.use_rotary_positional_embeddings
        trained = {
            "prediction": self.scheduler.config.prediction_type,
            "rotary_grid": list(self.rotary_grid) if rotary else None,
        }
        return super().checkpoint_settings() | dict.fromkeys(ORIGINS) | trained

    def save_base(self, folder: Path) -> None:
        """Write diffusers' parts, each loadable by diffusers alone, and all other weights as ``world.safetensors``."""
        save_parts(DiffusersParts(self.transformer.base, self.codec.vae, self.scheduler), folder)
        save_world(self.transformer, self.prompt, folder)

    def load_base(self, folder: Path) -> None:
        """Load what ``save_base`` wrote, or merge what ``save_lora`` wrote into the weights that it changes."""
        if self.settings.prompt or self.settings.prompt_embedding is not None:
            raise CheckpointError(
                f"{folder}: the base was trained with a prompt of its own; leave prompt and prompt_embedding out"
            )
        base = lora_base(folder)
        if isinstance(base, Path):
            self.load_base(base)
        else:
            changed = dataclasses.replace(self.settings, **(base or {}))
            self.set_parts(load_parts(folder) if base is None else starting_parts(changed))
        if self.prompt.is_meta:
            return
        if base is not None:
            merge_lora(self.transformer.base, folder, check=not isinstance(base, Path))  # lora_base verifies a folder
        self.prompt = load_world(self.transformer, folder)

    def load_codec(self, folder: Path) -> None:
        """Load the VAE of what ``save_base`` wrote; the transformer stays fresh."""
        own = DiffusersParts(self.transformer.base, self.codec.vae, self.scheduler)
        self.set_parts(dataclasses.replace(own, vae=load_part(folder, "vae")))
        self.prompt = starting_prompt(self.settings, self.prompt)

    def origin(self) -> dict[str, Any]:
        """Return the setting ``pretrained`` with an absolute path, valid from any working directory."""
        return origin_of(self.settings.pretrained)

    @property
    def video_shape(self) -> VideoShape:
        """The sizes of the model that an adapter is built for."""
        return self.transformer.video_shape(self.codec.spatial, self.codec.temporal)
