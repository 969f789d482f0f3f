"""What inspect says of a data set in figures, and of a fault in words, is what it means."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.checkpoint import POLICY_CARD
from persist_cli.api.observations import Observations
from persist_cli.data.check.convention import ConventionCheck, hypotheses
from persist_cli.data.check.inspect import check_table, figures_table, trajectory_figures, verdict_line
from persist_cli.data.check.others import describe_other
from persist_cli.data.check.reprojection import ReprojectionErrors
from persist_cli.data.store import Store, TrajectoryFile, write_trajectory
from persist_cli.io.files import write_json
from tests.support.rooms import Room, look

ROOM = Room(8, 8)


def pair(matrix: list[list[float]], height: int, width: int) -> Observations:
    """Two frames of depth 2 m by cameras of these intrinsics."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    cameras = Cameras(poses, torch.tensor(matrix, dtype=torch.float64).repeat(2, 1, 1), height, width)
    return Observations(
        torch.zeros(2, height, width, 3, dtype=torch.uint8), torch.full((2, height, width), 2.0), cameras
    )


def test_figures_are_those_of_the_frames_of_the_reference(tmp_path: Path) -> None:
    poses = np.stack([look((0.3 * number, 1.4, 0.4 * number), 10.0 * number) for number in range(6)])
    figures = trajectory_figures(TrajectoryFile(ROOM.write(tmp_path / "walk.parquet", poses)), slice(2, 5))
    assert (figures.frames, figures.actions) == (3, {"free": 3})
    assert figures.metres == pytest.approx(1.0)
    assert figures.turned == pytest.approx(20.0, abs=1e-3)
    assert figures.seconds == pytest.approx(0.2)


def test_the_field_of_view_counts_both_sides_of_a_principal_point(tmp_path: Path) -> None:
    info = replace(ROOM.info, intrinsics=np.array([[4.0, 0, 2], [0, 4, 4], [0, 0, 1]]))
    write_trajectory(tmp_path / "walk.parquet", info, ROOM.frames(np.stack([look((0, 1.4, 0), 0)])))
    figures = trajectory_figures(Store(tmp_path)[0])
    assert figures.field_of_view == pytest.approx(np.degrees(np.arctan(2 / 4) + np.arctan(6 / 4)))


def test_the_table_sums_up_all_trajectories(tmp_path: Path) -> None:
    for frames in (2, 3):
        poses = np.stack([look((0, 1.4, 0.5 * number), 0) for number in range(frames)])
        ROOM.write(tmp_path / f"walk-{frames}.parquet", poses)
    rows = dict(figures_table([trajectory_figures(file) for file in Store(tmp_path)], {"free": "any motion"}))
    assert (rows["trajectories"], rows["scenes"], rows["frames"]) == ("2", "1", "5 (2 to 3 each)")
    assert (rows["metres travelled"], rows["seconds"]) == ("1.50 (0.50 to 1.00 each)", "0.3 (0.1 to 0.2 each)")
    assert rows["action free: any motion"] == "3"


def test_the_table_of_the_check_has_shares_in_percent() -> None:
    figures = {"median_metres": 0.01, "median_relative": 0.012, "occluded": 0.25, "median_pixels": 0.5}
    check = ConventionCheck("ok", "", [], 3, 2, **figures, color_warped=3.0, color_unwarped=9.0)
    rows = dict(check_table(check))
    assert (rows["depth error over depth, median"], rows["occluded"]) == ("1.20 %", "25.00 %")
    assert rows["depth error, 95 % of what is not occluded"] == "none"


def test_the_table_of_the_check_says_which_colours_are_reprojected_and_how_far_depth_is_off() -> None:
    figures = {"median_metres": 0.01, "p95_metres": 0.25, "median_relative": 0.0, "occluded": 0.0, "median_pixels": 0.5}
    rows = dict(check_table(ConventionCheck("ok", "", [], 3, 2, **figures, color_warped=3.0, color_unwarped=9.0)))
    assert (rows["colour error, reprojected"], rows["colour error, same pixel"]) == ("3.0 of 255", "9.0 of 255")
    assert (rows["depth error, median"], rows["depth error, 95 % of what is not occluded"]) == ("0.0100 m", "0.2500 m")


