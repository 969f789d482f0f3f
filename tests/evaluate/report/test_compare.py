"""Two runs are compared side by side when they measured the same."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest

from persist_cli.errors import DataError
from persist_cli.evaluate.report.compare import compare_cells, compare_runs, run_compare
from persist_cli.evaluate.report.page import write_report
from persist_cli.evaluate.report.pictures import Pictures
from persist_cli.evaluate.report.result_file import Cell
from tests.support.example_results import ROWS, example_results


def write_results(tmp_path, name, change=lambda results: None):
    """Write the example's JSON after a change."""
    results = copy.deepcopy(example_results())
    change(results)
    (tmp_path / name).write_text(json.dumps(results))
    return tmp_path / name


def add_one_decibel(results):
    """Give the voxel row one dB more on every clip."""
    cell = results["tables"][0]["rows"]["voxel"]["columns"]["psnr"]
    cell["mean"] += 1
    cell["per_clip"] = [value + 1 for value in cell["per_clip"]]


def compared_psnr(tmp_path, change):
    """The voxel row's PSNR in the example, compared with the example after a change."""
    comparison = compare_runs(write_results(tmp_path, "a.json"), write_results(tmp_path, "b.json", change))
    return comparison.tables[0].rows["voxel"]["psnr"]


def test_a_run_compared_with_itself_differs_nowhere(tmp_path):
    same = write_results(tmp_path, "a.json")
    comparison = compare_runs(same, same)
    figures = [cell for row in comparison.tables[0].rows.values() for cell in row.values() if cell.a is not None]
    assert {(cell.difference, cell.low, cell.high) for cell in figures} == {(0.0, 0.0, 0.0)}
    assert (list(comparison.tables[0].rows), comparison.notes) == (list(ROWS), [])


def test_the_difference_is_paired_clip_by_clip(tmp_path):
    cell = compared_psnr(tmp_path, add_one_decibel)
    assert (cell.difference, cell.low, cell.high) == (pytest.approx(1), pytest.approx(1), pytest.approx(1))
    assert cell.pairs == 6


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"counted": [True, False, True]}, "clip 0: frame 2 counts in B only; .*3 more clips"),
        ({"first_visits": [-1, -1, 0]}, "clip 0: frame 2 returns to no earlier frame in A and frame 0 in B"),
    ],
)
def test_runs_of_which_other_frames_count_or_return_are_not_compared(tmp_path, changes, reason):
    def frames(**values):
        known = {"counted": [True, False, False], "first_visits": [-1, -1, -1]} | values
        return lambda results: [clip.update(known) for clip in results["measured"]["clips"]]

    a, b = write_results(tmp_path, "a.json", frames()), write_results(tmp_path, "b.json", frames(**changes))
    with pytest.raises(DataError, match=reason):
        compare_runs(a, b)
    assert compare_runs(a, write_results(tmp_path, "c.json")).notes == []  # an earlier version, which does not say it


def test_a_clip_without_a_figure_in_one_run_is_no_pair(tmp_path):
    def change(results):
        add_one_decibel(results)
        cell = results["tables"][0]["rows"]["voxel"]["columns"]["psnr"]
        cell["per_clip"][0] = None
        cell["per_clip"][1] = float("nan")

    cell = compared_psnr(tmp_path, change)
    assert (cell.pairs, cell.difference) == (4, pytest.approx(1))
    assert (cell.low, cell.high) == (None, None)  # of four pairs there is no interval


def test_figures_of_other_clips_have_no_difference(tmp_path):
    def keep(*clips):
        def change(results):
            cell = results["tables"][0]["rows"]["voxel"]["columns"]["psnr"]
            cell["per_clip"] = [value if place in clips else None for place, value in enumerate(cell["per_clip"])]

        return change

    files = write_results(tmp_path, "a", keep(0, 1)), write_results(tmp_path, "b", keep(2, 3))
    cell = compare_runs(*files).tables[0].rows["voxel"]["psnr"]
    assert None not in (cell.a, cell.b)
    assert cell.difference is None


def test_runs_of_five_clips_are_compared_without_intervals_and_say_why(tmp_path, capsys):
    def fewer(results):
        results.update(example_results(clips=5))

    def better(results):
        fewer(results)
        add_one_decibel(results)

    a, b = write_results(tmp_path, "a.json", fewer), write_results(tmp_path, "b.json", better)
    run_compare(a, b, False, tmp_path / "out")
    for text in (capsys.readouterr().out, (tmp_path / "out/compare.md").read_text()):
        assert "5 clips: too few for an interval; give at least 6" in text
        assert "+1.00" in text
        assert "*" not in text.replace("\\*", "*").replace("**", "")
    comparison = json.loads((tmp_path / "out/compare.json").read_text())
    assert comparison["tables"][0]["rows"]["voxel"]["psnr"]["low"] is None


