"""Source of the environment's frames: the sensor, with or without perturbations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.extension import load_reference
from ms_slam_env.camera import Distortion, RGBDFrame
from ms_slam_env.camera.distortion import NO_DISTORTION
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences.perturbations.perturbation import Perturbation
from ms_slam_env.slam.shared.state_check import SEED

_PERTURBED = "ms_slam_env.env.perturbed_feed:PerturbedFeed"  # imported by name


class CameraFeed(ABC):
    """Captures the frames of an episode.

    Attributes:
        perturbations: applied to the frames, in order.
    """

    perturbations: tuple[Perturbation, ...] = ()
    state_like: ClassVar[Mapping[str, Any]] = {"noise_seed": SEED}
    """Template against which ``state_check`` checks states."""

    @property
    def lens(self) -> Distortion:
        """Lens distortion of the frames, which are passed on as a pinhole camera's."""
        return NO_DISTORTION

    @property
    def has_begun(self) -> bool:
        """Whether the feed has been used since the start of the episode."""
        return True

    @abstractmethod
    def begin(
        self, scene: Scene, sensor: RGBDSensor, T_world_camera: Float64, noise_seed: int
    ) -> None:
        """Start an episode in a scene, seen by ``sensor``, from a pose (4, 4).

        Raises:
            InputError: a perturbation that is impossible there.
        """

    @abstractmethod
    def set_trajectory(self, times_s: Float64, poses: Float64) -> None:
        """Announce the poses (k, 4, 4) of the next frames; the first is the present pose.

        ``times_s`` (k,) are seconds since the start of the episode.
        """

    @abstractmethod
    def capture(self, T_world_camera: Float64, index: int, time_s: float) -> RGBDFrame | None:
        """Capture frame ``index`` at an announced pose (4, 4) and time; None if it is dropped.

        The first frame is always delivered.
        """

    @abstractmethod
    def true_depth(self) -> NDArray[np.float32]:
        """True depth (H, W) of the last frame, metres; 0 = no surface, or a moving one."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to resume bit-exactly."""

    def set_state(
        self, state: dict[str, Any], scene: Scene, sensor: RGBDSensor, start: Float64
    ) -> None:
        """Resume from a state that ``get_state`` returned in an episode begun at ``start``."""
        self.begin(scene, sensor, start, state["noise_seed"])


class SensorFeed(CameraFeed):
    """Every frame as the sensor captures it."""

    def begin(
        self, scene: Scene, sensor: RGBDSensor, T_world_camera: Float64, noise_seed: int
    ) -> None:
        """See the base class."""
        self._sensor, self._seed = sensor, noise_seed

    def set_trajectory(self, times_s: Float64, poses: Float64) -> None:
        """Do nothing: the frames do not depend on the camera's motion between them."""

    def capture(self, T_world_camera: Float64, index: int, time_s: float) -> RGBDFrame | None:
        """See the base class; every frame is delivered."""
        return self._sensor.capture(T_world_camera, index, time_s, self._seed)

    def true_depth(self) -> NDArray[np.float32]:
        """See the base class."""
        return self._sensor.last_true_depth()

    def get_state(self) -> dict[str, Any]:
        """See the base class."""
        return {"noise_seed": self._seed}


def make_camera_feed(perturbations: tuple[Perturbation, ...]) -> CameraFeed:
    """Make the feed for a tuple of perturbations, which may be empty.

    Raises:
        InputError: a perturbation that changes how the camera moves; the agent decides that.
    """
    if not perturbations:
        return SensorFeed()
    made: CameraFeed = load_reference(_PERTURBED)(perturbations)
    return made
