"""Controls that need no training: what a model with a memory must beat, and what it cannot exceed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.backbone import Backbone, Clip, Clips
from persist_cli.api.cameras import Cameras
from persist_cli.api.checkpoint import Checkpoint
from persist_cli.api.geometry import pose_differences
from persist_cli.api.observations import Observations
from persist_cli.api.promises import check_generated
from persist_cli.evaluate.cases import CaseFrames
from persist_cli.evaluate.coverage import held_frames
from persist_cli.evaluate.rows.interventions import NoisyPoses
from persist_cli.evaluate.rows.row import Row
from persist_cli.evaluate.rows.warp import Surface, warp

ViewRenderer = Callable[[Cameras, Tensor], tuple[Tensor, Tensor]]  # from a camera and distances to RGB and depth


class Control(Row):
    """A row that needs no training.

    Args:
        name: name in the table: the title, followed by a checkpoint where several rows have that title.
        base: checkpoint whose backbone the row needs.
        writes: whether the protocol writes predicted frames to the memory.
    """

    title: ClassVar[str]

    def __init__(self, name: str, base: Checkpoint, writes: bool = False) -> None:
        super().__init__(name, base)
        self.writes = writes


class Copy(Control):
    """The clip's first frame, repeated."""

    title = "copy of the first frame"
    definition = "the given first frame, repeated: a frozen video"

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Repeat the first frame of each clip as often as the clip has frames."""
        rgb = torch.stack([clip.observations.rgb[:1].expand_as(clip.observations.rgb) for clip in clips])
        depth = torch.stack([clip.observations.depth[:1].expand_as(clip.observations.depth) for clip in clips])
        return rgb, depth


class Truth(Control):
    """The clip itself, with the figures of a perfect prediction."""

    title = "ground truth"
    truth = "the true frames themselves"
    definition = "the true frames themselves"

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return the true frames."""
        return (
            torch.stack([clip.observations.rgb for clip in clips]),
            torch.stack([clip.observations.depth for clip in clips]),
        )


class CodecReconstruction(Control):
    """The true frames, encoded and decoded by the model's codec."""

    title = "codec reconstruction"
    truth = "the true frames themselves"
    uses_model = True
    definition = "true frames encoded and decoded, clip after clip as the model predicts them: the codec's ceiling"

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Encode and decode the true frames, all but the given one."""
        length = backbone.frames_per_clip - 1
        truths = [clip.observations for clip in clips]
        rgb = [torch.stack([truth.rgb[:1] for truth in truths])]
        depth = [torch.stack([truth.depth[:1] for truth in truths])]
        for first in range(0, len(truths[0]) - 1, length):
            count = min(length, len(truths[0]) - 1 - first)
            given = Clips.stack([cut_clip(truth, first, length) for truth in truths])
            images = backbone.reconstruct(given)
            check_generated(images, backbone.name, tuple(given.depth.shape))
            colors, metres = images
            rgb.append(colors[:, 1 : count + 1].cpu())
            depth.append(metres[:, 1 : count + 1].cpu())
        return torch.cat(rgb, dim=1), torch.cat(depth, dim=1)


class EarlierFramesControl(Control):
    """A control whose views are made of earlier true frames, those that the memory of a model would hold by then."""

    def videos(self, backbone: Backbone, clips: Sequence[CaseFrames], seeds: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Make each frame of the true frames that are held when it is predicted."""
        length = backbone.frames_per_clip - 1
        videos = [self.video(clip, length, seed) for clip, seed in zip(clips, seeds, strict=True)]
        return torch.stack([rgb for rgb, _ in videos]), torch.stack([depth for _, depth in videos])

    def earlier(self, clip: CaseFrames, length: int, seed: int) -> Observations:
        """The frames of the context and of the clip itself, of which ``held`` says when each is known."""
        return (
            clip.observations if clip.context is None else Observations.concatenate([clip.context, clip.observations])
        )

    def video(self, clip: CaseFrames, length: int, seed: int) -> tuple[Tensor, Tensor]:
        """The video of one clip, where ``length`` frames are predicted at once."""
        truth = clip.observations
        rgb, depth = truth.rgb.clone(), truth.depth.clone()
        earlier = self.earlier(clip, length, seed)
        render = self.renderer(earlier)
        for frame in range(1, len(rgb)):
            held = self.held(clip, frame, length)
            distances = pose_distances(earlier.cameras, truth.cameras[frame]).where(held, torch.inf)
            rgb[frame], depth[frame] = render(truth.cameras[frame : frame + 1], distances)
        return rgb, depth

    def held(self, clip: CaseFrames, frame: int, length: int) -> Bool[Tensor, " earlier"]:
        """A mask of the context and the clip: the frames known when a frame is predicted, never those to come."""
        case = clip.case
        numbers = held_frames(case.start, case.context, frame, length, self.writes)
        known = torch.zeros(case.context + case.frames, dtype=torch.bool)
        known[[*range(case.context), case.context]] = True  # the clip's given first frame follows the context
        known[[case.context + number - case.start for number in numbers if number >= case.start]] = True
        return known

    @abstractmethod
    def renderer(self, earlier: Observations) -> ViewRenderer:
        """A function that makes RGB and depth of a view from the frames whose distance from it is finite."""


