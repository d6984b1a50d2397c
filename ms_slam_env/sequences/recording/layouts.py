"""Folder layouts of well-known RGB-D datasets."""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.input_files import is_named, read_json
from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.depth_registration import ColorCamera
from ms_slam_env.camera.image_files import image_size
from ms_slam_env.errors import InputError, InputWarning, unknown
from ms_slam_env.sequences.recording.bags import SUFFIXES, Topics, is_bag, open_bag
from ms_slam_env.sequences.recording.euroc import is_euroc, open_euroc
from ms_slam_env.sequences.recording.image_folders import (
    FRAME_RATE_HZ,
    TIMES_FILES,
    find_color,
    folder_entries,
    images,
)
from ms_slam_env.sequences.recording.listings import (
    Calibration,
    Listed,
    calibration,
    flip_y,
    listed_images,
    number,
    parse_calibration,
    read_camera_matrix,
    read_intrinsics,
    read_pose,
    read_poses,
    rows,
)
from ms_slam_env.sequences.recording.parts import join_parts, part_folders
from ms_slam_env.sequences.recording.recording import Entry, Recording, Registration
from ms_slam_env.sequences.recording.stereo import is_kitti, open_kitti
from ms_slam_env.sequences.trajectory import (
    MAX_DIFFERENCE_S,
    associate,
    read_trajectory,
    say_few_pairs,
)
from ms_slam_env.sequences.writing import DESCRIPTION, UNFINISHED

# Published calibrations of the colour cameras, to which depth is registered, 640x480: TUM RGB-D
# benchmark, "Intrinsic camera calibration of the Kinect"; ICL-NUIM page; 7-Scenes page (default).
TUM_NAME = r"(rgbd_dataset_|tum[-_])?(freiburg|fr)([123])([-_].*)?"
TUM_CAMERAS = {
    "1": (517.3, 516.5, 318.6, 255.3),
    "2": (520.9, 521.0, 325.1, 249.7),
    "3": (535.4, 539.2, 320.1, 247.6),
}
ICL_NUIM_CAMERA = (481.2, -480.0, 319.5, 239.5)
SEVEN_SCENES_CAMERA = (585.0, 585.0, 320.0, 240.0)
DEPTH_SCALE = 5000.0
MILLIMETRES = 1000.0
CAMERA_MATRIX = "camera-intrinsics.txt"


def _calibration_of(
    folder: Path,
    given: Calibration | None,
    known: tuple[float, float, float, float] | None = None,
    whose: str = "",
    depth: Path | None = None,
) -> Calibration:
    """The user's, the folder's, or the dataset's published calibration, in that order.

    Args:
        folder: folder of the recording.
        given: calibration from the user.
        known: published calibration.
        whose: dataset of the published calibration.
        depth: a depth image, which gives the size if the file does not.
    """
    if given is not None:
        return given
    if is_named(folder / "intrinsics.txt"):
        return read_intrinsics(folder / "intrinsics.txt")
    for name in (CAMERA_MATRIX, "intrinsic/intrinsic_depth.txt"):  # 3DMatch, ScanNet
        if depth is not None and is_named(folder / name):
            return Calibration(read_camera_matrix(folder / name, depth), False, MILLIMETRES)
    for path in (folder / "cam_params.json", folder.parent / "cam_params.json"):  # Replica
        if depth is not None and is_named(path):
            return _camera_parameters(path)
    if known is not None:
        words = " ".join(f"{number:g}" for number in known)
        _say(f"{folder} has no intrinsics.txt: taken are the published ones of {whose}, {words}")
        return calibration(*known, 640, 480)
    raise InputError(
        f"intrinsics of {folder} are missing: write 'fx fy cx cy width height [depth_scale]' into "
        f"{folder / 'intrinsics.txt'}, or pass the same text as --intrinsics"
    )


def _camera_parameters(path: Path) -> Calibration:
    """Read the calibration from Replica's ``cam_params.json``."""
    read = read_json(path, "calibration")
    camera = read.get("camera") if isinstance(read, dict) else None
    keys = ("fx", "fy", "cx", "cy", "w", "h", "scale")
    values = [camera.get(key) for key in keys] if isinstance(camera, dict) else [None]
    if not all(type(value) in (int, float) for value in values):
        raise InputError(f"{path}: expected a camera with the numbers {', '.join(keys)}")
    return parse_calibration([str(value) for value in values], str(path))


def _say(text: str) -> None:
    warnings.warn(text, InputWarning, stacklevel=2)


