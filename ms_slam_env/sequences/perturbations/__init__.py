"""Imperfections of cameras and recordings, each with a strength; one file per variant.

Stochastic ones have a ``seed`` of their own beside the sequence's.
"""

from ms_slam_env.sequences.perturbations.auto_exposure import AutoExposure
from ms_slam_env.sequences.perturbations.base import (
    FrameSelection,
    ImagePerturbation,
    LightPerturbation,
    Moment,
    MotionPerturbation,
    OpticalPerturbation,
    Optics,
    Perturbation,
    WorldPerturbation,
)
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
from ms_slam_env.sequences.perturbations.registry import PERTURBATIONS, make_perturbation
from ms_slam_env.sequences.perturbations.rolling_shutter import RollingShutter

__all__ = [
    "PERTURBATIONS",
    "AutoExposure",
    "BlackFrames",
    "DepthDropout",
    "DepthQuantisation",
    "ExposureJumps",
    "ExposureRamp",
    "FastMotion",
    "FrameSelection",
    "FrameSkipping",
    "Illumination",
    "ImagePerturbation",
    "LightPerturbation",
    "Misregistration",
    "Moment",
    "MotionBlur",
    "MotionPerturbation",
    "MovingObjects",
    "OpticalPerturbation",
    "Optics",
    "Perturbation",
    "RollingShutter",
    "WorldPerturbation",
    "make_perturbation",
]
