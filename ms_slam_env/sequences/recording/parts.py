"""Recordings in several folders, one part after another."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.recording.bags import is_bag
from ms_slam_env.sequences.recording.recording import Entry, Recording

SEPARATOR = ","


def is_recording(path: str | Path) -> bool:
    """Whether a path is a folder or a bag."""
    return os.path.isdir(path) or is_bag(path)


def part_folders(text: str | Path) -> list[str]:
    """The folders or bags of a recording ``FOLDER[,FOLDER ...]``; an existing name is not split."""
    parts = str(text).split(SEPARATOR)
    is_one = is_recording(text) or not all(is_recording(part) for part in parts)
    return [str(text)] if is_one else parts


def join_parts(parts: Sequence[Recording]) -> Recording:
    """Join parts into one recording.

    If a part's times do not continue those of the part before, for example because each starts at
    0, it is shifted to start one median interval after that part's last frame, together with its
    true poses. The name is that of the first part with the number of parts.

    Raises:
        InputError: the parts have different cameras, or only some have colour or true poses.
    """
    first = parts[0]
    for part in parts[1:]:
        for attribute in ("source", "depth_scale", "registration", "has_color"):
            one, other = getattr(first, attribute), getattr(part, attribute)
            if one != other:
                raise InputError(
                    f"{part.name} does not go on from {first.name}: {attribute} {other}, not {one}"
                )
        if (part.truth is None) != (first.truth is None):
            raise InputError(f"of {first.name} and {part.name} only one has a true trajectory")
    interval = _interval([part.timestamps for part in parts])
    entries: list[Entry] = []
    truths: list[tuple[Float64, Float64]] = []
    for part in parts:
        begins = part.timestamps[0]
        goes_on = not entries or begins > entries[-1].timestamp
        shift = 0.0 if goes_on else entries[-1].timestamp + interval - begins
        entries += [dataclasses.replace(e, timestamp=e.timestamp + shift) for e in part.entries]
        truths += _truth(part, shift, margin=interval / 2)
    times, poses = map(np.concatenate, zip(*truths, strict=True)) if truths else (None, None)
    if times is not None and poses is not None:
        times, order = np.unique(times, return_index=True)
        poses = poses[order]
        if not len(times):  # all are before or after the frames
            times = poses = None
    name = f"{first.name}_and_{len(parts) - 1}_more"
    return dataclasses.replace(
        first, name=name, entries=tuple(entries), truth_times=times, truth=poses
    )


def _interval(times: Sequence[Float64]) -> float:
    """Median time between two frames, seconds."""
    intervals = np.concatenate([np.diff(part) for part in times])
    return float(np.median(intervals)) if len(intervals) else 1.0


def _truth(part: Recording, shift: float, margin: float) -> list[tuple[Float64, Float64]]:
    """Times and true poses from the part's first to its last frame, if it has any."""
    if part.truth_times is None or part.truth is None:
        return []
    first, last = part.timestamps[[0, -1]]
    inside = (part.truth_times >= first - margin) & (part.truth_times <= last + margin)
    return [(part.truth_times[inside] + shift, part.truth[inside])]
