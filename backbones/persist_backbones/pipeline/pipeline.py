"""The pipeline of diffusers' kind for a world model."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self, get_args

import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler, CogVideoXTransformer3DModel
from diffusers.utils import BaseOutput
from diffusers.video_processor import VideoProcessor
from jaxtyping import Float
from torch import Tensor, nn

from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.diffusion import MULTISTEP, SAMPLERS, SamplingStep
from persist_backbones.cogvideox.parts import DiffusersParts
from persist_backbones.extensions.extended import ExtendedCogVideoX
from persist_backbones.extensions.offload import OffloadingPipeline
from persist_backbones.pipeline.call_inputs import batch_of_images, make_clips
from persist_backbones.pipeline.components import MemoryAdapter, WorldModules, assemble
from persist_cli.api.backbone import Clips, Interactions, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.checkpoint import CARD, find_checkpoint
from persist_cli.api.inference import Precision
from persist_cli.api.meta_device import without_weights
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError, DataError, PersistError, hint
from persist_cli.io.files import follow_umask, reallocate
from persist_cli.io.settings import parse_settings

Callback = Callable[["WorldPipeline", int, Tensor, dict[str, Tensor]], dict[str, Tensor]]

NAME = "cogvideox"  # of the plugin
OF_NOISE = frozenset({  # options of schedulers that a configuration of training has, or that follow from it
    "num_train_timesteps", "beta_start", "beta_end", "beta_schedule", "trained_betas", "prediction_type",
    "timestep_spacing", "steps_offset", "rescale_betas_zero_snr",
})  # fmt: skip
OUTPUTS = ("pil", "np", "pt", "latent")


@dataclass
class WorldPipelineOutput(BaseOutput):  # type: ignore[misc]
    """The result of a call of the pipeline.

    Args:
        frames: videos that begin with the given images, of the call's ``output_type``; latents for ``latent``.
        depth: metres, 0 after the first frame for a model without depth; ``None`` with latents.
    """

    frames: Any
    depth: Float[Tensor, "batch frame height width"] | None


class WorldPipeline(OffloadingPipeline):
    """A pipeline that generates, from an image, its depth and a path of cameras, the RGB-D clip seen along the path.

    It has the usual features of diffusers' pipelines: ``to``, CPU offload, ``vae.enable_slicing()`` and
    ``vae.enable_tiling()``, ``transformer.enable_cache(config)``, another scheduler of ``SAMPLERS``, callbacks and
    ``interrupt``, saving and loading (safetensors only). Guidance is guidance over memory.

    Args:
        transformer: diffusers' transformer.
        vae: diffusers' VAE.
        scheduler: a scheduler of ``SAMPLERS``.
        world: the modules that make the transformer a world model.
        adapter: a memory adapter; ``None`` for the model of stage 1.
    """

    _optional_components: ClassVar = ["adapter"]
    _callback_tensor_inputs: ClassVar = ["latents"]

    def __init__(
        self,
        transformer: CogVideoXTransformer3DModel,
        vae: AutoencoderKLCogVideoX,
        scheduler: CogVideoXDDIMScheduler,
        world: WorldModules,
        adapter: MemoryAdapter | None = None,
    ) -> None:
        super().__init__()
        self.register_modules(transformer=transformer, vae=vae, scheduler=scheduler, world=world, adapter=adapter)
        self._noise = noise_of(scheduler)
        self._assembled: tuple[ExtendedCogVideoX, tuple[Any, ...]] | None = None
        self._guidance_scale = 1.0
        self._num_timesteps = 0
        self._interrupt = False

    @classmethod
    def of(cls, backbone: ExtendedCogVideoX) -> Self:
        """Make the pipeline of a backbone with its adapter in use, sharing their weights."""
        adapter = None if backbone.adapter is None else MemoryAdapter.of(backbone.adapter)
        parts = (backbone.transformer.base, backbone.codec.vae, backbone.scheduler)
        pipeline = cls(*parts, WorldModules.of(backbone), adapter)
        pipeline._assembled = backbone, pipeline._parts()
        return pipeline

    @property
    def backbone(self) -> ExtendedCogVideoX:
        """The backbone made of the present components, as a ``Backbone``."""
        parts = self._parts()
        if self._assembled is None or any(a is not b for a, b in zip(self._assembled[1], parts, strict=True)):
            transformer, vae, scheduler, world, adapter = parts
            trained = CogVideoXDDIMScheduler.from_config(scheduler.config)
            self._assembled = assemble(DiffusersParts(transformer, vae, trained), world, adapter), parts
        backbone = self._assembled[0]
        backbone.prompt = self.world.prompt  # a move of the components replaces this tensor
        return backbone

    def _parts(self) -> tuple[Any, ...]:
        return self.transformer, self.vae, self.scheduler, self.world, self.adapter

    @property
    def guidance_scale(self) -> float:
        """Weight of guidance over memory in the present step."""
        return self._guidance_scale

    @property
    def num_timesteps(self) -> int:
        """Number of denoising steps of the present call."""
        return self._num_timesteps

    @property
    def current_timestep(self) -> Tensor | None:
        """The noise level of the present step, ``None`` between calls."""
        return self.backbone.current_timestep

    @property
    def interrupt(self) -> bool:
        """Whether the present call will make no further step."""
        return self._interrupt

    def save_pretrained(self, save_directory: str | Path, safe_serialization: bool = True, **options: Any) -> None:
        """Save the pipeline like diffusers, as safetensors only."""
        if not safe_serialization:
            raise CheckpointError(f"{save_directory}: weights are saved as safetensors only")
        super().save_pretrained(save_directory, **options)
        for name in self.components:
            follow_umask(Path(save_directory) / name)

    @classmethod
    def from_pretrained(cls, pretrained_model_name_or_path: str | Path, **options: Any) -> Self:
        """Load the pipeline like diffusers, from safetensors only."""
        pipeline: Self = super().from_pretrained(pretrained_model_name_or_path, **options | {"use_safetensors": True})
        for part in pipeline.components.values():
            if isinstance(part, nn.Module):
                reallocate(part)
        return pipeline

    @torch.no_grad()
    def __call__(
        self,
        image: Any,
        depth: Any,
        cameras: Cameras | Sequence[Cameras],
        interactions: Sequence[Interactions] | None = None,
        memory_tokens: MemoryTokens | Sequence[MemoryTokens] | None = None,
        num_inference_steps: int = 50,
        guidance_scale: float = 1.0,
        generator: torch.Generator | list[torch.Generator] | None = None,
        latents: Tensor | None = None,
        output_type: str = "pil",
        return_dict: bool = True,
        callback_on_step_end: Callback | None = None,
        callback_on_step_end_tensor_inputs: Sequence[str] = ("latents",),
    ) -> WorldPipelineOutput | tuple[Any, ...]:
        """Generate clips that begin with the given images.

        Args:
            image: PIL image, uint8 ``[height, width, 3]`` or diffusers' ``pt``; a list or batch of them.
            depth: planar depth of the image in metres, 0 = missing; ``None`` if it is unknown.
            cameras: cameras of every frame of the clip, the image's first.
            interactions: actions of the agent that change the world, one for each step, one sequence a sample.
            memory_tokens: tokens that ``Memory.read`` returned for these cameras.
            num_inference_steps: number of denoising steps.
            guidance_scale: weight of classifier-free guidance over memory; 1 means no guidance.
            generator: generator of the noise, on the CPU; one for all samples, or a list of one a sample.
            latents: the noise; by default drawn from ``generator``.
            output_type: ``pil``, ``np``, ``pt`` or ``latent``.
            return_dict: whether to return a ``WorldPipelineOutput``, else a plain tuple.
            callback_on_step_end: function of the pipeline, the step's number, its timestep and a dictionary of tensors;
                latents in the dictionary that it returns replace those of the step.
            callback_on_step_end_tensor_inputs: names of the tensors in that dictionary.

        Raises:
            PersistError: one line for inputs that do not fit each other or the model.
        """
        sampling, backbone = Sampling(num_inference_steps, self._sampler(), guidance_scale), self.backbone
        self._check(sampling, output_type, callback_on_step_end_tensor_inputs, memory_tokens is not None)
        images = self._images(image)
        first = make_clips(images, depth, cameras, interactions, memory_tokens, backbone.check_clip_frames)
        generators = generators_for(generator, len(images))
        self._guidance_scale, self._num_timesteps, self._interrupt = guidance_scale, num_inference_steps, False
        with self.progress_bar(total=num_inference_steps) as bar:
            on_step = partial(self._end_step, bar, callback_on_step_end, callback_on_step_end_tensor_inputs)
            sampled = backbone.sample(first, sampling, on_step, generators, latents)
        output = self._output(sampled, first, output_type)
        self.maybe_free_model_hooks()
        return output if return_dict else output.to_tuple()

    def _end_step(self, bar: Any, callback: Callback | None, names: Sequence[str], step: SamplingStep) -> None:
        """Call the callback, which may change the step's latents; stop when the call is interrupted."""
        if callback is not None:
            tensors = {name: step.latents for name in names}
            step.latents = callback(self, step.number, step.timestep, tensors).pop("latents", step.latents)
        step.guidance, step.stop = self._guidance_scale, self._interrupt
        bar.update()

    def _images(self, image: Any) -> Tensor:
        """Return the images as one batch of the model's size."""
        images = batch_of_images(image)
        if images.shape[1:3] != self.backbone.image_size:
            size, wanted = ("x".join(map(str, sides)) for sides in (images.shape[1:3], self.backbone.image_size))
            raise DataError(f"an image of {size} pixels; this model takes {wanted}, depth and cameras alike")
        return images

    def _sampler(self) -> str:
        name = next((name for name, kind in SAMPLERS.items() if type(self.scheduler) is kind), None)
        if name is None:
            known = ", ".join(kind.__name__ for kind in SAMPLERS.values())
            raise CheckpointError(
                f"scheduler {type(self.scheduler).__name__} does not keep to training's noise; use {known}"
            )
        check_scheduler(self.scheduler, self._noise)
        return name

    def _check(self, sampling: Sampling, output_type: str, tensors: Sequence[str], remembers: bool) -> None:
        if self._execution_device.type == "mps":
            raise PersistError("cameras are computed in float64, which mps lacks; stay on the CPU: pipe.to('cpu')")
        self.backbone.check_sampling(sampling)
        if self.backbone.adapter is None and (remembers or sampling.memory_guidance != 1):
            raise PersistError("this model uses no memory adapter, which reads memory_tokens; load(…, adapter=NAME)")
        if output_type not in OUTPUTS:
            raise PersistError(f"unknown output_type {output_type!r}; known: {', '.join(OUTPUTS)}")
        unknown = set(tensors) - set(self._callback_tensor_inputs)
        if unknown:
            known = ", ".join(self._callback_tensor_inputs)
            raise PersistError(f"callback_on_step_end_tensor_inputs has {', '.join(sorted(unknown))}; known: {known}")

    def _output(self, latents: Tensor, first: Clips, output_type: str) -> WorldPipelineOutput:
        if output_type == "latent":
            return WorldPipelineOutput(latents, None)
        colors, metres = self.backbone.decode(latents, first)
        return WorldPipelineOutput(VideoProcessor().postprocess_video(colors, output_type), metres)


