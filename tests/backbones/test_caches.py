"""diffusers' caches with memory blocks between the cached blocks, two outputs and two predictions a step."""

import dataclasses

import pytest
import torch
from diffusers.hooks import (
    FasterCacheConfig,
    FirstBlockCacheConfig,
    MagCacheConfig,
    PyramidAttentionBroadcastConfig,
    TaylorSeerCacheConfig,
    TextKVCacheConfig,
)

from persist_backbones.extensions.caches import ClipCaches, enable_cache
from persist_backbones.pipeline.pipeline import WorldPipeline
from persist_cli.api.backbone import Sampling
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import PersistError
from tests.support.micro_model import (
    CHANNELS,
    equal,
    micro,
    random_clips,
    random_tokens,
    shaken,
    trained,
    with_adapter,
)

STEPS = 8
CLIPS, SAMPLING = random_clips(1, random_tokens(1, 5)), Sampling(STEPS, "ddim", 1.5)
RATIOS = {"num_inference_steps": STEPS, "mag_ratios": torch.full((STEPS,), 1.01)}
EXACT = {"taylor_factors_dtype": torch.float32}
IDLE = {  # caches set so that they never skip anything
    "first-block": lambda: FirstBlockCacheConfig(threshold=0.0),
    "MagCache": lambda: MagCacheConfig(threshold=0.0, **RATIOS),
    "TaylorSeer": lambda: TaylorSeerCacheConfig(cache_interval=1, **EXACT),
    "pyramid attention": lambda: PyramidAttentionBroadcastConfig(spatial_attention_block_skip_range=1),
    "FasterCache": lambda: FasterCacheConfig(spatial_attention_block_skip_range=1, is_guidance_distilled=True),
}
BUSY = {
    "first-block": lambda: FirstBlockCacheConfig(threshold=1e3),
    "MagCache": lambda: MagCacheConfig(threshold=0.2, **RATIOS),
    "TaylorSeer": lambda: TaylorSeerCacheConfig(cache_interval=3, **EXACT),
    "TaylorSeer lite": lambda: TaylorSeerCacheConfig(cache_interval=3, use_lite_mode=True, **EXACT),
    "pyramid attention": lambda: PyramidAttentionBroadcastConfig(spatial_attention_block_skip_range=2),
    "FasterCache": lambda: FasterCacheConfig(is_guidance_distilled=True),
}
EVERY_CACHE = pytest.mark.parametrize("name", BUSY)


@pytest.mark.parametrize("name", IDLE)
def test_a_cache_that_skips_nothing_changes_nothing(name):
    backbone = trained()
    plain = backbone.generate(CLIPS, SAMPLING)
    enable_cache(backbone.transformer, IDLE[name]())
    assert equal(backbone.generate(CLIPS, SAMPLING), plain)


def test_with_a_cache_the_model_is_told_the_noise_of_its_memory():
    backbone, sampling = with_adapter(micro(), noise=0.5), Sampling(4, "ddim", context_noise=0.3)
    shaken(backbone)
    plain = backbone.generate(CLIPS, sampling)
    enable_cache(backbone.transformer, IDLE["first-block"]())
    assert equal(backbone.generate(CLIPS, sampling), plain)


@EVERY_CACHE
def test_a_cache_changes_a_clip_and_not_the_next_one(name):
    backbone = trained()
    plain = backbone.generate(CLIPS, SAMPLING)
    enable_cache(backbone.transformer, BUSY[name]())
    cached = backbone.generate(CLIPS, SAMPLING)
    assert not equal(cached, plain)
    assert all(torch.isfinite(output.float()).all() for output in cached)
    assert equal(backbone.generate(CLIPS, SAMPLING), cached)
    batch = random_clips(2, random_tokens(2, 5))
    assert torch.isfinite(backbone.generate(batch, SAMPLING)[1]).all()  # of another size
    backbone.transformer.base.disable_cache()
    assert equal(backbone.generate(CLIPS, SAMPLING), plain)


@EVERY_CACHE
def test_an_interrupted_clip_leaves_nothing_in_the_cache(name):
    backbone, remaining_calls = trained(), [None] * 7  # two predictions a step
    enable_cache(backbone.transformer, BUSY[name]())
    whole = backbone.generate(CLIPS, SAMPLING)
    breaking = backbone.transformer.register_forward_pre_hook(lambda *_: remaining_calls.pop())
    with pytest.raises(IndexError):
        backbone.generate(CLIPS, SAMPLING)
    breaking.remove()
    assert equal(backbone.generate(CLIPS, SAMPLING), whole)


