"""A contact sheet shows evenly chosen frames under their labels."""

import numpy as np
import pytest
import torch
from PIL import Image

from persist_cli.output.depth import DepthScale
from persist_cli.output.sheet import CELL, GAP, HEADER, write_sheet

GRAY = torch.arange(0, 250, 10, dtype=torch.uint8)[:, None, None, None].expand(25, 8, 8, 3)


def sheet(path, *arguments, **options):
    write_sheet(path, *arguments, **options)
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def test_labels_stand_above_the_frames_that_were_chosen(tmp_path):
    names = ["" if number in (0, 24) else "###" for number in range(25)]
    picture = sheet(tmp_path / "a.png", [("x", GRAY)], names, most=3)
    margin = picture.shape[1] - 3 * (CELL + GAP)
    dark = [(picture[:HEADER, margin + n * (CELL + GAP) :][:, :CELL] < 128).any() for n in range(3)]
    assert dark == [False, True, False]


@pytest.mark.parametrize("length", [200, 3])
def test_a_label_never_runs_into_the_next_column(tmp_path, length):
    picture = sheet(tmp_path / "a.png", [("x", GRAY[:2])], ["M" * length, ""])
    assert (picture[:HEADER, -CELL - GAP :] == 255).all()


def test_a_bar_stands_under_the_rows(tmp_path):
    rows = [("x", GRAY)]
    plain = sheet(tmp_path / "a.png", rows)
    barred = sheet(tmp_path / "b.png", rows, bar=DepthScale(1, 2).bar)
    assert (barred[: len(plain)] == plain).all()
    assert (barred[len(plain) :] < 128).any()
