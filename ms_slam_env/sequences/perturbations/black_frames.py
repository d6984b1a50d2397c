"""Frames that show nothing."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import check_range
from ms_slam_env.sequences.perturbations.base import ImagePerturbation, Moment


@dataclass(frozen=True)
class BlackFrames(ImagePerturbation):
    """Runs of frames without colour, and without depth unless told otherwise.

    Attributes:
        start: first black frame (index on the trajectory).
        length: frames in a row; 0 = off.
        every: frames from the start of one run to the start of the next; 0 = one run only.
        keep_depth: whether depth is still read, as when the light goes out.

    Raises:
        InputError: a value out of range.
    """

    start: int = 60
    length: int = 10
    every: int = 0
    keep_depth: bool = False

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "start", 0, 10_000_000)
        check_range(self, "length", 0, 10_000_000)
        check_range(self, "every", 0, 10_000_000)

    def is_black(self, index: int) -> bool:
        """Whether the frame of this index is black."""
        since = index - self.start
        if since < 0:
            return False
        return (since % self.every if self.every else since) < self.length

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        if not self.is_black(moment.index):
            return frame
        depth = frame.depth if self.keep_depth else np.zeros_like(frame.depth)
        return dataclasses.replace(frame, color=np.zeros_like(frame.color), depth=depth)
