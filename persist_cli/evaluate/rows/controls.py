"""Controls that need no training: what a model with a memory must beat, and what it cannot exceed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.backbone import Backbone, Clip, Clips
from persist_cli.api.cameras import Cameras
from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.geometry import pose_differences
from persist_cli.api.observations import Observations
from persist_cli.evaluate.cases import CaseFrames
from persist_cli.evaluate.coverage import held_frames
from persist_cli.evaluate.rows.row import Row
from persist_cli.evaluate.rows.warp import Surface, warp

Shower = Callable[[Cameras, Tensor], tuple[Tensor, Tensor]]


class Copy(Row):
    """The clip's first frame, repeated."""

    definition = "the given first frame, repeated: a frozen video"

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """The first frame of each clip as often as it has frames."""
        rgb = torch.stack([clip.observations.rgb[:1].expand_as(clip.observations.rgb) for clip in clips])
        depth = torch.stack([clip.observations.depth[:1].expand_as(clip.observations.depth) for clip in clips])
        return rgb, depth


class Truth(Row):
    """The clip itself: what perfect prediction scores."""

    definition = "the true frames themselves"

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """The true frames."""
        return (
            torch.stack([clip.observations.rgb for clip in clips]),
            torch.stack([clip.observations.depth for clip in clips]),
        )


class CodecReconstruction(Row):
    """Ground truth after the codec."""

    uses_model = True
    definition = "true frames encoded and decoded, clip after clip as the model predicts them: the codec's ceiling"

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Encoded and decoded ground truth, the given frame as it is."""
        length = backbone.frames_per_clip - 1
        truths = [clip.observations for clip in clips]
        rgb, depth = (
            [torch.stack([truth.rgb[:1] for truth in truths])],
            [torch.stack([truth.depth[:1] for truth in truths])],
        )
        for first in range(0, len(truths[0]) - 1, length):
            wanted = min(length, len(truths[0]) - 1 - first)
            colors, metres = backbone.reconstruct(Clips.stack([part_of(truth, first, length) for truth in truths]))
            rgb.append(colors[:, 1 : wanted + 1].cpu())
            depth.append(metres[:, 1 : wanted + 1].cpu())
        return torch.cat(rgb, dim=1), torch.cat(depth, dim=1)


class Memoryless(Row):
    """A control made of the frames that the memory holds by then, as they really were."""

    def __init__(self, name: str, base: Checkpoint, writes: bool) -> None:
        super().__init__(name, base)
        self.writes = writes

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Each frame made of the true frames held when it is predicted."""
        made = [self.video(clip, backbone.frames_per_clip - 1) for clip in clips]
        return torch.stack([rgb for rgb, _ in made]), torch.stack([depth for _, depth in made])

    def video(self, clip: CaseFrames, length: int) -> tuple[Tensor, Tensor]:
        """One clip; ``length`` frames are predicted at once."""
        truth = clip.observations
        rgb, depth = truth.rgb.clone(), truth.depth.clone()
        earlier = truth if clip.context is None else Observations.concatenate([clip.context, truth])
        show = self.shower(earlier)
        for frame in range(1, len(rgb)):
            held = self.held(clip, frame, length)
            distances = pose_distances(earlier.cameras, truth.cameras[frame]).where(held, torch.inf)
            rgb[frame], depth[frame] = show(truth.cameras[frame : frame + 1], distances)
        return rgb, depth

    def held(self, clip: CaseFrames, frame: int, length: int) -> Bool[Tensor, " earlier"]:
        """Which of the context's and the clip's frames are known when a frame is predicted: never those to come."""
        case = clip.case
        numbers = held_frames(case.start, case.context, frame, length, self.writes)
        known = torch.zeros(case.context + case.frames, dtype=torch.bool)
        known[[*range(case.context), case.context]] = True  # the clip's given first frame follows the context
        known[[case.context + number - case.start for number in numbers if number >= case.start]] = True
        return known

    @abstractmethod
    def shower(self, earlier: Observations) -> Shower:
        """What makes RGB and depth of a view from the frames whose distance from it is finite."""


class Nearest(Memoryless):
    """The frame taken at the nearest earlier pose."""

    definition = "the true earlier frame whose pose is nearest (metres + radians) among those the memory holds by then"

    def shower(self, earlier: Observations) -> Shower:
        """The nearest frame as it is."""

        def show(camera: Cameras, distances: Tensor) -> tuple[Tensor, Tensor]:
            nearest = int(distances.argmin())
            return earlier.rgb[nearest], earlier.depth[nearest]

        return show


class Warp(Memoryless):
    """Earlier RGB-D frames projected into the asked view."""

    definition = (
        "the true earlier RGB-D frames that the memory holds by then, projected into the asked view with a z-buffer, "
        "colours from the nearest pose that shows the surface, holes filled from the nearest pixel"
    )

    def shower(self, earlier: Observations) -> Shower:
        """The warped view."""
        return partial(warp, Surface.of(earlier))


def pose_distances(cameras: Cameras, asked: Cameras) -> Float[Tensor, " frame"]:
    """Metres plus radians from every camera to the one asked for."""
    poses = cameras.world_from_camera
    metres, degrees = pose_differences(poses, asked.world_from_camera.expand_as(poses))
    return metres + torch.deg2rad(degrees)


def part_of(truth: Observations, first: int, length: int) -> Clip:
    """The frames ``first`` to ``first + length`` as a batch's sample, the last repeated to fill it."""
    numbers = [min(number, len(truth) - 1) for number in range(first, first + length + 1)]
    part = truth[numbers]
    return Clip(part, (None,) * length, seed=0)
