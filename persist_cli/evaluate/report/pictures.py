"""Pictures of an evaluation: clips of every row beside the truth, as MP4 and contact sheet."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.output.console import watched
from persist_cli.output.depth import DepthScale
from persist_cli.output.sheet import write_sheet
from persist_cli.output.video import SMALLEST, below, beside, enlarge, labelled, write_video

SHEET_FRAMES = 9  # of a clip on a contact sheet, so that they are large enough to look at on a page

CHUNK = 16  # frames that are averaged down at once, as floats


@dataclass(frozen=True)
class ClipPicture:
    """A generated clip beside the true one.

    Args:
        clip: number of the clip in ``measured.clips`` of the results.
        figure: figure that made it best, median or worst, as in ``PSNR 21.30``.
        generated: frames of the row.
        truth: true frames, as many and as large.
        depth: generated depth in metres, 0 where it is missing.
        true_depth: true depth in metres, 0 where it is missing.
    """

    clip: int
    figure: str
    generated: UInt8[Tensor, "frame height width 3"]
    truth: UInt8[Tensor, "frame height width 3"]
    depth: Float[Tensor, "frame height width"] | None = None
    true_depth: Float[Tensor, "frame height width"] | None = None


@dataclass(frozen=True)
class RowPictures:
    """The best, the median and the worst clip of a row; they may be the same where there are few."""

    table: str
    row: str
    best: ClipPicture
    median: ClipPicture
    worst: ClipPicture

    def picks(self) -> list[tuple[str, ClipPicture]]:
        """Each clip once, under ``best``, or under ``best, median`` when it is both."""
        picks: dict[int, tuple[list[str], ClipPicture]] = {}
        for name, clip in (("best", self.best), ("median", self.median), ("worst", self.worst)):
            picks.setdefault(clip.clip, ([], clip))[0].append(name)
        return [(", ".join(names), clip) for names, clip in picks.values()]


@dataclass(frozen=True)
class Sheet:
    """A contact sheet of one clip, with the name and the frames of each row."""

    title: str
    rows: tuple[tuple[str, UInt8[Tensor, "frame height width 3"]], ...]


@dataclass(frozen=True)
class Pictures:
    """The pictures of a report; both parts may be empty."""

    rows: tuple[RowPictures, ...] = ()
    sheets: tuple[Sheet, ...] = ()


@dataclass(frozen=True)
class ClipView:
    """A clip in the report, with its video and contact sheet as data URIs."""

    pick: str
    clip: int
    figure: str
    video: str
    sheet: str


@dataclass(frozen=True)
class RowClips:
    """The clips of a row in the report."""

    table: str
    row: str
    clips: list[ClipView]


def write_row_clips(pictures: Pictures, folder: Path) -> list[RowClips]:
    """Write ``clips/*.mp4`` and ``sheets/*.png`` of every row, and return them for the page."""
    rows = []
    for place, row in enumerate(watched(pictures.rows, "videos of the report", "rows")):
        clips = []
        for pick, clip in row.picks():
            name = file_name(place, row.table, row.row, pick)
            video, sheet = folder / "clips" / f"{name}.mp4", folder / "sheets" / f"{name}.png"
            write_video(video, side_by_side(clip))
            write_sheet(sheet, sheet_rows(clip), most=SHEET_FRAMES)
            clips.append(ClipView(pick, clip.clip, clip.figure, data_uri(video, "video/mp4"), picture_uri(sheet)))
        rows.append(RowClips(row.table, row.row, clips))
    return rows


def write_sheets(pictures: Pictures, folder: Path) -> list[tuple[str, str]]:
    """Write the common ``sheets/*.png``, and return title and data URI of each."""
    titled_uris = []
    for place, sheet in enumerate(pictures.sheets):
        path = folder / "sheets" / f"{file_name(place, 'rows', sheet.title)}.png"
        write_sheet(path, sheet.rows, most=SHEET_FRAMES)
        titled_uris.append((sheet.title, picture_uri(path)))
    return titled_uris


def side_by_side(clip: ClipPicture) -> UInt8[Tensor, "frame height width 3"]:
    """The true video left and the generated one right, with depth below where both have it."""
    videos = beside([labelled(_fit(clip.truth), "truth"), labelled(_fit(clip.generated), "generated")])
    pair = _depths(clip)
    return videos if pair is None else below([videos, beside([_fit(depth) for depth in pair])])


def sheet_rows(clip: ClipPicture) -> list[tuple[str, UInt8[Tensor, "frame height width 3"]]]:
    """The rows of the clip's contact sheet, by name."""
    rows = [("truth", clip.truth), ("generated", clip.generated)]
    pair = _depths(clip)
    return rows if pair is None else [*rows, ("true depth", pair[0]), ("depth", pair[1])]


def _depths(clip: ClipPicture) -> tuple[Tensor, Tensor] | None:
    """True and generated depth in colours of one scale, ``None`` where one is missing."""
    if clip.depth is None or clip.true_depth is None:
        return None
    pair = clip.true_depth.cpu(), clip.depth.cpu()
    scale = DepthScale.of(pair)
    return scale.color(pair[0]), scale.color(pair[1])


def _fit(video: UInt8[Tensor, "frame height width 3"]) -> UInt8[Tensor, "frame height width 3"]:
    """Average large frames down and enlarge small ones, so that a report stays light and can be seen."""
    factor = min(video.shape[1:3]) // SMALLEST
    if factor < 2:
        return enlarge(video.cpu())
    parts = []
    for frames in video.cpu().split(CHUNK):
        smaller = torch.nn.functional.avg_pool2d(frames.permute(0, 3, 1, 2).float(), factor)
        parts.append(smaller.round().to(torch.uint8).permute(0, 2, 3, 1))
    return torch.cat(parts)


def file_name(place: int, *parts: str) -> str:
    """A file name that any file system takes, different for each place."""
    words = [re.sub(r"[^a-z0-9]+", "-", part.lower()).strip("-")[:40] for part in parts]
    return "-".join([f"{place:02d}", *(word for word in words if word)])


def data_uri(path: Path, kind: str) -> str:
    """The file's content as a data URI of a MIME type."""
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def picture_uri(path: Path) -> str:
    """The picture in a PNG file as a data URI, in WebP because a page holds many."""
    from PIL import Image

    webp = io.BytesIO()
    with Image.open(path) as picture:
        picture.save(webp, format="WEBP", quality=90)
    return f"data:image/webp;base64,{base64.b64encode(webp.getvalue()).decode('ascii')}"
