"""RGB-D sequences: recordings on disk, camera paths, rendering with perturbations, files.

By name, as every command takes it: a folder, or scene:seed[:word[+word ...]] (``naming``)::

    sequence = open_sequence("living_room:2000:kinect+misregistration", "320x240")

Rendered, streamed and reproducible bit for bit::

    poses = HandheldPath(frames=600, loop=True).poses(scene, seed=1)  # or handheld_trajectory,
    # repeated_trajectory, place_trajectory(scene, *read_trajectory(file)[1:]).poses
    sequence = render_sequence(
        scene, poses, intrinsics, noise="kinect", seed=1,
        perturbations=(RollingShutter(0.03), ExposureJumps(gain=1.5), DepthDropout(0.1)),
    )
    for frame, T_world_camera in sequence: ...   # or sequence.frames[k], sequence.poses[k]
    sequence.frames.truth(k)                     # TrueView: depth, normals, labels, points

A perturbation is one of ``RollingShutter, MotionBlur, Misregistration, ExposureRamp,
ExposureJumps, AutoExposure, BlackFrames, DepthDropout, DepthQuantisation, FrameSkipping,
MovingObjects, FastMotion, Illumination``, or
``make_perturbation("rolling-shutter", {"readout_s": 0.02})``.
"""

from ms_slam_env.sequences.association import associate
from ms_slam_env.sequences.camera_path import CameraPath
from ms_slam_env.sequences.handheld_path import HandheldPath
from ms_slam_env.sequences.naming import check_sequence, open_sequence, parse_sequence
from ms_slam_env.sequences.paced_paths import MotionSegments, UnevenPath, WanderingPath
from ms_slam_env.sequences.perturbations import (
    PERTURBATIONS,
    AutoExposure,
    BlackFrames,
    DepthDropout,
    DepthQuantisation,
    ExposureJumps,
    ExposureRamp,
    FastMotion,
    FrameSkipping,
    Illumination,
    Misregistration,
    MotionBlur,
    MovingObjects,
    Perturbation,
    RollingShutter,
    make_perturbation,
)
from ms_slam_env.sequences.placement import Placement, place_trajectory
from ms_slam_env.sequences.pose_interpolation import PoseInterpolation
from ms_slam_env.sequences.route_path import RoutePath
from ms_slam_env.sequences.sequence import RenderedSequence, Sequence, render_sequence
from ms_slam_env.sequences.trajectories import handheld_trajectory, repeated_trajectory
from ms_slam_env.sequences.tum import read_trajectory, write_trajectory

__all__ = [
    "PERTURBATIONS",
    "AutoExposure",
    "BlackFrames",
    "CameraPath",
    "DepthDropout",
    "DepthQuantisation",
    "ExposureJumps",
    "ExposureRamp",
    "FastMotion",
    "FrameSkipping",
    "HandheldPath",
    "Illumination",
    "Misregistration",
    "MotionBlur",
    "MotionSegments",
    "MovingObjects",
    "Perturbation",
    "Placement",
    "PoseInterpolation",
    "RenderedSequence",
    "RollingShutter",
    "RoutePath",
    "Sequence",
    "UnevenPath",
    "WanderingPath",
    "associate",
    "check_sequence",
    "handheld_trajectory",
    "make_perturbation",
    "open_sequence",
    "parse_sequence",
    "place_trajectory",
    "read_trajectory",
    "render_sequence",
    "repeated_trajectory",
    "write_trajectory",
]
