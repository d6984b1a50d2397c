"""What a comparison runs on: a sequence in memory, with its true poses and surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.evaluation.seen_surface import seen_surface
from ms_slam_env.sequences import CameraPath, Sequence, open_sequence

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Input(Sequence):
    """A sequence with its truth, its frames in memory.

    Attributes:
        surface: (M, 3) true surface that the frames saw, about 1 cm apart, world frame.
    """

    surface: Float64


def load(text: str, image_size: str, path: CameraPath) -> Input:
    """The sequence that ``text`` names, at ``image_size``; ``path`` is that of rendered ones.

    Raises:
        InputError: a sequence that cannot be made or read, or a recording without truth.
    """
    sequence = open_sequence(text, image_size, path=path, with_truth=True)
    surface = seen_surface(sequence)
    frames = tuple(sequence.frames)
    return Input(frames, sequence.poses, sequence.intrinsics, sequence.name, surface)
