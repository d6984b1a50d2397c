"""Frames of the plain layout: a folder of depth images and an optional one of colour images."""

from __future__ import annotations

import re
import warnings
from decimal import Decimal
from pathlib import Path

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.input_files import is_named
from ms_slam_env.camera.image_files import SUFFIXES
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.sequences.recording.listings import listed_times
from ms_slam_env.sequences.recording.recording import Entry
from ms_slam_env.sequences.trajectory import MAX_DIFFERENCE_S, UNITS, say_unit, unit_of

FRAME_RATE_HZ = 30.0
"""Frame rate of a layout without times."""

COLOR_FOLDERS = ("rgb", "color", "colour", "image", "images", "img")
TIMES_FILES = ("times.txt", "timestamps.txt")
_NO_COLOR = {"depth", "depth_true", "labels", "mask", "masks", "normals", "objects"}


def folder_entries(folder: Path, truth_times: Float64 | None) -> list[Entry]:
    """List the frames of ``depth`` and one of `COLOR_FOLDERS`, ordered by the numbers in names.

    Times come from ``times.txt`` (`listed_times`), else from the names: seconds with a fraction, or
    time since 1970 or another start in milli-, micro- or nanoseconds. If names are frame numbers,
    the true trajectory's times are used if it has one pose per frame, else 30 Hz.

    Args:
        folder: folder of the recording.
        truth_times: (M,) seconds of the true trajectory in the folder.

    Raises:
        InputError: no images; colour and depth differ in number or numbering; times that do not
            match.
    """
    depth = images(folder / "depth")
    color_folder = find_color(folder)
    color: list[Path | None] = [None] * len(depth)
    if color_folder is not None:
        color = list(_paired(folder, depth, images(color_folder)))
    times = _times(folder, depth, truth_times)
    pairs = zip(times.tolist(), depth, color, strict=True)
    return [Entry(time, d, c, str(d)) for time, d, c in pairs]


def images(folder: Path) -> list[Path]:
    """List a folder's images, ordered by the numbers in their names.

    Raises:
        InputError: not a folder, or without images.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder of images")
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    if not found:
        raise InputError(f"{folder} holds no image; valid kinds: {', '.join(SUFFIXES)}")
    if all(re.fullmatch(r"\d{1,30}\.\d{1,30}", path.stem) for path in found):  # seconds
        return sorted(found, key=lambda path: (Decimal(path.stem), path.name))
    key = lambda path: [int(n) for n in re.findall(r"\d{1,30}", path.stem)]  # noqa: E731
    return sorted(found, key=lambda path: (key(path), path.name))


def find_color(folder: Path) -> Path | None:
    """Find the folder of colour images, by the usual names; None without colour.

    Warns of another folder with images, since it may hold the colour.

    Raises:
        InputError: there are two.
    """
    inside = sorted(path for path in folder.iterdir() if path.is_dir())
    found = [path for path in inside if path.name.lower() in COLOR_FOLDERS]
    if len(found) > 1:
        raise InputError(f"{folder} holds colour in both {found[0].name} and {found[1].name}")
    others = [path for path in inside if path.name.lower() not in _NO_COLOR and _has_image(path)]
    if not found and others:
        _warn(
            f"{folder}: {others[0].name} holds images that are not read; colour is taken from a "
            f"folder {', '.join(COLOR_FOLDERS)}"
        )
    return found[0] if found else None


def _has_image(folder: Path) -> bool:
    return any(path.suffix.lower() in SUFFIXES for path in folder.iterdir())


def _warn(text: str) -> None:
    warnings.warn(text, InputWarning, stacklevel=2)


def _paired(folder: Path, depth: list[Path], color: list[Path]) -> list[Path]:
    """The colour image of each depth image: equal numbers, or a constant offset."""
    if len(color) != len(depth):
        raise InputError(f"{folder}: {len(depth)} depth images but {len(color)} colour images")
    ours, theirs = _numbers(depth), _numbers(color)
    if ours is None or theirs is None:
        return color
    offset = theirs - ours
    apart = np.flatnonzero(np.abs(offset - np.median(offset)) > MAX_DIFFERENCE_S * FRAME_RATE_HZ)
    if len(apart):
        d, c = depth[apart[0]], color[apart[0]]
        raise InputError(
            f"{folder}: {d.parent.name}/{d.name} and {c.parent.name}/{c.name} do not belong "
            "together; an image of depth or colour is missing"
        )
    return color


def _numbers(paths: list[Path]) -> Float64 | None:
    """Increasing frame numbers (N,) at 30 Hz from the names; None if there are none."""
    found, unit, _ = _said(paths)
    if found is None:
        return None
    return found if unit is None else FRAME_RATE_HZ * UNITS[unit] * found


def _said(paths: list[Path]) -> tuple[Float64 | None, str | None, bool]:
    """Increasing numbers (N,) in the names, their unit of time, and whether that is a guess.

    Without a unit they are frame numbers; None if the names have none.
    """
    stems = [path.stem for path in paths]
    are_seconds = all(re.fullmatch(r"\d{1,12}\.\d{1,12}", stem) for stem in stems)
    found = np.array([float(stem) for stem in stems]) if are_seconds else _whole_numbers(stems)
    if found is None or not (np.diff(found) > 0).all():
        return None, None, False
    if are_seconds:
        return found, "s", False
    unit, is_guess = unit_of(found)
    return found, None if unit == "s" else unit, is_guess


def _whole_numbers(stems: list[str]) -> Float64 | None:
    """The only number that varies among the names, such as 12 in ``cam0_00012_depth``."""
    words = [re.findall(r"\d{1,20}", stem) for stem in stems]
    if len({len(word) for word in words}) != 1:
        return None
    columns = list(zip(*words, strict=True))
    columns = [column for column in columns if len(set(column)) > 1] or columns[-1:]
    if len(columns) != 1:
        return None
    return np.array([int(word) for word in columns[0]], dtype=np.float64)


def _times(folder: Path, depth: list[Path], truth_times: Float64 | None) -> Float64:
    """Times (N,) of the frames in seconds."""
    for name in TIMES_FILES:
        if is_named(folder / name):
            return listed_times(folder / name, [path.stem for path in depth])
    said, unit, is_guess = _said(depth)
    if said is not None and unit is not None:
        if is_guess:
            say_unit(unit, said, folder, "a file times.txt")
        _warn_of_gaps(folder, depth, said, "")
        return said * UNITS[unit]
    numbers = np.arange(len(depth), dtype=np.float64) if said is None else said
    if said is None:
        _warn(f"{folder}: the names of depth images say no times; 30 frames a second are assumed")
    taken = ""
    if truth_times is not None and len(truth_times) == len(depth):
        taken = "; the true trajectory has one pose a frame, whose times are taken"
    _warn_of_gaps(folder, depth, numbers, taken)
    return truth_times if truth_times is not None and taken else numbers / FRAME_RATE_HZ


def _warn_of_gaps(folder: Path, depth: list[Path], numbers: Float64, taken: str) -> None:
    if len(numbers) < 3:
        return
    steps = np.diff(numbers)
    usual = float(np.percentile(steps, 50, method="lower"))
    gaps = np.flatnonzero(steps > 1.5 * usual)
    if len(gaps):
        missing = int(np.sum(np.rint(steps[gaps] / usual) - 1))
        _warn(
            f"{folder}: the names leave out {missing} frames in {len(gaps)} gaps, the first after "
            f"{depth[gaps[0]].name}{taken}"
        )
