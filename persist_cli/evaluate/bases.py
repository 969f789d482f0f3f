"""The backbones of an evaluation: one in memory at a time, and what must fit before anything is measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.inference import InferenceOptions
from persist_cli.checkpoints.checkpoint import Checkpoint, load_backbone
from persist_cli.checkpoints.sampling_defaults import SamplingOverrides
from persist_cli.data.clips import check_size
from persist_cli.data.store import Store
from persist_cli.errors import CheckpointError
from persist_cli.evaluate.rows.row import Row


class Backbones:
    """The backbone of one base at a time, loaded when another is wanted.

    Args:
        placement: how they sample.
    """

    def __init__(self, placement: InferenceOptions = InferenceOptions()) -> None:
        self.placement = placement
        self.backbone: Backbone | None = None
        self.loaded = ""

    def of(self, base: Checkpoint) -> Backbone:
        """The backbone of a checkpoint's base, without regard to its adapters."""
        if self.backbone is None or base.fingerprint != self.loaded:
            self.backbone, self.loaded = load_backbone(base), base.fingerprint
        return self.backbone

    def ready(self, row: Row) -> Backbone:
        """The backbone, prepared for this row."""
        backbone = self.of(row.base)
        row.prepare(backbone, self.placement)
        return backbone


@dataclass(frozen=True)
class Bases:
    """What was found of the rows' bases.

    Args:
        frames_per_clip: that all of them predict at once, the given frame included.
        depthless: fingerprints of those that give no depth.
    """

    frames_per_clip: int
    depthless: frozenset[str]


def check_bases(
    checkpoints: Sequence[Checkpoint], data: Sequence[Path], sampling: Sampling, backbones: Backbones
) -> Bases:
    """Load every base once, the first one last, and check that it takes the images and can be sampled so.

    Raises:
        PersistError: one line for the first that does not fit, and when clips are not equally long.
    """
    files = [(file.info, f"{folder}#{file.name}") for folder in data for file in Store(folder)]
    lengths: dict[int, Checkpoint] = {}
    depthless = set()
    for base in reversed(list({each.fingerprint: each for each in checkpoints}.values())):
        backbone = backbones.of(base)
        backbone.check_sampling(sampling)
        for info, where in files:
            check_size(info, backbone.image_size, where)
        lengths[backbone.frames_per_clip] = base
        depthless |= set() if backbone.gives_depth else {base.fingerprint}
    if len(lengths) > 1:
        told = " and ".join(f"{base.folder} predicts clips of {frames} frames" for frames, base in lengths.items())
        raise CheckpointError(f"{told}: they share no clips; evaluate them apart")
    return Bases(next(iter(lengths)), frozenset(depthless))


def common_sampling(checkpoints: Sequence[Checkpoint], asked: SamplingOverrides) -> Sampling:
    """The sampling of all rows: that asked for, else the one that every checkpoint's card means.

    Raises:
        CheckpointError: when cards mean different ones, because rows of one table are sampled alike.
    """
    meant = {asked.over(each.sampling): each for each in checkpoints}
    if len(meant) > 1:
        told = " and ".join(
            f"{each.folder} means {way.steps} steps of {way.sampler} with guidance {way.memory_guidance:g}"
            for way, each in meant.items()
        )
        raise CheckpointError(f"{told}; name --steps, --sampler and --guidance")
    return next(iter(meant))
