"""The training of a backbone: its clips, their latents and memory tokens."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Final

import torch
from accelerate import Accelerator

from persist_cli.api.backbone import Backbone, Clips
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.lineage import Lineage, save_stage_recipes
from persist_cli.checkpoints.load import trains_codec_alone
from persist_cli.checkpoints.save import save_adapter, save_base, save_lora
from persist_cli.data.augment import Augmentation
from persist_cli.data.cameras import vertical_view
from persist_cli.data.clips import ClipDataset, ClipPlan, clip_length
from persist_cli.data.held_out import trained_scene
from persist_cli.data.images import crop_resize
from persist_cli.data.reference import data_folder
from persist_cli.data.writing_noise import WritingNoise
from persist_cli.errors import RecipeError
from persist_cli.memorize.factory import MemoryFactory, with_memory
from persist_cli.recipe import Recipe, of_the_whole_model
from persist_cli.train.clip_cache import CachedClips, CacheKeys, ClipCache, ClipEncoder
from persist_cli.train.distillation import Distiller
from persist_cli.train.distributed import Sharding, uses_zero
from persist_cli.train.optimizer import Opponent, requested_savings
from persist_cli.train.own_writes import OwnWrites
from persist_cli.train.tensor_cache import CacheSettings, TensorCache
from persist_cli.train.training_loop import TrainingLoop
from persist_cli.training_settings import DataSettings

START_BATCHES: Final = 16  # from which fresh weights are set at the beginning of a stage
LAST_BATCHES: Final = 4  # from which the scale of the codec's latents is measured at the end of its stage


class Trainer(TrainingLoop[Backbone]):
    """Trains one stage of a backbone.

    Args:
        recipe: the run's recipe.
        backbone: the backbone; in stage 2 it uses the adapter to train.
        factory: makes the memories that the adapter reads, in stage 2.
        accelerator: accelerate for this process, which may be one of many.
        cache: where latents and memory tokens of clips that come again are kept; ``None`` keeps none.

    Raises:
        PersistError: when there are no clips, or a cache would never be read.
    """

    def __init__(
        self,
        recipe: Recipe,
        backbone: Backbone,
        factory: MemoryFactory | None,
        accelerator: Accelerator,
        cache: CacheSettings | None = None,
    ) -> None:
        super().__init__(recipe, accelerator)
        check_whole(recipe, accelerator)
        self.backbone, self.factory = backbone, factory
        opponent: Opponent | None = None
        if recipe.adversarial is not None:
            discriminator = backbone.train_adversarially(recipe.adversarial)
            opponent = Opponent(discriminator, recipe.adversarial.learning_rate)
        parameters, settings = backbone.trained_parameters(recipe.stage), recipe.training
        for frames in recipe.data.clip_frames:
            backbone.check_clip_frames(frames)
        distiller = None if recipe.distill is None else Distiller(recipe.distill, backbone, recipe)
        backbone.apply_memory_savings(recipe.stage, requested_savings(settings, accelerator.device))
        clips = self.all_clips()
        self.scenes = scenes_of(clips)
        self.dataset = clips
        self.encoder = self.clip_encoder(cache)
        if self.encoder is not None:
            self.dataset = CachedClips(clips, self.encoder.cache)
        self.own_writes: OwnWrites | None = None
        if recipe.data.own_writes and self.encoder is not None:
            self.own_writes = OwnWrites(self.encoder, WritingNoise.of(recipe.data))
        if recipe.base is None:
            backbone.begin_stage(recipe.stage, self.first_batches(START_BATCHES))
        self.prepare(backbone, parameters, opponent)
        if distiller is not None:
            distiller.begin(self.state.averages(), accelerator.device)

    def make_sharding(self) -> Sharding | None:
        """What prepares the backbone for FSDP2, ``None`` where nothing is sharded."""
        return Sharding(self.backbone, self.recipe, self.accelerator) if self.accelerator.is_fsdp2 else None

    def write_model(self, model: Backbone, folder: Path, home: Path, lineage: Lineage) -> None:
        """Write an adapter or LoRA beside a pointer to what it stands on, else the whole model."""
        recipe = self.recipe
        model.finish_stage(recipe.stage, self.first_batches(LAST_BATCHES))
        save_stage_recipes(folder, lineage.recipes)
        if recipe.memory is not None and lineage.base is not None:
            save_adapter(model, lineage.base, recipe.memory, folder, home, lineage.scenes)
        elif recipe.lora is not None:
            save_lora(model, lineage.base, folder, home, lineage.scenes)
        else:
            save_base(model, folder, lineage.scenes, lineage.base, home, trains_codec_alone(recipe, lineage.base))

    def figures(self) -> dict[str, Any]:
        """What the cache did."""
        return self.encoder.figures() if self.encoder else {}

    def all_clips(self) -> ClipDataset:
        """All clips of the recipe's data sets."""
        recipe, backbone = self.recipe, self.backbone
        plan = ClipPlan(
            frames=backbone.frames_per_clip,
            strides=recipe.data.strides,
            context_frames=recipe.data.context_frames if self.factory else 0,
            seed=recipe.training.seed,
            image_size=backbone.image_size,
            clips_per_trajectory=recipe.data.clips_per_trajectory,
            exclude_targets=recipe.data.exclude_targets,
            exclude_metres=recipe.data.exclude_metres,
            exclude_degrees=recipe.data.exclude_degrees,
            augmentation=augmentation_of(recipe.data),
            own_writes=recipe.data.own_writes,
            own_after=recipe.data.own_warmup * recipe.training.batch,
            segments=recipe.data.own_segments,
            noise=WritingNoise.of(recipe.data),
            true_cells=recipe.data.true_cells if self.factory else 0.0,
            # what is not needed is not read; memories are read, and clips that come again kept, for their whole length
            lengths=() if self.factory or recipe.data.clips_per_trajectory else recipe.data.clip_frames,
            batch=recipe.training.batch,
        )
        return ClipDataset([data_folder(path) for path in recipe.data.path], plan)

    def clip_encoder(self, settings: CacheSettings | None) -> ClipEncoder | None:
        """The encoder of clips that come again or are chained, with a cache where there is one; else ``None``."""
        recipe, backbone = self.recipe, self.backbone
        repeats = recipe.data.clips_per_trajectory > 0
        if settings is None and not repeats and not recipe.data.own_writes:
            return None
        encodes = backbone.encodes(recipe.stage)
        if recipe.data.own_writes and not encodes:
            raise RecipeError(f"backbone {backbone.name!r} predicts no clips in training; set data.own_writes=0")
        if settings is None:
            return ClipEncoder(backbone, self.factory, self.accelerator, None) if encodes else None
        if not encodes:
            raise RecipeError(
                f"--cache: in stage {recipe.stage} backbone {backbone.name!r} keeps nothing of a clip; leave it out"
            )
        keeps_features = self.factory is not None and self.factory.encoder.costly
        if not repeats and not keeps_features and not backbone.framewise:
            raise RecipeError(
                "--cache: with data.clips_per_trajectory=0 hardly a clip comes twice; give it, as in "
                "data.clips_per_trajectory=32, or leave --cache out"
            )
        if not repeats and augmentation_of(recipe.data) != Augmentation():
            raise RecipeError(
                "--cache: with data.crop, data.mirror or data.color_jitter no view of a clip comes twice; give "
                "data.clips_per_trajectory, as in data.clips_per_trajectory=32, or leave --cache out"
            )
        device, precision = self.accelerator.device.type, self.accelerator.mixed_precision
        keys = CacheKeys.of(recipe, backbone, self.factory, device, precision)
        kept = ClipCache.of(TensorCache(settings), keys, self.factory)
        return ClipEncoder(backbone, self.factory, self.accelerator, kept)

    def to_batch(self, samples: list[Any]) -> Clips:
        """Make a batch of samples of ``dataset``, with memory tokens in stage 2 and latents where clips come again."""
        if self.encoder is None:
            with self.times.part("memory"):
                clips = [with_memory(sample, self.factory, self.backbone.token_budget) for sample in samples]
        else:
            with self.times.part("encode"):
                encoded = [self.encoder.with_latents(sample) for sample in samples]
            with self.times.part("memory"):
                if self.own_writes is not None:
                    encoded = self.own_writes.written(encoded)
                clips = [self.encoder.with_tokens(sample) for sample in encoded]
        return Clips.stack(clips).to(self.accelerator.device)

    def shortened(self, clips: Clips) -> Clips:
        """The clips, cut to one of the lengths of ``data.clip_frames``: one for all micro-batches of a step."""
        lengths, seed = self.recipe.data.clip_frames, self.recipe.training.seed
        return clips.shortened(clip_length(lengths, seed, self.state.step)) if lengths else clips

    def encoded(self, clips: Clips) -> Clips:
        """The clips, at the step's length; when times are taken, with latents that the forward pass would else make."""
        clips = self.shortened(clips)
        if not self.times.enabled or clips.latents is not None or not self.backbone.encodes(self.recipe.stage):
            return clips
        with self.times.part("encode"), torch.no_grad(), self.accelerator.autocast():
            return dataclasses.replace(clips, latents=self.backbone.encode(clips))


def scenes_of(clips: ClipDataset) -> TrainingScenes:
    """The scenes of all clips, and the views that cameras have in random windows too."""
    names, views = frozenset(trained_scene(file.info) for file in clips.files), list[float]()
    for info in (file.info for file in clips.files):
        crop, largest = clips.plan.augmentation.crop, 1.0
        if crop < 1:
            largest = crop_resize((info.height, info.width), clips.plan.image_size).window[0] / info.height
        views += [vertical_view(info, crop * largest), vertical_view(info, largest)]
    return TrainingScenes(names, fov=(min(views), max(views)) if views else None)


def augmentation_of(data: DataSettings) -> Augmentation:
    """The random views that a recipe asks for."""
    return Augmentation(data.crop, data.mirror, data.color_jitter)


def check_whole(recipe: Recipe, accelerator: Accelerator) -> None:
    """Raise ``RecipeError`` where a process has a part of the model, and the recipe needs the whole one in each."""
    whole = of_the_whole_model(recipe)
    if whole and (accelerator.is_fsdp2 or uses_zero(accelerator)):
        raise RecipeError(f"{whole[0]} needs the whole model in each process; launch with --multi_gpu, or leave it out")
