"""Keys of cached latents, tokens and memories: what each depends on, and what it does not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.encoder import Encoder
from persist_cli.checkpoints.load import adapter_memory, load_backbone
from persist_cli.data.clips import ClipDataset, ClipPlan
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.plugins import find_plugin
from persist_cli.recipe import Recipe
from persist_cli.train import clip_cache, tensor_cache
from persist_cli.train.clip_cache import CacheKeys
from persist_cli.training_settings import DataSettings, TrainingSettings
from tests.support.micro_runs import SIZE


@pytest.fixture
def keys_of(walks, voxel):
    """Makes the keys of one clip for a stage, settings of adapter and data, a changed codec, and another memory."""
    checkpoint = find_checkpoint(voxel)
    backbone, usual = load_backbone(checkpoint), adapter_memory(checkpoint, "voxel")
    frames = ClipDataset(
        [walks], ClipPlan(frames=9, strides=(1,), context_frames=5, seed=3, image_size=(SIZE, SIZE))
    ).choose(0)

    def of(stage="2", budget=7, codec=0.0, precision="no", adapter=None, data=None, **changes):
        device = changes.pop("device", "cpu")
        memory = replace(usual, **changes) if stage == "2" else None
        backbone.add_adapter(f"adapter-{len(backbone.adapters)}", 6, {"token_budget": budget} | (adapter or {}))
        factory = MemoryFactory.of(memory) if memory else None
        settings = DataSettings(clips_per_trajectory=3, **(data or {}))
        recipe = Recipe(stage, memory=memory, data=settings, training=TrainingSettings(precision=precision))
        with torch.no_grad():
            next(backbone.codec.parameters()).add_(codec)
        return CacheKeys.of(recipe, backbone, factory, device, recipe.training.precision).of_clip(frames)

    return of


def test_stages_and_memories_share_latents_and_not_tokens(keys_of):
    clip_keys = [keys_of(), keys_of(budget=8), keys_of(settings={"cell": [0.5, 0.5, 0.5]}),
                 keys_of(name="map2d", settings={}), keys_of(encoder_settings={"channels": 12})]  # fmt: skip
    assert {clip.latents for clip in clip_keys} == {keys_of("1").latents}
    assert len({clip.tokens for clip in clip_keys}) == len(clip_keys)
    assert keys_of("1").tokens is None


def test_another_codec_or_precision_changes_the_key_of_latents_and_not_of_tokens(keys_of):
    clip_keys = [keys_of(), keys_of(codec=1.0), keys_of(precision="bf16")]
    assert len({clip.latents for clip in clip_keys}) == len(clip_keys)
    assert {clip.tokens for clip in clip_keys} == {clip_keys[0].tokens}


def test_other_weights_or_settings_of_an_encoder_change_the_key_of_tokens_and_not_of_latents(keys_of, monkeypatch):
    clip_keys = [keys_of(), *(keys_of(encoder="classes", encoder_settings={"classes": count}) for count in (5, 6))]
    encoded = Encoder.encoded
    monkeypatch.setattr(Encoder, "encoded", lambda self, rgb: encoded(self, rgb) + 1)
    clip_keys.append(keys_of())
    assert len({clip.tokens for clip in clip_keys}) == len(clip_keys)
    assert len({clip.latents for clip in clip_keys}) == 1


@pytest.mark.parametrize("errors", ["pose_drift", "pose_drift_degrees", "depth_noise"])
def test_other_errors_of_what_is_written_change_the_key_of_tokens_and_not_of_latents(keys_of, errors):
    clip_keys = [keys_of(), *(keys_of(data={errors: strength}) for strength in (0.1, 0.2))]
    assert len({clip.tokens for clip in clip_keys}) == len({clip.memory for clip in clip_keys}) == 3
    assert len({clip.latents for clip in clip_keys}) == 1


def test_tokens_that_are_kept_as_rendered_views_depend_on_the_rendering_the_codec_and_the_precision(keys_of):
    rendered = {"form": "rendered"}
    clip_keys = [
        keys_of(),
        keys_of(adapter=rendered),
        keys_of(adapter=rendered | {"token_size": 0.05}),
        keys_of(adapter=rendered, precision="bf16"),
        keys_of(adapter=rendered, codec=1.0),
    ]
    assert len({clip.tokens for clip in clip_keys}) == len(clip_keys)


@pytest.mark.parametrize("newer", ["memory", "encoder"])
def test_another_version_of_a_plugin_changes_the_key_of_tokens(keys_of, monkeypatch, newer):
    before = keys_of()

    def find(kind, name):
        plugin = find_plugin(kind, name)
        return replace(plugin, version="9") if kind == newer else plugin

    monkeypatch.setattr(clip_cache, "find_plugin", find)
    assert keys_of().latents == before.latents
    assert keys_of().tokens != before.tokens


@pytest.mark.parametrize(
    ("edited", "adapter", "changed"),
    [
        ("memory", {}, {"tokens", "memory"}),
        ("encoder", {}, {"tokens", "memory"}),
        ("backbone", {}, {"latents"}),
        ("backbone", {"form": "rendered"}, {"latents", "tokens", "memory"}),  # whose codec encodes what is rendered
    ],
)
def test_edited_code_of_a_plugin_of_another_package_changes_the_keys_of_what_it_computes(
    keys_of, monkeypatch, edited, adapter, changed
):
    before = keys_of(adapter=adapter)
    monkeypatch.setattr(clip_cache, "code_of", lambda kind, name: f"{name} edited" if kind == edited else None)
    after = keys_of(adapter=adapter)
    assert {part for part in vars(after) if getattr(after, part) != getattr(before, part)} == changed


def test_another_device_or_version_and_another_format_of_entries_change_all_keys(keys_of, monkeypatch):
    clip_keys = [keys_of(), keys_of(device="cuda")]
    for module, name in ((clip_cache, "__version__"), (tensor_cache, "FORMAT")):
        monkeypatch.setattr(module, name, 9)
        clip_keys.append(keys_of())
    for part in ("latents", "tokens", "memory"):
        assert len({getattr(keys, part) for keys in clip_keys}) == len(clip_keys)


def test_another_format_of_tokens_changes_their_key_and_not_that_of_latents(keys_of, monkeypatch):
    before = keys_of()
    monkeypatch.setattr(clip_cache, "TOKENS", clip_cache.TOKENS - 1)
    assert keys_of().latents == before.latents
    assert keys_of().tokens != before.tokens
