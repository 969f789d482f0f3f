"""Protocols: which clips they find, and what the memory holds when a clip begins."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.geometry import near_poses, pose_differences
from persist_cli.data.reference import sample_data
from persist_cli.data.store import Store, write_trajectory
from persist_cli.errors import DataError
from persist_cli.evaluate.cases import cases_json, counts, path_motion, read_case
from persist_cli.evaluate.coverage import held_frames, recalled_share, seen_share
from persist_cli.evaluate.new_poses import NEW_POSES, NewPoses, returning_frames
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch, turning_point
from tests.support.micro_runs import slow_turn, without_depth
from tests.support.rooms import Room, look

EVERY_POSE = NewPoses(0.0, 0.0)


def search(folder, frames=0, scenes=(), new_poses=NEW_POSES):
    """A search for at most eight clips, for a model that predicts eight frames at once."""
    return ClipSearch(
        folders=[folder], frames=frames, limit=8, predicted_at_once=8, training_scenes=frozenset(scenes),
        new_poses=new_poses,
    )  # fmt: skip


def test_on_the_way_back_of_the_packaged_sample_every_frame_counts(monkeypatch):
    monkeypatch.delenv("PERSIST_REFERENCE")
    cases = PROTOCOLS["revisit"].find(search(sample_data()))
    assert cases
    assert all(all(case.counted[1:]) for case in cases)


def world_from_camera(case):
    """The poses of a case's trajectory and the numbers of the frames that its memory holds by each frame."""
    held = [held_frames(case.start, case.context, frame, 8, not case.context) for frame in range(case.frames)]
    return case.file.poses(), held


@pytest.mark.parametrize("protocol", ["revisit", "return"])
def test_no_frame_in_memory_is_near_the_pose_of_a_frame_that_counts(walks, held_out, protocol):
    for folder in (walks, held_out):
        for case in PROTOCOLS[protocol].find(search(folder)) if folder == held_out or protocol == "return" else []:
            poses, held = world_from_camera(case)
            for frame, numbers in enumerate(held):
                near = near_poses(poses[case.start + frame][None], poses[numbers], 0.2, 10.0)
                assert case.counted[frame] != bool(near.any())


def test_a_way_back_through_the_same_poses_has_no_clip_of_new_ones(walks):
    with pytest.raises(DataError, match=r"by poses that are new; collect with --policy loop"):
        PROTOCOLS["revisit"].find(search(walks))
    for case in PROTOCOLS["return"].find(search(walks)):  # it may still be measured by what needs no truth
        assert (case.first_visits[-1], case.counted[-1]) == (0, False)


def test_a_frame_first_visits_an_earlier_one_that_is_near_but_not_the_same(held_out):
    cases = PROTOCOLS["return"].find(search(held_out))
    assert len(cases) == 2
    for case in cases:
        poses = read_case(case).observations.cameras.world_from_camera
        pairs = [(number, earlier) for number, earlier in enumerate(case.first_visits) if earlier >= 0]
        assert sum(case.counted[number] for number, _ in pairs) >= 3
        assert all(number - earlier > 8 for number, earlier in pairs)  # over more than one predicted clip
        metres, degrees = pose_differences(*(poses[list(numbers)] for numbers in zip(*pairs, strict=True)))
        assert metres.max() <= 1.0
        assert degrees.max() <= 35.0


def test_a_camera_that_never_left_does_not_return():
    poses = torch.from_numpy(slow_turn(5))
    assert returning_frames(poses, [range(frame) for frame in range(5)]) == (-1,) * 5
    assert returning_frames(torch.cat([poses, torch.from_numpy(slow_turn(12))[[11, 0]]]), [range(5)] * 7)[-1] == 0


def test_limits_of_zero_let_every_frame_count(walks):
    (case, *_) = PROTOCOLS["revisit"].find(search(walks, new_poses=EVERY_POSE))
    assert case.counted == (True,) * case.frames


def test_clips_of_a_revisit_are_on_the_way_back(walks):
    seen = Store(walks)[0].read().observations
    cases = PROTOCOLS["revisit"].find(search(walks, new_poses=EVERY_POSE))
    assert len(cases) == 2
    assert all(recalled_share(seen, case.start, case.start + 8) > 0.3 for case in cases if case.trajectory == "walk-0")
    assert recalled_share(seen, 9, 9) == 0


def test_a_revisit_remembers_every_frame_up_to_the_first_and_none_of_the_clip(walks):
    case = PROTOCOLS["revisit"].find(search(walks, new_poses=EVERY_POSE))[0]
    clip = read_case(case)
    assert case.context == case.start + 1
    assert torch.equal(clip.context.rgb[-1], clip.observations.rgb[0])
    assert case.seen_before[0] == 1.0
    assert case.seen_before[-1] > 0.3