def test_intervals_of_two_models_say_that_they_hold_no_other_trainings(tmp_path, capsys):
    def trained_again(results):
        add_one_decibel(results)
        results["checkpoints"][0]["fingerprint"] = "b" * 64

    a, b, c = (
        write_results(tmp_path, name, change)
        for name, change in (("a", lambda results: None), ("b", trained_again), ("c", add_one_decibel))
    )
    run_compare(a, b, False, tmp_path / "out")
    words = "the models differ, and intervals draw clips, not trainings"
    for text in (capsys.readouterr().out, (tmp_path / "out/compare.md").read_text()):
        assert words in " ".join(text.split())
    run_compare(a, c, False, None)
    assert words not in " ".join(capsys.readouterr().out.split())


def test_without_figures_clip_by_clip_there_is_a_difference_of_means_and_no_interval(tmp_path):
    def change(results):
        add_one_decibel(results)
        results["tables"][0]["rows"]["voxel"]["columns"]["psnr"]["per_clip"] = None

    cell = compared_psnr(tmp_path, change)
    assert (cell.difference, cell.low, cell.pairs) == (pytest.approx(1), None, 0)


def test_the_interval_covers_the_true_difference_and_excludes_zero_only_when_it_should(tmp_path):
    def shift(results):
        cell = results["tables"][0]["rows"]["voxel"]["columns"]["psnr"]
        cell["per_clip"] = [value + (-1) ** place * 2 + 0.1 for place, value in enumerate(cell["per_clip"])]

    cell = compared_psnr(tmp_path, shift)
    assert cell.low < 0 < cell.difference < cell.high
    assert -1.91 < cell.low < cell.high < 2.11


def weigh(results, *weights):
    """Let the clips of the voxel row's PSNR count by weights."""
    results["tables"][0]["rows"]["voxel"]["columns"]["psnr"]["clip_weights"] = [*weights]


def test_weighted_clips_are_weighted_in_the_difference_too(tmp_path):
    def better_in_one_clip(results):
        weigh(results, 5, 1, 1, 1, 1, 1)
        results["tables"][0]["rows"]["voxel"]["columns"]["psnr"]["per_clip"][0] += 1

    a = write_results(tmp_path, "a.json", lambda results: weigh(results, 5, 1, 1, 1, 1, 1))
    comparison = compare_runs(a, write_results(tmp_path, "b.json", better_in_one_clip))
    assert comparison.tables[0].rows["voxel"]["psnr"].difference == pytest.approx(0.5)
    assert comparison.notes == []


def test_clips_that_an_earlier_version_did_not_weigh_have_no_difference_and_a_note(tmp_path):
    a = write_results(tmp_path, "a.json", lambda results: weigh(results, 5, 1, 1, 1, 1, 1))
    comparison = compare_runs(a, write_results(tmp_path, "b.json"))
    assert comparison.tables[0].rows["voxel"]["psnr"].difference is None
    note = "clips of PSNR are weighted in A only, so it has no difference: evaluate B again in its folder"
    assert comparison.notes == [note]


DIFFERENCES = {
    "protocol: revisit and return": lambda results: results["measured"]["protocol"].update(name="return"),
    "frames a clip: 9 and 112": lambda results: results["measured"]["protocol"].update(frames=112),
    "image size: 64×64 and 128×64": lambda results: results["measured"].update(image_size=[128, 64]),
    "clip 2: 0/house-2:24+9 and 0/house-2:25+9": lambda results: results["measured"]["clips"][2].update(start=25),
    "trajectory house-1 of data set 0: 000000000000 and abababababab": lambda results: results["measured"]["data"][0][
        "trajectories"
    ].update({"house-1": "ab" * 32}),
    "definition of SSIM: Gaussian window 11, sigma 1.5 and window 7": lambda results: results["measured"]["metrics"][
        "ssim"
    ].update(definition="window 7"),
    "weights lpips-alex of LPIPS: aaaaaaaaaaaa and bbbbbbbbbbbb": lambda results: results["measured"]["metrics"][
        "lpips-alex"
    ].update(weights={"lpips-alex": "b" * 64}),
    "frames of column psnr-last: last and return": lambda results: results["columns"]["psnr-last"].update(
        frames="return"
    ),
    "number of tables: 1 and 2": lambda results: results["tables"].append(results["tables"][0]),
    "clips of a table: 6 in all and 6 in all, not the same": lambda results: results["tables"][0]["clips"].reverse(),
}


@pytest.mark.parametrize("reason", DIFFERENCES)
def test_runs_that_measured_differently_are_refused_with_both_values(tmp_path, reason):
    a, b = write_results(tmp_path, "a.json"), write_results(tmp_path, "b.json", DIFFERENCES[reason])
    with pytest.raises(DataError) as error:
        compare_runs(a, b)
    assert str(error.value) == f"{a} and {b} were measured differently: {reason}"


def test_a_run_over_fewer_clips_is_refused_in_one_line(tmp_path):
    def change(results):
        smaller = example_results(clips=5)
        results.update(measured=smaller["measured"], tables=smaller["tables"])

    with pytest.raises(DataError, match=r"number of clips: 6 and 5") as error:
        compare_runs(write_results(tmp_path, "a.json"), write_results(tmp_path, "b.json", change))
    assert "\n" not in str(error.value)


