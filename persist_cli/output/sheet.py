"""Contact sheets: pictures with a labelled row of frames for each video."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from persist_cli.io.files import written_aside

CELL = 96  # pixels of a frame's height
GAP = 4
HEADER = 20  # pixels above the first row for the labels of its frames
SMALL = 11  # pixels of the letters of these labels
WIDEST_BAR = 480  # pixels


def write_sheet(
    path: Path,
    rows: Sequence[tuple[str, UInt8[Tensor, "frame height width 3"]]],
    labels: Sequence[str] = (),
    most: int = 16,
    bar: Callable[[int], UInt8[Tensor, "height width 3"]] | None = None,
) -> None:
    """Write a PNG with a labelled row of frames for each video, chosen evenly.

    Args:
        path: path of the PNG.
        rows: label and frames of each row.
        labels: label of each frame of the first video, which stands above its column.
        most: largest number of frames of a row.
        bar: makes a picture of a width in pixels, as ``DepthScale.bar`` does, which stands under the rows.
    """
    font = label_font()
    margin = GAP + max(int(font.getlength(label)) for label, _ in rows) + GAP
    images = [_cells(video, most) for _, video in rows]
    across = max(len(cells) * (cells[0].width + GAP) for cells in images)
    header = HEADER if labels else GAP
    legend = None if bar is None else Image.fromarray(bar(min(across - GAP, WIDEST_BAR)).numpy())
    height = header + len(rows) * (CELL + GAP)
    sheet = Image.new("RGB", (margin + across, height + (legend.height if legend else 0)), "white")
    draw = ImageDraw.Draw(sheet)
    for row, ((label, _), cells) in enumerate(zip(rows, images, strict=True)):
        top = header + row * (CELL + GAP)
        draw.text((GAP, top + CELL // 2 - 8), label, fill="black", font=font)
        for column, cell in enumerate(cells):
            sheet.paste(cell, (margin + column * (cell.width + GAP), top))
    if labels:
        _draw_labels(draw, [labels[number] for number in _chosen(len(labels), most)], margin, images[0][0].width)
    if legend:
        sheet.paste(legend, (margin, height))
    with written_aside(path) as aside:
        sheet.save(aside, format="PNG")


@cache
def label_font(size: int = 12) -> ImageFont.FreeTypeFont:
    """Return the font of labels in pictures, with Greek letters and signs, which Pillow's own font lacks."""
    import matplotlib

    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size)


def _draw_labels(draw: ImageDraw.ImageDraw, labels: Sequence[str], left: int, width: int) -> None:
    """Write each label above its column of this width, without the end that does not fit."""
    font = label_font(SMALL)
    for column, label in enumerate(labels):
        while label and font.getlength(label) > width:
            label = label[:-1]
        draw.text((left + column * (width + GAP), 3), label, fill="black", font=font)


def _chosen(frames: int, most: int) -> list[int]:
    """Return the numbers of at most ``most`` frames, evenly from first to last."""
    return [int(number) for number in np.unique(np.linspace(0, frames - 1, min(most, frames)).round())]


def _cells(video: Tensor, most: int) -> list[Image.Image]:
    """Return at most ``most`` frames, evenly chosen, as images of the cell's height."""
    size = round(CELL * video.shape[2] / video.shape[1]), CELL
    chosen = _chosen(len(video), most)
    return [Image.fromarray(video[number].numpy()).resize(size, Image.Resampling.NEAREST) for number in chosen]
