"""Contact sheets: pictures with a labelled row of frames for each video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from persist_cli.io.files import written_aside

CELL = 96  # pixels of a frame's height
GAP = 4


def write_sheet(
    path: Path,
    rows: Sequence[tuple[str, UInt8[Tensor, "frame height width 3"]]],
    columns: Sequence[str] = (),
    most: int = 16,
) -> None:
    """Write a PNG with a labelled row of frames for each video, chosen evenly.

    Args:
        path: path of the PNG.
        rows: label and frames of each row.
        columns: labels above the frames.
        most: largest number of frames of a row.
    """
    font = label_font()
    margin = GAP + max(int(font.getlength(label)) for label, _ in rows) + GAP
    images = [_cells(video, most) for _, video in rows]
    across = max(len(cells) * (cells[0].width + GAP) for cells in images)
    header = 20 if columns else GAP
    sheet = Image.new("RGB", (margin + across, header + len(rows) * (CELL + GAP)), "white")
    draw = ImageDraw.Draw(sheet)
    for row, ((label, _), cells) in enumerate(zip(rows, images, strict=True)):
        top = header + row * (CELL + GAP)
        draw.text((GAP, top + CELL // 2 - 8), label, fill="black", font=font)
        for column, cell in enumerate(cells):
            left = margin + column * (cell.width + GAP)
            sheet.paste(cell, (left, top))
            if row == 0 and column < len(columns):
                draw.text((left, 2), columns[column], fill="black", font=font)
    with written_aside(path) as aside:
        sheet.save(aside, format="PNG")


def label_font() -> ImageFont.FreeTypeFont:
    """Return the font of labels in pictures, with Greek letters and signs, which Pillow's own font lacks."""
    import matplotlib

    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", 12)


def _cells(video: Tensor, most: int) -> list[Image.Image]:
    """Return at most ``most`` frames, evenly chosen, as images of the cell's height."""
    numbers = np.unique(np.linspace(0, len(video) - 1, min(most, len(video))).round().astype(int))
    size = round(CELL * video.shape[2] / video.shape[1]), CELL
    return [Image.fromarray(video[int(number)].numpy()).resize(size, Image.Resampling.NEAREST) for number in numbers]