class Nearest(EarlierFramesControl):
    """The frame that was taken at the nearest earlier pose."""

    title = "nearest earlier frame"
    truth = "true earlier frames and their poses"
    definition = "the true earlier frame whose pose is nearest (metres + radians) among those the memory holds by then"

    def renderer(self, earlier: Observations) -> ViewRenderer:
        """A function that returns the nearest frame unchanged."""

        def render(camera: Cameras, distances: Tensor) -> tuple[Tensor, Tensor]:
            nearest = int(distances.argmin())
            return earlier.rgb[nearest], earlier.depth[nearest]

        return render


class Warp(EarlierFramesControl):
    """Earlier RGB-D frames, projected into the view."""

    title = "geometric warp"
    truth = "true earlier frames with their depth and poses"
    definition = (
        "the true earlier RGB-D frames that the memory holds by then, projected into the asked view with a z-buffer, "
        "colours from the nearest pose that shows the surface, holes filled from the nearest pixel"
    )

    def renderer(self, earlier: Observations) -> ViewRenderer:
        """A function that warps the earlier frames into the view."""
        return partial(warp, Surface.of(earlier))


class NoisyWarp(Warp):
    """Earlier RGB-D frames with the pose errors that a memory of this clip and seed is written with.

    Args:
        base: checkpoint whose backbone says how many frames are predicted at once.
        writes: whether the protocol writes predicted frames to the memory.
        noise: makes the errors.
    """

    random = True
    truth = "true earlier frames with their depth, and wrong poses"

    def __init__(self, base: Checkpoint, writes: bool, noise: NoisyPoses) -> None:
        super().__init__(f"{Warp.title}, {noise.name}", base, writes)
        self.noise = noise

    @property
    def definition(self) -> str:  # type: ignore[override]
        """What is warped, and how its poses are off."""
        return f"{Warp.definition}; {self.noise.definition}, with the same errors here as in the memories"

    def earlier(self, clip: CaseFrames, length: int, seed: int) -> Observations:
        """The frames with wrong poses, disturbed in the order in which a model's memory is written."""
        disturb, truth = self.noise.disturber(clip, seed), clip.observations
        parts = [] if clip.context is None else [disturb(clip.context)]
        if not self.writes:
            return Observations.concatenate([*parts, truth])
        clips = [truth[first : first + length] for first in range(1, len(truth), length)]
        return Observations.concatenate([*parts, disturb(truth[:1]), *map(disturb, clips)])


def pose_distances(cameras: Cameras, view: Cameras) -> Float[Tensor, " frame"]:
    """Metres plus radians from every camera to that of a view."""
    poses = cameras.world_from_camera
    metres, degrees = pose_differences(poses, view.world_from_camera.expand_as(poses))
    return metres + torch.deg2rad(degrees)


def cut_clip(truth: Observations, first: int, length: int) -> Clip:
    """The frames ``first`` to ``first + length`` as a clip for the backbone, the last repeated to fill it."""
    numbers = [min(number, len(truth) - 1) for number in range(first, first + length + 1)]
    return Clip(truth[numbers], (None,) * length, seed=0)
