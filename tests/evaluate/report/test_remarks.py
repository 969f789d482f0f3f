"""Remarks below the tables: what is left out and what the models were trained on."""

from __future__ import annotations

from persist_cli.evaluate.report.remarks import (
    ALL_COUNT,
    contamination,
    contamination_lines,
    left_out_line,
    new_poses_line,
    unknown_scenes_lines,
)
from persist_cli.evaluate.report.result_file import check_results
from persist_cli.evaluate.report.text import table_text
from persist_cli.metrics import METRICS
from tests.support.example_results import example_results


def weights(name, options=""):
    """The reason of a metric whose weights were not fetched."""
    return f"weights {name} are not here: persist weights fetch {name}{options}"


def trained_on(scenes):
    """Results of a checkpoint that is known to have been trained on such scenes."""
    results = example_results()
    results["checkpoints"][0]["training_scenes"] = scenes
    return check_results(results, "example")


def test_weights_that_one_command_fetches_are_left_out_together():
    left_out = {weights("a"): ["A"], "too few": ["C"], weights("b"): ["B"], weights("d", " --from DIR"): ["D"]}
    assert left_out_line(left_out) == (
        "left out: C (too few); A, B (weights are not here: persist weights fetch a b); "
        "D (weights are not here: persist weights fetch d --from DIR)"
    )
    assert "persist" not in left_out_line(left_out, commands=False)
    assert left_out_line({}) == ""


def test_a_warning_names_at_most_three_ranges_of_scenes():
    scenes = ["a1", "a2", "b", "c", "d"]
    assert contamination("runs/voxel/step-00000008/model", scenes, 9, allowed=True) == (
        "runs/voxel was trained on 5 of these 9 scenes (a1 to a2, b, c, …); its figures are not of unseen scenes "
        "(--allow-training-scenes)"
    )


def test_scenes_that_were_trained_on_are_a_warning_and_others_are_not():
    clean = trained_on({"known": 8, "complete": True, "evaluated": []})
    assert contamination_lines(clean) + unknown_scenes_lines(clean) == []
    (warning,) = contamination_lines(trained_on({"known": 8, "complete": True, "evaluated": ["1"]}))
    assert warning.startswith("runs/voxel was trained on 1 of these 3 scenes (1)")


def test_results_that_do_not_know_all_training_scenes_say_so():
    for scenes, words in (
        (None, "training scenes unknown"),
        ({"known": 0, "complete": False}, "training scenes unknown"),
        ({"known": 4, "complete": False}, "training scenes not all known (4 are)"),
        ({"known": 4, "complete": True}, "4 training scenes"),  # as an earlier version wrote it
    ):
        assert f"{words}; the evaluated ones may be among them" in table_text(trained_on(scenes))


def test_metrics_in_which_other_frames_count_too_are_named_where_frames_are_counted():
    results = example_results()
    limits = {"new_poses": {"metres": 0.2, "degrees": 10.0}, "counted_frames": 40, "predicted_frames": 48}
    results["measured"]["protocol"] |= limits
    assert new_poses_line(check_results(results, "example")).endswith("0.2 m and 10°; SRC: the others, too")
    for row in results["tables"][0]["rows"].values():
        row["columns"]["src"] = {"na": "no clip returns"}
    assert new_poses_line(check_results(results, "example")).endswith("0.2 m and 10°")


def test_frames_are_left_out_of_all_metrics_that_compare_them_with_the_truth_of_their_pose():
    kept = {name for name, metric in METRICS.items() if not getattr(metric, "compares_with_truth", False)}
    assert {*ALL_COUNT} == kept - {"fvd"}