def test_the_verdict_names_the_cause_or_what_the_data_cannot_show() -> None:
    wrong, unsure = ConventionCheck("suspicious", "a cause", [], 1, 1), ConventionCheck("ok", "", ["a", "b"], 1, 1)
    assert verdict_line(wrong) == "suspicious: a cause"
    assert verdict_line(unsure) == "ok, but this motion would not show: a, b"
    assert verdict_line(replace(unsure, undecided=[])) == "ok: cameras, depth and poses agree"


def test_of_many_sizes_the_three_most_frequent_are_named_and_the_cells_of_scenes_are_counted(tmp_path: Path) -> None:
    one = trajectory_figures(TrajectoryFile(ROOM.write(tmp_path / "walk.parquet", np.stack([look((0, 1.4, 0), 0)]))))
    sides = [1, 2, 3, 3, 4, 4, 5, 5]
    figures = [replace(one, size=(side, side), cells=side > 3, world_up_is="given" * (side > 4)) for side in sides]
    rows = dict(figures_table(figures, {}))
    assert rows["image size"] == "3×3, 4×4, 5×5 and 2 more"
    assert rows["trajectories with the cells of their scene"] == "4"
    assert rows["up axis is"] == "given"
    assert not {"trajectories with the cells of their scene", "up axis is"} & {*dict(figures_table(figures[:3], {}))}


def test_a_point_behind_what_the_other_frame_sees_is_occluded_and_none_before_it() -> None:
    errors = torch.tensor([0.1, -0.1, 0.0])
    assert ReprojectionErrors(1.0, errors, errors, errors, errors, errors).occluded.tolist() == [True, False, False]


def test_intrinsics_of_images_of_another_aspect_are_scaled_along_each_axis_by_itself() -> None:
    frames = pair([[50, 0, 16], [0, 100, 48], [0, 0, 1]], 48, 64)
    first = next(one for one in hypotheses(frames.cameras) if one.name == "intrinsics of another size")
    assert "about 96×32, these are 48×64: multiply their first row by 2 and their second by 0.5" in first.cause
    assert first.undo(frames).cameras.intrinsics[0].tolist() == [[100, 0, 32], [0, 50, 24], [0, 0, 1]]


def test_a_fault_is_undone_as_its_cause_says() -> None:
    frames, compared = pair([[50, 0, 32], [0, 50, 24], [0, 0, 1]], 48, 64), set()
    for one in hypotheses(frames.cameras):
        undone, numbers = one.undo(frames), [float(text) for text in re.findall(r"\d+\.?\d*", one.cause)]
        if one.name == "depth units":
            assert float(undone.depth[0, 0, 0]) == pytest.approx(2 * numbers[-1]), one.cause
        elif one.name == "focal length":
            assert float(undone.cameras.intrinsics[0, 1, 1]) == pytest.approx(50 * numbers[-1], rel=0.01), one.cause
        elif "should lie at" in one.cause:
            assert undone.cameras.intrinsics[0, :2, 2].tolist() == numbers[-2:], one.cause
        else:
            continue
        compared.add(one.name)
    assert {"depth units", "focal length"} < compared, compared


def test_a_run_of_a_policy_is_described_by_its_newest_checkpoint(tmp_path: Path) -> None:
    for step in (1, 2):
        write_json(tmp_path / f"step-{step:08d}/model/{POLICY_CARD}", {"policy": "nomad"})
    described = describe_other(tmp_path)
    assert described is not None
    assert described.startswith(f"a trained policy of 'nomad', {tmp_path / 'step-00000002/model'}; ")
