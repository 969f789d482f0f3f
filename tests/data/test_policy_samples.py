"""Samples of trajectories for learned policies."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from persist_cli.api.actions import rotation_about
from persist_cli.api.policy_network import PolicySample, SampleForm
from persist_cli.data.policy_samples import GroundPath, PolicySampleDataset, SampleFrames, ground_places, local_places
from persist_cli.data.store import Store
from persist_cli.errors import DataError
from tests.support.rooms import UP, Room, look

FORM = SampleForm(context=2, waypoints=4, spacing=2, farthest=6, nearest=2, negatives=0.3)


def write_straight(folder: Path, yaw: float = 0.0, name: str = "straight", frames: int = 24) -> Path:
    """Write a walk of 5 cm a frame along its heading."""
    ahead = look((0.0, 0.0, 0.0), yaw, 0.0)[:3, 2]
    poses = [look(tuple(np.array([0.0, 1.3, 0.5]) + 0.05 * frame * ahead), yaw, 0.0) for frame in range(frames)]
    return Room(8, 8).write(folder / f"{name}.parquet", np.stack(poses)).parent


def write_actions(folder: Path, actions: str) -> Path:
    """Write a walk of 25 cm steps (f) and turns of 15 degrees to the left or right (l, r)."""
    place, yaw = np.array([0.0, 1.3, 1.5]), 0.0
    poses = [look(tuple(place), yaw, 0.0)]
    for action in actions:
        place = place + 0.25 * poses[-1][:3, 2] * (action == "f")
        yaw += {"l": 15.0, "r": -15.0, "f": 0.0}[action]
        poses.append(look(tuple(place), yaw, 0.0))
    return Room(8, 8).write(folder / "walk.parquet", np.stack(poses)).parent


def test_a_straight_walk_has_straight_waypoints(tmp_path):
    samples = PolicySampleDataset([write_straight(tmp_path, yaw=35.0)], FORM, 0)
    expected = torch.arange(1, 5)[:, None] * torch.tensor([0.1, 0.0])
    assert all(torch.allclose(samples[number].waypoints, expected, atol=1e-6) for number in range(20))


def test_waypoints_to_the_left_are_positive():
    poses = torch.from_numpy(np.stack([look((0.0, 1.3, 0.0), 0.0, -20.0), look((-1.0, 1.3, -2.0), 50.0, 0.0)]))
    places, headings = ground_places(poses, UP)
    assert torch.allclose(local_places(places[1:], places[0], headings[0]), torch.tensor([[2.0, 1.0]]).double())


def test_a_moved_and_turned_world_changes_nothing():
    poses = torch.from_numpy(np.stack([look((0.1 * n, 1.3, 0.2 * n), 20.0 * n, -5.0) for n in range(5)]))
    move = torch.eye(4, dtype=torch.float64)
    move[:3, :3], move[:3, 3] = rotation_about(torch.tensor(UP), 2.3), torch.tensor([3.0, 0.0, -4.0])
    ways = []
    for path in (poses, move @ poses):
        places, headings = ground_places(path, UP)
        ways.append(local_places(places, places[1], headings[1]))
    assert torch.allclose(*ways, atol=1e-9)


def test_a_sample_depends_on_the_seed_and_its_number_only(walks):
    one, other = PolicySampleDataset([walks], FORM, 0), PolicySampleDataset([walks], FORM, 0)
    other[3]
    assert one.choose(7) == other.choose(7)
    assert torch.equal(one[7].seen, other[7].seen)
    assert PolicySampleDataset([walks], FORM, 1).choose(7) != one.choose(7)


def test_goals_are_later_frames_of_the_walk_or_frames_of_another_that_are_far(walks):
    samples = PolicySampleDataset([walks], FORM, 0)
    seen = set()
    for number in range(60):
        choice, sample = samples.choose(number), samples[number]
        own = choice.goal_file == choice.file
        assert sample.distance == ((choice.goal - choice.present) / 2 if own else 6)
        assert sample.leads_to_goal == (own and 2 < sample.distance < 6)
        assert bool(sample.goal_place.any()) == own
        assert torch.equal(sample.goal, Store(walks)[choice.goal_file].read([choice.goal]).observations.rgb[0])
        seen.add((own, sample.distance))
    assert seen == {(True, distance) for distance in (1, 2, 3, 4, 5, 6)} | {(False, 6)}


def test_the_place_of_a_goal_is_told_in_the_axes_of_the_present_camera(tmp_path):
    samples = PolicySampleDataset([write_actions(tmp_path, "ffff" + "l" * 6 + "ffffff")], FORM, 0)
    choice = dataclasses.replace(samples.choose(0), present=0, goal_file=0, file=0, goal=14, mirrored=False)
    assert samples.read(choice).goal_place.tolist() == pytest.approx([1.0, 1.0, 0.0, 1.0], abs=1e-4)
    mirrored = samples.read(dataclasses.replace(choice, mirrored=True))
    assert mirrored.goal_place.tolist() == pytest.approx([1.0, -1.0, 0.0, -1.0], abs=1e-4)


def test_frames_before_the_first_are_the_first_again(walks):
    samples = PolicySampleDataset([walks], FORM, 0)
    choice = dataclasses.replace(samples.choose(0), present=2, goal_file=0, file=0, goal=6, mirrored=False)
    rgb = Store(walks)[0].read([0, 0, 2]).observations.rgb
    assert torch.equal(samples.read(choice).seen, rgb)


def test_the_direct_way_of_an_agent_has_as_many_frames_as_it_takes_actions(tmp_path):
    file = Store(write_actions(tmp_path, "lllffffrr" + "lr" * 3))[0]
    path = GroundPath(*ground_places(file.poses(), UP))
    direct = path.direct_frames(0, path, torch.tensor([3, 7, 9, 15]))
    assert direct.tolist() == pytest.approx([3, 7, 9, 9], abs=1e-3)  # at the end it only turned to and fro


def test_a_walk_that_only_turns_goes_as_fast_as_the_one_that_it_is_to_reach(tmp_path):
    paths = []
    for name, word in (("turns", "lr" * 6), ("goes", "ffff" + "lr" * 3), ("stands", "rl" * 6)):
        file = Store(write_actions(tmp_path / name, word))[0]
        paths.append(GroundPath(*ground_places(file.poses(), UP)))
    turns, goes, stands = paths
    end = torch.tensor([4])
    assert turns.direct_frames(0, goes, end).tolist() == pytest.approx([4], abs=1e-3)
    assert stands.direct_frames(0, turns, end).tolist() == pytest.approx([0], abs=1e-3)  # it is there already
    away = dataclasses.replace(stands, places=stands.places + 1.0)
    assert turns.direct_frames(0, away, end).tolist() == [torch.inf]


def test_what_a_walk_only_came_to_by_wandering_is_far_and_not_led_to(tmp_path):
    folder = write_actions(tmp_path, "ffffff" + "lr" * 6 + "ffffff")
    form = dataclasses.replace(FORM, negatives=0.0, nearest=0, farthest=20)
    any_way, direct = (PolicySampleDataset([folder], form, 0, detour=detour) for detour in (None, 1.5))
    pairs: dict[tuple[int, int], PolicySample] = {}
    for number in range(800):
        choice = direct.choose(number)
        pairs[choice.present, choice.goal] = direct[number]
    straight, wandered = pairs[0, 6], pairs[0, 18]
    assert (straight.distance, straight.leads_to_goal) == (3, True)
    assert (wandered.distance, wandered.leads_to_goal) == (4, False)  # 6 frames ahead, in 18: counts as 1.5 times 6
    share = sum(direct[number].leads_to_goal for number in range(200)) / 200
    assert 0.5 < share < 0.9  # at least the half that is drawn from direct ways
    assert all(any_way[number].leads_to_goal for number in range(50) if any_way[number].distance < 20)


def test_another_walk_of_the_same_scene_is_as_far_as_it_is(tmp_path):
    for number, word in enumerate(("f" * 12, "ff" + "l" * 6 + "f" * 6)):
        write_actions(tmp_path / str(number), word)
    folders = [tmp_path / "0", tmp_path / "1"]
    samples = PolicySampleDataset(folders, dataclasses.replace(FORM, negatives=1.0, farthest=20), 0, detour=2.0)
    choice = dataclasses.replace(samples.choose(0), file=0, present=0, goal_file=1, goal=2, mirrored=False)
    sample = samples.read(choice)
    assert (sample.distance, sample.leads_to_goal) == (2, False)  # two steps ahead, at most twice as many
    unknown = PolicySampleDataset(folders, dataclasses.replace(FORM, negatives=1.0, farthest=20), 0)
    assert unknown.read(choice).distance == 20


def test_moments_and_the_goals_of_other_walks_are_any_that_there_are(tmp_path):
    for name in ("one", "two", "three"):
        write_straight(tmp_path, name=name)
    samples = PolicySampleDataset([tmp_path], dataclasses.replace(FORM, negatives=0.5), 0)
    drawn = [samples.choose(number) for number in range(600)]
    assert {one.present for one in drawn} == set(range(24 - 8))
    others = [one for one in drawn if one.file != one.goal_file]
    assert {one.goal for one in others} == set(range(24))
    assert len({(one.file, one.goal_file) for one in others}) == 6
    assert len({one.seed for one in drawn}) > 590


def test_the_direct_way_to_another_walk_begins_at_place_and_heading_of_the_present_camera(tmp_path):
    for number, word in enumerate(("ll" + "f" * 12, "f" * 12)):
        write_actions(tmp_path / str(number), word)
    form = dataclasses.replace(FORM, farthest=20)
    samples = PolicySampleDataset([tmp_path / "0", tmp_path / "1"], form, 0, detour=2.0)
    choice = SampleFrames(file=0, present=2, goal_file=1, goal=2, mirrored=False, seed=0)
    assert samples.read(choice).distance == 4  # two turns back and two steps, at most twice as many, by two frames


def test_frames_of_another_scene_are_far_also_where_walks_wander(walks):
    samples = PolicySampleDataset([walks], dataclasses.replace(FORM, farthest=50), 0, detour=2.0)
    sample = samples.read(SampleFrames(file=0, present=4, goal_file=1, goal=4, mirrored=False, seed=0))
    assert (sample.distance, sample.leads_to_goal) == (50, False)


def test_data_in_which_nothing_is_reached_directly_is_refused_in_one_line(tmp_path):
    folder = write_actions(tmp_path, "lr" * 12)
    with pytest.raises(DataError, match=r"1000 moments drawn, and none leads .* within 2 times .*; raise data.detour"):
        PolicySampleDataset([folder], dataclasses.replace(FORM, negatives=0.0), 0, detour=2.0).choose(0)


def test_a_mirrored_sample_has_left_and_right_exchanged(walks):
    plain, mirrored = PolicySampleDataset([walks], FORM, 0), PolicySampleDataset([walks], FORM, 0, mirror=1.0)
    one, other = plain[4], mirrored[4]
    assert torch.equal(one.seen.flip(2), other.seen)
    assert torch.equal(one.goal.flip(1), other.goal)
    assert torch.equal(one.waypoints * torch.tensor([1.0, -1.0]), other.waypoints)


def test_data_that_policies_cannot_learn_from_is_refused_in_one_line(walks, tmp_path):
    with pytest.raises(DataError, match="30 waypoints need 61 frames, the longest trajectory has 24"):
        PolicySampleDataset([walks], dataclasses.replace(FORM, waypoints=30), 0)
    with pytest.raises(DataError, match=r"straight.parquet: images are 8x8, those of .* are 32x32"):
        PolicySampleDataset([walks, write_straight(tmp_path)], FORM, 0)


def test_so_many_goals_are_of_another_walk_and_so_many_samples_mirrored_as_the_settings_say(tmp_path):
    write_straight(tmp_path)
    samples = PolicySampleDataset([write_straight(tmp_path, name="other")], FORM, 0, mirror=0.1)
    drawn = [samples.choose(number) for number in range(400)]
    assert np.mean([one.file != one.goal_file for one in drawn]) == pytest.approx(FORM.negatives, abs=0.07)
    assert np.mean([one.mirrored for one in drawn]) == pytest.approx(0.1, abs=0.05)
    own = [one.goal - one.present for one in drawn if one.file == one.goal_file]
    assert {2, 12} <= set(own) <= {2, 4, 6, 8, 10, 12}  # one to six spacings of two frames


def test_a_way_of_so_many_spacings_leads_to_the_goal_between_the_nearest_and_the_farthest(tmp_path):
    samples = PolicySampleDataset([write_straight(tmp_path, frames=40)], FORM, 0)
    read = [samples.read(SampleFrames(0, 10, 0, 10 + 2 * far, False, 0)) for far in range(1, 8)]
    assert [sample.distance for sample in read] == [1, 2, 3, 4, 5, 6, 7]
    assert [sample.leads_to_goal for sample in read] == [False, False, True, True, True, False, False]
