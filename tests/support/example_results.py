"""Example results of `persist eval`, with invented figures, for tests of the report."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from persist_cli.evaluate.report.pictures import ClipPicture, Pictures, RowPictures, Sheet

METRICS = {
    "psnr": ("PSNR", "higher", "dB, 8-bit RGB over the whole frame", 20.0, {}),
    "ssim": ("SSIM", "higher", "Gaussian window 11, sigma 1.5", 0.7, {}),
    "lpips-alex": ("LPIPS", "lower", "AlexNet, v0.1 heads, RGB at 64×64 without resize", 0.2, {"lpips-alex": "a" * 64}),
    "src": ("SRC", "higher", "100 × cosine of features at the return and at the first visit", 80.0, {}),
}

COLUMNS = {
    "psnr": ("psnr", "PSNR", "all"), "psnr-last": ("psnr", "PSNR last", "last"), "ssim": ("ssim", "SSIM", "all"),
    "lpips-alex": ("lpips-alex", "LPIPS", "all"), "src": ("src", "SRC", "all"),
}  # fmt: skip

ROWS = {
    "none": "model",
    "voxel": "model",
    "voxel, shuffled": "memory control",
    "copy of the first frame": "control",
    "codec reconstruction": "control",
}

GAINS = (0.0, 0.1, 0.005, -0.2, 0.3)

DREAMSIM = "weights dreamsim are not here: persist weights fetch dreamsim"


def cell(metric: str, gain: float, clips: int, first: bool, random: bool) -> dict[str, Any]:
    """A cell whose figure is better than the metric's usual one by the share ``gain``."""
    _, better, _, usual, _ = METRICS[metric]
    noise = np.random.default_rng(500 + round(1000 * gain)).normal(0, 0.02, clips)
    factor = gain if better == "higher" else -gain
    per_clip = usual * (1 + factor + noise)
    mean, half = float(per_clip.mean()), usual * 0.02
    gap = {"mean": usual * factor, "low": usual * factor - half, "high": usual * factor + half}
    return {
        "mean": mean, "std": usual * 0.004 if random else None, "low": mean - half, "high": mean + half,
        "count": clips, "per_clip": per_clip.tolist(), "difference": None if first else gap,
    }  # fmt: skip


def row(name: str, kind: str, gain: float, clips: int, frames: int) -> dict[str, Any]:
    """A row with every column and a curve for each metric."""
    random = kind != "control"
    curves = {}
    for metric, (_, better, _, usual, _) in METRICS.items():
        sign = 1 if better == "higher" else -1
        line = [usual * (1 + sign * (gain + 0.4 / (1 + frame) - 0.1)) for frame in range(1, frames)]
        shares = [
            {"low": low / 5, "high": (low + 1) / 5, "mean": usual * (1 + sign * gain * low / 5), "count": 40 - 5 * low}
            for low in range(5)
        ]
        curves[metric] = {"per_frame": line, "by_seen_before": shares}
    columns: dict[str, Any] = {
        key: cell(metric, gain, clips, name == "none", random) for key, (metric, _, _) in COLUMNS.items()
    }
    columns["dreamsim"] = {"na": DREAMSIM}
    return {
        "kind": kind, "definition": f"what {name} is", "checkpoint": "voxel" if random else None,
        "memory": name if random else None, "columns": columns, "curves": curves,
    }  # fmt: skip


