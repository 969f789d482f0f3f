"""A walk begins in a memory file: where its last path ends, or on open ground, with what the memory holds drawn."""

from __future__ import annotations

import pytest
import torch

from persist_cli.api.memory import MapPoints
from persist_cli.api.observations import Origin
from persist_cli.errors import CheckpointError, DataError
from persist_cli.memorize.memory_file import load_memory
from persist_cli.play.memory_start import drawn_points, memory_start
from persist_cli.play.open_play import PlayOptions, open_play
from persist_cli.play.start import StartOptions
from tests.support.cell_rooms import cell_room
from tests.support.drawn_scenes import empty_scene
from tests.support.micro_runs import SIZE
from tests.support.room_views import observe
from tests.support.rooms import look


@pytest.fixture(scope="module")
def remembered(walks, tmp_path_factory):
    """The file of a memory with a path."""
    from tests.support.micro_runs import run_persist

    path = tmp_path_factory.mktemp("memories") / "room.safetensors"
    run_persist("memorize", f"{walks}#0:0-12", "--out", str(path))
    return path


def test_a_walk_begins_where_the_last_path_of_a_memory_ends(voxel, walks, remembered):
    play = open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(str(remembered))))
    there = open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(f"{walks}#0:11")))
    one, two = play.shown.pose, there.shown.pose
    assert (one.x, one.y, one.degrees) == pytest.approx((two.x, two.y, two.degrees))
    assert play.shown.images["voxel"].shape == (SIZE, SIZE, 3)
    assert play.undo() is None  # to the drawing of points from which the first frame was imagined
    assert play.advance({"left"}).action == "left"
    assert play._walkers.lead.memory.figures().observed == load_memory(remembered).figures().observed


def test_a_memory_file_needs_no_suffix(voxel, remembered, tmp_path):
    file = tmp_path / "room"
    file.write_bytes(remembered.read_bytes())
    play = open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(str(file))))
    assert play.shown.images["voxel"].shape == (SIZE, SIZE, 3)


def test_a_completed_scene_is_entered_on_open_ground(tmp_path):
    scene = empty_scene()
    scene.add(cell_room())
    scene.save(tmp_path / "scene.safetensors", {})
    start = memory_start(tmp_path / "scene.safetensors", (SIZE, SIZE), (60.0, 60.0))
    frame = start.observations
    assert int(frame.origins[0]) == Origin.IMAGINED
    assert frame.depth.min() > 0.5  # farther than half a metre from every wall, in a closed room
    assert frame.depth.max() < 3.0


def test_points_are_drawn_where_the_camera_sees_them_the_nearest_in_front():
    view = observe([look((0.0, 1.4, 0.0), 20.0)], 48, 64)
    camera = view.cameras
    ahead = camera.world_from_camera[0, :3, 2].double()
    places = torch.stack([camera.centers[0].double() + metres * ahead for metres in (2.0, 1.0, -1.0)])
    colors = torch.tensor([[255, 0, 0], [0, 255, 0], [0, 0, 255]], dtype=torch.uint8)
    drawn = drawn_points(MapPoints(places, colors, 0.05), camera)
    assert drawn.rgb[0, 24, 32].tolist() == [0, 255, 0]
    assert float(drawn.depth[0, 24, 32]) == pytest.approx(1.0)
    assert not bool((drawn.rgb[0] == 255)[..., 2].any())
    assert float((drawn.depth == 0).float().mean()) > 0.9


def test_a_start_in_a_memory_that_does_not_fit_is_refused(voxel, tmp_path):
    empty = empty_scene()
    empty.save(tmp_path / "empty.safetensors", {})
    with pytest.raises(DataError, match="holds no places to stand at"):
        open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(str(tmp_path / "empty.safetensors"))))
    empty.add(cell_room())
    empty.save(tmp_path / "scene.safetensors", {})
    with pytest.raises(CheckpointError, match="a memory of kind 'scene', which voxel cannot read"):
        open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(str(tmp_path / "scene.safetensors"))))
    with pytest.raises(CheckpointError, match="no such memory file"):
        open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(str(tmp_path / "none.safetensors"))))
