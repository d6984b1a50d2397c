"""RGB-D sequences: recordings on disk, camera paths, rendering with perturbations, files.

By name, as in every command: a folder, or scene:seed[:word[+word ...]] (``naming``)::

    sequence = open_sequence("living_room:2000:kinect+misregistration", "320x240")

Rendered, streamed and reproducible bit for bit::

    poses = HandheldPath(frames=600, loop=True).poses(scene, seed=1)  # or handheld_trajectory,
    # place_trajectory(scene, *read_trajectory(file)[1:]).poses
    sequence = render_sequence(
        scene, poses, intrinsics, noise="kinect", seed=1,
        perturbations=(RollingShutter(0.03), ExposureJumps(gain=1.5), DepthDropout(0.1)),
    )
    for frame, T_world_camera in sequence: ...   # or sequence.frames[k], sequence.poses[k]
    sequence.frames.truth(k)                     # TrueView: depth, normals, labels, points

A perturbation is one of ``RollingShutter, MotionBlur, LensDistortion, Misregistration,
ExposureRamp, ExposureJumps, AutoExposure, BlackFrames, DepthDropout, DepthQuantisation,
FrameSkipping, MovingObjects, FastMotion, Illumination``, or
``make_perturbation("rolling-shutter", {"readout_s": 0.02})``.
"""

from typing import TYPE_CHECKING

from ms_slam_env._runtime.lazy import lazy_names

if TYPE_CHECKING:
    from ms_slam_env.sequences.naming import check_sequence, open_sequence, parse_sequence
    from ms_slam_env.sequences.paths import (
        CameraPath,
        HandheldPath,
        MotionSegments,
        Placement,
        RoutePath,
        UnevenPath,
        WanderingPath,
        handheld_trajectory,
        place_trajectory,
    )
    from ms_slam_env.sequences.perturbations import (
        PERTURBATIONS,
        Perturbation,
        make_perturbation,
    )
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
    from ms_slam_env.sequences.rendering import RenderedSequence, render_sequence
    from ms_slam_env.sequences.sequence import Sequence
    from ms_slam_env.sequences.trajectory import (
        PoseInterpolation,
        associate,
        read_trajectory,
        write_trajectory,
    )
else:
    __getattr__ = lazy_names(__name__)

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
    "LensDistortion",
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
    "write_trajectory",
]
