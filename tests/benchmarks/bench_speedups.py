"""What each speedup gains in training the reference model: ``python tests/benchmarks/bench_speedups.py``.

Prints a table, asserts nothing. Each row is a pair that takes turns: with and without one speedup, all else equal.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
import torch.nn.functional as F
from diffusers.models.autoencoders.autoencoder_kl_cogvideox import CogVideoXCausalConv3d

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_backbones.cogvideox.codec import FramewiseConv
from persist_backbones.cogvideox.inputs import camera_latents
from persist_backbones.tensors import fold_frames
from persist_cli.api.backbone import Backbone, Clip, Clips
from persist_cli.api.geometry import plucker
from persist_cli.api.half_precision import has_bfloat16_tiles
from persist_cli.data.clips import ClipDataset, ClipPlan, ClipSample
from persist_cli.io.hub import cached_weight
from persist_cli.memorize.factory import MemoryFactory, with_memory
from persist_cli.memorize.kept_features import KeptFeatures
from persist_cli.output.console import print_table
from persist_cli.plugins import make_backbone
from persist_cli.policies.nomad.efficientnet import EfficientNet
from persist_cli.policies.trained import packaged_policy
from persist_cli.recipe import make_recipe, read_recipe
from persist_cli.train.optimizer import MuonAndAdamW
from persist_cli.train.tensor_cache import CacheSettings, TensorCache
from tests.benchmarks.timing import alternate, say_conditions
from tests.support.room_views import write_room_walks

BATCH, LARGE, ROUNDS = 16, 64, 3
FULL_SIZE = {"block_out_channels": [16, 32, 32], "temporal_compression_ratio": 1, "latent_channels": 8}
Run = Callable[[], Any]


class Pair(NamedTuple):
    """A run without a speedup and one with it.

    Args:
        speedup: its name, and what is run.
        without: the run without it.
        having: the run with it.
        more_samples: how many times as many samples the run with it processes.
    """

    speedup: str
    without: Run
    having: Run
    more_samples: float = 1


def make_reference(**changes: Any) -> Backbone:
    """An untrained model of the reference recipes."""
    settings = make_recipe(read_recipe("houses-64-codec"), "codec").backbone.settings | changes
    torch.manual_seed(0)
    return make_backbone("cogvideox", settings)


def training_step(backbone: Backbone, clips: Clips, stage: Any, **autocast: Any) -> Run:
    """A function that takes one training step on the batch: loss, backward and optimizer."""
    optimizer = torch.optim.AdamW(backbone.trained_parameters(stage).values(), lr=1e-4)

    def step() -> None:
        with torch.autocast("cpu", **autocast):
            loss = backbone(clips, stage)["loss"]
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def codec_pairs(clips: Clips) -> list[Pair]:
    """Speedups of the codec."""
    framewise, causal = make_reference(), make_reference()
    for module in causal.modules():
        if type(module) is FramewiseConv:
            module.__class__ = CogVideoXCausalConv3d
    few = dataclasses.replace(clips, rgb=clips.rgb[:4], depth=clips.depth[:4], seeds=clips.seeds[:4])
    full_size = make_reference(vae=FULL_SIZE)
    return [
        Pair("frames coded as images: encoding", partial(causal.encode, few), partial(framewise.encode, few)),
        Pair(
            "4×4 pixels as channels: codec step",
            training_step(full_size, few, "codec", enabled=False),
            training_step(framewise, few, "codec", enabled=False),
        ),
    ]


def model_pairs(clips: Sequence[Clip]) -> list[Pair]:
    """Speedups of a step of stage 1."""
    plain = Clips.stack(clips)
    latents = make_reference().encode(plain)
    encoded = [dataclasses.replace(clip, latents=latents[number]) for number, clip in enumerate(clips)]
    batch = Clips.stack(encoded)
    large = Clips.stack([dataclasses.replace(encoded[seed % BATCH], seed=seed) for seed in range(LARGE)])
    compiled = make_reference()
    for block in compiled.transformer.base.transformer_blocks:  # type: ignore[union-attr]
        block.compile()
    step = training_step(make_reference(), batch, "1", enabled=False)
    return [
        Pair("latents kept: stage-1 step", training_step(make_reference(), plain, "1", enabled=False), step),
        Pair("batches of 64 for 16", step, training_step(make_reference(), large, "1", enabled=False), LARGE / BATCH),
        Pair("compiled blocks", step, training_step(compiled, batch, "1", enabled=False)),
        Pair("bfloat16", step, training_step(make_reference(), batch, "1", dtype=torch.bfloat16)),
        Pair("rays at the latents' size: rays alone", partial(pooled_rays, plain), partial(rays, plain)),
    ]


def optimizer_pairs() -> list[Pair]:
    """Muon's steps of the reference model's matrices in bfloat16, where that is fast, and in float32."""
    optimizers = [MuonAndAdamW(make_reference().trained_parameters("1").values(), 1e-3, 0.0) for _ in range(2)]
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.randn_like(parameter)

    def without() -> None:
        with patch("persist_cli.train.muon.has_bfloat16_tiles", return_value=False):
            optimizers[0].step()

    return [Pair("Muon in tiles of bfloat16: optimizer alone", without, optimizers[1].step)]


def rays(clips: Clips) -> torch.Tensor:
    """The camera latents as the model computes them."""
    return camera_latents(clips.cameras, 4, 1, printed=False)


def pooled_rays(clips: Clips) -> torch.Tensor:
    """The camera latents as the paper describes them: the rays of all pixels, pooled."""
    pixel_rays = plucker(clips.cameras).permute(0, 1, 4, 2, 3).float()
    return fold_frames(F.avg_pool2d(pixel_rays.flatten(0, 1), 4).unflatten(0, pixel_rays.shape[:2]), 1)


def memory_pairs(sample: ClipSample, folder: Path) -> list[Pair]:
    """The speedup of caching a clip's tokens over building its memory."""
    recipe = make_recipe(read_recipe("houses-64-stage2-voxel"), "voxel")
    assert recipe.memory is not None
    factory, budget = MemoryFactory.of(recipe.memory), int(recipe.adapter["token_budget"])
    build = partial(with_memory, sample, factory, budget)
    tokens, cache = build().tokens, TensorCache(CacheSettings(folder, 1))
    assert tokens is not None
    cache.put("tokens", tokens.tensors())
    return [Pair("tokens kept: memory alone", build, partial(cache.get, "tokens"))]


