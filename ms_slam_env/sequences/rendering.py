"""The frames of a rendered sequence, each rendered when it is asked for."""

from __future__ import annotations

import collections.abc
import dataclasses
from collections.abc import Iterable
from typing import overload

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor import ROLLING_ROWS, NoiseConfig, RGBDSensor, TrueView
from ms_slam_env.sensor.casters import make_caster
from ms_slam_env.sequences.exposure import LinearLight
from ms_slam_env.sequences.perturbations.base import (
    FrameSelection,
    ImagePerturbation,
    Moment,
    OpticalPerturbation,
    Optics,
    Perturbation,
    WorldPerturbation,
    random_numbers,
)
from ms_slam_env.sequences.perturbations.moving import Mover, bodies_of
from ms_slam_env.sequences.pose_interpolation import PoseInterpolation

Float64 = NDArray[np.float64]

_METERING_WIDTH = 40  # images whose brightness is what an exposure control goes by


class RenderedFrames(collections.abc.Sequence[RGBDFrame]):
    """Frames of a camera on a trajectory, a function of their index alone; none is kept.

    Attributes:
        kept: (N,) indices of the frames on the trajectory.
        timestamps: (N,) seconds.
        poses: (N, 4, 4) true T_world_camera, of the depth camera at the time stamp.
        object_trajectories: name -> (N, 4, 4) T_world_object of each object that moves.
    """

    def __init__(
        self,
        scene: Scene,
        trajectory: PoseInterpolation,
        intrinsics: Intrinsics,
        noise: str | NoiseConfig,
        seed: int,
        perturbations: Iterable[Perturbation],
    ) -> None:
        """Prepare to render.

        Raises:
            InputError: unknown noise model, a bad seed, or something that is no perturbation.
        """
        self._seed = seed
        self._trajectory = trajectory
        self._caster = make_caster(scene.mesh, "cpu")
        optics = Optics(intrinsics)
        movers: list[Mover] = []
        self._images: list[ImagePerturbation] = []
        self.kept = np.arange(len(trajectory.poses))
        for perturbation in perturbations:
            if isinstance(perturbation, FrameSelection):
                self.kept = self.kept[perturbation.keep(len(self.kept), seed)]
            elif isinstance(perturbation, WorldPerturbation):
                movers += perturbation.populate(scene, trajectory, intrinsics, seed)
            elif isinstance(perturbation, OpticalPerturbation):
                optics = perturbation.alter(optics)
            elif isinstance(perturbation, ImagePerturbation):
                self._images.append(perturbation)
            else:
                raise InputError(f"{perturbation!r} is not a perturbation")
        self.timestamps: Float64 = trajectory.times_s[self.kept]
        self.poses: Float64 = trajectory.poses[self.kept]
        self.object_trajectories = _trajectories(movers, self.timestamps)
        self._bodies = bodies_of(movers, scene)
        self._sensor = self._camera(scene, intrinsics, noise)
        self._optics = optics
        self._has_own_color_camera = optics.color != intrinsics or bool(
            (optics.T_depth_color != np.eye(4)).any()
        )
        self._color_sensor = self._sensor
        if self._has_own_color_camera:
            self._color_sensor = self._camera(scene, optics.color, noise)
        self._light = LinearLight(self._sensor.noise)
        self._brightness: Float64 | None = None

    def _camera(self, scene: Scene, K: Intrinsics, noise: str | NoiseConfig) -> RGBDSensor:
        return RGBDSensor(
            scene, K, noise=noise, seed=self._seed, caster=self._caster, bodies=self._bodies
        )

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.kept)

    @overload
    def __getitem__(self, index: int) -> RGBDFrame: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[RGBDFrame, ...]: ...

    def __getitem__(self, index: int | slice) -> RGBDFrame | tuple[RGBDFrame, ...]:
        """Render a frame, or several."""
        if isinstance(index, slice):
            return tuple(self[i] for i in range(len(self))[index])
        number = int(self.kept[index])
        frame = self._take(number)
        moment = self._moment(number)
        for perturbation in self._images:
            frame = perturbation.apply(frame, moment)
        return frame

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the objects in the scene, by the labels of ``truth``."""
        return self._sensor.labels

    def truth(self, index: int) -> TrueView:
        """Noise-free view (colour, depth, normals, labels, points) from the true pose of a frame.

        Nothing of it is perturbed: it is what a perfect camera sees at the time stamp, what moves
        through the scene included.
        """
        return self._sensor.ground_truth(self.poses[index], float(self.timestamps[index]))

    def _moment(self, number: int) -> Moment:
        return Moment(
            index=number,
            count=len(self._trajectory.poses),
            timestamp=float(self._trajectory.times_s[number]),
            intrinsics=self._sensor.intrinsics,
            seed=self._seed,
            brightness=self._metering,
        )

    def _take(self, number: int) -> RGBDFrame:
        """Take frame ``number`` of the trajectory with the optics; its images are not perturbed."""
        frame = self._expose(self._sensor, number, np.eye(4))
        if not self._has_own_color_camera and not self._optics.exposure_s:
            return frame
        color = frame.color
        if self._optics.exposure_s:
            color = self._blurred(number)
        elif self._has_own_color_camera:
            color = self._expose(self._color_sensor, number, self._optics.T_depth_color).color
        return dataclasses.replace(frame, color=color)

    def _expose(self, sensor: RGBDSensor, number: int, offset: Float64) -> RGBDFrame:
        """Frame of one of the two cameras, which stands at ``offset`` in the depth camera."""
        time = float(self._trajectory.times_s[number])
        if not self._optics.readout_s:
            return sensor.capture(self._trajectory.poses[number] @ offset, number, time)
        times = time + self._row_times()
        poses = self._trajectory(times) @ offset
        return sensor.capture_rolling(poses, number, time, row_times_s=times)

    def _row_times(self) -> Float64:
        """Times (rolling_poses,) of the rows that share a pose, after the frame's time stamp."""
        height = self._sensor.intrinsics.height
        first = ROLLING_ROWS * np.arange(self._sensor.rolling_poses)
        last = np.minimum(first + ROLLING_ROWS, height) - 1
        return self._optics.readout_s * ((0.5 * (first + last) + 0.5) / height - 0.5)

    def _blurred(self, number: int) -> NDArray[np.uint8]:
        """Colour integrated over the exposure, with the noise of one image."""
        optics = self._optics
        instants = (np.arange(optics.exposure_samples) + 0.5) / optics.exposure_samples - 0.5
        middles = self._trajectory.times_s[number] + optics.exposure_s * instants
        times = middles[:, None] + self._row_times()
        poses = self._trajectory(times) @ optics.T_depth_color
        colors = self._color_sensor.ideal_colors(poses, times)
        rng = random_numbers(self._seed, number, name="noise-of-blurred-colour")
        return self._light.mean(colors, rng)

    def _metering(self) -> Float64:
        """Mean intensity (count,) in [0, 255] from every pose of the trajectory."""
        if self._brightness is None:
            K = self._sensor.intrinsics
            small = K.scaled(min(1.0, _METERING_WIDTH / K.width))
            sensor = self._camera(self._sensor.scene, small, "none")
            self._brightness = np.array(
                [
                    intensity_image(sensor.capture(T, 0, time).color).mean()
                    for time, T in zip(
                        self._trajectory.times_s, self._trajectory.poses, strict=True
                    )
                ]
            )
        return self._brightness


def _trajectories(movers: Iterable[Mover], times_s: Float64) -> dict[str, Float64]:
    """Trajectory (N, 4, 4) of each mover, by name."""
    trajectories: dict[str, Float64] = {}
    for mover in movers:
        if mover.name in trajectories:
            raise InputError(
                f"two moving objects are called {mover.name!r}; use one moving-objects"
            )
        trajectories[mover.name] = mover.pose(times_s)
    return trajectories
