"""What diffusers' caches save and cost, with memory blocks and without: ``python tests/benchmarks/bench_caches.py``.

Prints a table for each number of DDIM steps, asserts nothing: seconds a clip, PSNR to the clip that is computed without
a cache, and PSNR to the recorded frames. The model is the reference model, or that of ``--checkpoint``, on the sample
houses; MagCache is calibrated on the same clips.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import io
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from diffusers.hooks import (
    FasterCacheConfig,
    FirstBlockCacheConfig,
    MagCacheConfig,
    PyramidAttentionBroadcastConfig,
    TaylorSeerCacheConfig,
)
from diffusers.utils import logging
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_backbones.extensions.caches import enable_cache
from persist_cli.api.backbone import Backbone, Clip, Clips, Sampling
from persist_cli.api.checkpoint import find_checkpoint, reference_checkpoint
from persist_cli.api.inference import InferenceOptions
from persist_cli.api.observations import Observations
from persist_cli.checkpoints.load import adapter_memory, load_adapter, load_backbone
from persist_cli.data.reference import sample_data
from persist_cli.data.store import Store
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.output.console import print_table
from tests.benchmarks.timing import alternate, say_conditions

UNCACHED = "none"
STARTS = (48,)  # frames at which clips begin; the memory holds the frames before


def configs(ratios: list[float]) -> dict[str, Any]:
    """Every cache by name, with the settings of its paper and diffusers' examples; first-block has two thresholds."""
    steps, exact = len(ratios), {"taylor_factors_dtype": torch.float32}
    return {
        "first-block 0.05": FirstBlockCacheConfig(threshold=0.05),
        "first-block 0.2": FirstBlockCacheConfig(threshold=0.2),
        "MagCache": MagCacheConfig(num_inference_steps=steps, mag_ratios=torch.tensor(ratios)),
        "TaylorSeer": TaylorSeerCacheConfig(**exact),
        "TaylorSeer lite": TaylorSeerCacheConfig(use_lite_mode=True, **exact),
        "pyramid attention": PyramidAttentionBroadcastConfig(spatial_attention_block_skip_range=2),
        "FasterCache": FasterCacheConfig(is_guidance_distilled=True, attention_weight_callback=lambda _: 0.5),
    }


def make_clips(backbone: Backbone, factory: MemoryFactory | None) -> tuple[Clips, Tensor]:
    """A batch of clips to predict, one from each start in each sample house, and the recorded colours of its frames."""
    clips, truth, frames = [], [], backbone.frames_per_clip
    for number, file in enumerate(Store(sample_data())):
        for start in STARTS:
            past = file.read(range(start)).observations
            recorded = file.read(range(start, start + frames)).observations
            tokens = None
            if factory is not None:
                memory = factory.empty(file.info)
                memory.write(past)
                tokens = memory.read(recorded.cameras, backbone.token_budget)
            first = Observations(recorded.rgb[:1], recorded.depth[:1], recorded.cameras)
            clips.append(Clip(first, (None,) * (frames - 1), len(STARTS) * number + start, tokens))
            truth.append(recorded.rgb)
    return Clips.stack(clips), torch.stack(truth)


def calibrate(backbone: Any, draw: Callable[[], Any], steps: int) -> list[float]:
    """MagCache's magnitude ratios of these clips, read from what it prints."""
    enable_cache(backbone.transformer, MagCacheConfig(num_inference_steps=steps, calibrate=True))
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        draw()
    backbone.transformer.base.disable_cache()
    ratios = next(line for line in output.getvalue().splitlines() if line.startswith("[") and "," in line)
    return [float(ratio) for ratio in ast.literal_eval(ratios)]


def with_cache(backbone: Any, config: Any, draw: Callable[[], Any]) -> Any:
    """The clips drawn with a cache; ``None`` is no cache."""
    if config is None:
        return draw()
    enable_cache(backbone.transformer, config)
    clips = draw()
    backbone.transformer.base.disable_cache()
    return clips


def psnr(one: Tensor, two: Tensor) -> float:
    """PSNR in dB of the predicted frames (all but the first), over all clips."""
    error = (one[:, 1:].double() - two[:, 1:].double()).square().mean()
    return float(10 * torch.log10(255**2 / error))


def table_rows(
    backbone: Any, factory: MemoryFactory | None, memory: str, sampling: Sampling, rounds: int
) -> list[tuple[str, ...]]:
    """A row for every cache, with this memory."""
    clips, truth = make_clips(backbone, factory)
    draw = partial(backbone.generate, clips, sampling)
    caches = {UNCACHED: None} | configs(calibrate(backbone, draw, sampling.steps))
    videos: dict[str, Tensor] = {}

    def draw_with(cache: str) -> None:
        videos[cache] = with_cache(backbone, caches[cache], draw)[0].cpu()

    times = alternate({cache: partial(draw_with, cache) for cache in caches}, rounds)
    return [
        (f"{memory}, {cache}", f"{times.median(cache) / len(truth):.3f}", f"{times.ratio(UNCACHED, cache):.2f}×",
         "" if cache == UNCACHED else f"{psnr(video, videos[UNCACHED]):.1f}", f"{psnr(video, truth):.2f}")
        for cache, video in videos.items()
    ]  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--steps", default="20,50")
    parser.add_argument("--guidance", type=float, default=1.0)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    logging.set_verbosity_error()  # FasterCache warns that it is experimental
    checkpoint = find_checkpoint(options.checkpoint or reference_checkpoint())
    backbone = load_backbone(checkpoint)
    say_conditions(f"{checkpoint.name}, DDIM, guidance over memory {options.guidance:g}")
    for steps in map(int, options.steps.split(",")):
        rows = []
        for adapter in (None, checkpoint.default_adapter()):
            load_adapter(backbone, checkpoint, adapter)
            backbone.prepare_inference(InferenceOptions())
            factory = MemoryFactory.of(adapter_memory(checkpoint, adapter)) if adapter else None
            sampling = Sampling(steps, "ddim", options.guidance)
            rows += table_rows(backbone, factory, adapter or "no memory", sampling, options.rounds)
        print_table(f"{steps} steps", ["memory, cache", "s a clip", "faster", "PSNR to none", "PSNR to truth"], rows)
