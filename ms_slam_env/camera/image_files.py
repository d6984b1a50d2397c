"""Image files: of the documented formats and of the size they should have, checked before."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ms_slam_env._runtime.input_files import MAX_IMAGE_BYTES, read_bytes
from ms_slam_env.camera.intrinsics import Intrinsics
from ms_slam_env.errors import InputError

SUFFIXES = (".png", ".pgm", ".jpg", ".jpeg", ".ppm", ".tif", ".tiff")
"""Endings of the names of images."""

_FORMATS = ("PNG", "JPEG", "PPM", "TIFF")

_DEPTH = ("I;16", "I;16B", "I;16L", "I")
_COLOR = ("RGB", "RGBA", "L", "LA", "P", "CMYK")
_GREY = (*_COLOR, *_DEPTH)

# What Pillow raises for files that are truncated or damaged, format by format.
_BROKEN = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    IndexError,
    KeyError,
    TypeError,
    OverflowError,
    MemoryError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)


def read_color(path: Path, intrinsics: Intrinsics) -> NDArray[np.uint8]:
    """Colour image (H, W, 3) in RGB; grey ones and those with a palette are converted.

    Raises:
        InputError: no such file, no image of a documented format, one that is damaged, or one that
            has another size than ``intrinsics`` say.
    """
    return decode_color(_bytes(path, "colour image"), str(path), intrinsics)


def read_grey(path: Path, intrinsics: Intrinsics) -> NDArray[np.uint8]:
    """As `read_color`, of a camera without depth: grey of 16 bits, as in TUM-VI, is rounded to 8.

    Raises:
        InputError: as `read_color`.
    """
    found = _decode(_bytes(path, "image"), str(path), "image", _GREY, intrinsics)
    if found.ndim == 2:
        grey = np.rint(found.clip(0, 65535) / 257.0)
        found = np.repeat(grey[..., None], 3, axis=2)
    return found.astype(np.uint8, copy=False)


def read_depth(path: Path, intrinsics: Intrinsics) -> NDArray[Any]:
    """Values (H, W) of a depth image with 16 bits or more.

    Raises:
        InputError: as `read_color`; 8 bits, which would be depth in steps of centimetres.
    """
    return decode_depth(_bytes(path, "16-bit depth image"), str(path), intrinsics)


def decode_color(data: bytes, name: str, intrinsics: Intrinsics) -> NDArray[np.uint8]:
    """As `read_color`, of what a file holds; ``name`` is for errors."""
    return _decode(data, name, "colour image", _COLOR, intrinsics).astype(np.uint8, copy=False)


def decode_depth(data: bytes, name: str, intrinsics: Intrinsics) -> NDArray[Any]:
    """As `read_depth`, of what a file holds; ``name`` is for errors."""
    return _decode(data, name, "16-bit depth image", _DEPTH, intrinsics)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file.

    Raises:
        InputError: no such file, or no image of a documented format.
    """
    try:
        with Image.open(io.BytesIO(_bytes(path, "image")), formats=_FORMATS) as image:
            return image.size
    except _BROKEN as error:
        raise InputError(f"cannot read {path}: {type(error).__name__}") from None


def _bytes(path: Path, kind: str) -> bytes:
    return read_bytes(path, kind, MAX_IMAGE_BYTES)


def _decode(
    content: bytes, path: str, kind: str, modes: tuple[str, ...], intrinsics: Intrinsics
) -> NDArray[Any]:
    data = io.BytesIO(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is wrong with the file is said below
            with Image.open(data, formats=_FORMATS) as image:
                check_size(path, image.size, intrinsics)
                if image.mode not in modes:
                    raise InputError(f"{path} is not a {kind}: its pixels are {image.mode}")
                image.load()
                return np.array(image.convert("RGB") if image.mode in _COLOR else image)
    except InputError:
        raise
    except _BROKEN as error:
        said = " ".join(str(error).replace(repr(data), "it").split()) or type(error).__name__
        raise InputError(f"cannot read {path}: {said}") from None


def check_size(path: str, size: tuple[int, int], intrinsics: Intrinsics) -> None:
    """Refuse an image ``path`` of another size (width, height) than the intrinsics say.

    Raises:
        InputError: naming both sizes.
    """
    if size != (intrinsics.width, intrinsics.height):
        raise InputError(
            f"{path} is {size[0]}x{size[1]} but the intrinsics say "
            f"{intrinsics.width}x{intrinsics.height}"
        )


_TEXTURES = ("PNG", "JPEG", "BMP", "TGA", "TIFF", "WEBP", "PPM", "GIF")
_MAX_TEXELS = 8192 * 8192
_MAX_TEXTURE = 1024


def decode_texture(data: bytes, name: str) -> NDArray[np.uint8]:
    """Image (h, w, 3) in RGB of a mesh's texture, shrunk to at most 1024 pixels a side.

    Args:
        data: what the file holds.
        name: for errors.

    Raises:
        InputError: no image of a common format, damaged, or of more than 8192 x 8192 pixels.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is wrong with the file is said below
            with Image.open(io.BytesIO(data), formats=_TEXTURES) as image:
                width, height = image.size
                if width * height > _MAX_TEXELS:
                    raise InputError(f"{name} has {width}x{height} pixels: more than 8192x8192")
                deep = image.mode.startswith("I")  # 16 bits, which Pillow would cut off at 255
                grey = (
                    Image.fromarray((np.asarray(image) // 256).astype(np.uint8)) if deep else image
                )
                pixels = np.asarray(grey.convert("RGB"))
    except InputError:
        raise
    except _BROKEN as error:
        said = " ".join(str(error).split()) or type(error).__name__
        said = "no image" if "cannot identify" in said else said
        raise InputError(f"cannot read {name}: {said} ({', '.join(_TEXTURES)} are read)") from None
    shrink = _MAX_TEXTURE / max(pixels.shape[:2])
    if shrink < 1.0:
        if min(pixels.shape[:2]) * shrink < 1.0:
            raise InputError(f"{name} has {width}x{height} pixels: too narrow")
        pixels = cv2.resize(pixels, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return pixels