def feature_pairs(sample: ClipSample) -> list[Pair]:
    """The paper's memory of a clip whose frames DINOv2 encodes again, and whose features are kept."""
    recipe = make_recipe(read_recipe("houses-64-paper"), "memory")
    assert recipe.memory is not None
    kept, budget = MemoryFactory.of(recipe.memory), int(recipe.adapter["token_budget"])
    assert isinstance(kept.encoder, KeptFeatures)
    again = dataclasses.replace(kept, encoder=kept.encoder.encoder)
    runs = (partial(with_memory, sample, factory, budget) for factory in (again, kept))
    return [Pair("features kept: memory of DINOv2 alone", *runs)]


def policy_pairs() -> list[Pair]:
    """The encoder of a policy's images with the channels of a pixel side by side in memory, and apart."""
    encoder = EfficientNet(packaged_policy().load().settings.encoder, 3, 0.0)
    images = torch.rand(LARGE, 3, 64, 64)

    def apart() -> None:
        state = F.silu(encoder.stem_norm(encoder.stem(images)))
        for block in encoder.blocks:
            state = block(state)
        encoder.head_norm(encoder.head(state)).sum().backward()

    return [Pair("channels last: a policy's images", apart, lambda: encoder.map(images).sum().backward())]


def main() -> None:
    """Time all pairs and print one table."""
    say_conditions(f"the reference model with untrained weights, 64×64, batches of {BATCH}")
    with TemporaryDirectory() as folder:
        data = write_room_walks(Path(folder), 64, frames=100)
        dataset = ClipDataset([data], ClipPlan(frames=9, strides=(1,), context_frames=96, seed=0, image_size=(64, 64)))
        samples = [dataset[number] for number in range(BATCH)]
        clips = [sample.clip for sample in samples]
        longest = max(samples, key=lambda sample: len(sample.context or ()))
        pairs = [
            *codec_pairs(Clips.stack(clips)),
            *model_pairs(clips),
            *(optimizer_pairs() if has_bfloat16_tiles() else ()),
            *policy_pairs(),
            *memory_pairs(longest, Path(folder) / "cache"),
            *(feature_pairs(longest) if cached_weight("dinov2-s-derived") else ()),
        ]
        rows = []
        for pair in pairs:
            times = alternate({"without": pair.without, "with": pair.having}, ROUNDS)
            milliseconds = (f"{1e3 * times.median(name):.1f}" for name in ("without", "with"))
            gain = pair.more_samples * times.ratio("without", "with")
            rows.append((pair.speedup, *milliseconds, f"{gain:.2f}×"))
    print_table("what made training faster", ["what", "without, ms", "with, ms", "gain a sample"], rows)


if __name__ == "__main__":
    main()
