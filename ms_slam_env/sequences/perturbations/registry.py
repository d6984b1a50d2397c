"""Perturbations by name, with options as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ms_slam_env.config import from_dict
from ms_slam_env.errors import unknown
from ms_slam_env.sequences.perturbations.auto_exposure import AutoExposure
from ms_slam_env.sequences.perturbations.base import Perturbation
from ms_slam_env.sequences.perturbations.black_frames import BlackFrames
from ms_slam_env.sequences.perturbations.depth_dropout import DepthDropout
from ms_slam_env.sequences.perturbations.depth_quantisation import DepthQuantisation
from ms_slam_env.sequences.perturbations.exposure_jumps import ExposureJumps
from ms_slam_env.sequences.perturbations.exposure_ramp import ExposureRamp
from ms_slam_env.sequences.perturbations.fast_motion import FastMotion
from ms_slam_env.sequences.perturbations.frame_skipping import FrameSkipping
from ms_slam_env.sequences.perturbations.illumination import Illumination
from ms_slam_env.sequences.perturbations.misregistration import Misregistration
from ms_slam_env.sequences.perturbations.motion_blur import MotionBlur
from ms_slam_env.sequences.perturbations.moving_objects import MovingObjects
from ms_slam_env.sequences.perturbations.rolling_shutter import RollingShutter

PERTURBATIONS: dict[str, type[Perturbation]] = {
    "rolling-shutter": RollingShutter,
    "motion-blur": MotionBlur,
    "misregistration": Misregistration,
    "exposure-ramp": ExposureRamp,
    "exposure-jumps": ExposureJumps,
    "auto-exposure": AutoExposure,
    "black-frames": BlackFrames,
    "depth-dropout": DepthDropout,
    "depth-quantisation": DepthQuantisation,
    "frame-skipping": FrameSkipping,
    "moving-objects": MovingObjects,
    "fast-motion": FastMotion,
    "illumination": Illumination,
}
"""Name to class."""


def make_perturbation(name: str, options: Mapping[str, Any] | None = None) -> Perturbation:
    """Make a perturbation; options that are left out keep their default strength.

    Raises:
        InputError: unknown name or option, or a value out of range.
    """
    if name not in PERTURBATIONS:
        raise unknown("perturbation", name, PERTURBATIONS)
    return from_dict(PERTURBATIONS[name], options or {}, name)
