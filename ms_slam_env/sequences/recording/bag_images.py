"""Converts ROS image messages to arrays: raw, compressed, and compressed depth."""

from __future__ import annotations

import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32
from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.image_files import check_size, decode_color, decode_depth
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.sequences.recording.recording import SATURATED

# By encoding: number of channels, and which of them are red, green and blue.
_COLORS = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
# By encoding: type of a value, and the value per metre (REP 118).
_DEPTHS = {"16UC1": ("u2", 1000.0), "mono16": ("u2", 1000.0), "32FC1": ("f4", 1.0)}
_DEPTH_HEADER = 12  # bytes before the image in compressed depth: its format and two numbers


def read_color_message(message: Any, topic: str, camera: Intrinsics) -> NDArray[np.uint8]:
    """Colour (H, W, 3) of an Image or a CompressedImage.

    Raises:
        InputError: not a colour encoding, or an image that is truncated, damaged, or whose size
            differs from ``camera``.
    """
    if hasattr(message, "format"):
        return decode_color(bytes(message.data), topic, camera)
    if message.encoding not in _COLORS:
        raise unknown(f"encoding of colour in {topic}", message.encoding, _COLORS)
    channels, order = _COLORS[message.encoding]
    return _raw(message, topic, camera, "u1", channels)[..., order].astype(np.uint8, copy=False)


def read_depth_message(
    message: Any, topic: str, camera: Intrinsics, scale: float | None = None
) -> Float32:
    """Depth (H, W) in metres, 0 = no reading, of an Image or a CompressedImage (compressedDepth).

    Infinite, NaN and negative values count as no reading. ``scale``, the value per metre, is by
    default that of the encoding.

    Raises:
        InputError: as `read_color_message`.
    """
    kind = message.format.split(";")[0] if hasattr(message, "format") else message.encoding
    if kind not in _DEPTHS:
        raise unknown(f"encoding of depth in {topic}", kind, _DEPTHS)
    dtype, own_scale = _DEPTHS[kind]
    if hasattr(message, "format"):
        values = _decompressed(message, topic, camera, dtype == "f4")
    else:
        values = _raw(message, topic, camera, dtype, 1)[..., 0].astype(np.float32)
    if dtype == "u2":
        values[values == SATURATED] = 0
    depth = values / np.float32(scale or own_scale)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _raw(message: Any, topic: str, camera: Intrinsics, dtype: str, channels: int) -> NDArray[Any]:
    """Values (H, W, channels) of an Image."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    check_size(topic, (width, height), camera)
    order = np.dtype((">" if message.is_bigendian else "<") + dtype)
    row, data = width * channels * order.itemsize, np.asarray(message.data, dtype=np.uint8)
    if step < row or len(data) < step * height:
        raise InputError(
            f"{topic}: an image is cut off: {len(data)} bytes in rows of {step}, where "
            f"{width}x{height} {message.encoding} needs {row * height} in rows of {row}"
        )
    rows = data[: step * height].reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(order).reshape(height, width, channels)


def _decompressed(message: Any, topic: str, camera: Intrinsics, is_inverse: bool) -> Float32:
    """Values (H, W) of image_transport's compressedDepth: PNG, quantised 1 / depth for 32FC1."""
    data = bytes(message.data)
    codec = re.search(r"compressedDepth\s*(\w*)", message.format)
    if codec is not None and codec[1] not in ("", "png"):  # not named before 2021
        wanted = ["16UC1; compressedDepth png", "32FC1; compressedDepth png"]
        raise unknown(f"format of depth in {topic}", message.format, wanted)
    is_plain = data[:4] == b"\x89PNG"  # written by tools that omit the header
    values = decode_depth(data if is_plain else data[_DEPTH_HEADER:], topic, camera)
    found = values.astype(np.float32)
    if not is_inverse:
        return found
    if is_plain:
        raise InputError(f"{topic}: compressed 32FC1 lacks the numbers that it was quantised with")
    a, b = struct.unpack_from("<ff", data, 4)
    return np.where(values > 0, np.float32(a) / np.where(found == b, np.inf, found - b), 0)
