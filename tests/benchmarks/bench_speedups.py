"""What made training the reference model faster, and what did not: ``python tests/benchmarks/bench_speedups.py``.

Each row is a pair that took turns in one run: with and without one thing, all else equal. Nothing is asserted.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import torch.nn.functional as F
from diffusers.models.autoencoders.autoencoder_kl_cogvideox import CogVideoXCausalConv3d

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_backbones.cogvideox.codec import FramewiseConv
from persist_backbones.cogvideox.inputs import camera_latents
from persist_backbones.tensors import fold_frames
from persist_cli.api.backbone import Backbone, Clips
from persist_cli.api.geometry import plucker
from persist_cli.data.clips import ClipDataset, ClipPlan, ClipSample
from persist_cli.memorize.factory import MemoryFactory, collate, recall
from persist_cli.plugins import make_backbone
from persist_cli.recipe import make_recipe, read_recipe
from persist_cli.train.clip_cache import Cache, CacheSettings
from persist_cli.viewing.console import print_table
from tests.benchmarks.timing import alternate, say_conditions, write_walks

BATCH, LARGE, ROUNDS = 16, 64, 3
FULL_SIZE = {"block_out_channels": [16, 32, 32], "temporal_compression_ratio": 1, "latent_channels": 8}
Work = Callable[[], Any]
Pair = tuple[str, Work, Work, float]  # what, without it, with it, and how many times as many samples the latter does


def reference(**changes: Any) -> Backbone:
    """A fresh model of the reference recipes."""
    settings = make_recipe(read_recipe("houses-64-codec"), "codec").backbone.settings | changes
    torch.manual_seed(0)
    return make_backbone("cogvideox", settings)


def training_step(backbone: Backbone, clips: Clips, stage: Any, **autocast: Any) -> Work:
    """Loss, backward and optimizer on one batch."""
    optimizer = torch.optim.AdamW(backbone.trained_parameters(stage).values(), lr=1e-4)

    def step() -> None:
        with torch.autocast("cpu", **autocast):
            loss = backbone(clips, stage)["loss"]
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def codec_pairs(clips: Clips) -> list[Pair]:
    """What the codec gained."""
    still, plain = reference(), reference()
    for module in plain.modules():
        if type(module) is FramewiseConv:
            module.__class__ = CogVideoXCausalConv3d
    few = dataclasses.replace(clips, rgb=clips.rgb[:4], depth=clips.depth[:4], seeds=clips.seeds[:4])
    tall = reference(vae=FULL_SIZE)
    return [
        ("frames coded as images: encoding", partial(plain.encode, few), partial(still.encode, few), 1),
        (
            "4×4 pixels as channels: codec step",
            training_step(tall, few, "codec", enabled=False),
            training_step(still, few, "codec", enabled=False),
            1,
        ),
    ]


def model_pairs(clips: Clips) -> list[Pair]:
    """What a step of stage 1 gained."""
    kept = dataclasses.replace(clips, latents=reference().encode(clips))
    many = dataclasses.replace(
        kept,
        cameras=dataclasses.replace(
            kept.cameras,
            world_from_camera=kept.cameras.world_from_camera.repeat(LARGE // BATCH, 1, 1, 1),
            intrinsics=kept.cameras.intrinsics.repeat(LARGE // BATCH, 1, 1, 1),
        ),
        interactions=list(kept.interactions) * (LARGE // BATCH),
        seeds=list(range(LARGE)),
        latents=kept.latents.repeat(LARGE // BATCH, 1, 1, 1, 1) if kept.latents is not None else None,
    )
    compiled = reference()
    for block in compiled.transformer.base.transformer_blocks:  # type: ignore[union-attr]
        block.compile()
    step = training_step(reference(), kept, "1", enabled=False)
    return [
        ("latents kept: stage-1 step", training_step(reference(), clips, "1", enabled=False), step, 1),
        ("batches of 64 for 16", step, training_step(reference(), many, "1", enabled=False), LARGE / BATCH),
        ("compiled blocks", step, training_step(compiled, kept, "1", enabled=False), 1),
        ("bfloat16", step, training_step(reference(), kept, "1", dtype=torch.bfloat16), 1),
        ("rays at the latents' size: rays alone", partial(pooled_rays, clips), partial(rays, clips), 1),
    ]


def rays(clips: Clips) -> torch.Tensor:
    """The camera latents as they are made."""
    return camera_latents(clips.cameras, 4, 1, printed=False)


def pooled_rays(clips: Clips) -> torch.Tensor:
    """The camera latents as the paper says it: the rays of all pixels, pooled."""
    every = plucker(clips.cameras).permute(0, 1, 4, 2, 3).float()
    return fold_frames(F.avg_pool2d(every.flatten(0, 1), 4).unflatten(0, every.shape[:2]), 1)


def memory_pairs(sample: ClipSample, folder: Path) -> list[Pair]:
    """What keeping a clip's tokens gains over building its memory."""
    recipe = make_recipe(read_recipe("houses-64-stage2-voxel"), "voxel")
    assert recipe.memory is not None
    maker, budget = MemoryFactory.of(recipe.memory), int(recipe.adapter["token_budget"])
    tokens, cache = recall(sample, maker, budget), Cache(CacheSettings(folder, 1))
    cache.put("tokens", {"features": tokens.features, "positions": tokens.positions, "mask": tokens.mask})
    return [("tokens kept: memory alone", partial(recall, sample, maker, budget), partial(cache.get, "tokens"), 1)]


def main() -> None:
    """Time all pairs and print one table."""
    say_conditions(f"the reference model with fresh weights, 64×64, batches of {BATCH}")
    with TemporaryDirectory() as folder:
        data = write_walks(Path(folder), 64, frames=100)
        samples = ClipDataset([data], ClipPlan(9, (1,), 96, 0, (64, 64)))
        batch = [samples[number] for number in range(BATCH)]
        clips = collate(batch)
        deepest = max(batch, key=lambda each: len(each.context or ()))
        pairs = [*codec_pairs(clips), *model_pairs(clips), *memory_pairs(deepest, Path(folder) / "cache")]
        rows = []
        for what, without, given, more in pairs:
            times = alternate({"without": without, "with": given}, ROUNDS)
            without_ms, with_ms = (f"{1e3 * times.median(name):.1f}" for name in ("without", "with"))
            rows.append((what, without_ms, with_ms, f"{more * times.ratio('without', 'with'):.2f}×"))
    print_table("what made training faster", ["what", "without, ms", "with, ms", "gain a sample"], rows)


if __name__ == "__main__":
    main()