def example_results(clips: int = 6, frames: int = 9, rows: dict[str, str] = ROWS) -> dict[str, Any]:
    """Results of a run with a base row, a memory, a memory control and two controls."""
    metrics = {
        name: {"title": title, "better": better, "definition": definition, "weights": weights}
        for name, (title, better, definition, _, weights) in METRICS.items()
    }
    metrics["dreamsim"] = {"title": "DreamSim", "better": "lower", "definition": "ensemble", "weights": {}}
    columns = {
        key: {"metric": metric, "title": title, "better": METRICS[metric][1], "definition": METRICS[metric][2],
              "frames": selection}
        for key, (metric, title, selection) in COLUMNS.items()
    }  # fmt: skip
    columns["dreamsim"] = {"metric": "dreamsim", "title": "DreamSim", "better": "lower", "definition": "ensemble",
                           "frames": "all"}  # fmt: skip
    gains = dict(zip(rows, [*GAINS, *np.linspace(0.02, 0.3, len(rows))], strict=False))
    table = {name: row(name, kind, gains[name], clips, frames) for name, kind in rows.items()}
    return {
        "format": "persist-evaluation", "version": 1, "measured": measured(clips, frames, metrics),
        "sampling": {"steps": 50, "sampler": "ddim", "sampling_of": {}, "seeds": [0, 1, 2], "batch": 8},
        "environment": {"persist": "0.3.0", "python": "3.11.2", "torch": "2.13.0", "platform": "Linux", "device": "cpu",
                        "packages": {"diffusers": "0.42.1", "numpy": "2.4.6"}, "processes": 2},
        "command": ["persist", "eval", "runs/voxel", "--data", "runs/houses test", "--memories", "none,voxel"],
        "checkpoints": [{"name": "voxel", "path": "runs/voxel", "fingerprint": "f" * 64, "recipe_sha256": "e" * 64,
                         "adapters": {"voxel": "d" * 64}}],
        "columns": columns, "tables": [{"name": "all", "clips": list(range(clips)), "rows": table}],
        "first_row": "none",
    }  # fmt: skip


def measured(clips: int, frames: int, metrics: dict[str, Any]) -> dict[str, Any]:
    """The part of the results that two runs must share to be compared."""
    return {
        "protocol": {"name": "revisit", "title": "Revisit", "definition": "Clips that look at places visited before.",
                     "frames": frames},
        "data": [{"path": "runs/houses-test", "trajectories": {f"house-{n}": f"{n:064x}" for n in range(3)}}],
        "image_size": [64, 64],
        "clips": [
            {"data": 0, "trajectory": f"house-{clip % 3}", "scene": f"{clip % 3}", "start": 12 * clip,
             "frames": frames, "seen_before": [None, *np.linspace(0.3, 0.9, frames - 1)], "path_metres": 1.5}
            for clip in range(clips)
        ],
        "metrics": metrics,
    }  # fmt: skip


def example_pictures(results: dict[str, Any], size: int = 32) -> Pictures:
    """Pictures of walks past coloured stripes; every row's video is the truth with some noise."""
    frames = results["measured"]["protocol"]["frames"]
    names = list(results["tables"][0]["rows"])

    def make_video(clip: int, noise: float) -> torch.Tensor:
        across = torch.arange(size)[None, None, :] + 2 * torch.arange(frames)[:, None, None] + 5 * clip
        waves = [(torch.sin(across * pitch) * 90 + 128).expand(frames, size, size) for pitch in (0.2, 0.31, 0.47)]
        clean = torch.stack(waves, dim=-1) * torch.linspace(0.6, 1.1, size)[None, :, None, None]
        noisy = clean + noise * torch.randn(clean.shape, generator=torch.Generator().manual_seed(clip))
        return noisy.clamp(0, 255).to(torch.uint8)

    def make_clip(number: int, noise: float) -> ClipPicture:
        depth = make_video(number, 0.0)[..., 0].float() / 50
        return ClipPicture(
            number, f"PSNR {30 - noise:.2f}", make_video(number, noise), make_video(number, 0.0), depth + 0.2, depth
        )

    rows = tuple(
        RowPictures("all", name, make_clip(0, 5.0), make_clip(1, 15.0 + number), make_clip(2, 30.0))
        for number, name in enumerate(names)
    )
    sheet = Sheet("clip 0", (("ground truth", make_video(0, 0.0)), *((name, make_video(0, 9.0)) for name in names)))
    return Pictures(rows, (sheet,))
