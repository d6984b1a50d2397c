"""EuRoC MAV and TUM-VI, in ASL format: two distorted cameras, ``mav0/cam0`` and ``cam1``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.input_files import is_named, read_text
from ms_slam_env.camera import Distortion, Intrinsics
from ms_slam_env.config import load_yaml
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, invert, make_pose, pose_from_quaternion
from ms_slam_env.sequences.recording.listings import Calibration, number, rigid, rows
from ms_slam_env.sequences.recording.recording import Recording
from ms_slam_env.sequences.recording.stereo import StereoEntry, StereoRig
from ms_slam_env.sequences.trajectory import associate

_TRUTH = ("state_groundtruth_estimate0", "mocap0", "vicon0")
_SAME_SHUTTER_S = 0.002


def is_euroc(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return is_named(folder / "mav0") or is_named(folder / "cam0" / "data.csv")


def open_euroc(folder: Path, intrinsics: Calibration | None) -> Recording:
    """Open the rectified left camera with depth by stereo matching; true poses are its own.

    Raises:
        InputError: intrinsics were given; a file is missing or invalid.
    """
    if intrinsics is not None:
        raise InputError(f"{folder}: the calibration of EuRoC is that of its sensor.yaml files")
    inside = folder / "mav0" if is_named(folder / "mav0") else folder
    (left, T_body_left), (right, T_body_right) = (_camera(inside / f"cam{k}") for k in (0, 1))
    rig = StereoRig(left, right, invert(T_body_left) @ T_body_right)
    lefts, rights = (_listed(inside / f"cam{k}") for k in (0, 1))
    ages = [np.array([time for time, _, _ in listed]) for listed in (lefts, rights)]
    entries = []
    for i, k in zip(*associate(ages[0], ages[1], _SAME_SHUTTER_S), strict=True):
        time, image, where = lefts[i]
        entries.append(StereoEntry(time, image, image, where, rights[k][1], rig))
    if not entries:
        raise InputError(f"{inside}: no image of cam1 is as old as one of cam0")
    truth_times, bodies = _truth(inside)
    T_body_camera = T_body_left @ make_pose(rig.R_left_rectified, np.zeros(3))
    return Recording(
        name=folder.name if inside != folder or folder.name != "mav0" else folder.parent.name,
        layout="euroc",
        entries=tuple(entries),
        source=rig.intrinsics,
        intrinsics=rig.intrinsics,
        depth_scale=1.0,
        truth_times=truth_times,
        truth=None if bodies is None else bodies @ T_body_camera,
    )


def _seconds(word: str, where: str) -> float:
    return 1e-9 * number(word, where)


def _listed(camera: Path) -> list[tuple[float, Path, str]]:
    """Time, file and line of every image of a camera's ``data.csv``."""
    path = camera / "data.csv"
    found: list[tuple[float, Path, str]] = []
    for where, words in rows(path):
        if len(words) != 2:
            raise InputError(f"{where}: expected 'timestamp_ns,file', got {' '.join(words)!r}")
        time = _seconds(words[0], where)
        if found and time <= found[-1][0]:
            raise InputError(f"{where}: timestamp {words[0]} does not come after the one before")
        found.append((time, camera / "data" / words[1], where))
    if not found:
        raise InputError(f"{path} lists no image")
    return found


def _sensor(path: Path) -> dict[str, Any]:
    """Read a ``sensor.yaml``; its first line may be OpenCV's ``%YAML:1.0``."""
    try:
        read = load_yaml(re.sub(r"\A%YAML.*\n", "", read_text(path, "calibration")))
    except ValueError as error:
        raise InputError(f"{path} is not a YAML file: {error}") from None
    if not isinstance(read, dict):
        raise InputError(f"{path} is not a mapping of options")
    return read


def _numbers(sensor: dict[str, Any], key: str, count: int | None, path: Path) -> list[float]:
    given = sensor.get(key)
    values = given if isinstance(given, list) else []
    is_right = bool(values) and (count is None or len(values) == count)
    if not is_right or not all(type(value) in (int, float) for value in values):
        many = "numbers" if count is None else f"{count} numbers"
        raise InputError(f"{path}: {key} must be a list of {many}, got {str(given)[:80]}")
    return [number(str(value), f"{path}: {key}") for value in values]


def _pose(sensor: dict[str, Any], path: Path) -> Float64:
    """T_body_sensor (4, 4), made exactly rigid because files round it."""
    given = sensor.get("T_BS")
    if not isinstance(given, dict):
        raise InputError(f"{path}: T_BS, the pose of the sensor, is missing")
    matrix = np.array(_numbers(given, "data", 16, path)).reshape(4, 4)
    return check_pose(rigid(matrix), f"{path}: T_BS")


def _camera(folder: Path) -> tuple[Intrinsics, Float64]:
    """Intrinsics and T_body_camera (4, 4) from ``sensor.yaml``."""
    path = folder / "sensor.yaml"
    sensor = _sensor(path)
    if sensor.get("camera_model") != "pinhole":
        given = sensor.get("camera_model")
        raise InputError(f"{path}: camera_model {given!r} is unknown; valid choices: pinhole")
    fx, fy, cx, cy = _numbers(sensor, "intrinsics", 4, path)
    width, height = _numbers(sensor, "resolution", 2, path)
    lens = _numbers(sensor, "distortion_coefficients", None, path)
    try:
        distortion = Distortion.of(str(sensor.get("distortion_model")), lens)
        camera = Intrinsics(fx, fy, cx, cy, round(width), round(height), distortion)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return camera, _pose(sensor, path)


def _truth(inside: Path) -> tuple[Float64, Float64] | tuple[None, None]:
    """Times (M,) and T_world_body (M, 4, 4) from the first existing file of `_TRUTH`."""
    for name in _TRUTH:
        path = inside / name / "data.csv"
        if is_named(path):
            times, poses = _states(path)
            sensor = inside / name / "sensor.yaml"
            if is_named(sensor) and "T_BS" in (read := _sensor(sensor)):
                poses = poses @ invert(_pose(read, sensor))
            return times, poses
    return None, None


def _states(path: Path) -> tuple[Float64, Float64]:
    """Read lines ``timestamp_ns, x, y, z, qw, qx, qy, qz``, ignoring further columns."""
    times: list[float] = []
    poses: list[Float64] = []
    for where, words in rows(path):
        if len(words) < 8:
            raise InputError(f"{where}: expected 'timestamp_ns,x,y,z,qw,qx,qy,qz'")
        x, y, z, *q = (number(word, where) for word in words[1:8])
        if not np.linalg.norm(q) > 0.5:
            raise InputError(f"{where}: {q} is no unit quaternion")
        time = _seconds(words[0], where)
        if times and time <= times[-1]:
            raise InputError(f"{where}: timestamp {words[0]} does not come after the one before")
        times.append(time)
        pose = pose_from_quaternion([x, y, z], [*q[1:], q[0]])
        poses.append(check_pose(pose, where))
    if not times:
        raise InputError(f"{path} holds no pose")
    return np.array(times), np.stack(poses)
