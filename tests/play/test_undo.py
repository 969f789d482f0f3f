"""A step that is undone leaves no trace, in the picture, the memory or on the ground."""

from __future__ import annotations

import pytest
import torch

from persist_cli.data.store import Store
from persist_cli.play import history
from tests.play.test_collisions import play_in_room
from tests.play.test_play import FORWARD, LEFT, play_on, walked
from tests.support.micro_worlds import remembering_model
from tests.support.rooms import look


@pytest.fixture(scope="module")
def backbone():
    return remembering_model()


def memory_of(play):
    play._walkers.remember()
    return play._walkers.lead.memory.tensors()


def same(one, two):
    return one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)


def test_an_undone_walk_goes_on_as_if_it_had_never_been_walked(backbone, walks):
    play, other = play_on(backbone, walks), play_on(backbone, walks)
    shown = walked(play, FORWARD, 3)
    walked(other, FORWARD, 3)
    walked(play, LEFT, 2)
    play.undo()
    back = play.undo()
    assert torch.equal(back.images["voxel"], shown[-1].images["voxel"])
    assert same(memory_of(play), memory_of(other))
    assert torch.equal(walked(play, LEFT, 1)[0].images["voxel"], walked(other, LEFT, 1)[0].images["voxel"])


def test_the_start_cannot_be_undone(backbone, walks):
    play = play_on(backbone, walks)
    walked(play, FORWARD, 1)
    assert play.undo() is not None
    assert play.undo() is None


def test_undo_reaches_back_over_copies_of_the_memory_and_is_bounded(backbone, walks, monkeypatch):
    monkeypatch.setattr(history, "UNDO", 4)
    play, shown = play_on(backbone, walks), []
    for held in (FORWARD, LEFT) * 5:
        shown += walked(play, held, 2)
    back = [play.undo() for _ in range(20)]
    undone = [one for one in back if one is not None]
    assert 4 <= len(undone) < 20
    for one, truth in zip(undone, shown[-2::-1], strict=False):
        assert torch.equal(one.images["voxel"], truth.images["voxel"])


def test_what_is_undone_before_the_first_recorded_frame_is_not_recorded(backbone, walks, tmp_path):
    play = play_on(backbone, walks)
    walked(play, FORWARD, 1)
    play.record()
    first = play.undo()
    walked(play, LEFT, 2)
    walk = Store(play.save_recording(tmp_path).data)["voxel"].read()
    assert walk.actions == ("left", "left", None)
    assert torch.equal(walk.observations.rgb[0], first.images["voxel"])


def test_an_undone_jump_leads_back_to_where_it_began(backbone, walks):
    play, other = play_on(backbone, walks), play_on(backbone, walks)
    before = walked(play, FORWARD, 2)[-1]
    walked(other, FORWARD, 2)
    play.home()
    walked(play, LEFT, 1)
    play.undo()
    back = play.undo()
    assert back.pose == before.pose
    assert torch.equal(back.images["voxel"], before.images["voxel"])
    assert same(memory_of(play), memory_of(other))


def test_an_undone_turn_shows_no_ground():
    play = play_in_room(look((1.7, 1.25, 0.0), 0.0, 0.0))
    known = [play._walkers.lead.surroundings.map().states]
    for held in (LEFT, LEFT, FORWARD, LEFT):
        play.advance(held)
        known.append(play._walkers.lead.surroundings.map().states)
    assert int((known[0] > 0).sum()) < int((known[-1] > 0).sum())
    for ground in known[-2::-1]:
        assert play.undo().free
        assert torch.equal(play._walkers.lead.surroundings.map().states, ground)


def test_the_map_after_an_undone_step_is_the_one_before_it():
    play = play_in_room(look((1.7, 1.25, 0.0), 0.0, 0.0), ahead=False)
    play.advance(FORWARD)
    play.advance(frozenset())
    before = play.map(128)
    play.advance(FORWARD)
    play.undo()
    assert torch.equal(play.map(128).picture, before.picture)


def test_a_frame_that_is_undone_is_not_remembered_although_those_before_it_are(backbone, walks):
    play, other = play_on(backbone, walks), play_on(backbone, walks)
    walked(play, LEFT, 3)
    walked(other, LEFT, 2)
    play.undo()
    before = memory_of(other)
    assert same(memory_of(play), before)
    walked(other, LEFT, 1)
    assert not same(memory_of(other), before)
