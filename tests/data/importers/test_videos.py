"""Pictures of videos are found by their times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from persist_cli.data.importers.videos import TimedPictures
from persist_cli.errors import DataError
from tests.support.lerobot_datasets import write_codes


def test_a_picture_of_a_long_video_is_found_by_its_time(tmp_path: Path) -> None:
    """Forward, backward and far away, where LeRobot has a key picture every other one."""
    images = [np.full((32, 32), number, np.uint16) for number in range(100)]
    write_codes(tmp_path / "a.mp4", images)
    write_codes(tmp_path / "b.mp4", images[::-1])
    pictures = TimedPictures()

    def value(name: str, seconds: float) -> int:
        return int(pictures.at(tmp_path / name, seconds, 0.04).to_ndarray(format="gray12le")[0, 0])

    assert [value("a.mp4", seconds) for seconds in (0.0, 0.1, 0.13, 9.9, 9.8, 0.0, 5.0)] == [0, 1, 1, 99, 98, 0, 50]
    assert [value(*place) for place in (("b.mp4", 5.1), ("a.mp4", 5.1), ("b.mp4", 5.2))] == [48, 51, 47]
    for seconds in (0.05, 10.0, 99.0):
        with pytest.raises(DataError, match=rf"a.mp4: no picture of {seconds:.3f} s in it"):
            value("a.mp4", seconds)
    assert value("a.mp4", 3.0) == 30


def test_the_nearest_picture_is_taken_where_a_video_has_more_than_the_dataset(tmp_path: Path) -> None:
    write_codes(tmp_path / "a.mp4", [np.full((32, 32), number, np.uint16) for number in range(40)])  # 10 a second
    pictures = TimedPictures()
    chosen = [pictures.at(tmp_path / "a.mp4", number / 3 + 1e-8, 0.4 / 3) for number in range(9)]
    values = [int(picture.to_ndarray(format="gray12le")[0, 0]) for picture in chosen]
    assert values == [0, 3, 7, 10, 13, 17, 20, 23, 27]


def test_names_in_a_video_that_are_not_utf8_do_not_matter(tmp_path: Path) -> None:
    write_codes(tmp_path / "a.mp4", [np.full((32, 32), 7, np.uint16)], title="a title of its own")
    data = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "a.mp4").write_bytes(data.replace(b"a title of its own", b"a titl\xff of its own"))
    assert TimedPictures().at(tmp_path / "a.mp4", 0.0, 0.04).width == 32