def test_a_path_that_never_returns_has_no_clip_to_evaluate(tmp_path):
    Room(32, 32).write(tmp_path / "a.parquet", slow_turn(24))
    with pytest.raises(DataError, match=r"no clip of 9 frames returns to a place seen before"):
        PROTOCOLS["revisit"].find(search(tmp_path))
    with pytest.raises(DataError, match=r"no trajectory goes away and comes back"):
        PROTOCOLS["return"].find(search(tmp_path))


def test_the_first_visit_of_a_there_and_back_is_the_frame_of_the_same_pose_once_that_is_in_memory(walks):
    for case in PROTOCOLS["return"].find(search(walks)):
        poses = read_case(case).observations.cameras.world_from_camera
        pairs = [(number, visit) for number, visit in enumerate(case.first_visits) if visit >= 0]
        same = [(number, visit) for number, visit in pairs if number + visit == case.frames - 1]
        assert len(same) >= 5
        metres, degrees = pose_differences(*(poses[list(numbers)] for numbers in zip(*same, strict=True)))
        assert metres.max() < 0.02
        assert degrees.max() < 2.0
        assert same[-1] == (case.frames - 1, 0)
        assert case.context == 0


def test_the_turning_point_may_lie_on_a_frame_or_between_two():
    out = slow_turn(20)
    assert turning_point(torch.from_numpy(np.concatenate([out, out[::-1][1:]]))) == (38, 39)
    assert turning_point(torch.from_numpy(np.concatenate([out, out[::-1]]))) == (39, 40)


def test_standing_still_is_no_return(tmp_path):
    Room(32, 32).write(tmp_path / "a.parquet", np.repeat(slow_turn(1), 24, axis=0))
    with pytest.raises(DataError, match="comes back"):
        PROTOCOLS["return"].find(search(tmp_path))


@pytest.mark.parametrize("pause", [0, 24, 30])
def test_a_return_is_found_behind_a_stretch_in_which_the_camera_stands_still(tmp_path, pause):
    out = slow_turn(20)
    walk = np.concatenate([np.repeat(out[:1], pause, axis=0), out, out[::-1]])
    Room(16, 16).write(tmp_path / "a.parquet", walk)
    (case,) = PROTOCOLS["return"].find(search(tmp_path, frames=24, new_poses=EVERY_POSE))
    assert case.start == pause + 8
    assert sum(visit >= 0 for visit in case.first_visits) >= 5


def test_a_long_clip_needs_112_frames_to_predict(walks, tmp_path):
    with pytest.raises(DataError, match="no trajectory has 113 frames, the longest has 24"):
        PROTOCOLS["long"].find(search(walks))
    with pytest.raises(DataError, match="--frames 50 are too few"):
        PROTOCOLS["long"].find(search(walks, frames=50))
    turning = [look((0.0, 1.3, 0.0), 6.0 * number, 0.0) for number in range(115)]
    Room(16, 16).write(tmp_path / "a.parquet", np.stack(turning))
    (case,) = PROTOCOLS["long"].find(search(tmp_path))
    assert (case.frames, case.context) == (113, 0)
    assert case.seen_before[100] > 0.9  # after a full turn


def test_the_first_long_clips_are_of_different_trajectories(tmp_path):
    turning = np.stack([look((0.0, 1.3, 0.0), 6.0 * number, 0.0) for number in range(226)])
    for name in "ab":
        Room(8, 8).write(tmp_path / f"{name}.parquet", turning)
    cases = PROTOCOLS["long"].find(replace(search(tmp_path), limit=3))
    assert [(case.trajectory, case.start) for case in cases] == [("a", 0), ("b", 0), ("a", 113)]


@pytest.mark.parametrize("protocol", ["revisit", "return"])
def test_a_limit_of_clips_takes_turns_over_the_data_sets(held_out, tmp_path, protocol):
    again = shutil.copytree(held_out, tmp_path / "again")
    few = replace(search(held_out), folders=[held_out, again], limit=3)
    cases = PROTOCOLS[protocol].find(few)
    assert [case.data for case in cases] == [str(held_out), str(again), str(held_out)]
    assert len({case.trajectory for case in cases if case.data == str(held_out)}) == 2


def test_turns_go_over_data_sets_then_trajectories_and_pass_over_those_that_have_no_more(held_out, tmp_path):
    again = shutil.copytree(held_out, tmp_path / "again")
    few = replace(search(held_out), folders=[held_out, again])
    assert few.in_turns(["ab", "cde", "x", ""]) == [*"axcbde"]


