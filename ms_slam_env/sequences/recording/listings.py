"""Text files that list a sequence's images, poses and intrinsics, line by line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.input_files import read_text, words_of
from ms_slam_env.camera import Distortion, Intrinsics
from ms_slam_env.camera.distortion import ALIASES, NAMES
from ms_slam_env.camera.image_files import image_size
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.sequences.trajectory import in_seconds, said_unit, say_unit, unit_of

_ROUNDED = 1e-2  # tolerance, as for the length of a quaternion

CALIBRATION = (
    "fx fy cx cy width height [depth_scale] "
    "[radial-tangential k1 k2 p1 p2 k3 | equidistant k1 k2 k3 k4 | "
    "rational k1 k2 p1 p2 k3 k4 k5 k6]"
)
"""Fields of a calibration; distortion applies to both images."""


@dataclass(frozen=True)
class Listed:
    """A file with its time, and the line that lists it."""

    timestamp: float
    path: Path
    where: str


def rows(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield (``file:line``, words) of every line that is neither empty nor a comment.

    Raises:
        InputError: the file cannot be read.
    """
    for where, line in _lines(path):
        words = words_of(line)
        if words:  # a line of only separators has none
            yield where, words


def _lines(path: Path, comments: list[str] | None = None) -> Iterator[tuple[str, str]]:
    """Yield (``file:line``, text) of every nonempty line, without its comment."""
    for number, line in enumerate(read_text(path, "listing").splitlines(), start=1):
        text, mark, comment = re.match(r"(.*?)((?:^|(?<=\s))#|$)(.*)", line).groups()  # type: ignore[union-attr]
        if mark and comments is not None:
            comments.append(comment)
        if text.strip():
            yield f"{path}:{number}", text


def number(word: str, where: str) -> float:
    """Parse a finite number.

    Raises:
        InputError: it names file and line.
    """
    try:
        value = float(word)
    except ValueError:
        raise InputError(f"{where}: {word!r} is not a number") from None
    if not math.isfinite(value):
        raise InputError(f"{where}: {word} is not finite")
    return value


def listed_images(path: Path) -> list[Listed]:
    """Read lines ``timestamp filename``: increasing times, files relative to the folder.

    A name with blanks is in quotation marks.

    Raises:
        InputError: it names file and line.
    """
    found: list[Listed] = []
    comments: list[str] = []
    for where, line in _lines(path, comments):
        words = _NAME_AND_TIME.fullmatch(line.strip())
        if words is None:
            raise InputError(f"{where}: expected 'timestamp filename', got {line.strip()!r}")
        first, quoted, plain = words.groups()
        time = number(first.replace(",", "."), where)
        if found and time <= found[-1].timestamp:
            before = found[-1].timestamp
            raise InputError(f"{where}: timestamp {first} does not come after {before}")
        name = (quoted or plain).replace("\\", "/")
        found.append(Listed(time, path.parent / name, where))
    if not found:
        raise InputError(f"{path} lists no image")
    said = next(filter(None, map(said_unit, comments)), None)
    times = in_seconds(np.array([image.timestamp for image in found]), path, said)
    return [replace(one, timestamp=time) for one, time in zip(found, times.tolist(), strict=True)]


_NAME_AND_TIME = re.compile(r"""([^\s;,]+(?:,\d+(?=\s))?)[\s;,]+(?:"([^"]+)"|([^\s"]+))""")


def listed_times(path: Path, names: Sequence[str]) -> Float64:
    """Read image times (N,) in seconds from lines ``time``, or TUM-VI's ``id time [exposure]``.

    Args:
        path: path of the file; a comment may name the unit of time, as ``[ns]``.
        names: N image names without suffix; an id is one of them.

    Raises:
        InputError: it names file and line; or the numbers of lines and images differ.
    """
    comments: list[str] = []
    lines = [(where, words_of(line)) for where, line in _lines(path, comments)]
    if len(lines) != len(names):
        raise InputError(f"{path}: {len(lines)} times for {len(names)} images")
    times = []
    for name, (where, words) in zip(names, lines, strict=True):
        has_id = len(words) > 1
        if len(words) > 3 or (has_id and not _is_id(words[0], name)):
            raise InputError(
                f"{where}: expected a time, with a point for decimals, or 'id time [exposure]' "
                f"with id {name}, got {' '.join(words)!r}"
            )
        times.append(number(words[has_id], where))
    found = np.array(times)
    said = next(filter(None, map(said_unit, comments)), None)
    step = float(np.median(np.diff(found))) if len(found) > 1 else 0.0
    if not said and unit_of(found)[0] == "s" and step >= 2:  # too far apart for seconds
        said = "ms"
        say_unit(said, found, path, "a comment such as [s]")
    return in_seconds(found, path, said)


