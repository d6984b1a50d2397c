"""Where the environment's frames come from: the sensor, as it is or with imperfections."""

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

_PERTURBED = "ms_slam_env.env.perturbed_feed:PerturbedFeed"  # where it is asked for by name


class CameraFeed(ABC):
    """Takes the frames of an episode.

    Attributes:
        perturbations: of the frames, in order.
    """

    perturbations: tuple[Perturbation, ...] = ()
    state_like: ClassVar[Mapping[str, Any]] = {"noise_seed": SEED}
    """What ``state_check`` compares states with."""

    @property
    def lens(self) -> Distortion:
        """What bends the frames that are handed on as a pinhole camera's."""
        return NO_DISTORTION

    @property
    def has_begun(self) -> bool:
        """Whether it took part in the episode from its start."""
        return True

    @abstractmethod
    def begin(
        self, scene: Scene, sensor: RGBDSensor, T_world_camera: Float64, noise_seed: int
    ) -> None:
        """Start an episode in a scene, which ``sensor`` looks at, from a pose (4, 4).

        Raises:
            InputError: an imperfection that cannot be had there.
        """

    @abstractmethod
    def set_trajectory(self, times_s: Float64, poses: Float64) -> None:
        """Announce the poses (k, 4, 4) of the next frames, after the present one, which is first.

        ``times_s`` (k,) since the start of the episode.
        """

    @abstractmethod
    def capture(self, T_world_camera: Float64, index: int, time_s: float) -> RGBDFrame | None:
        """Take frame ``index`` at an announced pose (4, 4) and time; None if it is not delivered.

        The first frame is always delivered.
        """

    @abstractmethod
    def true_depth(self) -> NDArray[np.float32]:
        """True depth (H, W) of the last frame, metres; 0 = no surface, or one that moves."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly."""

    def set_state(
        self, state: dict[str, Any], scene: Scene, sensor: RGBDSensor, start: Float64
    ) -> None:
        """Go on from a state that ``get_state`` returned in an episode that began at ``start``."""
        self.begin(scene, sensor, start, state["noise_seed"])


class SensorFeed(CameraFeed):
    """Every frame as the sensor takes it."""

    def begin(
        self, scene: Scene, sensor: RGBDSensor, T_world_camera: Float64, noise_seed: int
    ) -> None:
        """See the base class."""
        self._sensor, self._seed = sensor, noise_seed

    def set_trajectory(self, times_s: Float64, poses: Float64) -> None:
        """Nothing depends on where the camera is between the frames."""

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
    """Frames as the sensor takes them, with perturbations if there are any.

    Raises:
        InputError: one that changes how the camera moves, which is the agent's business.
    """
    if not perturbations:
        return SensorFeed()
    made: CameraFeed = load_reference(_PERTURBED)(perturbations)
    return made