def test_unseen_refuses_scenes_that_were_trained_on(walks, held_out, tmp_path):
    with pytest.raises(DataError, match="trained on its scene 'room-1'"):
        PROTOCOLS["unseen"].find(search(walks, scenes=["room-1"]))
    assert len(PROTOCOLS["unseen"].find(search(held_out))) == 2
    info = replace(Room(32, 32).info, source={"simulator": "miniworld", "split": "train"})
    write_trajectory(tmp_path / "a.parquet", info, Room(32, 32).frames(slow_turn(24)))
    with pytest.raises(DataError, match="of the training split"):
        PROTOCOLS["unseen"].find(search(tmp_path))


def test_the_error_for_data_without_depth_names_the_protocols_that_remain(walks, tmp_path):
    without_depth(walks, tmp_path)
    with pytest.raises(DataError, match=r"no frame has depth.*--protocol return or long"):
        PROTOCOLS["revisit"].find(search(tmp_path))
    case = PROTOCOLS["return"].find(search(tmp_path))[0]
    assert set(case.seen_before) == {None}


def test_the_memory_grows_by_whole_clips_where_output_is_written():
    assert held_frames(start=0, context=0, frame=8, predicted_at_once=8, writes=True) == [0]
    assert held_frames(start=0, context=0, frame=9, predicted_at_once=8, writes=True) == list(range(9))
    assert held_frames(start=5, context=6, frame=9, predicted_at_once=8, writes=False) == list(range(6))


def test_a_view_is_wholly_seen_by_its_own_frame_and_not_at_all_by_none(walks):
    seen = Store(walks)[0].read().observations
    assert seen_share(seen, 3, [3]) == 1.0
    assert seen_share(seen, 3, []) == 0.0


@pytest.fixture
def capture(tmp_path):
    """A capture of which the frames from 12 on are held out."""
    room = Room(32, 32)
    info = replace(room.info, source={"held_out_from": 12})
    write_trajectory(tmp_path / "capture.parquet", info, room.frames(slow_turn(24)))
    return tmp_path


def test_later_clips_are_of_held_out_frames_and_remember_all_before(capture):
    cases = PROTOCOLS["later"].find(search(capture, 5))
    assert [case.start for case in cases] == [12, 14, 16, 18]
    assert all(case.context == case.start + 1 for case in cases)
    PROTOCOLS["later"].check_scenes(search(capture, 5, ["room before frame 12"]))


@pytest.mark.parametrize("scene", ["room", "room before frame 13"])
def test_later_clips_are_refused_to_a_model_that_was_trained_on_them(capture, scene):
    with pytest.raises(DataError, match="the model was trained on its scene 'room'"):
        PROTOCOLS["later"].check_scenes(search(capture, 5, [scene]))


def test_a_capture_without_held_out_frames_or_with_few_has_no_later_clips(walks, capture):
    with pytest.raises(DataError, match=r"import the capture with --hold-out 0\.3"):
        PROTOCOLS["later"].find(search(walks))
    with pytest.raises(DataError, match="no capture has 20 frames held out"):
        PROTOCOLS["later"].find(search(capture, 20))


def paths(*places):
    """Poses at these metres to the right and degrees to the left."""
    return torch.from_numpy(np.stack([look((x, 1.3, 0.0), yaw, 0.0) for x, yaw in places]))


def test_the_first_visit_is_the_nearest_in_metres_and_radians():
    poses = paths((0.0, 20.0), (0.6, 0.0), (0.0, 120.0), (0.0, 0.0))
    assert returning_frames(poses, [range(frame) for frame in range(4)])[-1] == 0


def test_disjoint_clips_are_chosen_by_what_they_recall_the_most_first(walks, monkeypatch):
    shares = {5: 0.29, 10: 0.9, 12: 0.8, 15: 0.5}
    monkeypatch.setattr("persist_cli.evaluate.protocols.recalled_share", lambda seen, start, last: shares.get(start, 0))
    assert PROTOCOLS["revisit"].rank_starts(Store(walks)[0], 4, EVERY_POSE) == [10, 15]


def test_the_motion_of_a_clip_is_that_of_its_own_path_and_only_predicted_frames_are_counted(held_out):
    motion = path_motion(paths((0.0, 0.0), (0.3, 30.0), (0.0, 0.0)))
    assert motion == pytest.approx({"path_metres": 0.6, "farthest_metres": 0.3, "turned_degrees": 60.0})
    case = PROTOCOLS["revisit"].find(search(held_out))[0]
    poses, own = case.file.poses(), slice(case.start, case.start + case.frames)
    (values,) = cases_json([case])
    assert {name: values[name] for name in motion} == pytest.approx(path_motion(poses[own]))
    assert path_motion(poses[own]) != pytest.approx(path_motion(poses[: case.frames]))
    assert counts([replace(case, counted=(True,) * case.frames)]) == (case.frames - 1, case.frames - 1)