def _is_id(word: str, name: str) -> bool:
    """Whether a word is a name, or the number in it."""
    numbers = [number.lstrip("0") for number in re.findall(r"[0-9]+", name)]
    is_number = re.fullmatch("[0-9]+", word) and numbers == [word.lstrip("0")]
    return word.rpartition(".")[0] == name or word == name or bool(is_number)


def read_pose(path: Path) -> Float64 | None:
    """Read a pose (4, 4) T_world_camera written as four rows of four numbers.

    A rotation that is orthonormal up to rounding is made exactly so. None if all values are
    ``-inf``, as in ScanNet for unknown poses.

    Raises:
        InputError: a wrong shape, NaN, or not a rigid motion.
    """
    if [words for _, words in rows(path)] == 4 * [4 * ["-inf"]]:
        return None
    return check_pose(rigid(_read_matrix(path, (4,))), str(path))


def _read_matrix(path: Path, sides: Sequence[int]) -> Float64:
    """Read a square matrix of one of the sizes ``sides``.

    Raises:
        InputError: a wrong shape, or something that is not a finite number.
    """
    values = [[number(word, where) for word in words] for where, words in rows(path)]
    if len(values) not in sides or any(len(row) != len(values) for row in values):
        many = " or ".join(f"{side} rows of {side} numbers" for side in sides)
        raise InputError(f"{path}: expected {many}")
    return np.array(values)


def read_poses(path: Path, count: int) -> Float64:
    """Read poses (N, 4, 4), one line per frame, with 16 numbers or 12 without the last row.

    Raises:
        InputError: it names file and line; or there are not ``count`` poses.
    """
    poses = []
    for where, words in rows(path):
        if len(words) not in (12, 16):
            raise InputError(f"{where}: expected 12 or 16 numbers, got {len(words)}")
        matrix = np.eye(4)
        matrix.ravel()[: len(words)] = [number(word, where) for word in words]
        poses.append(check_pose(rigid(matrix), where))
    if len(poses) != count:
        raise InputError(f"{path}: {len(poses)} poses for {count} frames")
    return np.stack(poses)


def read_camera_matrix(path: Path, image: Path) -> Intrinsics:
    """Read intrinsics from a matrix (3, 3) or (4, 4), for images of the size of ``image``.

    Raises:
        InputError: it names the file.
    """
    K = _read_matrix(path, (3, 4))
    try:
        return Intrinsics(K[0, 0], K[1, 1], K[0, 2], K[1, 2], *image_size(image))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def rigid(matrix: Float64) -> Float64:
    """Make a pose's rotation, orthonormal up to rounding, exactly so."""
    if np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() < _ROUNDED:
        left, _, right = np.linalg.svd(matrix[:3, :3])  # the nearest orthonormal matrix
        matrix[:3, :3] = left @ right
    return matrix


@dataclass(frozen=True)
class Calibration:
    """Content of ``intrinsics.txt``.

    Attributes:
        intrinsics: intrinsics of the images on disk, with positive focal lengths.
        flipped: whether fy was negative: the camera frame of the poses has y up.
        depth_scale: depth image value per metre; None if not given.
    """

    intrinsics: Intrinsics
    flipped: bool
    depth_scale: float | None


def read_intrinsics(path: Path) -> Calibration:
    """Read a file `CALIBRATION`.

    Raises:
        InputError: it names file and line.
    """
    for where, words in rows(path):
        return parse_calibration(words, where)
    raise InputError(f"{path} holds no intrinsics: {CALIBRATION!r}")


def parse_calibration(words: Sequence[str], where: str) -> Calibration:
    """Parse the words of `CALIBRATION`.

    Raises:
        InputError: it names ``where``, their origin.
    """
    models = (*NAMES, *ALIASES)
    end = next((k for k, word in enumerate(words) if word in models), len(words))
    values = [number(word, where) for word in words[:end]]
    lens = [number(word, where) for word in words[end + 1 :]]
    if len(values) not in (6, 7):
        raise InputError(f"{where}: expected {CALIBRATION!r}, got {' '.join(words)!r}")
    try:
        read = calibration(*values)
        if end == len(words):
            return read
        bent = replace(read.intrinsics, distortion=Distortion.of(words[end], lens))
        return replace(read, intrinsics=bent)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def calibration(
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: float,
    height: float,
    depth_scale: float | None = None,
) -> Calibration:
    """Make a calibration; fy may be negative, as in ICL-NUIM."""
    if depth_scale is not None and not depth_scale > 0:
        raise InputError(f"depth_scale = {depth_scale} must be above 0")
    intrinsics = Intrinsics(fx, abs(fy), cx, cy, round(width), round(height))
    return Calibration(intrinsics, fy < 0, depth_scale)


def flip_y(poses: Float64) -> Float64:
    """Mirror poses (N, 4, 4) of cameras with y up in a left-handed world.

    The reflection y -> -y in both frames gives right-handed poses of cameras with y down.
    """
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    return mirror @ poses @ mirror
