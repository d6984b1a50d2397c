"""Stereo depth: rectification, then OpenCV's semi-global block matching; KITTI odometry.

The depth is thus an estimate by this package, not a recorded reading. It has holes without texture,
at the left border and behind edges, and its error grows with depth squared.

KITTI odometry: rectified image pairs, ``calib.txt``, ``times.txt`` and ``poses.txt``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.input_files import is_named
from ms_slam_env.camera import Intrinsics, intensity_image
from ms_slam_env.camera.image_files import image_size, read_grey
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, make_pose
from ms_slam_env.sequences.recording.image_folders import images
from ms_slam_env.sequences.recording.listings import (
    Calibration,
    listed_times,
    number,
    read_poses,
    rows,
)
from ms_slam_env.sequences.recording.recording import Entry, Recording

_BLOCK_PX = 5
_WIDEST = 1 / 6  # largest disparity as a share of the image's width, which limits the nearest depth
_NARROWEST_PX = 64
_STEPS = 16.0  # OpenCV's disparity steps per pixel


class StereoRig:
    """A left and a right camera, rectified to the left one's undistorted intrinsics.

    Attributes:
        intrinsics: intrinsics of the rectified images.
        baseline_m: distance between the cameras.
        R_left_rectified: (3, 3) rotation of the rectified camera in the left one's frame.
    """

    def __init__(self, left: Intrinsics, right: Intrinsics, T_left_right: Float64) -> None:
        """Rectify cameras; ``T_left_right`` (4, 4) is the pose of the right one.

        The rectified x axis follows the baseline, z is as close to the two optical axes as that
        allows (Hartley and Zisserman, section 11.12).

        Raises:
            InputError: the images differ in size or are too narrow, or the right camera is not to
                the right or looks elsewhere.
        """
        if left.shape != right.shape:
            raise InputError(f"the two cameras have images of {left.shape} and {right.shape}")
        if left.width < _NARROWEST_PX:
            raise InputError(
                f"stereo matching needs images of {_NARROWEST_PX} columns, got {left.width}"
            )
        check_pose(T_left_right, "pose of the right camera")
        self.baseline_m = float(np.linalg.norm(T_left_right[:3, 3]))
        if not T_left_right[0, 3] > 0.5 * self.baseline_m > 0:
            raise InputError(
                "the right camera must stand to the right of the left one, got "
                f"{np.round(T_left_right[:3, 3], 6).tolist()} m in the left camera's frame"
            )
        self.cameras = left, right
        self.intrinsics = left.undistorted
        x = T_left_right[:3, 3] / self.baseline_m
        z = np.array([0.0, 0.0, 1.0]) + T_left_right[:3, 2]
        y = np.cross(z, x)
        if not np.linalg.norm(y) > 0.5:
            raise InputError("the two cameras do not look the same way")
        y /= np.linalg.norm(y)
        self.R_left_rectified = np.stack([x, y, np.cross(x, y)], axis=1)
        rotations = self.R_left_rectified, T_left_right[:3, :3].T @ self.R_left_rectified
        self._maps = [self._map(*one) for one in zip(self.cameras, rotations, strict=True)]

    def _map(self, camera: Intrinsics, R: Float64) -> NDArray[np.float32]:
        """Column and row (2, H, W) in a camera's image of every rectified pixel.

        Directions beyond 90 degrees from the camera's axis are outside its image.
        """
        rays = self.intrinsics.rays() @ R.T
        ahead = rays[..., 2] > 1e-3
        places = np.full((*rays.shape[:2], 2), -10.0)
        places[ahead] = camera.project(rays[ahead])
        return np.ascontiguousarray(np.moveaxis(places, -1, 0).astype(np.float32))

    def rectify(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8]
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Rectify both images (H, W, 3): corresponding points share a row; black outside."""
        pairs = zip((left, right), self._maps, strict=True)
        one, other = (cv2.remap(image, x, y, cv2.INTER_LINEAR) for image, (x, y) in pairs)
        return one.astype(np.uint8, copy=False), other.astype(np.uint8, copy=False)

    def depth(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Depth (H, W) in metres of the rectified left image (H, W, 3); 0 without a match."""
        matcher = _matcher(self.intrinsics.width)
        disparity = matcher.compute(intensity_image(left), intensity_image(right)) / _STEPS
        found = disparity > 0
        metres = self.intrinsics.fx * self.baseline_m / np.where(found, disparity, 1)
        return np.where(found, metres, 0).astype(np.float32)


def _matcher(width: int) -> cv2.StereoSGBM:
    """OpenCV's matcher with the smoothness that its documentation recommends."""
    area = _BLOCK_PX**2
    return cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=16 * math.ceil(_WIDEST * width / 16),
        blockSize=_BLOCK_PX,
        P1=8 * area,
        P2=32 * area,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )


@dataclass(frozen=True)
class StereoEntry(Entry):
    """A stereo frame; ``color`` and ``depth`` are both the left image.

    Attributes:
        right: path of the right image.
        rig: the two cameras.
    """

    right: Path
    rig: StereoRig

    def read(
        self, camera: Intrinsics, color_camera: Intrinsics | None = None
    ) -> tuple[NDArray[np.uint8] | None, NDArray[Any]]:
        """Read the rectified left image, and depth in metres; see the base class."""
        paths = zip((self.depth, self.right), self.rig.cameras, strict=True)
        left, right = self.rig.rectify(*(read_grey(path, K) for path, K in paths))
        return left, self.rig.depth(left, right)


_PAIRS = ((2, 3), (0, 1))  # colour, grey


def is_kitti(folder: Path) -> bool:
    """Whether a folder has KITTI's layout."""
    return is_named(folder / "calib.txt") and any(
        (folder / f"image_{left}").is_dir() for left, _ in _PAIRS
    )


def open_kitti(folder: Path, intrinsics: Calibration | None) -> Recording:
    """Open the left camera, in colour if available, with depth by stereo matching.

    True poses come from ``poses.txt``, or the dataset's own ``../../poses/NN.txt``. They are those
    of camera 0 and are transformed to this camera.

    Raises:
        InputError: intrinsics were given; a file is missing or invalid.
    """
    if intrinsics is not None:
        raise InputError(f"{folder}: the calibration of KITTI is that of its calib.txt")
    pair = next((p for p in _PAIRS if all((folder / f"image_{k}").is_dir() for k in p)), None)
    if pair is None:
        raise InputError(f"{folder} needs both images of a pair: image_0 and image_1, or 2 and 3")
    lefts, rights = (images(folder / f"image_{k}") for k in pair)
    if len(lefts) != len(rights):
        raise InputError(
            f"{folder}: {len(lefts)} images in image_{pair[0]} and {len(rights)} in image_{pair[1]}"
        )
    times = listed_times(folder / "times.txt", [path.stem for path in lefts]).tolist()
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
    """Read the matrix (3, 4) of a line ``P0: ...``."""
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
    """Intrinsics with an image's size, which is not in ``calib.txt``."""
    return Intrinsics(P[0, 0], P[1, 1], P[0, 2], P[1, 2], *image_size(image))


def _truth(folder: Path, count: int) -> Float64 | None:
    """T_world_camera0 (N, 4, 4), if there is one per frame."""
    for path in (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"):
        if is_named(path):
            return read_poses(path, count)
    return None
