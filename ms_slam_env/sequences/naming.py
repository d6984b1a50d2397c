"""Sequence names shared by all commands: a recording's folder, or a rendered sequence.

``FOLDER[,FOLDER ...]`` is a recording in one or several consecutive parts; a ROS bag or an MCAP
file counts as a folder.

``scene:seed[:word[+word ...]]``: a scene (a name or a mesh file), the seed of scene, path, noise
and perturbations, then in any order (but noise before perturbations) the sensor noise, the camera
path and the perturbations, each with its options, if any::

    living_room:2000
    living_room:2000:none
    living_room:2000:kinect+misregistration+motion-blur,exposure_s=0.02
    small_house.glb,up=z:7:uneven,frames=120+depth-dropout

The defaults are Kinect noise, the command's path, and no perturbations.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env import scenes
from ms_slam_env._runtime.extension import is_reference
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.camera.image_size import NATIVE
from ms_slam_env.config import from_dict, parse_named
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.scenes.registry import check_name
from ms_slam_env.sensor import NOISE_MODELS
from ms_slam_env.sequences.paths import (
    CameraPath,
    HandheldPath,
    MotionSegments,
    UnevenPath,
    WanderingPath,
)
from ms_slam_env.sequences.perturbations import POINT, Perturbation, make_perturbation
from ms_slam_env.sequences.recording import Calibration, Topics, open_recording
from ms_slam_env.sequences.recording.parts import is_recording, part_folders
from ms_slam_env.sequences.recording.recording import Registration, recorded_sequence
from ms_slam_env.sequences.rendering import render_sequence
from ms_slam_env.sequences.sequence import Sequence

PATHS: dict[str, type[CameraPath]] = {
    "handheld": HandheldPath,
    "steady": HandheldPath,
    "uneven": UnevenPath,
    "segments": MotionSegments,
    "wander": WanderingPath,
}
"""Camera path of each word; ``steady`` is the older word for ``handheld``."""

RENDERED_SIZE = "160x120"
"""Default image size of a rendered sequence."""

_GRAMMAR = (
    "is neither a folder nor scene:seed[:word[+word ...]], such as table:2000, table:2000:none or "
    "table:2000:kinect+rolling-shutter, nor a bag (.bag, .mcap, .db3)"
)


@dataclass(frozen=True)
class SequenceName:
    """The parsed name of a rendered sequence.

    Attributes:
        scene: name of the scene, or a mesh file.
        seed: seed of scene, path, noise and perturbations.
        noise: noise model of the sensor.
        perturbations: perturbations in the order of application.
        path: word of the camera path; None leaves it to the command.
        path_options: options of that path.
    """

    scene: str
    seed: int
    noise: str = "kinect"
    perturbations: tuple[Perturbation, ...] = ()
    path: str | None = None
    path_options: Mapping[str, Any] = field(default_factory=dict)

    def camera_path(self, default: CameraPath) -> CameraPath:
        """The camera path: ``default``, or the named one with the default's frames unless given."""
        if self.path is None:
            return default
        frames = getattr(default, "frames", None)
        given = {} if frames is None else {"frames": frames}
        return from_dict(PATHS[self.path], given | dict(self.path_options), self.path)


def parse_sequence(text: str | Path) -> SequenceName | Path:
    """Parse the name of a sequence: a folder, or a rendered sequence.

    Raises:
        InputError: neither; an unknown word (the message lists the valid ones), or a bad option.
            Scenes are checked when made, or by `check_sequence`.
    """
    if all(is_recording(part) for part in part_folders(text)):
        return Path(text)
    parts = re.fullmatch(r"(.+?):(\d{1,18})(?::(.*))?", str(text))
    if parts is None:
        raise InputError(f"sequence {str(text)!r} {_GRAMMAR}")
    scene, seed, words = parts.groups()
    named = SequenceName(scene, int(seed))
    for word in () if words is None else words.split("+"):
        named = _with_word(named, word, str(text))
    return named


def _with_word(named: SequenceName, word: str, text: str) -> SequenceName:
    """Add one word to ``named``; a noise model must precede the perturbations."""
    name, options = parse_named(word, f"part of sequence {text!r}")
    if name in NOISE_MODELS and not options and not named.perturbations:
        return dataclasses.replace(named, noise=name)
    if name in PATHS and named.path is None:
        made = dataclasses.replace(named, path=name, path_options=options)
        made.camera_path(HandheldPath())  # refuses bad options
        return made
    if not is_reference(name) and name not in POINT.names():
        free = () if named.path else PATHS
        names = (*NOISE_MODELS, *POINT.names(), *free, POINT.form)
        raise unknown(f"part of sequence {text!r}", name, names)
    made_perturbations = (*named.perturbations, make_perturbation(name, options))
    return dataclasses.replace(named, perturbations=made_perturbations)


def check_sequence(text: str | Path) -> None:
    """Check a name before any work; refuses whatever `open_sequence` ``with_truth`` would.

    Raises:
        InputError: as `parse_sequence`; an unknown scene, not a recording, or one without truth.
    """
    named = parse_sequence(text)
    if isinstance(named, SequenceName):
        check_name(named.scene)
    else:
        recorded_sequence(open_recording(named)).where_known()


def open_sequence(
    name: str | Path,
    image_size: str | None = None,
    *,
    path: CameraPath | None = None,
    every: int = 1,
    with_truth: bool = False,
    layout: str = "auto",
    intrinsics: Intrinsics | Calibration | None = None,
    register: bool | Registration | None = None,
    topics: Topics | None = None,
) -> Sequence:
    """Open the sequence ``name``; frames are decoded or rendered on request.

    Args:
        name: a folder, or ``scene:seed[:word[+word ...]]`` as this module describes.
        image_size: such as 160x120, or 160x120+crop for the central part with that aspect ratio
            (`ms_slam_env.camera.image_size`); ``native`` or None: the size on disk, or
            `RENDERED_SIZE` for rendered sequences.
        path: camera path of rendered sequences whose names contain none; hand-held by default.
        every: take every n-th frame.
        with_truth: leave out frames without a known true pose, and refuse a recording with fewer
            than two others. Otherwise their ``poses`` are NaN.
        layout: layout of the folder; see `open_recording`, also for the next three.
        intrinsics: intrinsics of the images on disk.
        register: whether to register colour to the depth camera.
        topics: topics of a bag.

    Raises:
        InputError: the sequence cannot be made or read; ``every`` is below 1.
    """
    if every < 1:
        raise InputError(f"every = {every} must be at least 1")
    named = parse_sequence(name)
    if isinstance(named, SequenceName):
        if layout != "auto" or intrinsics is not None or register is not None:
            raise InputError(f"{name} is rendered: layout, intrinsics and register are of folders")
        size = RENDERED_SIZE if image_size in (None, NATIVE) else image_size
        sequence = _rendered(named, size, path or HandheldPath())
    else:
        recording = open_recording(named, layout, intrinsics, register, topics)
        sequence = recorded_sequence(recording.at_size(image_size or NATIVE))
    if with_truth:
        sequence = sequence.where_known()
    return sequence if every == 1 else sequence.picked(np.arange(0, len(sequence), every))


def _rendered(named: SequenceName, image_size: str, default: CameraPath) -> Sequence:
    intrinsics = xtion(image_size)
    scene = scenes.make(named.scene, named.seed)
    times, poses = named.camera_path(default).motion(scene, named.seed)
    return render_sequence(
        scene,
        poses,
        intrinsics,
        named.noise,
        named.seed,
        perturbations=named.perturbations,
        timestamps=times,
    )
