"""Writes a sequence to a folder in the TUM layout, which appears only when complete."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.input_files import read_json
from ms_slam_env._runtime.interrupts import kept
from ms_slam_env._runtime.output_files import write_bytes, write_text
from ms_slam_env._runtime.progress import Bar
from ms_slam_env._runtime.result_folders import alone_in, lock_beside, own_folder
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.sequence import Sequence
from ms_slam_env.sequences.trajectory import write_trajectory

if TYPE_CHECKING:
    from ms_slam_env.sequences.rendering import RenderedSequence

DEPTH_SCALE = 5000.0
"""Depth image value per metre, as in the TUM RGB-D benchmark."""

DESCRIPTION = "sequence.json"
"""File that describes how a sequence was made; in an unfinished folder it is ``UNFINISHED``."""

UNFINISHED = "incomplete.json"


def working_folder(folder: Path) -> Path:
    """Folder in which a sequence is written until it is complete."""
    return folder.with_name(folder.name + ".partial")


def write_sequence(
    sequence: RenderedSequence,
    folder: str | Path,
    description: Mapping[str, Any],
    with_truth: bool = False,
) -> bool:
    """Write a rendered sequence in the TUM layout; show progress.

    Files: ``rgb/TIME.png``, ``depth/TIME.png`` (16 bits, 5000 per metre, 0 = no reading or beyond
    13.1 m), ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``, ``intrinsics.txt`` and
    ``sequence.json``; for every moving object ``objects/NAME.txt``, its poses T_world_object at the
    frames' times. Everything is written to ``FOLDER.partial``, each image atomically, and the
    folder is renamed at the end. A second call with the same description resumes an interrupted
    one, and produces the same files.

    Args:
        sequence: the sequence.
        folder: must not exist, or hold the same sequence.
        description: how the sequence is made, for ``sequence.json``; sequences with equal
            descriptions count as the same.
        with_truth: also write ``depth_true/TIME.png``, the noise-free depth from the true pose,
            ``labels/TIME.png``, the object there (16 bits, 0 = none), and ``objects.txt``.

    Returns:
        whether anything was left to write.

    Raises:
        InputError: the folder, or the unfinished one, holds something else or is being written.
    """
    target = Path(folder)
    content = json.loads(json.dumps(dict(description)))
    with alone_in(target, lock_beside(target)):
        return _write_whole(sequence, target, content, with_truth)


def _write_whole(
    sequence: RenderedSequence, target: Path, content: dict[str, Any], with_truth: bool
) -> bool:
    """Write a sequence or its missing rest; return whether anything was written."""
    if _is_there(target, content):  # written by another process meanwhile
        return False
    partial = working_folder(target)
    _begin(partial, content)
    names = [f"{time:.6f}" for time in sequence.frames.timestamps]
    kinds = ("rgb", "depth", *(("depth_true", "labels") if with_truth else ()))
    for kind in (*kinds, "objects") if sequence.frames.object_trajectories else kinds:
        own_folder(partial / kind)
    with kept(f"finished frames are kept in {partial}; the same command continues"):
        for index, name in enumerate(Bar(names, desc=sequence.name, unit="frame")):
            _write_frame(partial, name, sequence, index, with_truth)
    _write_lists(partial, names, kinds)
    if with_truth:
        objects = enumerate(sequence.frames.labels, start=1)
        lines = "".join(f"{value} {label}\n" for value, label in objects)
        write_text(partial / "objects.txt", f"# value object\n{lines}")
    write_trajectory(partial / "groundtruth.txt", sequence.frames.timestamps, sequence.poses)
    for name, poses in sequence.frames.object_trajectories.items():
        file = partial / "objects" / f"{name.replace(' ', '_')}.txt"
        write_trajectory(file, sequence.frames.timestamps, poses)
    write_text(partial / "intrinsics.txt", _intrinsics(sequence.intrinsics))
    os.replace(partial / UNFINISHED, partial / DESCRIPTION)
    os.replace(partial, target)
    return True


def write_frames(sequence: Sequence, folder: Path) -> None:
    """Write only a sequence's images to a folder in the TUM layout, without true poses.

    Files: ``rgb/TIME.png``, ``depth/TIME.png``, ``rgb.txt``, ``depth.txt`` and ``intrinsics.txt``,
    as in `write_sequence`; TIME in seconds with six decimals. ``intrinsics.txt`` is one line of
    numbers, ``fx fy cx cy width height depth_scale``.
    """
    names = []
    for frame in sequence.frames:
        names.append(f"{frame.timestamp:.6f}")
        _write_image(folder / f"rgb/{names[-1]}.png", frame.color[:, :, ::-1])
        _write_image(folder / f"depth/{names[-1]}.png", depth_values(frame.depth))
    _write_lists(folder, names, ("rgb", "depth"))
    write_text(folder / "intrinsics.txt", _intrinsics(sequence.intrinsics))


def _write_lists(folder: Path, names: Iterable[str], kinds: Iterable[str]) -> None:
    for kind in kinds:
        lines = "".join(f"{name} {kind}/{name}.png\n" for name in names)
        write_text(folder / f"{kind}.txt", f"# timestamp filename\n{lines}")


def _is_there(target: Path, content: dict[str, Any]) -> bool:
    """Whether the folder holds the sequence already."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return False
    if not (target / DESCRIPTION).is_file():
        raise InputError(f"{target} exists and is no generated sequence; choose another folder")
    if _read(target / DESCRIPTION) != content:
        raise InputError(f"{target} holds another sequence, see its {DESCRIPTION}")
    return True