def test_other_sampling_versions_and_rows_are_noted_and_not_refused(tmp_path):
    def change(results):
        results["sampling"] |= {"steps": 25, "seeds": [0]}
        results["environment"]["torch"] = "2.14.0"
        results["checkpoints"][0]["fingerprint"] = "0" * 64
        del results["tables"][0]["rows"]["voxel, shuffled"]
        del results["columns"]["ssim"]

    comparison = compare_runs(write_results(tmp_path, "a.json"), write_results(tmp_path, "b.json", change))
    assert comparison.notes == [
        "steps: 50 and 25", "seeds: [0, 1, 2] and [0]", "torch: 2.13.0 and 2.14.0",
        "checkpoint voxel: ffffffffffff and 000000000000", "column ssim: only in A", "row voxel, shuffled: only in A",
    ]  # fmt: skip
    assert "ssim" not in comparison.columns


BROKEN = {
    "no such file": None,
    "not readable as JSON": "{",
    "not the results of `persist eval`": "[]",
    "no format 'persist-evaluation' in it": '{"rows": 1}',
    "results of version 2; this persist reads version 1": '{"format": "persist-evaluation", "version": 2}',
    "results are damaged: measured is missing; it must be a mapping": '{"format": "persist-evaluation", "version": 1}',
}


@pytest.mark.parametrize("cause", BROKEN)
def test_a_file_that_is_not_results_is_one_line(tmp_path, cause):
    if BROKEN[cause] is not None:
        (tmp_path / "b.json").write_text(BROKEN[cause])
    with pytest.raises(DataError) as error:
        compare_runs(write_results(tmp_path, "a.json"), tmp_path / "b.json")
    assert cause in str(error.value)
    assert str(tmp_path / "b.json") in str(error.value)
    assert "\n" not in str(error.value)


def test_data_in_another_folder_and_results_named_by_their_folder_compare_alike(tmp_path):
    def change(results):
        results["measured"]["data"][0]["path"] = "elsewhere/houses-test"
        results["tables"][0]["name"] = "elsewhere/houses-test (miniworld)"

    (tmp_path / "eval").mkdir()
    write_results(tmp_path / "eval", "metrics.json", change)
    assert list(compare_runs(write_results(tmp_path, "a.json"), tmp_path / "eval").tables[0].rows) == list(ROWS)


def test_weights_that_one_run_did_not_have_are_no_reason_to_refuse(tmp_path):
    def change(results):
        results["measured"]["metrics"]["lpips-alex"]["weights"] = {}
        for row in results["tables"][0]["rows"].values():
            row["columns"]["lpips-alex"] = {"na": "weights lpips-alex are not here"}

    comparison = compare_runs(write_results(tmp_path, "a.json"), write_results(tmp_path, "b.json", change))
    assert comparison.tables[0].rows["voxel"]["lpips-alex"].b is None
    assert comparison.tables[0].rows["voxel"]["psnr"].difference == 0


def test_runs_without_a_common_row_are_one_line(tmp_path):
    def change(results):
        results["tables"][0]["rows"] = {"other": results["tables"][0]["rows"]["none"]}

    with pytest.raises(DataError, match="have no row in common"):
        compare_runs(write_results(tmp_path, "a.json"), write_results(tmp_path, "b.json", change))


def test_run_compare_prints_a_table_and_leaves_json_and_markdown(tmp_path, capsys):
    write_report(example_results(), Pictures(), tmp_path / "report")
    run_compare(tmp_path / "report", write_results(tmp_path, "b.json", add_one_decibel), False, tmp_path / "out")
    printed = capsys.readouterr().out
    assert "B − A" in printed
    assert printed.count("┏") == 1
    assert "left out: DreamSim (neither run has them)" in printed
    assert "+1.00*" in printed
    comparison = json.loads((tmp_path / "out/compare.json").read_text())
    assert comparison["tables"][0]["rows"]["voxel"]["psnr"]["difference"] == pytest.approx(1)
    assert "+1.00" in (tmp_path / "out/compare.md").read_text()
    run_compare(tmp_path / "report", tmp_path / "b.json", True, None)
    assert json.loads(capsys.readouterr().out) == comparison


def test_clips_of_one_scene_are_drawn_together_in_a_difference():
    gaps = np.repeat([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], 4)
    a, b = (Cell(mean=float(values.mean()), per_clip=values.tolist()) for values in (0 * gaps, gaps))
    scenes, clips = (compare_cells(a, b, clusters) for clusters in (np.arange(32) // 4, np.arange(32)))
    assert (scenes.difference, scenes.pairs, clips.pairs) == (3.5, 8, 32)
    assert scenes.high - scenes.low > 1.5 * (clips.high - clips.low)


@pytest.mark.parametrize(("drawn", "unit"), [(("clips", "clips"), "clips"), (("clips", "scenes"), "scenes")])
def test_clips_are_drawn_only_where_both_runs_drew_them(tmp_path, drawn, unit):
    runs = [
        write_results(
            tmp_path, f"{number}.json", lambda results, one=one: results.update(statistics={"resampled": one})
        )
        for number, one in enumerate(drawn)
    ]
    assert compare_runs(*runs).unit == unit
