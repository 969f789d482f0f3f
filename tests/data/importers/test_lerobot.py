"""LeRobot datasets give back the room that was written in their format."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from persist_cli.data.importers import videos
from persist_cli.data.importers.importing import ImportPlan, run_import
from persist_cli.data.importers.lerobot import LeRobot
from persist_cli.data.importers.lerobot_images import ColumnImages, DepthCode, ImageFeature
from persist_cli.data.importers.lerobot_info import LeRobotSettings
from persist_cli.data.importers.readers import decode_color
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError
from persist_cli.plugins import load_plugin
from tests.support.foreign_captures import FROM_Y_UP, usable
from tests.support.lerobot_datasets import (
    COLOR,
    DEPTH,
    HEIGHT,
    PITCH,
    POSE,
    ROBOT,
    ROOM,
    change_info,
    change_table,
    codes,
    picture,
    poses,
    read_all,
    stored_depth,
    video,
    write_codes,
    write_later_episode,
    write_lerobot,
)


def test_the_importer_is_a_plugin() -> None:
    assert load_plugin("importer", "lerobot") is LeRobot


@pytest.mark.parametrize(
    ("form", "stored", "settings", "exact"),
    [
        ("quaternion", "video", POSE, 0.0013),  # a code of 12 bits is 2.6 mm wide at 4 m
        ("matrix", "mm", POSE, 0.00051),
        ("planar", "m", ROBOT, 1e-6),
    ],
)
def test_a_dataset_is_imported_as_it_was(
    tmp_path: Path, form: str, stored: str, settings: LeRobotSettings, exact: float
) -> None:
    truth = list(ROOM.frames(poses(7, form)[1]))
    first = 0
    for number, (episode, length) in enumerate(
        zip(read_all(write_lerobot(tmp_path / "room", (4, 3), form, stored), settings), (4, 3), strict=True)
    ):
        info, frames = episode.info, list(episode.frames)
        assert (episode.name, info.scene) == (f"room-episode-{number:06}", "room")
        assert (info.source["format"], info.source["episode"]) == ("lerobot", number)
        assert (info.height, info.width) == (48, 64)
        assert info.intrinsics == pytest.approx(ROOM.intrinsics)
        assert info.world_up[2] > 0.99999
        assert len(frames) == episode.length == length
        for index, frame in enumerate(frames):
            true = truth[first + index]
            assert np.array_equal(frame.rgb, true.rgb)
            assert frame.depth[0, 0] == 0
            assert np.abs(frame.depth - true.depth)[1:].max() < exact
            assert frame.world_from_camera == pytest.approx(FROM_Y_UP @ true.world_from_camera, abs=1e-9)
            assert frame.timestamp == pytest.approx(index / 10)
        first += length


def test_an_imported_dataset_can_be_inspected(persist: Any, tmp_path: Path) -> None:
    dataset = write_lerobot(tmp_path / "room", (6, 4), "planar")
    words = ("--set", "pose=observation.pose", "--set", "axes=robot", "--set", f"mount=[0,0,{HEIGHT},{PITCH}]")
    imported = persist("import", "lerobot", dataset, *words, "--out", tmp_path / "out", "--json")
    assert (imported.code, imported.err) == (0, "")
    rows = json.loads(imported.out)["trajectories"]
    assert [(row["frames"], row["world_up"], row["world_up_is"]) for row in rows] == [
        (6, [0, 0, 1], "z, as of a robot"),
        (4, [0, 0, 1], "z, as of a robot"),
    ]
    again = persist("import", "lerobot", dataset, *words, "--out", tmp_path / "out", "--json")
    assert [row["state"] for row in json.loads(again.out)["trajectories"]] == ["already there"] * 2
    inspected = persist("inspect", tmp_path / "out")
    assert inspected.code == 0, inspected.out
    assert "agree" in inspected.out


def test_numbers_of_the_pose_are_picked_by_their_names(dataset: Path) -> None:
    whole = read_all(dataset)[0]
    picked = read_all(dataset, LeRobotSettings(pose="observation.state", names=tuple("0123456")))[0]
    nested = read_all(dataset, replace(POSE, names=tuple(f"n{number}" for number in range(7))))[0]
    for one, other, third in zip(whole.frames, picked.frames, nested.frames, strict=True):
        assert np.array_equal(one.world_from_camera, other.world_from_camera)
        assert np.array_equal(one.world_from_camera, third.world_from_camera)


def test_poses_of_opengl_are_turned_to_opencv(dataset: Path) -> None:
    opencv, opengl = (next(read_all(dataset, replace(POSE, axes=axes))[0].frames) for axes in ("opencv", "opengl"))
    turned = opencv.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert opengl.world_from_camera == pytest.approx(turned)


def test_a_camera_is_where_the_robot_carries_it(tmp_path: Path) -> None:
    dataset = write_lerobot(tmp_path / "room", (2,), "planar")
    frame = next(read_all(dataset, replace(ROBOT, mount=(0.3, 0.1, 0.6, 0.0)))[0].frames)  # the robot is at 0, yaw 0
    right, down, ahead = frame.world_from_camera[:3, :3].T
    assert frame.world_from_camera[:3, 3] == pytest.approx([0.3, 0.1, 0.6])
    assert (right, down, ahead) == tuple(map(pytest.approx, ([0, -1, 0], [0, 0, -1], [1, 0, 0])))
    lowered = next(read_all(dataset, replace(ROBOT, mount=(0.0, 0.0, 0.6, -30.0)))[0].frames)
    assert lowered.world_from_camera[:3, 2] == pytest.approx([np.cos(np.pi / 6), 0, -0.5])


def test_episodes_can_be_scenes_of_their_own(dataset: Path) -> None:
    for axes in ("opencv", "robot"):
        settings = replace(POSE, axes=axes, scene="episode")
        assert [one.info.scene for one in read_all(dataset, settings)] == [
            "room-episode-000000",
            "room-episode-000001",
        ]
    assert [one.info.scene for one in read_all(dataset)] == ["room", "room"]


def test_the_episodes_of_one_scene_share_its_up_axis(dataset: Path) -> None:
    shared, own = (
        [one.info.world_up for one in read_all(dataset, replace(POSE, scene=scene))] for scene in ("dataset", "episode")
    )
    assert shared[0] == shared[1]
    assert own[0] != own[1]


def test_the_up_axis_that_is_given_wins_over_that_of_robots(dataset: Path) -> None:
    importer = LeRobot(replace(POSE, axes="robot"))
    importer.up = (0.0, 0.0, -1.0)
    for episode in usable(importer, dataset):
        assert episode.info.world_up == (0, 0, -1)
        assert episode.info.source["world_up"].startswith("given")


def test_some_episodes_are_read_and_others_are_added_later(persist: Any, dataset: Path, tmp_path: Path) -> None:
    for chosen, states in (("1", ["written"]), ("0-2", ["written", "already there"]), ("0-9", ["already there"] * 2)):
        words = ("--set", "pose=observation.pose", "--set", f"episodes={chosen}", "--up", "0,0,1")
        imported = persist("import", "lerobot", dataset, *words, "--out", tmp_path / "out", "--json")
        assert (imported.code, imported.err) == (0, "")
        assert [row["state"] for row in json.loads(imported.out)["trajectories"]] == states
    for chosen, cause in (
        ("2", "episodes: has no episode 2"),
        ("1-1", "no episode 1-1"),
        ("first", "neither a number"),
    ):
        with pytest.raises(DataError, match=cause):
            read_all(dataset, replace(POSE, episodes=chosen))


def test_a_folder_of_datasets_is_read_too(written: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(written, tmp_path / "all" / name)
    assert [one.info.scene for one in read_all(tmp_path / "all")] == ["a", "a", "b", "b"]
    with pytest.raises(DataError, match=r"nowhere: neither meta/info.json in it nor folders with one"):
        read_all(tmp_path / "nowhere")


def test_depth_of_another_size_is_resampled(dataset: Path) -> None:
    frames = list(ROOM.frames(poses(7, "quaternion")[1]))
    write_codes(video(dataset, DEPTH), [codes(frame.depth)[::2, ::2] for frame in frames])
    change_info(dataset, lambda info: info["features"][DEPTH].update(shape=[24, 32, 1]))
    episode, _ = read_all(dataset)
    assert (episode.info.height, episode.info.width) == (24, 32)
    assert episode.info.intrinsics[:2] == pytest.approx(ROOM.intrinsics[:2] / 2)
    assert [frame.rgb.shape for frame in episode.frames] == [(24, 32, 3)] * 4


@pytest.mark.parametrize("shape", [[48, 64, 3], [3, 48, 64], [48, 64, 1], [1, 48, 64], [48, 64]])
def test_the_size_of_images_is_known_wherever_their_channels_stand(shape: list[int]) -> None:
    assert ImageFeature.of("front", {"dtype": "video", "shape": shape}).size == (48, 64)


@pytest.mark.parametrize(
    ("said", "is_depth"),
    [
        ({"info": {"is_depth_map": True}}, True),
        ({"info": {"video.is_depth_map": True}}, True),
        ({"video_info": {"video.is_depth_map": True}}, True),
        ({"info": {"video.is_depth_map": False}, "video_info": None}, False),
    ],
)
def test_depth_is_marked_in_any_of_the_ways_of_lerobot(said: dict[str, Any], is_depth: bool) -> None:
    assert ImageFeature.of("front", {"dtype": "video", "shape": [48, 64, 1], **said}).is_depth is is_depth


def test_a_distance_in_metres_that_is_none_is_missing_depth(tmp_path: Path) -> None:
    dataset = write_lerobot(tmp_path / "room", (2,), stored="m")
    depth = [stored_depth(frame.depth, "m") for frame in ROOM.frames(poses(2, "quaternion")[1])]
    for image in depth:
        image[0, :4] = np.nan, np.inf, -np.inf, -1
    change_table(dataset, "data", lambda rows: rows.update({DEPTH: [picture(image, "TIFF") for image in depth]}))
    for frame, image in zip(read_all(dataset)[0].frames, depth, strict=True):
        assert not frame.depth[0, :4].any()
        assert np.array_equal(frame.depth[1:], image[1:])


def test_codes_in_proportion_are_read_too() -> None:
    info = {"is_depth_map": True, "video.depth_min": 0.0, "video.depth_max": 4.095, "video.use_log": False}
    code = DepthCode.of(ImageFeature.of("depth", {"dtype": "video", "shape": [2, 2], "info": info}))
    metres = code.metres(np.array([[0, 1], [1000, 4095]], np.uint16))
    assert metres == pytest.approx(np.array([[0, 0.001], [1, 0]], np.float32))  # the last may be farther


def test_codes_are_those_of_lerobot_where_the_feature_says_nothing_of_them() -> None:
    code = DepthCode.of(ImageFeature.of("depth", {"dtype": "video", "shape": [2, 2], "info": {"is_depth_map": True}}))
    assert code == DepthCode(nearest=0.01, farthest=10.0, shift=3.5, by_logarithm=True)


@pytest.mark.parametrize(("kind", "unit"), [("m", "mm"), ("mm", "m")])
def test_the_unit_of_depth_images_is_the_one_that_the_feature_says(tmp_path: Path, kind: str, unit: str) -> None:
    dataset = write_lerobot(tmp_path / "room", (1,), stored=kind)
    usual = next(read_all(dataset)[0].frames).depth
    change_info(dataset, lambda info: info["features"][DEPTH]["info"].update(depth_unit=unit))
    factor = {"mm": 0.001, "m": 1000.0}[unit]
    assert next(read_all(dataset)[0].frames).depth == pytest.approx(factor * usual)


def test_images_that_were_stored_smaller_have_a_camera_of_their_size(tmp_path: Path) -> None:
    dataset = write_lerobot(tmp_path / "room", (2,), stored="mm")
    frames = list(ROOM.frames(poses(2, "quaternion")[1]))
    smaller = {
        COLOR: [picture(frame.rgb[::2, ::2], "PNG") for frame in frames],
        DEPTH: [picture(stored_depth(frame.depth, "mm")[::2, ::2], "TIFF") for frame in frames],
    }
    change_table(dataset, "data", lambda rows: rows.update(smaller))
    info = read_all(dataset)[0].info
    assert (info.height, info.width) == (24, 32)
    assert info.intrinsics[:2] == pytest.approx(ROOM.intrinsics[:2] / 2)


@pytest.mark.parametrize(
    "change",
    [
        lambda info: info.update(fps=11),
        lambda info: info["features"]["observation.pose"].update(names=None),
        lambda info: info["features"][COLOR]["info"].update({"video.fps": 11}),
    ],
)
def test_an_episode_whose_rate_pose_or_colours_are_described_otherwise_is_another_one(
    tmp_path: Path, change: Callable[[dict[str, Any]], object]
) -> None:
    dataset, settings = write_lerobot(tmp_path / "room", (2,), "planar"), {"pose": "observation.pose", "axes": "robot"}
    run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, settings)
    change_info(dataset, change)
    with pytest.raises(DataError, match="holds another trajectory"):
        run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, settings)


def test_a_video_is_decoded_once_where_episodes_follow_each_other(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []
    decoded = videos.decoded
    monkeypatch.setattr(videos, "decoded", lambda path, since: opened.append(path) or decoded(path, since))
    for episode in LeRobot(replace(POSE, axes="robot")).trajectories(dataset):
        assert len(list(episode.frames)) == episode.length
    assert sorted(opened) == sorted(video(dataset, key) for key in (COLOR, DEPTH))


def test_a_video_of_larger_pictures_than_any_camera_takes_is_not_decoded(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(videos, "MOST_PIXELS", 1000)
    with pytest.raises(DataError, match=r"file-000.mp4: cannot be read as a video"):
        read_all(dataset, replace(POSE, axes="robot"))


def test_images_in_one_large_group_of_rows_are_read_a_few_at_once(tmp_path: Path) -> None:
    many = write_lerobot(tmp_path / "room", (24,), stored="mm")
    column = ColumnImages(ImageFeature.of(COLOR, {"dtype": "image", "shape": [48, 64, 3]}), as_depth=False)
    path = many / "data/chunk-000/file-000.parquet"
    truth = [image["bytes"] for image in pq.read_table(path)[COLOR].to_pylist()]
    for row in (0, 1, 20, 23, 2, 2, 17):
        assert np.array_equal(column.image(path, row).read(), decode_color(truth[row], "")), row
        assert len(column._files) <= 16


def test_episodes_that_are_recorded_later_are_added(tmp_path: Path) -> None:
    settings = {"pose": "observation.pose", "axes": "robot"}
    dataset = write_lerobot(tmp_path / "room", (3,), "planar")
    change_info(dataset, lambda info: info.update(total_frames=3))
    run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, settings)
    write_later_episode(dataset)
    change_info(dataset, lambda info: info.update(total_frames=1000))  # a description of another size
    run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, settings)
    assert [len(trajectory) for trajectory in Store(tmp_path / "out")] == [3, 3]
    change_info(dataset, lambda info: info["features"][DEPTH]["info"].update({"video.depth_max": 9.0}))
    with pytest.raises(DataError, match="holds another trajectory"):
        run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, settings)


def test_names_may_be_given_by_their_places(dataset: Path) -> None:
    places = {f"p{number}": number for number in reversed(range(7))}
    change_info(dataset, lambda info: info["features"]["observation.pose"].update(names=places))
    whole, picked = (
        read_all(dataset, replace(POSE, names=names))[0] for names in ((), tuple(f"p{number}" for number in range(7)))
    )
    for one, other in zip(whole.frames, picked.frames, strict=True):
        assert np.array_equal(one.world_from_camera, other.world_from_camera)


def test_settings_that_do_not_exist_are_named(persist: Any, dataset: Path, tmp_path: Path) -> None:
    refused = persist("import", "lerobot", dataset, "--set", "posse=x", "--out", tmp_path / "out")
    assert (refused.code, refused.out) == (1, "")
    assert refused.err == "error: importer 'lerobot': unknown key 'posse', did you mean 'pose'?\n"
    refused = persist("import", "lerobot", dataset, "--set", "axes=ros", "--out", tmp_path / "out")
    assert refused.err.startswith("error: importer 'lerobot': axes must be ")
    assert not (tmp_path / "out").exists()
    with pytest.raises(PersistError, match="importer 'tum': unknown key 'pose'"):
        run_import("tum", dataset, tmp_path / "out", ImportPlan(), True, {"pose": "x"})
