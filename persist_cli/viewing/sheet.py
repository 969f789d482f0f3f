"""Contact sheets: rows of frames with a label, one picture to see a whole video or a comparison."""

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
    """A PNG with a labelled row of frames for each video, at most ``most`` of each, evenly chosen.

    Args:
        path: of the PNG.
        rows: label and frames.
        columns: labels above the frames.
        most: frames a row.
    """
    font = label_font()
    margin = GAP + max(int(font.getlength(label)) for label, _ in rows) + GAP
    widths = [_cells(video, most) for _, video in rows]
    across = max(len(cells) * (cells[0].width + GAP) for cells in widths)
    header = 20 if columns else GAP
    sheet = Image.new("RGB", (margin + across, header + len(rows) * (CELL + GAP)), "white")
    draw = ImageDraw.Draw(sheet)
    for row, ((label, _), cells) in enumerate(zip(rows, widths, strict=True)):
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
    """The font of labels in pictures; it has Greek letters and signs, which Pillow's own lacks."""
    import matplotlib

    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", 12)


def _cells(video: Tensor, most: int) -> list[Image.Image]:
    """At most ``most`` frames, evenly chosen, as images of the cell's height."""
    chosen = np.unique(np.linspace(0, len(video) - 1, min(most, len(video))).round().astype(int))
    width = round(CELL * video.shape[2] / video.shape[1])
    return [
        Image.fromarray(video[int(number)].numpy()).resize((width, CELL), Image.Resampling.NEAREST) for number in chosen
    ]
