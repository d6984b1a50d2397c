"""Read motions and recorded depth of ICL-NUIM's living room from a folder.

Handa et al., ICRA 2014: ``icl_nuim/trajectories/lr_kt0.tum.txt`` and so on, and
``icl_nuim/lr_kt3_depth``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, rendered_size
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.recording import Recording, open_recording
from ms_slam_env.sequences.recording.recording import RecordedSequence
from ms_slam_env.sequences.trajectory import read_trajectory

INTRINSICS = Intrinsics(fx=481.2, fy=480.0, cx=319.5, cy=239.5, width=640, height=480)
RECORDED = "lr_kt3"
"""The motion whose depth was recorded."""


@lru_cache(maxsize=8)
def read_motion(data: str, name: str) -> tuple[Float64, Float64]:
    """Times (N,) and poses (N, 4, 4) of a motion such as ``lr_kt0``."""
    return read_trajectory(Path(data) / f"icl_nuim/trajectories/{name}.tum.txt")


def read_motions(data: str, names: Sequence[str]) -> tuple[list[Float64], Float64]:
    """Times (N_i,) of each motion, and the poses (sum N_i, 4, 4) of all of them.

    Raises:
        InputError: no name, or a trajectory that cannot be read.
    """
    if not names:
        raise InputError("no motion given")
    pairs = [read_motion(data, name) for name in names]
    return [times for times, _ in pairs], np.concatenate([poses for _, poses in pairs])


def recorded_depth(data: str, image_size: str, every: int) -> Recording:
    """Every ``every``-th frame of the recorded depth, at most as large as ``image_size``."""
    recording = open_recording(Path(data) / f"icl_nuim/{RECORDED}_depth").every(every)
    is_larger = rendered_size(image_size)[0] < recording.source.width
    return recording.at_size(image_size) if is_larger else recording


def recorded_motion(data: str, image_size: str, every: int) -> RecordedSequence:
    """The recorded depth, each frame with the true pose closest in time."""
    recording = recorded_depth(data, image_size, every)
    times, poses = read_motion(data, RECORDED)
    nearest = np.abs(times[:, None] - recording.timestamps).argmin(axis=0)
    return RecordedSequence(recording, poses[nearest], recording.intrinsics, recording.name)