def _pairs(folder: Path) -> list[Entry]:
    """List frames from ``associations.txt``, or from ``depth.txt`` and ``rgb.txt`` by time."""
    for name in ("associations.txt", "association.txt"):
        if is_named(folder / name):
            return _associations(folder / name)
    depth = listed_images(folder / "depth.txt")
    if not is_named(folder / "rgb.txt"):
        _expect_no_color(folder)
        return [Entry(image.timestamp, image.path, None, image.where) for image in depth]
    color = listed_images(folder / "rgb.txt")
    pairs = list(zip(*associate(_times(depth), _times(color), MAX_DIFFERENCE_S), strict=True))
    if not pairs:
        raise InputError(f"{folder}: no image of rgb.txt is as old as one of depth.txt")
    say_few_pairs(folder, len(pairs), len(depth))
    return [
        Entry(depth[d].timestamp, depth[d].path, color[c].path, depth[d].where) for d, c in pairs
    ]


def _expect_no_color(folder: Path) -> None:
    """Refuse a folder without ``rgb.txt`` that has colour, or should have it."""
    color = find_color(folder)
    if color is not None:
        raise InputError(f"{folder / 'rgb.txt'} is missing, which lists the images of {color.name}")
    _expect_all_files(folder, "rgb.txt")


def _expect_all_files(folder: Path, name: str) -> None:
    """Refuse a generated sequence with a missing file."""
    if is_named(folder / DESCRIPTION):
        raise InputError(f"{folder / name} is missing; every generated sequence has one")


def _times(images: list[Listed]) -> Float64:
    return np.array([image.timestamp for image in images])


def _associations(path: Path) -> list[Entry]:
    """Read lines ``time file time file``; the path containing "depth" is the depth image."""
    entries = []
    for where, words in rows(path):
        if len(words) != 4:
            raise InputError(f"{where}: expected 'time file time file', got {' '.join(words)!r}")
        first_is_depth = "depth" in words[1].lower()
        d, c = (0, 2) if first_is_depth else (2, 0)
        time = number(words[d], where)
        entries.append(Entry(time, path.parent / words[d + 1], path.parent / words[c + 1], where))
    if not entries:
        raise InputError(f"{path} lists no image")
    return entries


def _trajectory(folder: Path, flipped: bool) -> tuple[Float64, Float64] | tuple[None, None]:
    found = [folder / "groundtruth.txt", *sorted(folder.glob("*.gt.freiburg"))]
    for path in found:
        if is_named(path):
            times, poses = read_trajectory(path)
            return times, flip_y(poses) if flipped else poses
    _expect_all_files(folder, "groundtruth.txt")
    return None, None


def open_tum(folder: Path, intrinsics: Calibration | None) -> Recording:
    """TUM RGB-D benchmark: ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``; scale 5000."""
    name = re.fullmatch(TUM_NAME, folder.name)
    known = (TUM_CAMERAS[name[3]], f"TUM freiburg{name[3]}, by its name") if name else (None, "")
    return _listed(folder, "tum", _calibration_of(folder, intrinsics, *known))


def open_icl_nuim(folder: Path, intrinsics: Calibration | None) -> Recording:
    """ICL-NUIM, TUM-compatible: ``associations.txt``, ``*.gt.freiburg``; y up in its poses."""
    return _listed(
        folder, "icl-nuim", _calibration_of(folder, intrinsics, ICL_NUIM_CAMERA, "ICL-NUIM")
    )


def _listed(folder: Path, layout: str, camera: Calibration) -> Recording:
    return _recording(folder, layout, _pairs(folder), camera)


def _recording(folder: Path, layout: str, entries: list[Entry], camera: Calibration) -> Recording:
    scale, (times, truth) = camera.depth_scale or DEPTH_SCALE, _trajectory(folder, camera.flipped)
    K = camera.intrinsics
    frames = tuple(entries), K, K.undistorted
    return Recording(folder.name, layout, *frames, scale, times, truth)


def open_seven_scenes(folder: Path, intrinsics: Calibration | None) -> Recording:
    """7-Scenes: ``frame-NNNNNN.color.png`` (or JPEG), ``.depth.png`` in millimetres, ``.pose.txt``.

    Colour and depth are the raw images of two cameras, so colour is registered by default, with the
    defaults of ``Registration``. With a ``camera-intrinsics.txt`` they come from 3DMatch and are
    already registered.
    """
    first = min(folder.glob("frame-*.depth.png"), default=None)
    known = SEVEN_SCENES_CAMERA, "7-Scenes", first
    camera = _calibration_of(folder, intrinsics, *known)
    is_registered = is_named(folder / CAMERA_MATRIX)
    if is_registered:
        _say(f"{folder}: colour is taken as registered with depth, for there is a {CAMERA_MATRIX}")
    entries, poses = [], []
    colors = {path.name.partition(".")[0]: path for path in sorted(folder.glob("frame-*.color.*"))}
    for depth in sorted(folder.glob("frame-*.depth.png")):
        stem = depth.name.removesuffix(".depth.png")
        pose = folder / f"{stem}.pose.txt"
        color = colors.get(stem, folder / f"{stem}.color.png") if colors else None
        time = number(stem.removeprefix("frame-"), str(depth)) / FRAME_RATE_HZ
        entries.append(Entry(time, depth, color, str(depth)))
        if is_named(pose) and (T := read_pose(pose)) is not None:
            poses.append((time, T))
    return Recording(
        name=folder.name,
        layout="7-scenes",
        entries=tuple(entries),
        source=camera.intrinsics,
        intrinsics=camera.intrinsics.undistorted,
        depth_scale=camera.depth_scale or MILLIMETRES,
        truth_times=np.array([time for time, _ in poses]) if poses else None,
        truth=np.stack([T for _, T in poses]) if poses else None,
        registration=None if is_registered else Registration(),
    )


