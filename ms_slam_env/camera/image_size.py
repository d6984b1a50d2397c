"""Sizes of images by name, and which part of an image is taken before it is reduced.

``160x120`` reduces whole images, which must have that aspect. ``160x120+crop`` takes the largest
central part that has it, ``160x120+crop=480x360`` the central part of that size; ``native`` in
place of the size reduces nothing.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from ms_slam_env.camera.intrinsics import LARGEST_SIDE, XTION_SIZES, Intrinsics
from ms_slam_env.errors import InputError, unknown

NATIVE = "native"
"""The size that keeps the images' own."""

SMALLEST_SIDE = 8
"""Pixels; below, nothing can be tracked."""

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
    """Images that cannot be brought to the size that was asked for."""


@dataclass(frozen=True)
class Crop:
    """A part of an image, in its pixels: from ``left``, ``top`` on, ``width`` x ``height``."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class ImageSize:
    """A size as it was named.

    Attributes:
        size: (width, height) to reduce to; None keeps the pixels.
        crop: (width, height) of the central part that is taken before; None for all that has the
            aspect of ``size``.
        crops: whether anything may be cut away.
    """

    size: tuple[int, int] | None
    crop: tuple[int, int] | None = None
    crops: bool = False

    def part_of(self, source: Intrinsics, name: str) -> Crop:
        """What is taken of an image of ``source``.

        Args:
            source: intrinsics of the whole image.
            name: of the thing that has these images, for the error message.

        Raises:
            ImageSizeError: a part or a size that is larger, or whole images of another aspect;
                the message says what would do.
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
        """The largest part of an image of ``source`` that has this aspect."""
        width, height = self.size or (source.width, source.height)
        scale = min(source.width / width, source.height / height)
        return round(width * scale), round(height * scale)

    def _reduces(self, part: tuple[int, int]) -> bool:
        """Whether an image of this size is ``part`` reduced, to half a pixel."""
        if self.size is None:
            return True
        width, height = self.size
        is_larger = width > part[0] or height > part[1]
        return not is_larger and 2 * abs(width * part[1] - height * part[0]) <= max(part)


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def parse_image_size(text: str) -> ImageSize:
    """The size that ``text`` names, as this module describes.

    Raises:
        InputError: it names none; the message says what may stand there.
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
    """(width, height) of images that are made as ``text`` asks, so that there is nothing to crop.

    Raises:
        InputError: no size, ``native``, or a part of a size of its own.
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

    570.3 px at 640x480 is the focal length of the OpenNI driver's default calibration
    (58 x 45 degrees field of view). Of another aspect than 4:3 it is the central part that has it.

    Raises:
        InputError: unknown size.
    """
    width, height = rendered_size(size)
    focal = 570.3 * max(width / 640, height / 480)
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def pinhole(size: str, field_of_view_deg: float | None = None) -> Intrinsics:
    """A camera with square pixels and its axis in the middle of the image.

    Args:
        size: of the image, as ``xtion`` takes it.
        field_of_view_deg: from the left edge to the right one; None for the Xtion's own.

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
