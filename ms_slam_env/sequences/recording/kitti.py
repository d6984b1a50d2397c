"""KITTI odometry: rectified image pairs, ``calib.txt``, ``times.txt`` and ``poses.txt``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.image_files import image_size
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import Float64, check_pose, make_pose
from ms_slam_env.input_files import is_named
from ms_slam_env.sequences.recording.image_folders import images
from ms_slam_env.sequences.recording.listings import Calibration, number, rigid, rows
from ms_slam_env.sequences.recording.recording import Recording
from ms_slam_env.sequences.recording.stereo import StereoEntry, StereoRig

_PAIRS = ((2, 3), (0, 1))  # colour, grey


def is_kitti(folder: Path) -> bool:
    """Whether a folder is laid out so."""
    return is_named(folder / "calib.txt") and any(
        (folder / f"image_{left}").is_dir() for left, _ in _PAIRS
    )


def open_kitti(folder: Path, intrinsics: Calibration | None) -> Recording:
    """The left camera, of colour if there is any, with depth by stereo matching.

    Its true poses are those of ``poses.txt``, which are of camera 0, moved to it; also found as
    ``../../poses/NN.txt``, where the dataset has them.

    Raises:
        InputError: intrinsics given; a file that is missing or does not parse.
    """
    if intrinsics is not None:
        raise InputError(f"{folder}: the calibration of KITTI is that of its calib.txt")
    pair = next((p for p in _PAIRS if all((folder / f"image_{k}").is_dir() for k in p)), None)
    if pair is None:
        raise InputError(f"{folder} needs both images of a pair: image_0 and image_1, or 2 and 3")
    lefts, rights = (images(folder / f"image_{k}") for k in pair)
    times = [number(words[0], where) for where, words in rows(folder / "times.txt")]
    if not len(lefts) == len(rights) == len(times):
        raise InputError(
            f"{folder}: {len(lefts)} images in image_{pair[0]} and {len(rights)} in "
            f"image_{pair[1]} for {len(times)} times in times.txt"
        )
    matrices = [_projection(folder / "calib.txt", f"P{k}") for k in pair]
    places = [_place(matrix) for matrix in matrices]
    left, right = (_intrinsics(matrix, lefts[0]) for matrix in matrices)
    rig = StereoRig(left, right, make_pose(np.eye(3), places[1] - places[0]))
    entries = [
        StereoEntry(time, one, one, str(one), other, rig)
        for time, one, other in zip(times, lefts, rights, strict=True)
    ]
    truth = _truth(folder, len(times))
    T_first_left = make_pose(np.eye(3), places[0])
    return Recording(
        name=folder.name,
        layout="kitti",
        entries=tuple(entries),
        source=rig.intrinsics,
        intrinsics=rig.intrinsics,
        depth_scale=1.0,
        truth_times=None if truth is None else np.array(times),
        truth=None if truth is None else truth @ T_first_left,
    )


def _projection(path: Path, name: str) -> Float64:
    """The matrix (3, 4) of a line ``P0: ...``."""
    for where, words in rows(path):
        if words[0].rstrip(":") == name:
            return _matrix(words[1:], where)
    raise InputError(f"{path} has no line {name}:")


def _matrix(words: list[str], where: str) -> Float64:
    if len(words) != 12:
        raise InputError(f"{where}: expected 12 numbers, got {len(words)}")
    return np.array([number(word, where) for word in words]).reshape(3, 4)


def _place(P: Float64) -> Float64:
    """Centre (3,) of a camera P = K [I | -c], in the frame of camera 0."""
    if abs(np.linalg.det(P[:, :3])) < 1e-9:
        raise InputError(f"{P.tolist()} is no matrix of a camera")
    return np.asarray(-np.linalg.solve(P[:, :3], P[:, 3]), dtype=np.float64)


def _intrinsics(P: Float64, image: Path) -> Intrinsics:
    """Of the size of an image: ``calib.txt`` does not say it."""
    return Intrinsics(P[0, 0], P[1, 1], P[0, 2], P[1, 2], *image_size(image))


def _truth(folder: Path, count: int) -> Float64 | None:
    """T_world_camera0 (N, 4, 4), if there is one a frame."""
    for path in (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"):
        if is_named(path):
            poses = []
            for where, words in rows(path):
                matrix = np.vstack([_matrix(words, where), [0, 0, 0, 1]])
                poses.append(check_pose(rigid(matrix), where))
            if len(poses) != count:
                raise InputError(f"{path}: {len(poses)} poses for {count} frames")
            return np.stack(poses)
    return None
