"""What a comparison runs on: rendered scenes and recordings, with true poses and surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import scenes
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.metrics.reconstruction import voxel_thin
from ms_slam_env.scenes.registry import check_name
from ms_slam_env.sensor import NOISE_MODELS
from ms_slam_env.sequences import (
    PERTURBATIONS,
    HandheldPath,
    associate,
    make_perturbation,
    render_sequence,
)
from ms_slam_env.sequences.recording import Recording, open_recording

Float64 = NDArray[np.float64]

SURFACE_SPACING_M = 0.01
_MOST_VIEWS = 60  # of the true surface; neighbours see the same
_MAX_DIFFERENCE_S = 0.02


@dataclass(frozen=True)
class SequenceName:
    """A rendered sequence ``scene:seed[:noise[+perturbation ...]]``.

    Attributes:
        scene: its name, or a mesh file.
        seed: of scene, path, noise and perturbations.
        noise: of the sensor.
        perturbations: at their default strengths.
    """

    scene: str
    seed: int
    noise: str
    perturbations: tuple[str, ...]


@dataclass(frozen=True)
class Input:
    """A sequence with its truth.

    Attributes:
        frames: N frames.
        poses: (N, 4, 4) true T_world_camera.
        intrinsics: of the frames.
        surface: (M, 3) true surface that the frames saw, about 1 cm apart, world frame.
    """

    frames: tuple[RGBDFrame, ...]
    poses: Float64
    intrinsics: Intrinsics
    surface: Float64


def parse_sequence(text: str) -> SequenceName | Path:
    """What ``text`` names: a folder, or a rendered sequence.

    Raises:
        InputError: neither; an unknown noise model or perturbation. Scenes are checked where they
            are made.
    """
    if Path(text).is_dir():
        return Path(text)
    scene, *rest = text.split(":")
    if not 1 <= len(rest) <= 2 or not rest[0].isdigit():
        raise InputError(
            f"sequence {text!r} is neither a folder nor scene:seed[:noise[+perturbation ...]], "
            "such as table:2000, table:2000:none or table:2000:kinect+rolling-shutter"
        )
    noise, *perturbations = (rest[1] if len(rest) == 2 else "kinect").split("+")
    if noise not in NOISE_MODELS:
        raise unknown(f"noise of sequence {text!r}", noise, NOISE_MODELS)
    for name in perturbations:
        if name not in PERTURBATIONS:
            raise unknown(f"perturbation of sequence {text!r}", name, PERTURBATIONS)
    return SequenceName(scene, int(rest[0]), noise, tuple(perturbations))


def check_sequence(text: str) -> None:
    """Refuse, before any work is done, what ``load`` would refuse.

    Raises:
        InputError: as `parse_sequence`; an unknown scene, no recording, or one without truth.
    """
    named = parse_sequence(text)
    if isinstance(named, Path):
        _check_truth(open_recording(named))
    else:
        check_name(named.scene)


def load(text: str, image_size: str, path: HandheldPath) -> Input:
    """The sequence that ``text`` names, at ``image_size``; ``path`` is that of rendered ones.

    Raises:
        InputError: a sequence that cannot be made or read, or a recording without truth.
    """
    named = parse_sequence(text)
    if isinstance(named, Path):
        return _recorded(open_recording(named).at_size(image_size))
    return _rendered(named, xtion(image_size), path)


def _rendered(named: SequenceName, intrinsics: Intrinsics, path: HandheldPath) -> Input:
    scene = scenes.make(named.scene, named.seed)
    sequence = render_sequence(
        scene,
        path.poses(scene, named.seed),
        intrinsics,
        named.noise,
        named.seed,
        perturbations=[make_perturbation(name) for name in named.perturbations],
        timestamps=path.timestamps,
    )
    picked = evenly_picked(len(sequence))
    views = ((sequence.poses[k], sequence.frames.truth(int(k)).depth) for k in picked)
    surface = seen_surface(views, intrinsics)
    return Input(tuple(sequence.frames), sequence.poses, intrinsics, surface)


def _check_truth(recording: Recording) -> tuple[NDArray[np.int64], Float64]:
    """Frames (N,) that have a true pose, and these poses (N, 4, 4)."""
    if recording.truth is None or recording.truth_times is None:
        raise InputError(f"sequence {recording.name} has no true trajectory to compare with")
    own, true = associate(recording.timestamps, recording.truth_times, _MAX_DIFFERENCE_S)
    if len(own) < 2:
        raise InputError(f"sequence {recording.name}: fewer than 2 frames have a true pose")
    return own, recording.truth[true]


def _recorded(recording: Recording) -> Input:
    own, poses = _check_truth(recording)
    kept = tuple(recording.frame(int(index)) for index in own)
    views = ((poses[k], kept[k].depth) for k in evenly_picked(len(kept)))
    return Input(kept, poses, recording.intrinsics, seen_surface(views, recording.intrinsics))


def evenly_picked(count: int) -> NDArray[np.int64]:
    """Numbers below ``count``, evenly picked, ``_MOST_VIEWS`` at most: enough to see a surface."""
    return np.unique(np.linspace(0, count - 1, _MOST_VIEWS).astype(np.int64))


def seen_surface(
    views: Iterator[tuple[Float64, NDArray[np.float32]]],
    intrinsics: Intrinsics,
    cutoff_m: float = 4.0,
) -> Float64:
    """Points (M, 3) of what ``views`` saw: pairs of T_world_camera (4, 4) and depth (H, W) metres.

    Readings beyond ``cutoff_m``, SLAM's own default, do not count as seen. One point is kept for
    each cell of ``SURFACE_SPACING_M``.

    Raises:
        InputError: no reading at all.
    """
    v, u = np.mgrid[: intrinsics.height, : intrinsics.width]
    rays = np.stack(
        [
            (u - intrinsics.cx) / intrinsics.fx,
            (v - intrinsics.cy) / intrinsics.fy,
            np.ones(u.shape),
        ],
        axis=-1,
    )
    clouds = []
    for T, depth in views:
        valid = (depth > 0) & (depth <= cutoff_m)
        clouds.append((rays[valid] * depth[valid, None]) @ T[:3, :3].T + T[:3, 3])
    return voxel_thin(np.concatenate(clouds), SURFACE_SPACING_M)