def noise_of(scheduler: Any) -> tuple[Tensor, str]:
    """Return the signal left at each noise level, and what is predicted, as a scheduler's configuration has it."""
    trained = CogVideoXDDIMScheduler.from_config(scheduler.config)
    return trained.alphas_cumprod, str(trained.config.prediction_type)


def check_scheduler(scheduler: Any, noise: tuple[Tensor, str]) -> None:
    """Raise ``CheckpointError`` for a scheduler of other noise than training's, or with options that nothing reads.

    Args:
        scheduler: a scheduler of ``SAMPLERS``.
        noise: what ``noise_of`` said of that of training.
    """
    name, (levels, prediction) = type(scheduler).__name__, noise_of(scheduler)
    if prediction != noise[1] or not torch.equal(levels, noise[0]):
        raise CheckpointError(
            f"scheduler {name} has not training's noise; make it by from_config(pipe.scheduler.config)"
        )
    if type(scheduler) not in MULTISTEP.values():
        return
    options = inspect.signature(type(scheduler)).parameters.items()
    own = {key: option.default for key, option in options if key not in OF_NOISE}
    unread = [key for key, usual in own.items() if scheduler.config.get(key, usual) != usual]
    if unread:
        raise CheckpointError(f"scheduler {name}: nothing reads {', '.join(unread)}; leave them as they are by default")


