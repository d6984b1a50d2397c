"""Imperfections of cameras and recordings, each with a strength, by name.

Stochastic ones have their own ``seed`` in addition to the sequence's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ms_slam_env._runtime.extension import ExtensionPoint
from ms_slam_env.config import from_dict
from ms_slam_env.sequences.perturbations.perturbation import Moment, Perturbation

__all__ = ["PERTURBATIONS", "Moment", "Perturbation", "make_perturbation"]

_OWN = __name__

PERTURBATIONS: dict[str, str] = {
    "rolling-shutter": f"{_OWN}.optics:RollingShutter",
    "motion-blur": f"{_OWN}.optics:MotionBlur",
    "misregistration": f"{_OWN}.optics:Misregistration",
    "lens-distortion": f"{_OWN}.optics:LensDistortion",
    "exposure-ramp": f"{_OWN}.images:ExposureRamp",
    "exposure-jumps": f"{_OWN}.images:ExposureJumps",
    "auto-exposure": f"{_OWN}.images:AutoExposure",
    "black-frames": f"{_OWN}.images:BlackFrames",
    "depth-dropout": f"{_OWN}.images:DepthDropout",
    "depth-quantisation": f"{_OWN}.images:DepthQuantisation",
    "frame-skipping": f"{_OWN}.optics:FrameSkipping",
    "moving-objects": f"{_OWN}.moving_objects:MovingObjects",
    "fast-motion": f"{_OWN}.optics:FastMotion",
    "illumination": f"{_OWN}.illumination:Illumination",
}
"""Location of each perturbation's class, which is imported when made."""

POINT = ExtensionPoint("perturbation", "ms_slam_env.perturbations", Perturbation, own=PERTURBATIONS)
"""Finds perturbations."""


def make_perturbation(
    name: str | type[Perturbation], options: Mapping[str, Any] | None = None
) -> Perturbation:
    """Make a perturbation; omitted options keep their default strength.

    Raises:
        InputError: unknown name or option, or a value out of range.
    """
    made: Perturbation = from_dict(POINT.find(name), options or {}, str(name))
    return made
