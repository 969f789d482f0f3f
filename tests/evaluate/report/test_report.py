"""The folder of a report: page, tables, curves, sheets and clips."""

from __future__ import annotations

import json
import math
import re
from xml.etree import ElementTree

import pytest
import torch
from PIL import Image

from persist_cli.errors import DataError, PersistError
from persist_cli.evaluate.report.curves import nice_ticks, plots, row_styles
from persist_cli.evaluate.report.page import write_report
from persist_cli.evaluate.report.pictures import ClipPicture, Pictures, RowPictures, side_by_side
from persist_cli.evaluate.report.result_file import check_results
from persist_cli.output.sheet import label_font
from persist_cli.output.video import read_video
from tests.support.example_results import ROWS, example_pictures, example_results


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_report(example_results(), example_pictures(example_results(rows={"a row": "model"})), folder)
    return folder


def test_the_folder_holds_page_tables_curves_sheets_and_clips(report):
    assert {"report.html", "table.md", "table.tex", "results.json"} <= {path.name for path in report.iterdir()}
    assert len(list((report / "curves").glob("*.svg"))) == 8
    assert len(list((report / "clips").glob("*.mp4"))) == 3
    assert len(list((report / "sheets").glob("*.png"))) == 4
    assert not list(report.rglob(".partial-*"))


def test_the_page_refers_to_nothing_outside_itself(report):
    page = (report / "report.html").read_text(encoding="utf-8")
    assert "http" not in page.replace("http-equiv", "")
    assert all(link.startswith("data:") for link in re.findall(r'(?:src|href)="([^"]*)', page))
    assert "url(" not in page
    assert "<script" not in page


def test_results_in_the_folder_are_strict_json_with_everything(tmp_path):
    results = example_results()
    results["tables"][0]["rows"]["none"]["columns"]["psnr"]["std"] = math.nan
    write_report(results, Pictures(), tmp_path)
    written = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)
    assert written["tables"][0]["rows"]["none"]["columns"]["psnr"].pop("std") is None
    results["tables"][0]["rows"]["none"]["columns"]["psnr"].pop("std")
    assert written == json.loads(json.dumps(results))


def test_the_page_holds_all_that_is_needed_to_measure_again(report):
    page = (report / "report.html").read_text(encoding="utf-8")
    for fact in ("runs/houses test&#39;", "f" * 64, "e" * 64, "d" * 64, "a" * 64, "2.13.0", "0.42.1", f"{1:064x}"):
        assert fact in page


def test_a_new_report_replaces_the_old_one_and_leaves_other_files(tmp_path):
    write_report(example_results(), example_pictures(example_results(rows={"old": "model"})), tmp_path)
    assert list((tmp_path / "clips").glob("*.mp4"))
    own = [tmp_path / "notes.txt", tmp_path / "clips" / "holiday.mp4"]
    for path in own:
        path.write_text("mine")
    write_report(example_results(), Pictures(), tmp_path)
    assert list((tmp_path / "clips").glob("*")) == own[1:]
    assert [path.read_text() for path in own] == ["mine", "mine"]


