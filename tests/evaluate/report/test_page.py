"""The report as a real browser shows it."""

from __future__ import annotations

import html
import json
import re

import pytest

from persist_cli.evaluate.report.page import write_report
from persist_cli.reproduce.pages import CHROMIUM, driven_chromium
from tests.support.browser import DESCRIBE_PAGE, POLICY, open_page
from tests.support.example_results import ROWS, example_pictures, example_results

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium or Chrome on this machine")

HOSTILE = "</style><script>alert(1)</script><img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def browser():
    with driven_chromium() as browser:
        yield browser


def describe(browser, folder, tmp_path, width=1280):
    """The browser's view of the report, described by a script in a copy of the page."""
    text = (folder / "report.html").read_text(encoding="utf-8")
    copy = tmp_path / "copy.html"
    copy.write_text(POLICY.sub("", text, count=1).replace("</body>", f"{DESCRIBE_PAGE}</body>"), encoding="utf-8")
    dom, complaints = open_page(browser, copy, width, "#truths")
    truths = re.search(r'<pre id="truths">(.*?)</pre>', dom, re.DOTALL)
    assert truths, complaints
    return json.loads(html.unescape(truths.group(1)))


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    results = example_results()
    write_report(results, example_pictures(results), folder)
    return folder


def test_a_browser_shows_every_row_plot_picture_and_video(browser, report, tmp_path):
    seen = describe(browser, report, tmp_path)
    assert seen["rows"] == list(ROWS)
    assert (seen["images"], seen["broken"]) == (3 * len(ROWS) + 1, 0)
    assert seen["videos"] == seen["playable"] == 3 * len(ROWS)
    assert seen["drawn"] == 8  # four metrics, against frames and against what was seen before


@pytest.mark.parametrize("width", [500, 1280])
def test_the_page_is_never_wider_than_the_window(browser, report, tmp_path, width):
    assert describe(browser, report, tmp_path, width)["across"] <= 0


def test_the_page_loads_no_other_file_and_its_console_is_silent(browser, report, tmp_path):
    dom, complaints = open_page(browser, report / "report.html")
    assert complaints == []
    assert "codec reconstruction" in dom
    assert describe(browser, report, tmp_path)["fetched"] == []


def test_a_page_with_fifty_rows_keeps_its_layout(browser, tmp_path):
    rows = {f"a rather long name of row number {number}": "model" for number in range(50)}
    write_report(example_results(rows=rows), example_pictures(example_results(rows={})), tmp_path / "report")
    seen = describe(browser, tmp_path / "report", tmp_path)
    assert (len(seen["rows"]), seen["across"] <= 0) == (50, True)


def test_a_row_name_with_html_in_it_is_shown_as_text(browser, tmp_path):
    results = example_results(rows={"none": "model", HOSTILE: "control"})
    results["measured"]["protocol"]["title"] = HOSTILE
    results["tables"][0]["rows"][HOSTILE]["columns"]["psnr"] = {"na": HOSTILE}
    write_report(results, example_pictures(results), tmp_path / "report")
    seen = describe(browser, tmp_path / "report", tmp_path)
    assert seen["rows"] == ["none", HOSTILE]
    assert (seen["scripts"], seen["broken"]) == (1, 0)  # the one script is the test's own
