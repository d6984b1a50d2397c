"""RGB-D sequences: hand-held trajectories, rendering, trajectory files."""

from ms_slam_env.sequences.association import associate
from ms_slam_env.sequences.sequence import Sequence, render_sequence
from ms_slam_env.sequences.trajectories import handheld_trajectory, repeated_trajectory
from ms_slam_env.sequences.tum import read_trajectory, write_trajectory

__all__ = [
    "Sequence",
    "associate",
    "handheld_trajectory",
    "read_trajectory",
    "render_sequence",
    "repeated_trajectory",
    "write_trajectory",
]
