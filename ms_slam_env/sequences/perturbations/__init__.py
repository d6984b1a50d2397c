"""Imperfections of cameras and recordings, each with a strength, by name.

Stochastic ones have a ``seed`` of their own beside the sequence's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ms_slam_env._runtime.extension import ExtensionPoint
from ms_slam_env.config import from_dict
from ms_slam_env.sequences.perturbations.base import Moment, Perturbation
from ms_slam_env.sequences.perturbations.illumination import Illumination
from ms_slam_env.sequences.perturbations.images import (
    AutoExposure,
    BlackFrames,
    DepthDropout,
    DepthQuantisation,
    ExposureJumps,
    ExposureRamp,
)
from ms_slam_env.sequences.perturbations.moving_objects import MovingObjects
from ms_slam_env.sequences.perturbations.optics import (
    FastMotion,
    FrameSkipping,
    LensDistortion,
    Misregistration,
    MotionBlur,
    RollingShutter,
)

__all__ = ["PERTURBATIONS", "Moment", "Perturbation", "make_perturbation"]

PERTURBATIONS: dict[str, type[Perturbation]] = {
    "rolling-shutter": RollingShutter,
    "motion-blur": MotionBlur,
    "misregistration": Misregistration,
    "lens-distortion": LensDistortion,
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

POINT = ExtensionPoint("perturbation", "ms_slam_env.perturbations", Perturbation, own=PERTURBATIONS)
"""Where perturbations are found."""


def make_perturbation(
    name: str | type[Perturbation], options: Mapping[str, Any] | None = None
) -> Perturbation:
    """Make a perturbation; options that are left out keep their default strength.

    Raises:
        InputError: unknown name or option, or a value out of range.
    """
    made: Perturbation = from_dict(POINT.find(name), options or {}, str(name))
    return made
