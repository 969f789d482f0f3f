"""Interactions change the scene that is walked in, once for each press of a key, and can be undone."""

from __future__ import annotations

import torch

from persist_cli.api.observations import Trajectory
from persist_cli.play.play import Play
from persist_cli.play.settings import PlaySettings
from tests.support.cell_rooms import BOX_CELLS, camera_at, cell_room
from tests.support.drawn_scenes import DrawnWalls, empty_scene
from tests.support.scene_worlds import scene_world

FORWARD, LEFT, PICK_UP = frozenset({"forward"}), frozenset({"left"}), frozenset({"pick_up"})


def play_in_scene() -> Play:
    """A walk in a room of cells, 1.25 m before a box."""
    scene = empty_scene()
    scene.add(cell_room())
    world = scene_world(scene, camera_at(cell_room(), (4, 4, 5), (9, 4, 5), size=64))
    agent = world.agents[0]
    return Play({"scene": world}, Trajectory("room", agent.now, (None,), agent.info), PlaySettings())


def play_through_walls() -> Play:
    """A walk from the same place without a body, in a scene that imagines what is outside of the room."""
    play = play_in_scene()
    world = play._walkers.worlds["scene"]
    world.agents[0].body = None
    world.agents[0].memory = empty_scene(DrawnWalls())
    world.agents[0].memory.add(cell_room())
    return Play({"scene": world}, play._start, PlaySettings(ahead=False))


def cells_of(play: Play) -> dict[str, torch.Tensor]:
    return play._walkers.lead.memory.tensors()


def ground_of(play: Play) -> torch.Tensor:
    return play._walkers.lead.surroundings.map().states


def box_is_there(play: Play) -> bool:
    grid = cell_room()
    return bool(play._walkers.lead.scene.cells.box(grid.corner, grid.shape).solid[BOX_CELLS].any())


def test_a_thing_is_picked_up_once_and_the_way_is_free_then():
    play = play_in_scene()
    assert [play.advance(FORWARD).free for _ in range(4)] == [True, True, True, False]
    taken = play.advance(PICK_UP)
    assert taken.action == "pick_up"
    assert taken.free
    assert not box_is_there(play)
    assert play.advance(PICK_UP) is None  # while the key is still held
    assert play.advance(FORWARD).free


def test_a_key_that_is_pressed_again_acts_again_and_one_held_through_a_reset_does_not():
    play = play_in_scene()
    assert play.advance(PICK_UP).free
    play.undo()
    assert play.advance(PICK_UP) is None
    assert play.advance(PICK_UP, PICK_UP).free
    play.reset()
    assert play.advance(PICK_UP) is None
    assert box_is_there(play)


def test_a_thing_that_is_picked_up_is_back_after_undo():
    play = play_in_scene()
    play.advance(FORWARD)
    before = play.shown
    play.advance(PICK_UP)
    assert not box_is_there(play)
    back = play.undo()
    assert box_is_there(play)
    assert torch.equal(back.images["scene"], before.images["scene"])


def test_undo_keeps_what_a_scene_imagined_for_the_steps_before():
    play, known = play_through_walls(), []
    for held in (LEFT, FORWARD, PICK_UP, *(FORWARD, LEFT) * 8):
        if play.advance(held):
            known.append((play.shown.pose, cells_of(play)))
    assert len(known[2][1]["cells"]) < len(known[3][1]["cells"]) < len(known[-1][1]["cells"])
    for pose, cells in known[-2::-1]:
        assert play.undo().pose == pose
        assert all(torch.equal(cells_of(play)[name], cells[name]) for name in cells)


def test_thinking_ahead_does_no_interaction():
    play = play_in_scene()
    play.advance(PICK_UP | FORWARD)
    play.undo()
    assert not play.think(600)
    assert box_is_there(play)


def test_an_interaction_with_nothing_in_reach_is_refused():
    play = play_in_scene()
    for _ in range(6):
        play.advance(frozenset({"right"}))
    assert not play.advance(frozenset({"toggle"})).free
    assert play.advance(frozenset({"toggle"})) is None
    play.advance(frozenset())
    assert not play.advance(frozenset({"toggle"})).free


def test_where_a_thing_was_picked_up_the_way_stays_free_when_its_drop_is_undone():
    play = play_in_scene()
    play.advance(PICK_UP)
    before = ground_of(play)
    assert play.advance(frozenset({"drop"})).free
    assert not torch.equal(ground_of(play), before)
    play.undo()
    assert torch.equal(ground_of(play), before)
    assert [play.advance(FORWARD).free for _ in range(4)] == [True] * 4
