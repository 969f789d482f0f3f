"""Training steps of both stages, compared with the plain loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Iterator
from functools import partial
from itertools import repeat
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor
from torch.utils.data import Dataset

from persist_cli.api.backbone import Clips
from persist_cli.api.clips import ClipLatents
from persist_cli.api.stages import Stage
from persist_cli.api.tokens import MemoryTokens
from persist_cli.recipe import apply_overrides, make_recipe, read_recipe
from persist_cli.train.trainer import Trainer
from tests.benchmarks.full_scale import flops
from tests.benchmarks.full_scale.measuring import Timing, Turns, Work, release
from tests.benchmarks.full_scale.plain import Plain, share_moments
from tests.benchmarks.full_scale.rows import Row, Target
from tests.benchmarks.full_scale.shapes import ADAPTER, Bench

RECIPES: dict[Stage, str] = {"1": "tiny-stage1", "2": "tiny-stage2-voxel"}

ENDLESS = 1_000_000  # steps

UTILISATION = 0.45  # target of model FLOP utilisation


class NoClips(Dataset[Any]):
    """A data set without a clip; the trainer gets its batch directly."""

    files: tuple[()] = ()


class FixedBatchTrainer(Trainer):
    """The training loop on one batch over and over, which begins at latents.

    Args:
        bench: the model.
        stage: stage of the training.
        batch: the clips, with their latents.
    """

    def __init__(self, bench: Bench, stage: Stage, batch: Clips) -> None:
        self.batch = batch
        changes = [
            "base=none", f"training.batch={len(batch.seeds)}", f"training.steps={ENDLESS}", "training.warmup=0",
            "training.cooldown=0", "training.ema=0", f"training.precision={'bf16' if bench.mixed else 'no'}",
            "data.clips_per_trajectory=0", *bench.changes,
        ]  # fmt: skip
        recipe = make_recipe(apply_overrides(read_recipe(RECIPES[stage]), changes), "the benchmark")
        accelerator = Accelerator(cpu=bench.device.type == "cpu", mixed_precision=recipe.training.precision)
        super().__init__(recipe, bench.backbone, None, accelerator)

    def all_clips(self) -> Any:
        """No clip."""
        return NoClips()

    def loader(self) -> Generator[Clips, None, None]:
        """The same batch without end."""
        yield from repeat(self.batch)


def make_batch(bench: Bench, batch: int, tokens: int) -> Clips:
    """Clips with random latents and ``tokens`` random tokens of a memory; 0 for no memory."""
    frames, height, width = bench.size
    codec = bench.backbone.codec
    latent_frames = (frames - 1) // codec.temporal + 1
    shape = (batch, latent_frames, 2 * codec.channels, height // codec.spatial, width // codec.spatial)
    features = torch.randn(batch, tokens, bench.model.channels)
    memory = MemoryTokens(features, 2 * torch.randn(batch, tokens, 3).double(), torch.ones(batch, tokens).bool())
    video = torch.randn(shape, device=bench.device, dtype=bench.precision)
    latents = ClipLatents(video, video[:, :1] if bench.backbone.framewise else torch.randn_like(video[:, :1]))
    return dataclasses.replace(bench.clips(batch, 0), latents=latents, tokens=memory if tokens else None)


def plain_batch(bench: Bench, clips: Clips) -> tuple[Tensor, Tensor, Tensor]:
    """Latents, image latents and camera latents of the clips, for the plain loop."""
    assert clips.latents is not None
    camera = bench.backbone.conditions(clips, torch.zeros(len(clips.seeds)).long()).camera
    image = bench.backbone.image_condition(clips.latents.image, bench.backbone.shape)
    latents, image, camera = (
        part.to(bench.device, bench.precision)
        for part in (bench.backbone.shape.pad(clips.latents.video), image, camera)
    )
    return latents, image, camera


def stage1_steps(bench: Bench, batch: int) -> dict[str, Work]:
    """Functions that take a step of ours and of the plain loop; both train the same blocks and share their moments."""
    bench.backbone.use_adapter(None)
    clips = make_batch(bench, batch, 0)
    trainer = FixedBatchTrainer(bench, "1", clips)
    settings, plain = trainer.recipe.training, Plain(bench)
    if settings.gradient_checkpointing:
        plain.transformer.enable_gradient_checkpointing()
    options = {"lr": settings.learning_rate, "weight_decay": settings.weight_decay}
    optimizer = torch.optim.AdamW(plain.transformer.parameters(), **options)
    batch_latents, steps = plain_batch(bench, clips), trainer.steps()

    def ours() -> None:
        next(steps)
        if not optimizer.state:
            blocks = plain.transformer.transformer_blocks
            share_moments(trainer.state.moments, optimizer.state, list(blocks.parameters()))

    return {"ours": ours, "plain": partial(plain.step, batch_latents, optimizer, settings.clip)}


def stage2_steps(bench: Bench, batch: int) -> dict[str, Work]:
    """A function that takes a step of ours with as many tokens as the adapter takes."""
    bench.backbone.use_adapter(ADAPTER)
    trainer = FixedBatchTrainer(bench, "2", make_batch(bench, batch, bench.backbone.token_budget))
    return {"ours": partial(next, trainer.steps())}


def fitting(bench: Bench, stage: Stage) -> tuple[int, dict[str, Timing | None]]:
    """The largest batch that fits, halving from the model's own, and the timings of steps with it."""
    make, batch = stage1_steps if stage == "1" else stage2_steps, bench.model.batch
    while True:
        bench.backbone.train()
        try:
            with bench.training():
                timings = Turns(bench.device, bench.rounds).measure(make(bench, batch))
        except torch.OutOfMemoryError:
            timings = {"ours": None}
        bench.backbone.zero_grad(set_to_none=True)
        bench.backbone.eval().requires_grad_(False)
        release(bench.device)
        if timings["ours"] is not None or batch == 1:
            return batch, timings
        batch //= 2


def step_rows(bench: Bench) -> Iterator[Row]:
    """A step of stage 1 beside the plain loop's, and a step of stage 2."""
    batch, timings = fitting(bench, "1")
    video, size = flops.video_sizes(bench.backbone, batch), "×".join(map(str, bench.size))
    row = Row(
        bench.model.name, f"stage-1 step, {batch} × {size}", timings["ours"], "plain diffusers", timings.get("plain"),
        batch, flops.stage1_step(video), bench.peak,
    )  # fmt: skip
    targets = [Target("no slower than plain", row.ratio, 1.0)]
    if bench.model.name == "5b":
        targets.append(Target(f"utilisation ≥ {UTILISATION:.0%}", row.utilisation, UTILISATION, at_most=False))
    yield row.with_targets(*targets) if bench.model.published else row
    batch, timings = fitting(bench, "2")
    tokens = bench.backbone.token_budget
    memory = flops.memory_sizes(bench.backbone, tokens)
    total = flops.stage2_step(flops.video_sizes(bench.backbone, batch), memory)
    what = f"stage-2 step, {batch} × {size}, {tokens} tokens"
    yield Row(bench.model.name, what, timings["ours"], samples=batch, flops=total, peak=bench.peak)
