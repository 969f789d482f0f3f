"""A walk with the keys gives what a rollout of the same actions gives, and remembers what was shown alone."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError
from persist_cli.play.play import Play
from persist_cli.play.settings import PlaySettings
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.support.micro_model import FRAMEWISE
from tests.support.micro_plays import micro_walks
from tests.support.micro_worlds import remembering_model

FORWARD, LEFT = frozenset({"forward"}), frozenset({"left"})


@pytest.fixture(scope="module")
def backbone():
    return remembering_model()


def voxels() -> Memory:
    return make_memory("voxel", {}, make_encoder("patches", {}), FrameOfReference("room-0", (0.0, 1.0, 0.0)))


def play_on(backbone, walks: Path, **settings) -> Play:
    """A walk from the ninth frame of the first trajectory, with a voxel memory and without one."""
    play = micro_walks(walks, backbone=backbone)()
    play.set(PlaySettings(steps=2, **settings))
    return play


def rollout_world(backbone, walks: Path) -> WorldModel:
    """A world model at the same frame."""
    start = Store(walks)[0].read([8])
    backbone.use_adapter("voxel")
    world = WorldModel(backbone, [Agent(voxels())], Sampling(2))
    world.reset([start.observations], [start.info])
    return world


def walked(play: Play, held, frames: int):
    return [play.advance(held) for _ in range(frames)]


def test_held_keys_show_the_frames_of_a_rollout(backbone, walks):
    play, world = play_on(backbone, walks), rollout_world(backbone, walks)
    shown = walked(play, FORWARD, 8) + walked(play, LEFT, 8)
    backbone.use_adapter("voxel")
    [truth] = world.step([["forward"] * 8 + ["left"] * 8])
    assert torch.equal(torch.stack([one.images["voxel"] for one in shown]), truth.seen.rgb)
    assert [one.number for one in shown] == list(range(1, 17))
    assert not torch.equal(shown[-1].images["stage1"], shown[-1].images["voxel"])


def test_clips_under_newly_held_keys_begin_short_and_grow(walks):
    play = micro_walks(walks, backbone=remembering_model(**FRAMEWISE))()
    worlds, lengths = play._walkers.worlds.values(), []
    for held in (FORWARD,) * 9 + (LEFT,) * 2:
        play.advance(held)
        lengths.append(next(iter(worlds)).clip_frames)
    assert lengths == [2, 3, 3, 5, 5, 5, 5, 9, 9, 2, 3]
    play.set(PlaySettings(growing=False))
    play.advance(LEFT)
    assert {world.clip_frames for world in worlds} == {9}


def test_a_tap_acts_alone_before_what_is_held(backbone, walks):
    play = play_on(backbone, walks)
    walked(play, FORWARD, 2)
    assert play.advance(FORWARD, LEFT).action == "left"
    assert play.advance(FORWARD | LEFT, LEFT).action == "left"
    assert play.advance(FORWARD | LEFT).action == "forward"
    assert play.advance(FORWARD, {"backward"}).action == "backward"
    assert [one.action for one in walked(play, FORWARD, 2)] == ["forward"] * 2


def test_frames_of_keys_that_are_let_go_are_dropped_and_not_remembered(backbone, walks):
    play, world = play_on(backbone, walks), rollout_world(backbone, walks)
    walked(play, FORWARD, 3)
    shown = walked(play, LEFT, 2)
    backbone.use_adapter("voxel")
    agent = world.agents[0]
    seen = world.predict([0], [agent.cameras_after(["forward"] * 8)], [(None,) * 8])[0]
    world.take(agent, seen[:3])
    truth = world.predict([0], [agent.cameras_after(["left"] * 8)], [(None,) * 8])[0]
    assert torch.equal(torch.stack([one.images["voxel"] for one in shown]), truth.rgb[:2])


def test_nothing_is_shown_while_no_key_is_held(backbone, walks):
    play = play_on(backbone, walks)
    first = play.advance(FORWARD)
    assert play.advance(frozenset()) is None
    assert play.shown is first


def test_a_reset_begins_the_same_walk_and_another_seed_another_one(backbone, walks):
    play = play_on(backbone, walks)
    start, before = play.shown, walked(play, FORWARD, 10)
    again = play.reset()
    assert again.pose == start.pose
    assert torch.equal(again.images["voxel"], start.images["voxel"])
    after = walked(play, FORWARD, 10)
    assert all(torch.equal(one.images["voxel"], two.images["voxel"]) for one, two in zip(before, after, strict=True))
    play.reset(seed=5)
    assert not torch.equal(walked(play, FORWARD, 1)[0].images["voxel"], before[0].images["voxel"])


def test_home_is_the_start_pose_as_it_is_imagined(backbone, walks):
    play = play_on(backbone, walks)
    start = play.shown
    walked(play, FORWARD, 4)
    shown = play.home()
    assert shown.action is None
    assert (shown.pose.x, shown.pose.y) == pytest.approx((start.pose.x, start.pose.y))
    assert not torch.equal(shown.images["voxel"], start.images["voxel"])


def test_a_look_from_elsewhere_is_the_last_frame_of_a_clip_that_stands_still(backbone, walks):
    play, world = play_on(backbone, walks), rollout_world(backbone, walks)
    shown = play.home()
    backbone.use_adapter("voxel")
    still = world.agents[0].cameras_after(["stay"] * 8)
    truth = world.predict([0], [still], [(None,) * 8])[0]
    assert torch.equal(shown.images["voxel"], truth.rgb[-1])


def test_what_a_model_without_depth_lacks_is_told_in_a_line(backbone, walks):
    assert play_on(backbone, walks).notices == ()
    play = micro_walks(walks, backbone=remembering_model(depth=False))()
    (notice,) = play.notices
    assert notice == "this model imagines no depth: what it imagines stops nobody, and voxel cannot remember it"
    assert play.advance(FORWARD).free


def test_an_unknown_action_changes_nothing(backbone, walks):
    play = play_on(backbone, walks)
    first = walked(play, FORWARD, 1)[0]
    with pytest.raises(DataError, match="unknown action 'fly'"):
        play.advance(frozenset({"fly"}))
    assert play.shown is first


def test_settings_that_cannot_be_used_leave_the_old_ones(backbone, walks):
    play = play_on(backbone, walks)
    with pytest.raises(PersistError, match="0 denoising steps"):
        play.set(PlaySettings(steps=0))
    assert play.settings.steps == 2


def test_a_clip_that_was_thought_of_is_shown_without_imagining_it_again(backbone, walks, monkeypatch):
    clips, generate = [], backbone.generate
    monkeypatch.setattr(backbone, "generate", lambda *given: clips.append(given) or generate(*given))
    play, other = play_on(backbone, walks), play_on(backbone, walks)
    assert not play.think(600)
    assert len(clips) == 8  # two moves and two turns, for each memory
    shown = walked(play, LEFT, 3)
    assert len(clips) == 8
    truth = walked(other, LEFT, 3)
    assert all(torch.equal(one.images["voxel"], two.images["voxel"]) for one, two in zip(shown, truth, strict=True))


def test_thinking_ends_with_its_time_and_where_nobody_wants_it(backbone, walks):
    play = play_on(backbone, walks)
    assert play.think(0)  # something is left to imagine, and no time
    play.set(PlaySettings(steps=2, ahead=False))
    assert not play.think(0)


def test_the_map_grows_with_the_walk(backbone, walks):
    play = play_on(backbone, walks)
    before = play.map(128)
    walked(play, LEFT, 9)
    play.advance(frozenset())
    after = play.map(128)
    assert max(after.picture.shape) == 128
    assert before.extent != after.extent


def test_a_jump_keeps_height_and_heading(backbone, walks):
    play = play_on(backbone, walks)
    before = play.shown.pose
    shown = play.jump(before.x + 0.5, before.y - 0.25)
    assert (shown.pose.x, shown.pose.y) == pytest.approx((before.x + 0.5, before.y - 0.25))
    assert shown.pose.degrees == pytest.approx(before.degrees)
    assert play.advance(FORWARD).action == "forward"
