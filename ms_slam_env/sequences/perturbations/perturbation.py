"""Interfaces of perturbations of a rendered sequence.

Kinds, applied in this order: camera motion, frame selection, scene content, optics, images.
"""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.camera import Distortion, Intrinsics, RGBDFrame
from ms_slam_env.camera.distortion import NO_DISTORTION
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import ChangingLight
from ms_slam_env.sequences.perturbations.movers import Mover
from ms_slam_env.sequences.trajectory import PoseInterpolation


def random_numbers(*keys: int, name: str) -> np.random.Generator:
    """Make a generator that depends only on the integers >= 0 ``keys`` and on ``name``.

    Raises:
        InputError: a key that is not an integer >= 0.
    """
    for key in keys:
        if isinstance(key, bool) or not isinstance(key, (int, np.integer)) or key < 0:
            raise InputError(f"a seed must be an integer >= 0, got {key!r}")
    return np.random.default_rng([*map(int, keys), zlib.crc32(name.encode())])


@dataclass(frozen=True)
class Optics:
    """Optics of a frame.

    Attributes:
        color: intrinsics of the colour camera; its image has the size of the depth image.
        T_depth_color: (4, 4) pose of the colour camera in the depth camera's frame.
        readout_s: time from the first row to the last; 0 = all rows at once.
        exposure_s: time over which colour is integrated; 0 = an instant.
        exposure_samples: number of instants that approximate the integral.
        lens: distortion of both cameras.
    """

    color: Intrinsics
    T_depth_color: Float64 = field(default_factory=lambda: np.eye(4))
    readout_s: float = 0.0
    exposure_s: float = 0.0
    exposure_samples: int = 1
    lens: Distortion = NO_DISTORTION


@dataclass(frozen=True)
class Moment:
    """Information about a frame for perturbations.

    Attributes:
        index: index of the frame on the trajectory, before any frame was skipped.
        count: number of poses of the trajectory.
        timestamp: seconds.
        intrinsics: intrinsics of the frames.
        seed: seed of the sequence.
        brightness: function that returns the mean intensity (count,) in [0, 255] of the view from
            every pose of the trajectory, or of those so far; computed at the first call.
    """

    index: int
    count: int
    timestamp: float
    intrinsics: Intrinsics
    seed: int
    brightness: Callable[[], Float64]


class Perturbation(ABC):  # noqa: B024 - its kinds share a name and no method
    """One imperfection of a camera or of a recording; omit it from the list to turn it off."""


class MotionPerturbation(Perturbation):
    """Changes how the camera moves."""

    @abstractmethod
    def retime(self, path: PoseInterpolation, seed: int) -> PoseInterpolation:
        """Return the changed path; ``seed`` is that of the sequence."""


class FrameSelection(Perturbation):
    """Selects frames of the trajectory."""

    @abstractmethod
    def keep(self, count: int, seed: int) -> Int64:
        """Increasing indices to keep of ``count`` frames; ``seed`` is that of the sequence."""


class WorldPerturbation(Perturbation):
    """Changes the content of the scene."""

    @abstractmethod
    def populate(
        self,
        scene: Scene,
        camera: PoseInterpolation,
        intrinsics: Intrinsics,
        seed: int,
        others: Sequence[Mover] = (),
    ) -> tuple[Mover, ...]:
        """Return objects that move through ``scene`` while ``camera`` follows its path.

        ``others`` move there already.
        """


class LightPerturbation(Perturbation):
    """Changes the light of the scene over time."""

    @abstractmethod
    def light(
        self, scene: Scene, camera: PoseInterpolation, intrinsics: Intrinsics, seed: int
    ) -> ChangingLight | None:
        """Return the changing light of ``scene`` while ``camera`` follows its path, or None."""


class OpticalPerturbation(Perturbation):
    """Changes the optics."""

    @abstractmethod
    def alter(self, optics: Optics) -> Optics:
        """Return the changed optics."""


class ImagePerturbation(Perturbation):
    """Changes the images of a captured frame."""

    @abstractmethod
    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """Return the changed frame, which must depend on the two arguments alone."""
