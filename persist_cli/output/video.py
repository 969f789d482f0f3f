"""Videos: written as MP4 or GIF and read back, side by side, and with labels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from persist_cli.errors import DataError
from persist_cli.io.files import written_aside

SMALLEST = 256  # pixels of the shorter side of a written image
STRIP = 20  # pixels of the height of the strip with a label


def beside(
    videos: Sequence[UInt8[Tensor, "frame height width 3"]], gap: int = 2
) -> UInt8[Tensor, "frame height all 3"]:
    """Join videos of equal length and height side by side, with a white gap of ``gap`` pixels."""
    parts: list[Tensor] = []
    for number, video in enumerate(videos):
        if number:
            parts.append(torch.full((*video.shape[:2], gap, 3), 255, dtype=torch.uint8))
        parts.append(video)
    return torch.cat(parts, dim=2)


def below(videos: Sequence[UInt8[Tensor, "frame height width 3"]], gap: int = 2) -> UInt8[Tensor, "frame all width 3"]:
    """Join videos of equal length and width one below the other, with a white gap of ``gap`` pixels."""
    transposed = beside([video.transpose(1, 2) for video in videos], gap)
    return transposed.transpose(1, 2).contiguous()


def labelled(video: UInt8[Tensor, "frame height width 3"], label: str) -> UInt8[Tensor, "frame taller width 3"]:
    """Return the video under a white strip with a label."""
    from PIL import Image, ImageDraw

    from persist_cli.output.sheet import label_font

    strip = Image.new("RGB", (video.shape[2], STRIP), "white")
    ImageDraw.Draw(strip).text((4, 2), label, fill="black", font=label_font())
    return torch.cat([still(torch.from_numpy(np.array(strip)), len(video)), video], dim=1)


def still(picture: UInt8[Tensor, "height width 3"], frames: int) -> UInt8[Tensor, "frame height width 3"]:
    """Return the picture as a video in which nothing moves."""
    return picture.expand(frames, -1, -1, -1)


def enlarge(video: UInt8[Tensor, "frame height width 3"]) -> UInt8[Tensor, "frame height width 3"]:
    """Return the video with its pixels repeated until the shorter side has at least 256."""
    factor = max(1, -(-SMALLEST // min(video.shape[1:3])))
    return video.repeat_interleave(factor, dim=1).repeat_interleave(factor, dim=2)


def write_video(path: Path, video: Iterable[UInt8[Tensor, "height width 3"]], frames_per_second: int = 8) -> None:
    """Write the frames, enlarged to be seen, as an MP4 (H.264), whole or not at all.

    Args:
        path: of the file.
        video: a tensor of frames, or one frame after the other; no more than one is enlarged at a time.
        frames_per_second: of the video.
    """
    import av

    with written_aside(path) as aside, av.open(str(aside.absolute()), "w", format="mp4") as container:
        stream = container.add_stream(
            "libx264", rate=Fraction(frames_per_second), options={"crf": "18", "preset": "veryfast"}
        )
        stream.pix_fmt = "yuv420p"
        for number, picture in enumerate(video):
            image = enlarge(picture[None])[0]
            height, width = (side - side % 2 for side in image.shape[:2])  # H.264 wants even sides
            if number == 0:
                stream.width, stream.height = width, height
            even = np.ascontiguousarray(image[:height, :width].numpy())
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
        container.mux(stream.encode())


def write_gif(path: Path, video: UInt8[Tensor, "frame height width 3"], frames_per_second: int = 8) -> None:
    """Write the frames in their own size as an endless GIF, whole or not at all, for pages that do not play videos."""
    from PIL import Image

    first, *rest = (Image.fromarray(frame.numpy()).quantize(256) for frame in video)
    milliseconds = 1000 // frames_per_second
    with written_aside(path) as aside:
        first.save(aside, format="GIF", save_all=True, append_images=rest, duration=milliseconds, loop=0)


def read_video(path: Path, height: int, width: int) -> UInt8[Tensor, "frame height width 3"]:
    """Return the frames of a video file, scaled to this height and width in pixels.

    Raises:
        DataError: when it is missing or no video.
    """
    import av

    try:
        with av.open(str(path.absolute())) as container:  # what begins with a name and a colon would be an address
            pictures = container.decode(video=0) if container.streams.video else ()
            frames = [picture.reformat(width, height, format="rgb24").to_ndarray() for picture in pictures]
    except (OSError, av.error.FFmpegError) as error:
        raise DataError(f"{path}: cannot be read as a video ({error})") from error
    if not frames:
        raise DataError(f"{path}: holds no frames of a video")
    return torch.from_numpy(np.stack(frames))
