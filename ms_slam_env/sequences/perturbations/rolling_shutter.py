"""Rows that are exposed one after the other."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ms_slam_env.config import check_range
from ms_slam_env.sequences.perturbations.base import OpticalPerturbation, Optics


@dataclass(frozen=True)
class RollingShutter(OpticalPerturbation):
    """Colour and depth are read row by row, from top to bottom, while the camera moves.

    Every two rows are rendered from the pose that the camera has at their own time. The time stamp,
    and with it the true pose, of a frame is that of the middle of the image.

    Attributes:
        readout_s: time from the first row to the last; 0 = off. The default is most of the time
            between two frames at 30 Hz.

    Raises:
        InputError: a value out of range.
    """

    readout_s: float = 0.03

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "readout_s", 0.0, 10.0)

    def alter(self, optics: Optics) -> Optics:
        """See the base class."""
        return dataclasses.replace(optics, readout_s=self.readout_s)