@EVERY_CACHE
def test_predictions_with_and_without_memory_have_caches_of_their_own(name):
    backbone = trained()
    enable_cache(backbone.transformer, BUSY[name]())
    without_tokens = dataclasses.replace(CLIPS, tokens=MemoryTokens.stack([MemoryTokens.empty(CHANNELS)]))
    unguided = backbone.generate(without_tokens, Sampling(STEPS))
    assert equal(backbone.generate(CLIPS, Sampling(STEPS, memory_guidance=0.0)), unguided)


@pytest.mark.parametrize("form", ["cross", "projected", "canvas", "rendered"])
@pytest.mark.parametrize("name", ["first-block", "MagCache"])
def test_skipped_blocks_add_their_memory_once(name, form):
    backbone = with_adapter(micro(transformer={**micro().settings.transformer, "num_layers": 4}), form=form)
    shaken(backbone)
    config = MagCacheConfig(threshold=9.0, retention_ratio=0.0, **RATIOS) if name == "MagCache" else BUSY[name]()
    enable_cache(backbone.transformer, config)
    noisy, timesteps = torch.randn(1, 3, 8, 8, 8, generator=torch.Generator().manual_seed(0)), torch.tensor([500])
    conditions = backbone.conditions(CLIPS, timesteps, backbone.memory_condition(CLIPS))
    image, caches, block_runs = backbone.encode_first(CLIPS), ClipCaches(backbone.transformer), []
    backbone.transformer.base.transformer_blocks[2].attn1.register_forward_hook(lambda *_: block_runs.append(1))
    with torch.no_grad(), caches.prediction("cond", conditions):
        computed, cached = (backbone.predict(noisy, image, caches.around(conditions)) for _ in range(2))
    assert len(block_runs) == 1
    assert torch.allclose(cached, computed, atol=1e-4)


@EVERY_CACHE
def test_a_cache_is_enabled_on_a_pipeline_as_on_one_of_diffusers(name):
    backbone = trained()
    enable_cache(backbone.transformer, BUSY[name]())
    rgb, _ = backbone.generate(CLIPS, SAMPLING)
    pipeline, config = WorldPipeline.of(trained()), BUSY[name]()
    pipeline.set_progress_bar_config(disable=True)
    if hasattr(config, "current_timestep_callback"):
        config.current_timestep_callback = lambda: pipeline.current_timestep
    if isinstance(config, TaylorSeerCacheConfig) and not config.use_lite_mode:
        config.cache_identifiers = [r"transformer_blocks\.\d+\.attn1"]
    pipeline.transformer.enable_cache(config)
    output = pipeline(
        CLIPS.rgb[:, 0], CLIPS.depth[:, 0], CLIPS.cameras, memory_tokens=CLIPS.tokens, num_inference_steps=STEPS,
        guidance_scale=1.5, generator=torch.Generator().manual_seed(0), output_type="pt",
    )  # fmt: skip
    assert torch.equal((output.frames.movedim(2, -1) * 255).round().to(torch.uint8), rgb)


def test_a_cache_that_cannot_work_is_refused():
    backbone = trained()
    with pytest.raises(
        PersistError, match=r"^TextKVCacheConfig does not work with this transformer; known: FirstBlock"
    ):
        enable_cache(backbone.transformer, TextKVCacheConfig())
    with pytest.raises(PersistError, match=r"give it is_guidance_distilled=True$"):
        enable_cache(backbone.transformer, FasterCacheConfig())
    backbone.transformer.base.enable_cache(TaylorSeerCacheConfig())  # whose own names for layers fit none
    with pytest.raises(PersistError, match=r"^TaylorSeerCacheConfig fits no layer; attention is"):
        backbone.generate(CLIPS, SAMPLING)


def test_a_sampling_that_is_refused_leaves_no_cache_behind():
    backbone = trained()
    enable_cache(backbone.transformer, IDLE["first-block"]())
    with pytest.raises(PersistError, match="has no guide"):
        backbone.sample(CLIPS, dataclasses.replace(SAMPLING, autoguidance=2.0))
    assert backbone.caches is None
