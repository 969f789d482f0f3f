"""Cropping and resizing keep every world point on its own pixel."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from persist_cli.data.images import crop_resize, decode_depth, decode_rgb, encode_rgb, parse_size
from persist_cli.data.importers.readers import read_color, read_photo
from persist_cli.errors import DataError
from tests.support.damage import write_huge_image

INTRINSICS = np.array([[50.0, 0, 33.0], [0, 52.0, 22.0], [0, 0, 1]])

SIZES = [(48, 64), (24, 32), (30, 30), (16, 64), (96, 128), (17, 23)]


@pytest.mark.parametrize("size", SIZES)
def test_a_world_point_projects_to_the_corresponding_pixel(size: tuple[int, int]) -> None:
    crop = crop_resize((48, 64), size)
    point = np.array([0.3, -0.2, 2.0])
    before, after = INTRINSICS @ point / point[2], crop.intrinsics(INTRINSICS) @ point / point[2]
    scale = np.array([size[1] / crop.window[1], size[0] / crop.window[0]])
    assert after[:2] == pytest.approx((before[:2] - [crop.left, crop.top]) * scale)


@pytest.mark.parametrize("size", [(24, 32), (30, 30), (96, 128)])
def test_a_picture_of_pixel_positions_still_shows_them(size: tuple[int, int]) -> None:
    v, u = np.mgrid[:48, :64] + 0.5
    crop = crop_resize((48, 64), size)
    image = np.stack([3 * u, 3 * v, np.zeros_like(u)], -1).astype(np.uint8)
    rows, columns = np.mgrid[: size[0], : size[1]] + 0.5
    resized = crop.rgb(image)[..., :2] / 3
    mapped = np.stack([columns * crop.window[1] / size[1] + crop.left, rows * crop.window[0] / size[0] + crop.top], -1)
    assert np.abs(resized - mapped)[2:-2, 2:-2].max() < 0.7  # rounding to whole levels, the nearest pixel


@pytest.mark.parametrize("size", SIZES)
def test_depth_is_never_mixed_across_an_edge(size: tuple[int, int]) -> None:
    depth = np.where(np.arange(64) < 31, np.float32(1), np.float32(5)) * np.ones((48, 1), np.float32)
    resized = crop_resize((48, 64), size).depth(depth)
    assert resized.shape == size
    assert set(np.unique(resized)) == {1.0, 5.0}


def test_resized_depth_is_that_of_the_pixel_in_the_middle_as_colours_are() -> None:
    depth = np.arange(9 * 15, dtype=np.float32).reshape(9, 15)
    assert np.array_equal(crop_resize((9, 15), (3, 5)).depth(depth), depth[1::3, 1::3])
    assert np.array_equal(crop_resize((9, 15), (3, 3)).depth(depth), depth[1::3, 4:12:3])


@pytest.mark.parametrize("size", SIZES)
def test_the_window_is_central_and_has_the_aspect_of_the_target(size: tuple[int, int]) -> None:
    crop = crop_resize((48, 64), size)
    assert crop.window[0] == 48 or crop.window[1] == 64
    assert abs(crop.window[0] * size[1] - crop.window[1] * size[0]) <= max(size)
    assert abs(2 * crop.top + crop.window[0] - 48) <= 1
    assert abs(2 * crop.left + crop.window[1] - 64) <= 1


def test_resizing_to_the_same_size_changes_nothing() -> None:
    crop = crop_resize((48, 64), (48, 64))
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    assert np.array_equal(crop.rgb(image), image)
    assert np.array_equal(crop.intrinsics(INTRINSICS), INTRINSICS)


@pytest.mark.parametrize("text", ["", "64", "64x", "x64", "0x64", "64x-1", "64x64x3"])
def test_a_text_that_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(DataError, match="cannot read the size"):
        parse_size(text)


@pytest.mark.parametrize("text", ["100000x64", "64x100000"])
def test_a_size_that_would_fill_the_memory_is_refused(text: str) -> None:
    with pytest.raises(DataError, match=f"'{text}' is beyond 4096x4096 pixels"):
        parse_size(text)


def test_a_size_is_height_by_width() -> None:
    assert parse_size("240x320") == parse_size("240X320") == parse_size("240×320") == (240, 320)


def test_an_image_of_several_channels_is_no_depth() -> None:
    with pytest.raises(ValueError, match="a depth image must have one channel"):
        decode_depth(encode_rgb(np.zeros((2, 2, 3), np.uint8)))


def test_a_photo_is_turned_as_its_exif_says_and_the_image_of_a_capture_is_not(tmp_path: Path) -> None:
    stored, exif, path = np.zeros((8, 16, 3), np.uint8), Image.Exif(), tmp_path / "photo.png"
    stored[:4] = 255  # the upper half
    exif[0x0112] = 6  # the camera was held turned by a quarter
    Image.fromarray(stored).save(path, exif=exif)
    shown = np.rot90(stored, -1)
    assert np.array_equal(read_photo(path), shown)
    assert all(np.array_equal(image, stored) for image in (decode_rgb(path.read_bytes()), read_color(path)))


def test_a_photo_with_damaged_exif_is_named(tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    Image.fromarray(np.zeros((8, 16, 3), np.uint8)).save(path, exif=b"Exif\x00\x00no header of TIFF")
    with pytest.raises(DataError, match=r"photo.png: its EXIF is damaged \(.*\); save the image anew"):
        read_photo(path)


def test_an_image_that_would_fill_the_memory_is_named(tmp_path: Path) -> None:
    write_huge_image(tmp_path / "large.png")
    for read in (read_color, read_photo):
        with pytest.raises(DataError, match=r"large.png: not a whole image \(Image size \(900000000 pixels\) exceeds"):
            read(tmp_path / "large.png")


@pytest.mark.parametrize("read", [read_color, read_photo])
def test_a_grey_image_of_16_bits_keeps_its_shades(tmp_path: Path, read) -> None:
    shades = np.array([[0, 128 * 257, 65535]], np.uint16)
    for name, kind in (("grey.png", "<u2"), ("grey.tif", ">u2")):
        Image.fromarray(shades.astype(kind)).save(tmp_path / name)
        assert read(tmp_path / name)[..., 1].tolist() == [[0, 128, 255]]


@pytest.mark.parametrize("read", [read_color, read_photo])
@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_a_colour_image_of_32_bit_numbers_is_refused(tmp_path: Path, read, kind) -> None:
    Image.fromarray(np.ones((4, 4), kind)).save(tmp_path / "deep.tif")
    with pytest.raises(DataError, match=r"deep\.tif: a colour image of 32-bit numbers; save it with 8 or 16 bits"):
        read(tmp_path / "deep.tif")


@pytest.mark.parametrize("read", [read_color, read_photo, lambda path: decode_rgb(path.read_bytes())])
def test_an_image_in_postscript_is_refused_and_not_run(
    read: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ghostscript = tmp_path / "gs"
    ghostscript.write_text(f"#!/bin/sh\ntouch {tmp_path}/ran\n")
    ghostscript.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    Image.new("RGB", (8, 8)).save(tmp_path / "image.png", "EPS")
    with pytest.raises((DataError, OSError), match="cannot identify image file"):
        read(tmp_path / "image.png")
    assert not (tmp_path / "ran").exists()
