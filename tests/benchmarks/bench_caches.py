"""Which of diffusers' caches pay, with memory blocks and without: ``python tests/benchmarks/bench_caches.py``.

Prints a table for each number of DDIM steps, asserts nothing: seconds a clip, PSNR to the clip that is computed without
a cache, and PSNR to what is really there. The model is the reference model, or the checkpoint given, on the sample
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

from persist_cli.api.backbone import Backbone, Clips, Sampling
from persist_cli.api.inference import InferenceOptions
from persist_cli.checkpoints.checkpoint import (
    find_checkpoint,
    load_adapter,
    load_backbone,
    reference_checkpoint,
)
from persist_cli.data.reference import sample_data
from persist_cli.data.store import Store
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.rollout.world_model import ClipRequest, batch_of
from persist_cli.viewing.console import print_table
from tests.benchmarks.timing import alternate, say_conditions

UNCACHED = "none"
PLACES = (48,)  # where clips begin; memory holds what was seen before


def configs(ratios: list[float]) -> dict[str, Any]:
    """Each cache as its papers and diffusers' own examples set it, and first-block with two thresholds."""
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


def make_clips(backbone: Backbone, maker: MemoryFactory | None) -> tuple[Clips, Tensor]:
    """A batch that goes on from each place of each sample house, and the true colours of its frames."""
    requests, truth, frames = [], [], backbone.frames_per_clip
    for number, file in enumerate(Store(sample_data())):
        for place in PLACES:
            seen = file.read(range(place)).observations
            clip = file.read(range(place, place + frames)).observations
            tokens = None
            if maker is not None:
                memory = maker.empty(file.info)
                memory.write(seen)
                tokens = memory.read(clip.cameras, backbone.token_budget)
            seed = len(PLACES) * number + place
            requests.append(ClipRequest(clip[:1], clip.cameras, (None,) * (frames - 1), tokens, seed))
            truth.append(clip.rgb)
    return batch_of(requests), torch.stack(truth)


def calibrate(backbone: Any, draw: Callable[[], Any], steps: int) -> list[float]:
    """What MagCache says of these clips; it prints it."""
    backbone.transformer.enable_cache(MagCacheConfig(num_inference_steps=steps, calibrate=True))
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        draw()
    backbone.transformer.disable_cache()
    found = next(line for line in said.getvalue().splitlines() if line.startswith("[") and "," in line)
    return [float(each) for each in ast.literal_eval(found)]


def with_cache(backbone: Any, config: Any, draw: Callable[[], Any]) -> Any:
    """The clips drawn with a cache."""
    if config is not None:
        backbone.transformer.enable_cache(config)
    drawn = draw()
    if config is not None:
        backbone.transformer.disable_cache()
    return drawn


def psnr(one: Tensor, two: Tensor) -> float:
    """Of the frames after the given one, over all clips."""
    error = (one[:, 1:].double() - two[:, 1:].double()).square().mean()
    return float(10 * torch.log10(255**2 / error))


def rows(
    backbone: Any, maker: MemoryFactory | None, name: str, sampling: Sampling, rounds: int
) -> list[tuple[str, ...]]:
    """One for each cache."""
    clips, truth = make_clips(backbone, maker)
    draw = partial(backbone.generate, clips, sampling)
    caches = {UNCACHED: None} | configs(calibrate(backbone, draw, sampling.steps))
    drawn: dict[str, Tensor] = {}

    def work(each: str) -> None:
        drawn[each] = with_cache(backbone, caches[each], draw)[0].cpu()

    times = alternate({each: partial(work, each) for each in caches}, rounds)
    return [
        (f"{name}, {each}", f"{times.median(each) / len(truth):.3f}", f"{times.ratio(UNCACHED, each):.2f}×",
         "" if each == UNCACHED else f"{psnr(video, drawn[UNCACHED]):.1f}", f"{psnr(video, truth):.2f}")
        for each, video in drawn.items()
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
        table = []
        for adapter in (None, checkpoint.default_adapter()):
            load_adapter(backbone, checkpoint, adapter)
            backbone.prepare_inference(InferenceOptions())
            maker = MemoryFactory.of(checkpoint.memory_config(adapter)) if adapter else None
            sampling = Sampling(steps, "ddim", options.guidance)
            table += rows(backbone, maker, adapter or "no memory", sampling, options.rounds)
        print_table(f"{steps} steps", ["memory, cache", "s a clip", "faster", "PSNR to none", "PSNR to truth"], table)
