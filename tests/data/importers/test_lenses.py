"""Images are resampled to another lens, and undistorted, to where their content belongs."""

from __future__ import annotations

import numpy as np
import pytest

from persist_cli.data.importers.lenses import Lens, retake, undistort
from persist_cli.errors import DataError

LENS = Lens(50.0, 52.0, 33.0, 23.5, size=(48, 64))


def content(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Smooth colours at places of the plane one metre ahead."""
    waves = [np.sin(4 * x + 1), np.cos(3 * y - x), np.sin(5 * x * y + 2 * y)]
    return 127.5 + 110 * np.stack(waves, -1)


def seen(lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """The content as an undistorted lens shows it."""
    row, column = np.mgrid[: size[0], : size[1]] + 0.5
    return np.rint(content((column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy)).astype(np.uint8)


def seen_bent(lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """The content as a distorted lens shows it: the undistorted place of each pixel is found by iteration."""
    k1, k2, p1, p2, k3 = lens.distortion
    row, column = np.mgrid[: size[0], : size[1]] + 0.5
    bent = np.stack([(column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy])
    x, y = bent
    for _ in range(100):
        square = x * x + y * y
        radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
        x = (bent[0] - 2 * p1 * x * y - p2 * (square + 2 * x * x)) / radial
        y = (bent[1] - p1 * (square + 2 * y * y) - 2 * p2 * x * y) / radial
    return np.rint(content(x, y)).astype(np.uint8)


@pytest.mark.parametrize("distortion", [(0.3, 0, 0, 0, 0), (-0.2, 0.1, 0.02, -0.015, 0.05), (0.3, 0, 0, 0, 0.8)])
def test_undistorted_colours_are_where_a_pinhole_camera_sees_them(distortion) -> None:
    lens, size = Lens(50.0, 52.0, 33.0, 23.5, distortion), (48, 64)
    bent, truth = seen_bent(lens, size), seen(lens, size)
    inside = np.s_[3:-3, 3:-3]  # at the edge there may be nothing to see
    before = np.abs(bent.astype(int) - truth)[inside]
    after = np.abs(undistort(bent, lens).astype(int) - truth)[inside]
    assert before.mean() > 2.5
    assert after.mean() < 0.3


def test_undistorted_depth_is_that_of_a_pixel_or_missing() -> None:
    lens = Lens(50.0, 52.0, 33.0, 23.5, (0.3, 0.0, 0.0, 0.0, 0.0))
    depth = np.linspace(1, 2, 48 * 64, dtype=np.float32).reshape(48, 64)
    result = undistort(depth, lens)
    assert set(np.unique(result)) <= {0.0, *np.unique(depth)}
    assert (result[0, 0], result[24, 33]) == (0, depth[24, 33])
    assert undistort(depth, lens.undistorted) is depth


@pytest.mark.parametrize(
    ("wanted", "size"),
    [(Lens(25.0, 26.0, 16.5, 11.75), (24, 32)), (Lens(25.0, 25.0, 16.0, 12.0), (24, 32)),
     (Lens(60.0, 61.0, 32.0, 24.0), (48, 64))],
)  # fmt: skip
def test_colours_of_another_lens_are_where_that_lens_sees_them(wanted: Lens, size: tuple[int, int]) -> None:
    result = retake(seen(LENS, (48, 64)), LENS, wanted, size)
    assert result.shape == (*size, 3)
    assert np.abs(result.astype(int) - seen(wanted, size))[2:-2, 2:-2].mean() < 1.5


def test_depth_of_another_lens_is_that_of_the_nearest_pixel_and_missing_beyond_the_image() -> None:
    depth = np.arange(1, 48 * 64 + 1, dtype=np.float32).reshape(48, 64)
    half = retake(depth, LENS, Lens(25.0, 26.0, 16.5, 11.75), (24, 32))
    assert np.array_equal(half, depth[1::2, 1::2])
    moved = retake(depth, LENS, Lens(50.0, 52.0, 35.0, 23.5), (48, 64))
    assert np.array_equal(moved[:, 2:], depth[:, :-2])
    assert not moved[:, :2].any()


def test_a_matrix_that_counts_from_the_centre_of_the_first_pixel_moves_by_half_a_pixel() -> None:
    matrix = np.array([[500.0, 0, 319.5], [0, 520, 239.5], [0, 0, 1]])
    assert Lens.of_pixel_centres(matrix) == Lens(500.0, 520.0, 320.0, 240.0)


def test_the_same_lens_changes_no_pixel() -> None:
    image = seen(LENS, (48, 64))
    assert retake(image, LENS, LENS, (48, 64)) is image


def test_depth_that_sees_far_beyond_the_colours_is_refused() -> None:
    with pytest.raises(DataError, match="reaches far beyond the colours"):
        retake(seen(LENS, (48, 64)), LENS, Lens(40.0, 42.0, 33.0, 23.5), (48, 64))
    for beyond in (Lens(50.0, 42.0, 33.0, 23.5), Lens(40.0, 52.0, 33.0, 23.5), Lens(50.0, 52.0, 33.0, 17.5)):
        with pytest.raises(DataError, match="reaches far beyond the colours"):
            retake(seen(LENS, (48, 64)), LENS, beyond, (48, 64))


def test_a_lens_follows_the_size_of_its_images_but_not_another_aspect() -> None:
    half = LENS.of((24, 32))
    assert (half.fx, half.fy, half.cx, half.cy) == (25.0, 26.0, 16.5, 11.75)
    assert Lens(50.0, 52.0, 33.0, 23.5).of((24, 32)).fx == 50.0
    with pytest.raises(DataError, match="24×24 pixels, its camera is of 48×64, which is another aspect"):
        LENS.of((24, 24))
    with pytest.raises(DataError, match="24×48 pixels, its camera is of 48×64, which is another aspect"):
        LENS.of((24, 48))
