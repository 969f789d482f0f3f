"""Memories of whole frames: the last ones, and those whose fields of view cover most; neither ever sees depth."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from persist_cli.api.backbone import Clip
from persist_cli.api.cameras import Cameras
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.api.observations import Observations, Origin
from persist_cli.api.tokens import MemoryTokens
from persist_cli.data.clips import ClipSample
from persist_cli.errors import CheckpointError, DataError
from persist_cli.memorize.factory import MemoryFactory, with_memory
from persist_cli.plugins import make_encoder
from persist_memory.frames.context import ContextMemory
from persist_memory.frames.frame_memory import FrameMemory, FrameSettings
from persist_memory.frames.views import ViewsMemory, ViewsSettings, view_points
from tests.support.room_views import observe, room_walk
from tests.support.rooms import UP, Room, look

KINDS: dict[str, tuple[type[FrameMemory], FrameSettings]] = {
    "context": (ContextMemory, FrameSettings()),
    "views": (ViewsMemory, ViewsSettings()),
}
of_both_kinds = pytest.mark.parametrize("kind", KINDS)


def empty(kind: str, **settings: int) -> FrameMemory:
    """An empty memory of a kind, with these settings instead of the defaults."""
    memory, defaults = KINDS[kind]
    made = memory(replace(defaults, **settings), make_encoder("patches", {}), FrameOfReference("room", UP))
    made.name = kind
    return made


def written(kind: str, observations: Observations, **settings: int) -> FrameMemory:
    """A memory into which these frames were written without their depth."""
    memory = empty(kind, **settings)
    memory.memorize(observations)
    return memory


@of_both_kinds
def test_an_empty_memory_gives_no_frame_but_the_size_of_frames(kind: str) -> None:
    tokens = empty(kind).read(room_walk(2).cameras, 9)
    assert len(tokens) == 0
    assert tokens.images is not None
    assert tokens.images.shape == (0, 48, 64, 3)
    assert empty(kind).figures().cells == 0


@of_both_kinds
def test_a_read_gives_frames_as_they_were_seen_with_their_cameras(kind: str) -> None:
    walk = room_walk(3)
    tokens = written(kind, walk).read(walk.cameras, 9)
    for image, pose, position in zip(tokens.images, tokens.world_from_camera, tokens.positions, strict=True):
        same = [frame for frame in range(3) if torch.equal(walk.cameras.world_from_camera[frame], pose)]
        assert torch.equal(walk.rgb[same[0]], image)
        assert torch.equal(pose[:3, 3], position)


@of_both_kinds
def test_a_read_gives_at_most_the_count_and_the_budget(kind: str) -> None:
    walk = room_walk(6)
    memory = written(kind, walk, count=3)
    assert [len(memory.read(walk.cameras, budget)) for budget in (0, 2, 9)] == [0, 2, 3]


def test_context_is_the_last_frames_the_newest_first() -> None:
    walk = room_walk(6)
    memory = written("context", walk[:5], count=2)
    memory.memorize(walk[5:].with_origin(Origin.IMAGINED))
    tokens = memory.read(walk.cameras[:1], 9)
    assert torch.equal(tokens.images, walk.rgb[[5, 4]])
    assert tokens.origins.tolist() == [Origin.IMAGINED, Origin.OBSERVED]


def test_views_finds_the_frame_that_looks_where_the_cameras_look() -> None:
    walk = room_walk(8)
    memory = written("views", walk, count=1)
    for frame in range(8):
        assert torch.equal(memory.read(walk.cameras[frame : frame + 1], 1).images[0], walk.rgb[frame])


def test_views_chooses_frames_that_complete_each_other() -> None:
    walk = room_walk(8)
    memory = written("views", Observations.concatenate([walk[:1], walk[:2], walk[4:5]]), count=2)
    chosen = memory.read(Cameras.concatenate([walk.cameras[:1], walk.cameras[4:5]]), 2).images
    assert {image.numpy().tobytes() for image in chosen} == {walk.rgb[n].numpy().tobytes() for n in (0, 4)}


def test_a_full_album_of_views_drops_a_frame_that_others_show_and_keeps_observed_ones() -> None:
    walk = room_walk(8)
    memory = written("views", walk[[0, 4, 0]], capacity=2)
    memory.memorize(walk[[1, 2, 3]].with_origin(Origin.IMAGINED))
    tensors = memory.tensors()
    assert tensors["origins"].tolist() == [Origin.OBSERVED] * 2 + [Origin.IMAGINED] * 2
    assert {image.numpy().tobytes() for image in tensors["images"][:2]} == {
        walk.rgb[n].numpy().tobytes() for n in (0, 4)
    }


@of_both_kinds
def test_a_restored_memory_is_equal_to_the_bit(kind: str) -> None:
    walk = room_walk(5)
    memory, restored = written(kind, walk), empty(kind)
    restored.restore(memory.tensors())
    assert all(torch.equal(part, restored.tensors()[name]) for name, part in memory.tensors().items())
    memory.clear()
    assert memory.tensors() == {}


@of_both_kinds
def test_tensors_of_another_memory_are_refused(kind: str) -> None:
    memory = written(kind, room_walk(2))
    with pytest.raises(CheckpointError, match="its tensors are not those of this memory"):
        memory.restore({"cells": torch.zeros(2, 3)})
    assert memory.figures().cells == 2


@of_both_kinds
def test_frames_of_two_sizes_are_refused_in_one_line(kind: str) -> None:
    memory, walk = written(kind, room_walk(2)), room_walk(1)
    larger = replace(
        walk, rgb=walk.rgb.repeat_interleave(2, 1), depth=walk.depth.repeat_interleave(2, 1),
        cameras=replace(walk.cameras, height=96),
    )  # fmt: skip
    with pytest.raises(DataError, match="it holds frames of 48x64 pixels, a new one has 96x64"):
        memory.memorize(larger)


@of_both_kinds
def test_frames_with_depth_are_refused(kind: str) -> None:
    with pytest.raises(DataError, match="it takes frames without depth"):
        empty(kind).write(room_walk(1))


class Watching(ContextMemory):
    """A memory that looks at the depth that it is given."""

    seen: tuple[float, ...] = ()

    def write(self, observations: Observations) -> None:
        self.seen = (*self.seen, float(observations.depth.max()))
        super().write(observations)


def test_no_memory_that_reads_no_depth_is_ever_given_any() -> None:
    walk, made = room_walk(4), []

    def make(*arguments) -> Memory:
        made.append(Watching(*arguments))
        return made[-1]

    factory = MemoryFactory(make, FrameSettings(), make_encoder("patches", {}))  # type: ignore[arg-type]
    with_memory(ClipSample(Clip(walk, (None,) * 3, 0), walk, Room().info), factory, 4)
    assert walk.depth.max() > 1
    assert made[0].seen == (0.0,)


@of_both_kinds
def test_a_batch_of_frames_is_padded(kind: str) -> None:
    walk = room_walk(3)
    memory = written(kind, walk)
    batch = MemoryTokens.stack([memory.read(walk.cameras, budget) for budget in (0, 1, 3)])
    assert batch.mask.sum(1).tolist() == [0, 1, 3]
    assert batch.images.shape == (3, 3, 48, 64, 3)


def test_points_of_a_view_lie_in_it() -> None:
    cameras = room_walk(2).cameras
    points = view_points(cameras)
    assert points.shape == (2, 64, 3)
    local = torch.linalg.inv(cameras.world_from_camera[1]) @ torch.cat([points[1], torch.ones(64, 1)], 1).T
    assert (local[2] > 0.4).all()


def test_an_album_of_views_drops_one_of_each_pair_and_not_both_of_one() -> None:
    walk = room_walk(8)
    images = written("views", walk[[0, 0, 4, 4]], capacity=2).tensors()["images"]
    assert {image.numpy().tobytes() for image in images} == {walk.rgb[n].numpy().tobytes() for n in (0, 4)}


def test_of_views_that_show_as_much_the_nearest_is_read() -> None:
    behind_and_here = observe([look((0.0, 1.4, 1.0), 0.0, 0.0), look((0.0, 1.4, 0.0), 0.0, 0.0)])
    chosen = written("views", behind_and_here, count=1).read(behind_and_here.cameras[1:], 1)
    assert torch.equal(chosen.images[0], behind_and_here.rgb[1])