def open_folder(folder: Path, intrinsics: Calibration | None) -> Recording:
    """Plain folders: ``depth`` and, with colour, ``rgb``, ``color`` or a similar name.

    True poses come from ``groundtruth.txt``, or one per frame from ``pose/NUMBER.txt`` (ScanNet) or
    the lines of ``traj.txt`` (Replica). ScanNet's colour comes from another camera and is
    registered to the depth camera.
    """
    depth = images(folder / "depth")
    camera = _calibration_of(folder, intrinsics, depth=depth[0])
    _check_scale(folder, camera)
    times, _ = _trajectory(folder, camera.flipped)
    found = _recording(folder, "folder", folder_entries(folder, times), camera)
    of_color, color = folder / "intrinsic/intrinsic_color.txt", found.entries[0].color
    if is_named(of_color) and color is not None and image_size(color) != image_size(depth[0]):
        seen = ColorCamera(read_camera_matrix(of_color, color), np.eye(4))
        found = dataclasses.replace(found, registration=seen)
    return found if times is not None else _with_poses(folder, found)


def open_replica(folder: Path, intrinsics: Calibration | None) -> Recording:
    """Replica in the form of NICE-SLAM: ``results/depthNNNNNN.png`` and ``frameNNNNNN.jpg``.

    True poses are the lines of ``traj.txt``, the calibration is ``cam_params.json`` beside them or
    in the folder above.
    """
    depth = sorted((folder / "results").glob("depth*.png"))
    if not depth:
        raise InputError(f"{folder / 'results'} holds no depth*.png")
    camera = _calibration_of(folder, intrinsics, depth=depth[0])
    _check_scale(folder, camera)
    entries = []
    for path in depth:
        stem = path.stem.removeprefix("depth")
        color = path.with_name(f"frame{stem}.jpg")
        time = number(stem, str(path)) / FRAME_RATE_HZ
        entries.append(Entry(time, path, color, str(path)))
    return _with_poses(folder, _recording(folder, "replica", entries, camera))


def _check_scale(folder: Path, camera: Calibration) -> None:
    """Refuse to guess the unit of depth."""
    if camera.depth_scale is None:
        raise InputError(
            f"the depth scale of {folder} is missing: add the value of a depth image for one metre "
            "as the seventh number of the intrinsics, 1000 for millimetres, 5000 as TUM has it"
        )


def _with_poses(folder: Path, recording: Recording) -> Recording:
    """Add a folder's true poses, one per frame, if it has any."""
    times = recording.timestamps
    if is_named(folder / "pose"):
        by_number = {_number(path): path for path in (folder / "pose").glob("*.txt")}
        paths = [by_number.get(_number(entry.depth)) for entry in recording.entries]
        poses = [None if path is None else read_pose(path) for path in paths]
    elif is_named(folder / "traj.txt"):
        poses = list(read_poses(folder / "traj.txt", len(times)))
    else:
        return recording
    known = [k for k, pose in enumerate(poses) if pose is not None]
    if not known:
        raise InputError(f"{folder / 'pose'} holds no pose of a frame")
    truth = np.stack([pose for pose in poses if pose is not None])
    return dataclasses.replace(recording, truth_times=times[known], truth=truth)


def _number(path: Path) -> int:
    """The last number in a name; -1 if there is none."""
    return int((re.findall(r"\d{1,18}", path.stem) or [-1])[-1])


LAYOUTS: dict[str, Callable[[Path, Calibration | None], Recording]] = {
    "tum": open_tum,
    "icl-nuim": open_icl_nuim,
    "7-scenes": open_seven_scenes,
    "folder": open_folder,
    "replica": open_replica,
    "euroc": open_euroc,
    "kitti": open_kitti,
    "bag": open_bag,
}
"""Reader of each layout."""


