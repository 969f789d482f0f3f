"""Videos and GIFs are read back nearly as they were written."""

import sys
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image

from persist_cli.errors import DataError
from persist_cli.output.video import beside, enlarge, labelled, read_video, write_gif, write_video

RAMP = (torch.linspace(0, 255, 64)[None, None, :, None] * torch.linspace(0.5, 1, 5)[:, None, None, None]).expand(
    5, 64, 64, 3
)
VIDEO = RAMP.round().to(torch.uint8)


def test_a_video_is_read_back_with_the_codecs_losses_only(tmp_path):
    write_video(tmp_path / "a.mp4", VIDEO)
    frames = read_video(tmp_path / "a.mp4", 64, 64)
    assert frames.shape == VIDEO.shape
    assert (frames.int() - VIDEO.int()).abs().float().mean() < 4


@pytest.mark.skipif(sys.platform == "win32", reason="no name has a colon there")
def test_a_folder_whose_name_looks_like_an_address_is_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_video(Path("https:walk/a.mp4"), VIDEO)
    assert read_video(Path("https:walk/a.mp4"), 64, 64).shape == VIDEO.shape


def test_a_file_of_sound_alone_is_no_video(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=16000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        sound.rate = 16000
        container.mux([*stream.encode(sound), *stream.encode(None)])
    with pytest.raises(DataError, match="holds no frames of a video"):
        read_video(tmp_path / "a.mp4", 64, 64)


def test_a_gif_is_endless_and_has_every_frame_in_nearly_its_colours(tmp_path):
    write_gif(tmp_path / "a.gif", VIDEO, frames_per_second=10)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.info["duration"], image.info["loop"]) == (5, 100, 0)
        for number in range(5):
            image.seek(number)
            frame = torch.frombuffer(bytearray(image.convert("RGB").tobytes()), dtype=torch.uint8).reshape(64, 64, 3)
            assert (frame.int() - VIDEO[number].int()).abs().float().mean() < 4


def test_labelled_videos_stand_side_by_side():
    both = beside([labelled(enlarge(VIDEO), name) for name in ("one", "two")])
    assert both.shape == (5, 276, 2 * 256 + 2, 3)
    assert torch.equal(both[:, 20:, :256], both[:, 20:, 258:])
