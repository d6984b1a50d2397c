"""Coordinate frames of a bag: transforms between the cameras and the body of the true poses."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.depth_registration import ColorCamera
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.geometry import check_pose, invert, pose_from_quaternion

_SAME_M = 1e-3  # metres or radians; cameras that differ by less are the same
_SAME_PX = 0.5

Transforms = dict[tuple[str, str], Float64]
"""T_parent_child (4, 4) by parent and child frame."""


def transforms_of(messages: Iterable[tuple[float, Any]], topic: str) -> Transforms:
    """Transforms from ``/tf_static`` messages; the last one for each pair of frames counts."""
    found: Transforms = {}
    for _, message in messages:
        for one in message.transforms:
            t, q = one.transform.translation, one.transform.rotation
            numbers = np.array([q.x, q.y, q.z, q.w])
            if not abs(np.linalg.norm(numbers) - 1) < 0.1:
                raise InputError(f"a transform of {topic} has no unit quaternion")
            T = check_pose(pose_from_quaternion([t.x, t.y, t.z], numbers), topic)
            found[plain(one.header.frame_id), plain(one.child_frame_id)] = T
    return found


def plain(frame: str) -> str:
    """A frame's name without the leading slash of ROS 1."""
    return str(frame).lstrip("/")


def find_transform(known: Transforms, a: str, b: str) -> Float64 | None:
    """T_a_b (4, 4) along the tree of frames; None if they are not connected."""
    edges = known | {(child, parent): invert(T) for (parent, child), T in known.items()}
    reached, before = {a: np.eye(4)}, 0
    while len(reached) > before:
        before = len(reached)
        for (start, end), T in edges.items():
            if start in reached and end not in reached:
                reached[end] = reached[start] @ T
    return reached.get(b)


def registration_of(
    path: object,
    frames: tuple[str, str],
    cameras: tuple[Intrinsics, Intrinsics | None],
    known: Transforms,
) -> ColorCamera | None:
    """How to register colour to the depth camera; None if both come from one camera.

    Args:
        path: path of the bag, for messages.
        frames: frames named by the depth and the colour images; empty if unknown.
        cameras: calibrations of depth and colour; None if colour has none of its own.
        known: transforms between frames.

    Raises:
        InputError: the images have different frames, and no transform between them is known.
    """
    (depth, color), (K, of_color) = map(plain, frames), cameras
    T = np.eye(4)
    if depth and color and depth != color:
        found = find_transform(known, color, depth)
        if found is None:
            raise InputError(
                f"{path}: depth is of frame {depth} and colour of {color}, and no /tf_static says "
                "how these stand: --register False takes them as registered, --register True "
                "assumes a Kinect"
            )
        T = found
    is_here = bool(np.abs(T - np.eye(4)).max() < _SAME_M)
    if is_here and (of_color is None or _is_same(K, of_color)):
        return None
    if of_color is None:
        raise InputError(
            f"{path}: colour is of another camera, {color}, whose CameraInfo is missing: "
            "--register False takes it as registered, --register True assumes a Kinect"
        )
    made = ColorCamera(of_color, T)
    warnings.warn(f"{path}: depth is not registered: {made}", InputWarning, stacklevel=2)
    return made


def _is_same(one: Intrinsics, other: Intrinsics) -> bool:
    """Whether two calibrations belong to the same camera."""
    numbers = [np.array([K.fx, K.fy, K.cx, K.cy]) for K in (one, other)]
    return (
        one.shape == other.shape
        and one.distortion == other.distortion
        and bool(np.abs(numbers[0] - numbers[1]).max() < _SAME_PX)
    )


def poses_of_camera(
    path: object, topic: str, poses: Float64, body: str, camera: str, known: Transforms
) -> Float64:
    """T_world_camera (N, 4, 4) from poses of a body; warn if no transform connects them."""
    body, camera = plain(body), plain(camera)
    if not body or not camera or body == camera:
        return poses
    T_body_camera = find_transform(known, body, camera)
    if T_body_camera is not None:
        return poses @ T_body_camera
    warnings.warn(
        f"{path}: poses of {topic} are of frame {body}, images of {camera}, and no /tf_static says "
        "how these stand: the poses are taken as the camera's",
        InputWarning,
        stacklevel=2,
    )
    return poses
