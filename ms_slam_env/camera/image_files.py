"""Reads image files, after checking their format and size."""

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
"""Suffixes of image file names."""

_FORMATS = ("PNG", "JPEG", "PPM", "TIFF")

_DEPTH = ("I;16", "I;16B", "I;16L", "I")
_COLOR = ("RGB", "RGBA", "L", "LA", "P", "CMYK")
_GREY = (*_COLOR, *_DEPTH)

# Errors that Pillow raises for truncated or damaged files, depending on the format.
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
    """Read a colour image (H, W, 3) in RGB; grey and palette images are converted.

    Raises:
        InputError: no such file, not an image of a documented format, a damaged one, or one whose
            size differs from ``intrinsics``.
    """
    return decode_color(_bytes(path, "colour image"), str(path), intrinsics)


def read_grey(path: Path, intrinsics: Intrinsics) -> NDArray[np.uint8]:
    """Read an image of a camera without depth; 16-bit grey, as in TUM-VI, is rounded to 8 bits.

    Raises:
        InputError: as `read_color`.
    """
    found = _decode(_bytes(path, "image"), str(path), "image", _GREY, intrinsics)
    if found.ndim == 2:
        grey = np.rint(found.clip(0, 65535) / 257.0)
        found = np.repeat(grey[..., None], 3, axis=2)
    return found.astype(np.uint8, copy=False)


def read_depth(path: Path, intrinsics: Intrinsics) -> NDArray[Any]:
    """Read the values (H, W) of a depth image with 16 bits or more.

    Raises:
        InputError: as `read_color`, or 8 bits, which would be depth in steps of centimetres.
    """
    return decode_depth(_bytes(path, "16-bit depth image"), str(path), intrinsics)


def decode_color(data: bytes, name: str, intrinsics: Intrinsics) -> NDArray[np.uint8]:
    """`read_color` for the content of a file; ``name`` is for error messages."""
    return _decode(data, name, "colour image", _COLOR, intrinsics).astype(np.uint8, copy=False)


def decode_depth(data: bytes, name: str, intrinsics: Intrinsics) -> NDArray[Any]:
    """`read_depth` for the content of a file; ``name`` is for error messages."""
    return _decode(data, name, "16-bit depth image", _DEPTH, intrinsics)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file.

    Raises:
        InputError: no such file, or not an image of a documented format.
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
            warnings.simplefilter("ignore")  # problems are reported below
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
    """Refuse an image ``path`` whose size (width, height) differs from the intrinsics.

    Raises:
        InputError: it names both sizes.
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
    """Decode a mesh's texture to RGB (h, w, 3), shrunk to at most 1024 pixels per side.

    Args:
        data: content of the file.
        name: name for error messages.

    Raises:
        InputError: not an image of a common format, damaged, or larger than 8192 x 8192 pixels.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # problems are reported below
            with Image.open(io.BytesIO(data), formats=_TEXTURES) as image:
                width, height = image.size
                if width * height > _MAX_TEXELS:
                    raise InputError(f"{name} has {width}x{height} pixels: more than 8192x8192")
                deep = image.mode.startswith("I")  # 16 bits, which Pillow would clip at 255
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