def generators_for(generator: torch.Generator | list[torch.Generator] | None, batch: int) -> list[torch.Generator]:
    """Return one generator a sample; a single one serves all samples in turn, ``None`` means torch's default one.

    Raises:
        PersistError: when a list does not have one generator for each sample.
    """
    if isinstance(generator, list):
        if len(generator) != batch:
            raise PersistError(f"{len(generator)} generators for {batch} images; give one, or one for each")
        return generator
    return [generator or torch.default_generator] * batch


def load_pipeline(folder: Path, adapter: str | None, dtype: Precision | None) -> WorldPipeline:
    """Load a checkpoint as a pipeline; see ``persist_backbones.load``."""
    dtype = str(dtype).removeprefix("torch.") if isinstance(dtype, torch.dtype) else dtype
    if dtype is not None and dtype not in get_args(Precision):
        raise CheckpointError(f"unknown dtype {dtype!r}; {hint(dtype, get_args(Precision))}")
    checkpoint = find_checkpoint(folder)
    card = checkpoint.base_folder / CARD
    if checkpoint.backbone != NAME:
        raise CheckpointError(f"{card}: a checkpoint of backbone {checkpoint.backbone!r}, not of {NAME!r}")
    with without_weights():  # weights come from the files
        backbone = ExtendedCogVideoX(parse_settings(CogVideoXSettings, checkpoint.settings, str(card)))
    backbone.name = NAME
    adapter = checkpoint.chosen_adapter(adapter)
    checkpoint.check_weights(adapter)
    backbone.load_base(checkpoint.base_folder)
    if adapter is not None:
        backbone.load_adapter(adapter, checkpoint.adapter_folder(adapter))
    return WorldPipeline.of(backbone.to(getattr(torch, dtype or "float32")).eval())
