"""Where the environment's frames come from: the sensor, as it is or with imperfections."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences.perturbations.base import Perturbation

Float64 = NDArray[np.float64]


class FrameSource(ABC):
    """Takes the frames of an episode.

    Attributes:
        perturbations: of the frames, in order.
    """

    perturbations: tuple[Perturbation, ...] = ()

    @abstractmethod
    def begin(
        self, scene: Scene, sensor: RGBDSensor, T_world_camera: Float64, noise_seed: int
    ) -> None:
        """Start an episode in a scene, which ``sensor`` looks at, from a pose (4, 4).

        Raises:
            InputError: an imperfection that cannot be had there.
        """

    @abstractmethod
    def set_out(self, times_s: Float64, poses: Float64) -> None:
        """Announce the poses (k, 4, 4) of the next frames, after the present one, which is first.

        ``times_s`` (k,) since the start of the episode.
        """

    @abstractmethod
    def take(self, T_world_camera: Float64, index: int, time_s: float) -> RGBDFrame | None:
        """Take frame ``index`` at an announced pose (4, 4) and time; None if it is not delivered.

        The first frame is always delivered.
        """

    @abstractmethod
    def true_depth(self) -> NDArray[np.float32]:
        """True depth (H, W) of the last frame, metres; 0 = no surface, or one that moves."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly."""

    @abstractmethod
    def set_state(
        self, state: dict[str, Any], scene: Scene, sensor: RGBDSensor, start: Float64
    ) -> None:
        """Go on from a state that ``get_state`` returned in an episode that began at ``start``."""


class SensorFrames(FrameSource):
    """Every frame as the sensor takes it."""

    def begin(
        self, scene: Scene, sensor: RGBDSensor, T_world_camera: Float64, noise_seed: int
    ) -> None:
        """See the base class."""
        self._sensor, self._seed = sensor, noise_seed

    def set_out(self, times_s: Float64, poses: Float64) -> None:
        """Nothing depends on where the camera is between the frames."""

    def take(self, T_world_camera: Float64, index: int, time_s: float) -> RGBDFrame | None:
        """See the base class; every frame is delivered."""
        return self._sensor.capture(T_world_camera, index, time_s, self._seed)

    def true_depth(self) -> NDArray[np.float32]:
        """See the base class."""
        return self._sensor.last_true_depth()

    def get_state(self) -> dict[str, Any]:
        """See the base class."""
        return {"noise_seed": self._seed}

    def set_state(
        self, state: dict[str, Any], scene: Scene, sensor: RGBDSensor, start: Float64
    ) -> None:
        """See the base class."""
        self.begin(scene, sensor, start, state["noise_seed"])
