"""Image sizes by name, with an optional crop before the reduction.

``160x120`` reduces whole images, which must have that aspect ratio. ``160x120+crop`` takes the
largest central part with that ratio, ``160x120+crop=480x360`` the central part of that size;
``native`` instead of a size means no reduction.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from ms_slam_env.camera.intrinsics import LARGEST_SIDE, XTION_SIZES, Intrinsics
from ms_slam_env.errors import InputError, unknown

NATIVE = "native"
"""Keyword for the images' own size."""

SMALLEST_SIDE = 8
"""In pixels; smaller images cannot be tracked."""

_PIXELS = r"[0-9]{1,5}x[0-9]{1,5}"
_FORM = re.compile(f"(?P<size>native|{_PIXELS})(?P<crop>[+]crop(?:=(?P<part>{_PIXELS}))?)?")
_CHOICES = (
    *XTION_SIZES,
    f"any WIDTHxHEIGHT from {SMALLEST_SIDE} to {LARGEST_SIDE}",
    "160x120+crop",
    "160x120+crop=480x360",
    NATIVE,
)


class ImageSizeError(InputError):
    """The images cannot be brought to the requested size."""


@dataclass(frozen=True)
class Crop:
    """A part of an image in pixels: ``width`` x ``height``, starting at ``left``, ``top``."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class ImageSize:
    """A parsed image size.

    Attributes:
        size: (width, height) to reduce to; None keeps the pixels.
        crop: (width, height) of the central part to take first; None for the largest with the
            aspect ratio of ``size``.
        crops: whether cropping is allowed.
    """

    size: tuple[int, int] | None
    crop: tuple[int, int] | None = None
    crops: bool = False

    def part_of(self, source: Intrinsics, name: str) -> Crop:
        """The part to take of an image of ``source``.

        Args:
            source: intrinsics of the whole image.
            name: name of the images' owner, for error messages.

        Raises:
            ImageSizeError: the part or size is larger than the image, or a whole image has another
                aspect ratio; the message says what is valid.
        """
        whole, fitting = (source.width, source.height), self._fitting(source)
        if self.crop is not None and (self.crop[0] > whole[0] or self.crop[1] > whole[1]):
            raise ImageSizeError(
                f"{name}: images of {_text(whole)} have no part of {_text(self.crop)}"
            )
        part = self.crop or (fitting if self.crops else whole)
        if self.size is not None and not self._reduces(part):
            remedies = f"valid choices: {NATIVE}"
            if self._reduces(fitting):
                remedies += f", {_text(self.size)}+crop, which takes their central {_text(fitting)}"
            raise ImageSizeError(
                f"{name}: images of {_text(part)} cannot be reduced to {_text(self.size)}; "
                f"{remedies}"
            )
        return Crop((whole[0] - part[0]) // 2, (whole[1] - part[1]) // 2, *part)

    def _fitting(self, source: Intrinsics) -> tuple[int, int]:
        """The largest part of an image of ``source`` with this aspect ratio."""
        width, height = self.size or (source.width, source.height)
        scale = min(source.width / width, source.height / height)
        return round(width * scale), round(height * scale)

    def _reduces(self, part: tuple[int, int]) -> bool:
        """Whether ``part`` reduces to this size, to within half a pixel."""
        if self.size is None:
            return True
        width, height = self.size
        is_larger = width > part[0] or height > part[1]
        return not is_larger and 2 * abs(width * part[1] - height * part[0]) <= max(part)


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def parse_image_size(text: str) -> ImageSize:
    """Parse a size in the notation of this module.

    Raises:
        InputError: not a size; the message says what is valid.
    """
    found = _FORM.fullmatch(text) if isinstance(text, str) else None
    if found is None:
        raise unknown("image size", text, _CHOICES)
    size, part = (_pixels(found[group]) for group in ("size", "part"))
    sides = (*(size or ()), *(part or ()))
    if any(not SMALLEST_SIDE <= side <= LARGEST_SIDE for side in sides):
        raise unknown("image size", text, _CHOICES)
    return ImageSize(size, part, found["crop"] is not None)


def _pixels(text: str | None) -> tuple[int, int] | None:
    if text is None or text == NATIVE:
        return None
    width, _, height = text.partition("x")
    return int(width), int(height)


def rendered_size(text: str) -> tuple[int, int]:
    """Parse a size (width, height) for rendered images, which need no crop.

    Raises:
        InputError: not a size, ``native``, or a crop of a given size.
    """
    named = parse_image_size(text)
    if named.size is None or named.crop is not None:
        raise InputError(
            f"image size {text!r}: rendered images have no size of their own to keep or to cut "
            "from; valid choices: WIDTHxHEIGHT such as 160x120"
        )
    return named.size


def xtion(size: str = "160x120") -> Intrinsics:
    """Intrinsics of the ASUS Xtion Pro Live, scaled to ``size``.

    570.3 px at 640x480 is the focal length of the OpenNI driver's default calibration (58 x 45
    degrees field of view). For an aspect ratio other than 4:3 it is the central part with that
    ratio.

    Raises:
        InputError: unknown size.
    """
    width, height = rendered_size(size)
    focal = 570.3 * max(width / 640, height / 480)
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def pinhole(size: str, field_of_view_deg: float | None = None) -> Intrinsics:
    """Make a camera with square pixels and its axis at the image centre.

    Args:
        size: size of the image, as for ``xtion``.
        field_of_view_deg: horizontal field of view; None for the Xtion's.

    Raises:
        InputError: unknown size, or an angle outside [10, 150].
    """
    if field_of_view_deg is None:
        return xtion(size)
    width, height = rendered_size(size)
    if not 10 <= field_of_view_deg <= 150:
        raise InputError(f"field_of_view_deg = {field_of_view_deg} is outside [10, 150]")
    focal = 0.5 * width / math.tan(math.radians(field_of_view_deg) / 2)
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