def test_a_report_that_fails_leaves_the_old_one_whole(tmp_path):
    write_report(example_results(), Pictures(), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    small, large = (torch.zeros(3, size, size, 3, dtype=torch.uint8) for size in (8, 9))
    clip = ClipPicture(0, "", small, large)  # of two sizes: cannot stand side by side
    with pytest.raises(RuntimeError):
        write_report(example_results(), Pictures((RowPictures("all", "none", clip, clip, clip),)), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_file_in_the_way_of_the_report_is_one_line_and_no_page_is_written(tmp_path):
    (tmp_path / "curves").write_text("a file in the way")
    with pytest.raises(PersistError, match="the report cannot be written there"):
        write_report(example_results(), Pictures(), tmp_path)
    assert not (tmp_path / "report.html").exists()
    assert not list(tmp_path.glob(".partial-*"))
    with pytest.raises(PersistError, match="the report cannot be written there"):
        write_report(example_results(), Pictures(), tmp_path / "curves")


def test_damaged_results_are_one_line(tmp_path):
    results = example_results()
    del results["measured"]["image_size"]
    with pytest.raises(DataError, match=r"are damaged: measured.image_size is missing; it must be two whole numbers$"):
        write_report(results, Pictures(), tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_curve_files_are_svg_with_a_line_for_each_row(report):
    root = ElementTree.parse(report / "curves/psnr-frames.svg").getroot()
    lines = list(root.iter("{http://www.w3.org/2000/svg}polyline"))
    assert len(lines) == len(ROWS)
    assert sum("stroke-dasharray" in line.attrib for line in lines) == 3  # the controls


def test_a_curve_is_broken_where_a_figure_is_missing_and_ends_at_the_last_frame():
    results = example_results()
    curve = results["tables"][0]["rows"]["voxel"]["curves"]["psnr"]
    curve["per_frame"][3] = math.nan
    checked = check_results(results, "example")
    plot = plots(checked, checked.tables[0], row_styles(checked))[0]
    line = next(line for line in plot.lines if line.style.row == "voxel")
    assert [len(stroke.split()) for stroke in line.strokes] == [3, 4]
    assert line.dots[-1].x == plot.box[2]
    assert line.dots[-1].tip.startswith("voxel: frame 8, ")


def test_a_line_is_broken_where_a_bin_of_seen_before_is_empty():
    results = example_results()
    del results["tables"][0]["rows"]["voxel"]["curves"]["psnr"]["by_seen_before"][2]
    checked = check_results(results, "example")
    plot = plots(checked, checked.tables[0], row_styles(checked))[1]
    line = next(line for line in plot.lines if line.style.row == "voxel")
    assert [len(stroke.split()) for stroke in line.strokes] == [2, 2]
    assert len(plot.counts) == 5


def test_every_row_has_a_style_of_its_own():
    many = {f"row {number}": kind for number, kind in enumerate(["model"] * 9 + ["control"] * 5)}
    styles = row_styles(check_results(example_results(rows=many), "example")).values()
    assert len({(style.color, style.dash, style.marked) for style in styles}) == len(many)
    assert {style.kind for style in styles if style.dash} == {"control"}


@pytest.mark.parametrize(("low", "high"), [(17.3, 26.1), (0.0, 1.0), (-3.0, 2.0), (0.0012, 0.0019), (5.0, 5.0)])
def test_at_most_five_ticks_lie_within_the_range(low, high):
    ticks = nice_ticks(low, high, 5)
    assert 1 <= len(ticks) <= 5
    assert all(low - 1e-9 <= tick <= high + 1e-9 for tick in ticks)


def test_a_metric_without_any_figure_has_no_plot(tmp_path):
    results = example_results()
    for row in results["tables"][0]["rows"].values():
        row["curves"]["src"] = {"per_frame": [None] * 8, "by_seen_before": []}
    write_report(results, Pictures(), tmp_path)
    assert not list((tmp_path / "curves").glob("src*"))


def test_a_clip_shows_truth_left_and_generated_right_with_depth_below(report):
    truth, generated = (torch.full((4, 64, 64, 3), value, dtype=torch.uint8) for value in (50, 200))
    video = side_by_side(ClipPicture(0, "", generated, truth))
    left, right = video[:, 30:, : video.shape[2] // 2 - 2], video[:, 30:, video.shape[2] // 2 + 2 :]
    assert (int(left.min()), int(left.max()), int(right.min()), int(right.max())) == (50, 50, 200, 200)
    depth = torch.ones(4, 64, 64)
    assert side_by_side(ClipPicture(0, "", generated, truth, depth, depth)).shape[1] > 2 * 256
    assert len(read_video(next((report / "clips").glob("*.mp4")), 64, 64)) == 9
    assert Image.open(next((report / "sheets").glob("*.png"))).size[0] > 500


def test_large_frames_are_averaged_down_for_the_video():
    large = torch.arange(2, dtype=torch.uint8).repeat(20, 640, 320)[..., None].expand(-1, -1, -1, 3) * 100
    video = side_by_side(ClipPicture(0, "", large, large))
    assert video.shape[2] < 2 * 640
    assert set(video[:, 30:, :300].unique().tolist()) == {50}  # of columns 0 and 100


def test_labels_in_pictures_have_greek_letters():
    font = label_font()
    assert bytes(font.getmask("σ")) != bytes(font.getmask("\uffff"))


def test_results_of_one_seed_without_pictures_or_first_row_still_give_a_report(tmp_path):
    results = example_results(rows={"copy": "control"})
    results |= {"first_row": None, "checkpoints": [], "command": []}
    results["tables"].append(results["tables"][0] | {"name": "vizdoom", "rows": {}})
    results["sampling"] = {"seeds": [0]}
    write_report(results, Pictures(), tmp_path)
    assert "vizdoom" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_one_clip_that_is_best_and_worst_is_shown_once():
    clip = ClipPicture(3, "", torch.zeros(2, 8, 8, 3), torch.zeros(2, 8, 8, 3))
    assert [pick for pick, _ in RowPictures("all", "none", clip, clip, clip).picks()] == ["best, median, worst"]
