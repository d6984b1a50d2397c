"""Images on disk: documented formats, the size that they should have, and nothing else."""

import os
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.image_files import read_color, read_depth, read_grey
from ms_slam_env.errors import InputError

CAMERA = Intrinsics(20, 20, 7.5, 5.5, 16, 12)
DEPTH = np.arange(16 * 12, dtype=np.uint16).reshape(12, 16) * 300
COLOR = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)


@pytest.mark.parametrize("suffix", ["png", "pgm", "tif"])
def test_depth_of_every_format(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"d.{suffix}"
    Image.fromarray(DEPTH).save(path)
    assert np.array_equal(read_depth(path, CAMERA), DEPTH)


@pytest.mark.parametrize("suffix", ["png", "ppm", "tiff", "jpg"])
def test_colour_of_every_format(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"c.{suffix}"
    Image.fromarray(COLOR).save(path)
    assert np.array_equal(read_color(path, CAMERA), np.asarray(Image.open(path)))


@pytest.mark.parametrize("mode", ["RGBA", "LA", "L", "P", "CMYK"])
def test_colour_of_every_kind(tmp_path: Path, mode: str) -> None:
    grey = Image.fromarray(np.full((4, 6), 100, dtype=np.uint8))
    path = tmp_path / f"a.{'tif' if mode == 'CMYK' else 'png'}"
    grey.convert("RGB").convert(mode).save(path)
    found = read_color(path, Intrinsics(5, 5, 2.5, 1.5, 6, 4))
    assert found.shape == (4, 6, 3)
    assert np.abs(found.astype(int) - 100).max() <= 2


def test_grey_of_sixteen_bits_is_no_colour_but_what_a_camera_sees(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.uint16).reshape(4, 6) * 2730
    Image.fromarray(values).save(tmp_path / "a.png")
    K = Intrinsics(5, 5, 2.5, 1.5, 6, 4)
    found = read_grey(tmp_path / "a.png", K)
    np.testing.assert_array_equal(found, np.rint(values / 257).astype(int)[..., None].repeat(3, 2))
    with pytest.raises(InputError, match="not a colour image: its pixels are I;16"):
        read_color(tmp_path / "a.png", K)


def test_depth_of_eight_bits_is_refused(tmp_path: Path) -> None:
    Image.fromarray(COLOR[:, :, 0]).save(tmp_path / "d.png")
    with pytest.raises(InputError, match=r"d\.png is not a 16-bit depth image: its pixels are L"):
        read_depth(tmp_path / "d.png", CAMERA)


@pytest.mark.parametrize("suffix", ["bmp", "gif", "webp", "tga"])
def test_other_formats_are_refused_whatever_their_name(tmp_path: Path, suffix: str) -> None:
    made = tmp_path / f"c.{suffix}"
    Image.fromarray(COLOR).save(made)
    with pytest.raises(InputError, match="cannot identify"):
        read_color(made.rename(tmp_path / "c.png"), CAMERA)


def test_the_size_is_checked_before_anything_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "huge.png"
    Image.new("L", (13000, 13000)).save(path, compress_level=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        started = time.process_time()
        with pytest.raises(InputError, match="is 13000x13000 but the intrinsics say 16x12"):
            read_color(path, CAMERA)
    assert time.process_time() - started < 0.2


def test_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "d.png")
    with pytest.raises(InputError, match="not a regular file"):
        read_depth(tmp_path / "d.png", CAMERA)


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from(["png", "jpg", "tif", "ppm"]),
    st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=6),
    st.integers(0, 10**6),
)
def test_damage_gives_an_image_or_one_line(
    tmp_path_factory: Any, suffix: str, flips: list[tuple[int, int]], cut: int
) -> None:
    path = tmp_path_factory.getbasetemp() / f"damaged.{suffix}"
    Image.fromarray(COLOR).save(path)
    data = bytearray(path.read_bytes())
    for where, value in flips:
        data[where % len(data)] = value
    path.write_bytes(bytes(data[: cut % len(data)] if cut % 3 == 0 else data))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            assert read_color(path, CAMERA).shape == (12, 16, 3)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
