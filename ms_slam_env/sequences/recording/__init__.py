"""Recorded sequences on disk: one class of recording, one file per format."""

from typing import TYPE_CHECKING

from ms_slam_env._runtime.lazy import lazy_names

if TYPE_CHECKING:
    from ms_slam_env.sequences.recording.bags import Topics
    from ms_slam_env.sequences.recording.layouts import LAYOUTS, open_recording
    from ms_slam_env.sequences.recording.listings import Calibration, parse_calibration
    from ms_slam_env.sequences.recording.recording import (
        Entry,
        RecordedSequence,
        Recording,
        Registration,
        recorded_sequence,
    )
else:
    __getattr__ = lazy_names(__name__)

__all__ = [
    "LAYOUTS",
    "Calibration",
    "Entry",
    "RecordedSequence",
    "Recording",
    "Registration",
    "Topics",
    "open_recording",
    "parse_calibration",
    "recorded_sequence",
]
