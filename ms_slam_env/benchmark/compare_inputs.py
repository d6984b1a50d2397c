"""What a comparison runs on: rendered scenes and recordings, with true poses and surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import scenes
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.reconstruction import voxel_thin
from ms_slam_env.sensor import NOISE_MODELS, RGBDSensor
from ms_slam_env.sequences import associate, handheld_trajectory, render_sequence
from ms_slam_env.sequences.recording import Recording, open_recording

Float64 = NDArray[np.float64]

SURFACE_SPACING_M = 0.01
_MOST_VIEWS = 60  # of the true surface; neighbours see the same
_MAX_DIFFERENCE_S = 0.02


@dataclass(frozen=True)
class SequenceName:
    """A rendered sequence ``scene:seed[:noise]``.

    Attributes:
        scene: its name.
        seed: of scene, trajectory and noise.
        noise: of the sensor.
    """

    scene: str
    seed: int
    noise: str


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
    """What ``text`` names: a folder, or a rendered sequence ``scene:seed[:noise]``.

    Raises:
        InputError: neither; an unknown noise model. Scenes are checked where they are made.
    """
    if Path(text).is_dir():
        return Path(text)
    scene, *rest = text.split(":")
    if not 1 <= len(rest) <= 2 or not rest[0].isdigit():
        raise InputError(
            f"sequence {text!r} is neither a folder nor scene:seed[:noise], "
            "such as table:2000 or table:2000:none"
        )
    noise = rest[1] if len(rest) == 2 else "kinect"
    if noise not in NOISE_MODELS:
        raise InputError(
            f"sequence {text!r}: unknown noise {noise!r}; valid choices: {', '.join(NOISE_MODELS)}"
        )
    return SequenceName(scene, int(rest[0]), noise)


def load(text: str, image_size: str, frames: int, speed_m: float, rot_deg: float) -> Input:
    """The sequence that ``text`` names, at ``image_size``.

    Args:
        text: see ``parse_sequence``.
        image_size: such as 160x120.
        frames: of a rendered sequence; a recording is taken whole.
        speed_m: largest translation from frame to frame of a rendered sequence.
        rot_deg: largest rotation.

    Raises:
        InputError: a sequence that cannot be made or read, or a recording without truth.
    """
    named = parse_sequence(text)
    if isinstance(named, Path):
        return _recorded(open_recording(named).at_size(image_size))
    return _rendered(named, xtion(image_size), frames, speed_m, rot_deg)


def _rendered(
    named: SequenceName, intrinsics: Intrinsics, frames: int, speed_m: float, rot_deg: float
) -> Input:
    scene = scenes.make(named.scene, named.seed)
    poses = handheld_trajectory(scene, frames, named.seed, speed_m, rot_deg)
    sequence = render_sequence(scene, poses, intrinsics, named.noise, named.seed)
    sensor = RGBDSensor(scene, intrinsics, noise="none", seed=0)
    views = ((T, sensor.ground_truth(T).depth) for T in poses[_some(len(poses))])
    return Input(tuple(sequence.frames), poses, intrinsics, seen_surface(views, intrinsics))


def _recorded(recording: Recording) -> Input:
    if recording.truth is None or recording.truth_times is None:
        raise InputError(f"sequence {recording.name} has no true trajectory to compare with")
    own, true = associate(recording.timestamps, recording.truth_times, _MAX_DIFFERENCE_S)
    if len(own) < 2:
        raise InputError(f"sequence {recording.name}: fewer than 2 frames have a true pose")
    poses = recording.truth[true]
    kept = tuple(recording.frame(int(index)) for index in own)
    views = ((poses[k], kept[k].depth) for k in _some(len(kept)))
    return Input(kept, poses, recording.intrinsics, seen_surface(views, recording.intrinsics))


def _some(count: int) -> NDArray[np.int64]:
    """At most ``_MOST_VIEWS`` of the numbers below ``count``, evenly picked."""
    return np.unique(np.linspace(0, count - 1, _MOST_VIEWS).astype(np.int64))


def seen_surface(
    views: Iterator[tuple[Float64, NDArray[np.float32]]],
    intrinsics: Intrinsics,
    cutoff_m: float = 3.0,
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
