"""The backbones of an evaluation: one in memory at a time, and what must fit before anything is measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.checkpoints.load import check_noise, check_video_model, empty_backbone, load_backbone
from persist_cli.data.clips import check_size
from persist_cli.data.store import Store
from persist_cli.errors import CheckpointError
from persist_cli.evaluate.rows.row import Row, unique_bases


class BackboneLoader:
    """Holds the backbone of one base at a time and loads another when it is wanted.

    Args:
        placement: device and precision of the backbones.
    """

    def __init__(self, placement: InferenceOptions = InferenceOptions()) -> None:
        self.placement = placement
        self.backbone: Backbone | None = None
        self.fingerprint = ""

    def load(self, base: Checkpoint) -> Backbone:
        """The backbone of a checkpoint's base, without regard to its adapters."""
        if self.backbone is None or base.fingerprint != self.fingerprint:
            self.backbone, self.fingerprint = load_backbone(base), base.fingerprint
        return self.backbone

    def load_for(self, row: Row) -> Backbone:
        """The backbone, prepared for this row."""
        backbone = self.load(row.base)
        row.prepare(backbone, self.placement)
        return backbone


@dataclass(frozen=True)
class BaseProperties:
    """Properties of the bases that the rows stand on.

    Args:
        frames_per_clip: frames that each of them predicts at once, the given frame included.
        depthless: fingerprints of the bases whose models take no depth and give none.
    """

    frames_per_clip: int
    depthless: frozenset[str]


def check_bases(
    checkpoints: Sequence[Checkpoint], data: Sequence[Path], samplings: Sequence[Sampling], loader: BackboneLoader
) -> BaseProperties:
    """Check that every base takes the images and can be sampled so, then load each once, the first one last.

    Raises:
        PersistError: one line for the first that does not fit or is damaged, and when clips are not equally long.
    """
    for sampling in samplings:
        check_noise(sampling, checkpoints)
    files = [(file.info, f"{folder}#{file.name}") for folder in data for file in Store(folder)]
    bases = unique_bases(checkpoints)
    bases_by_length: dict[int, Checkpoint] = {}
    depthless = set()
    for base in reversed(bases):
        backbone = empty_backbone(base)
        for sampling in samplings:
            backbone.check_sampling(sampling)
        for info, where in files:
            check_size(info, backbone.image_size, where)
        bases_by_length[backbone.frames_per_clip] = base
        if not backbone.gives_depth:
            depthless.add(base.fingerprint)
    if len(bases_by_length) > 1:
        lengths = " and ".join(
            f"{base.folder} predicts clips of {frames} frames" for frames, base in bases_by_length.items()
        )
        raise CheckpointError(f"{lengths}: they share no clips; evaluate them apart")
    for base in reversed(bases):
        loader.load(base)
    return BaseProperties(next(iter(bases_by_length)), frozenset(depthless))


def common_sampling(checkpoints: Sequence[Checkpoint], overrides: SamplingOverrides, protocol: str) -> Sampling:
    """The sampling of all rows: what the command line overrides, the rest from the checkpoints' cards for a protocol.

    Raises:
        CheckpointError: when the cards give different ones, because rows of one table are sampled alike.
    """
    for checkpoint in checkpoints:
        check_video_model(checkpoint)
    checkpoints_by_sampling = {checkpoint.sampling_with(overrides, protocol): checkpoint for checkpoint in checkpoints}
    if len(checkpoints_by_sampling) > 1:
        samplings = " and ".join(
            f"{checkpoint.folder} means {sampling.words}" for sampling, checkpoint in checkpoints_by_sampling.items()
        )
        raise CheckpointError(f"{samplings}; name --steps, --sampler, --guidance, --context-noise and --autoguidance")
    return next(iter(checkpoints_by_sampling))