def _begin(partial: Path, content: dict[str, Any]) -> None:
    """Make the working folder, or check that it belongs to the same sequence."""
    own_folder(partial)
    if any(partial.iterdir()):
        if (partial / DESCRIPTION).is_file():  # interrupted between the last two steps
            os.replace(partial / DESCRIPTION, partial / UNFINISHED)
        is_same = (partial / UNFINISHED).is_file() and _read(partial / UNFINISHED) == content
        if not is_same:
            raise InputError(
                f"{partial} holds the beginning of another sequence; delete it or choose another "
                "folder"
            )
    write_text(partial / UNFINISHED, json.dumps(content, indent=1) + "\n")


def _read(path: Path) -> Any:
    return read_json(path, "description")


def _write_frame(
    partial: Path, name: str, sequence: RenderedSequence, index: int, with_truth: bool
) -> None:
    """Write the missing files of a frame."""
    rgb, depth = partial / f"rgb/{name}.png", partial / f"depth/{name}.png"
    if not (rgb.exists() and depth.exists()):
        frame = sequence.frames[index]
        _write_image(rgb, frame.color[:, :, ::-1])
        _write_image(depth, depth_values(frame.depth))
    if not with_truth:
        return
    true_depth, labels = partial / f"depth_true/{name}.png", partial / f"labels/{name}.png"
    if not (true_depth.exists() and labels.exists()):
        view = sequence.frames.truth(index)
        _write_image(true_depth, depth_values(view.depth))
        _write_image(labels, (view.labels + 1).astype(np.uint16))


def depth_values(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Values (H, W) of a 16-bit depth image; depth beyond its range becomes no reading."""
    values = np.rint(depth.astype(np.float64) * DEPTH_SCALE)
    return np.where(values <= np.iinfo(np.uint16).max, values, 0).astype(np.uint16)


def _intrinsics(K: Intrinsics) -> str:
    numbers = (K.fx, K.fy, K.cx, K.cy, K.width, K.height, DEPTH_SCALE)
    return " ".join(f"{n:.10g}" for n in numbers) + "\n"


def _write_image(path: Path, pixels: NDArray[Any]) -> None:
    import cv2

    _, data = cv2.imencode(".png", np.ascontiguousarray(pixels))
    write_bytes(path, data.tobytes(), durable=False)
