"""Apply perturbations to the environment's frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Distortion, RGBDFrame, xtion
from ms_slam_env.env.camera_feed import CameraFeed
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences.perturbations.movers import Mover
from ms_slam_env.sequences.perturbations.perturbation import Perturbation
from ms_slam_env.sequences.perturbed_camera import Imperfections, PerturbedCamera
from ms_slam_env.sequences.trajectory import PoseInterpolation
from ms_slam_env.slam.shared.state_check import MOST, SEED, ListOf, Real

_EPISODE_FRAMES = 151  # the first and one per step: effects that span a sequence end here
_NEAREST_M = 0.35  # moving objects come no nearer to the camera than this


class PerturbedFeed(CameraFeed):
    """Applies perturbations to each frame, by the same rules as in a rendered sequence.

    Between frames of one motion the camera's pose is interpolated by ``PoseInterpolation``; after
    the last frame the motion continues. Moving objects begin where the start camera can see them,
    and wait rather than hit the camera.
    """

    state_like: ClassVar[Mapping[str, Any]] = {
        "noise_seed": SEED,
        "brightness": ListOf(Real(0, 255), "metered"),
        "waits": ListOf(ListOf((0.0, Real(0, MOST)))),
    }

    def __init__(self, perturbations: tuple[Perturbation, ...]) -> None:
        """Set the perturbations.

        Raises:
            InputError: a perturbation that changes how the camera moves; the agent decides that.
        """
        self.perturbations = perturbations
        self._imperfections = Imperfections.of(perturbations)
        if self._imperfections.motion:
            raise InputError(
                "fast-motion changes a path that is known; in an environment the agent moves the "
                "camera: make an id with FastMotion in its name, or give larger step_m and step_rad"
            )
        self._began: tuple[Any, ...] = ()
        self._brightness: list[float] = []
        self._movers: list[Mover] = []

    def begin(
        self, scene: Scene, sensor: RGBDSensor, T_world_camera: Float64, noise_seed: int
    ) -> None:
        """See the base class; camera and moving objects may be in the scene already."""
        self._path = PoseInterpolation([0.0], T_world_camera[None])
        began = (scene.name, scene.seed, noise_seed, T_world_camera.tobytes())
        if began != self._began:
            self._began = ()
            self._enter(scene, sensor, noise_seed)
            self._began = began
        self._brightness = []
        for mover in self._movers:
            mover.set_state([])

    def _enter(self, scene: Scene, sensor: RGBDSensor, noise_seed: int) -> None:
        """Put the camera and moving objects into the scene."""
        self._seed = noise_seed
        given = (scene, self._path, sensor.intrinsics, noise_seed)
        self._movers = self._imperfections.movers(*given)
        light = self._imperfections.changing_light(*given)
        self._camera = PerturbedCamera(
            scene,
            sensor.intrinsics,
            sensor.noise,
            self._imperfections,
            self._movers,
            light,
            sensor,
            sensor.caster,
        )

    def set_trajectory(self, times_s: Float64, poses: Float64) -> None:
        """See the base class; objects that would come too near to the camera wait.

        Raises:
            InputError: the perturbations were added after the episode began.
        """
        self._check_begun()
        self._path = PoseInterpolation(times_s, poses)
        for k in range(1, len(times_s)):
            here, before, now = poses[k : k + 1, :3, 3], times_s[k - 1], times_s[k]
            for mover in self._movers:
                if mover.distance(here, times_s[k : k + 1])[0] < _NEAREST_M:
                    mover.wait(float(before), float(now - before))

    def capture(self, T_world_camera: Float64, index: int, time_s: float) -> RGBDFrame | None:
        """See the base class."""
        if not self._is_delivered(index):
            return None
        count = max(_EPISODE_FRAMES, index + 1)
        return self._camera.take(
            self._path,
            time_s,
            index,
            count,
            self._seed,
            lambda: self._meter(T_world_camera, index, time_s),
        )

    def _is_delivered(self, index: int) -> bool:
        """Whether frame ``index`` is kept rather than dropped, given the frames before it."""
        kept = np.arange(index + 1)
        for selection in self._imperfections.selection:
            kept = kept[selection.keep(len(kept), self._seed)]
            if kept[-1] != index:
                return index == 0
        return True

    def _meter(self, T_world_camera: Float64, index: int, time_s: float) -> Float64:
        """Mean intensity (index + 1,) of the frames so far; a dropped one repeats the last."""
        if len(self._brightness) <= index:
            now = self._camera.brightness(T_world_camera, time_s)
            gap = index - len(self._brightness)
            self._brightness += [self._brightness[-1] if self._brightness else now] * gap
            self._brightness.append(now)
        return np.array(self._brightness)

    def true_depth(self) -> NDArray[np.float32]:
        """See the base class."""
        return self._camera.last_true_depth(moving=False)

    @property
    def lens(self) -> Distortion:
        """See the base class."""
        return self._imperfections.optics_of(xtion("80x60")).lens

    @property
    def movers(self) -> tuple[Mover, ...]:
        """The moving objects, with their poses by time."""
        return tuple(self._movers)

    @property
    def has_begun(self) -> bool:
        """See the base class."""
        return bool(self._began)

    def _check_begun(self) -> None:
        if not self.has_begun:
            raise InputError(
                "a perturbation was put on after the episode began: call env.reset() first"
            )

    def get_state(self) -> dict[str, Any]:
        """See the base class.

        Raises:
            InputError: the perturbations were added after the episode began.
        """
        self._check_begun()
        return {
            "noise_seed": self._seed,
            "brightness": list(self._brightness),
            "waits": [mover.get_state() for mover in self._movers],
        }

    def set_state(
        self, state: dict[str, Any], scene: Scene, sensor: RGBDSensor, start: Float64
    ) -> None:
        """See the base class."""
        super().set_state(state, scene, sensor, start)
        self._brightness = [float(value) for value in state["brightness"]]
        for mover, waits in zip(self._movers, state["waits"], strict=True):
            mover.set_state(waits)