_TELLING = re.compile(
    r".*(intrinsic|extrinsic|calib|cam_|camera|pose|traj|truth|(^|[_.-])gt([_.-]|$)|times).*"
)
_CALIBRATIONS = ("intrinsics.txt", CAMERA_MATRIX)
_READ = {
    "tum": ("intrinsics.txt", "groundtruth.txt"),
    "icl-nuim": ("intrinsics.txt", "groundtruth.txt"),
    "7-scenes": _CALIBRATIONS,
    "folder": (
        *(*_CALIBRATIONS, "intrinsic", "cam_params.json"),
        *("groundtruth.txt", "pose", "traj.txt", *TIMES_FILES),
    ),
    "replica": ("intrinsics.txt", "cam_params.json", "traj.txt"),
    "kitti": ("calib.txt", "times.txt", "poses.txt"),
}
"""Names matching `_TELLING` that each layout reads."""


def _say_what_is_not_read(folder: Path, layout: str) -> None:
    """Warn of unread files that may contain calibration, times or true poses."""
    if layout not in _READ:
        return
    found = (path.name for path in folder.iterdir() if path.suffix != ".freiburg")
    left = [
        name
        for name in sorted(found)
        if _TELLING.fullmatch(name.lower()) and name not in _READ[layout]
        and not name.startswith("frame-")
    ]  # fmt: skip
    if left:
        more = f" and {len(left) - 5} more" if len(left) > 5 else ""
        _say(f"{folder}: not read: {', '.join(left[:5])}{more}")


def _recognise(folder: Path) -> str:
    """Recognise a folder's layout by its files."""
    for layout, is_it in (("bag", is_bag), ("euroc", is_euroc), ("kitti", is_kitti)):
        if is_it(folder):
            return layout
    if any(folder.glob("*.gt.freiburg")):
        return "icl-nuim"
    if any(is_named(folder / n) for n in ("depth.txt", "associations.txt", "association.txt")):
        return "tum"
    if is_named(folder / "rgb.txt"):
        raise InputError(f"{folder / 'depth.txt'} is missing, though there is an rgb.txt")
    if any(folder.glob("frame-*.depth.png")):
        return "7-scenes"
    if (folder / "depth").is_dir():
        return "folder"
    if any(folder.glob("results/depth*.png")):
        return "replica"
    raise InputError(
        f"{folder} is no RGB-D sequence: found neither depth.txt or associations.txt (TUM, "
        "ICL-NUIM) nor frame-*.depth.png (7-Scenes) nor a folder depth nor results/depth*.png "
        "(Replica) nor mav0 (EuRoC) nor calib.txt and image_0 (KITTI) nor metadata.yaml (ROS 2)"
    )


def open_recording(
    path: str | Path,
    layout: str = "auto",
    intrinsics: Intrinsics | Calibration | None = None,
    register: bool | Registration | None = None,
    topics: Topics | None = None,
) -> Recording:
    """Open a recorded sequence; images are read later, frame by frame.

    Args:
        path: its folder or bag, or those of its parts in order, separated by commas (`join_parts`).
        layout: ``auto`` or one of ``LAYOUTS``.
        intrinsics: intrinsics of the images on disk, with or without the depth scale; by default
            those of ``intrinsics.txt`` in the folder, else the dataset's published ones.
        register: whether to register colour to the depth camera, with the values of an uncalibrated
            Kinect or the given ones; by default only for 7-Scenes, whose images are not registered.
        topics: topics of a bag; by default found by type and name.

    Raises:
        InputError: no such folder, bag or layout, an incompletely written sequence, missing
            intrinsics, an invalid listing, parts that do not match.
    """
    parts = part_folders(path)
    if len(parts) > 1:
        how = layout, intrinsics, register, topics
        return join_parts([open_recording(part, *how) for part in parts])
    folder = Path(path).resolve()
    if not folder.is_dir() and not is_bag(folder):
        raise InputError(f"no sequence at {path}: not a folder, nor a bag {SUFFIXES}")
    if layout != "auto" and layout not in LAYOUTS:
        raise unknown("layout", layout, ("auto", *LAYOUTS))
    if (folder / UNFINISHED).is_file():
        raise InputError(f"{path} was not generated to its end: give its command again")
    if isinstance(intrinsics, Intrinsics):
        intrinsics = Calibration(intrinsics, False, None)
    name = _recognise(folder) if layout == "auto" else layout
    if topics not in (None, Topics()) and name != "bag":
        raise InputError(f"{path} is not a bag: it has no topics")
    if name == "bag":
        found = open_bag(folder, intrinsics, topics, register is not None)
    else:
        found = LAYOUTS[name](folder, intrinsics)
    _say_what_is_not_read(folder, name)
    if register is None or (register is True and found.registration is not None):
        return found
    given = register if isinstance(register, Registration) else Registration()
    return dataclasses.replace(found, registration=given if register else None)
