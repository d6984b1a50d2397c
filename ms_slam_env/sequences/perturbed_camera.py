"""An imperfect camera on any path, shared by rendered sequences and environments."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import ROLLING_ROWS, ChangingLight, NoiseConfig, RGBDSensor
from ms_slam_env.sensor.casters import RayCaster, make_caster
from ms_slam_env.sequences.perturbations.movers import Mover, bodies_of
from ms_slam_env.sequences.perturbations.optics import LinearLight
from ms_slam_env.sequences.perturbations.perturbation import (
    FrameSelection,
    ImagePerturbation,
    LightPerturbation,
    Moment,
    MotionPerturbation,
    OpticalPerturbation,
    Optics,
    Perturbation,
    WorldPerturbation,
    random_numbers,
)
from ms_slam_env.sequences.trajectory import PoseInterpolation

_METERING_WIDTH = 40  # columns of the images that exposure control measures


@dataclasses.dataclass(frozen=True)
class Imperfections:
    """Perturbations sorted by what they change, each kind in the given order."""

    motion: tuple[MotionPerturbation, ...]
    selection: tuple[FrameSelection, ...]
    world: tuple[WorldPerturbation, ...]
    light: tuple[LightPerturbation, ...]
    optics: tuple[OpticalPerturbation, ...]
    images: tuple[ImagePerturbation, ...]

    @staticmethod
    def of(perturbations: Iterable[Perturbation]) -> Imperfections:
        """Sort perturbations.

        Raises:
            InputError: something is not a perturbation, or two change the light.
        """
        given = tuple(perturbations)
        kinds = (
            MotionPerturbation,
            FrameSelection,
            WorldPerturbation,
            LightPerturbation,
            OpticalPerturbation,
            ImagePerturbation,
        )
        for perturbation in given:
            if not isinstance(perturbation, kinds):
                raise InputError(f"{perturbation!r} is not a perturbation")
        sorted_out = [tuple(p for p in given if isinstance(p, kind)) for kind in kinds]
        if len(sorted_out[3]) > 1:
            raise InputError("only one perturbation can change the light: give illumination once")
        return Imperfections(*sorted_out)  # type: ignore[arg-type]

    def optics_of(self, intrinsics: Intrinsics) -> Optics:
        """The optics of a camera with these imperfections."""
        optics = Optics(intrinsics)
        for perturbation in self.optics:
            optics = perturbation.alter(optics)
        return optics

    def movers(
        self, scene: Scene, path: PoseInterpolation, intrinsics: Intrinsics, seed: int
    ) -> list[Mover]:
        """The objects that move through the scene while the camera follows its path.

        Raises:
            InputError: no free route, or two objects with one name.
        """
        movers: list[Mover] = []
        for perturbation in self.world:
            movers += perturbation.populate(scene, path, intrinsics, seed, tuple(movers))
        names = [mover.name for mover in movers]
        if len(set(names)) < len(names):
            raise InputError("two moving-objects of one kind: give it once, with a larger count")
        return movers

    def changing_light(
        self, scene: Scene, path: PoseInterpolation, intrinsics: Intrinsics, seed: int
    ) -> ChangingLight | None:
        """How the light changes; None if it does not."""
        return next((p.light(scene, path, intrinsics, seed) for p in self.light), None)


class PerturbedCamera:
    """Captures frames with imperfect optics in a scene with moving objects and changing light.

    Attributes:
        sensor: sensor of a perfect camera at the depth camera's pose.
        lens: distortion of the depth and the colour camera.
    """

    def __init__(
        self,
        scene: Scene,
        intrinsics: Intrinsics,
        noise: str | NoiseConfig,
        imperfections: Imperfections,
        movers: Iterable[Mover] = (),
        light: ChangingLight | None = None,
        sensor: RGBDSensor | None = None,
        caster: RayCaster | None = None,
    ) -> None:
        """Prepare to render.

        Args:
            scene: the scene.
            intrinsics: intrinsics of the frames.
            noise: noise model of the sensor.
            imperfections: those of optics and images are used.
            movers: objects that move through the scene.
            light: how the scene's light changes.
            sensor: an existing sensor in the scene; used if nothing moves or changes there.
            caster: ray caster for the scene.

        Raises:
            InputError: unknown noise model.
        """
        self._scene, self._light = scene, light
        self._bodies = bodies_of(list(movers), scene)
        self._caster = caster
        is_still = not self._bodies and light is None
        self.sensor = sensor if sensor is not None and is_still else self._camera(intrinsics, noise)
        self._images = imperfections.images
        self._optics = optics = imperfections.optics_of(intrinsics)
        self._has_own_color_camera = optics.color != intrinsics or bool(
            (optics.T_depth_color != np.eye(4)).any()
        )
        self.lens = optics.lens
        self._depth_sensor = self.sensor
        if self.lens:
            self._depth_sensor = self._camera(self._bent(intrinsics), noise)
        self._color_sensor = self._depth_sensor
        if self._has_own_color_camera:
            self._color_sensor = self._camera(self._bent(optics.color), noise)
        self._linear_light = LinearLight(self.sensor.noise)
        self._meter: RGBDSensor | None = None

    def _bent(self, K: Intrinsics) -> Intrinsics:
        return dataclasses.replace(K, distortion=self.lens)

    def _camera(self, K: Intrinsics, noise: str | NoiseConfig) -> RGBDSensor:
        if self._caster is None:
            self._caster = make_caster(self._scene.mesh, "cpu")
        return RGBDSensor(
            self._scene, K, noise=noise, caster=self._caster, bodies=self._bodies, light=self._light
        )

    def take(
        self,
        path: PoseInterpolation,
        time_s: float,
        index: int,
        count: int,
        seed: int,
        brightness: Callable[[], Float64],
    ) -> RGBDFrame:
        """Capture a frame at a time on a path.

        Args:
            path: the camera's path around that time.
            time_s: time stamp.
            index: number of the frame; also the counter of its noise.
            count: number of frames, for perturbations that span the whole sequence.
            seed: seed of noise and perturbations.
            brightness: see ``Moment``.
        """
        frame = self._take(path, time_s, index, seed)
        moment = Moment(index, count, time_s, self.sensor.intrinsics, seed, brightness)
        for perturbation in self._images:
            frame = perturbation.apply(frame, moment)
        return frame

    def last_true_depth(self, moving: bool = True) -> NDArray[np.float32]:
        """True depth (H, W) of the last frame; see ``RGBDSensor``."""
        return self._depth_sensor.last_true_depth(moving)

    def brightness(self, T_world_camera: Float64, time_s: float) -> float:
        """Mean intensity in [0, 255] of the view from a pose (4, 4) at a time."""
        if self._meter is None:
            K = self.sensor.intrinsics
            small = K.scaled(min(1.0, _METERING_WIDTH / K.width))
            self._meter = self._camera(small, "none")
        color = self._meter.capture(T_world_camera, 0, time_s).color
        return float(intensity_image(color).mean())

    def _take(self, path: PoseInterpolation, time_s: float, index: int, seed: int) -> RGBDFrame:
        """Capture a frame with the optics, before image perturbations."""
        color = None
        if self._optics.exposure_s:
            color = self._blurred(path, time_s, index, seed)
        elif self._has_own_color_camera:
            offset = self._optics.T_depth_color
            color = self._expose(self._color_sensor, path, time_s, index, seed, offset).color
        frame = self._expose(self._depth_sensor, path, time_s, index, seed, np.eye(4))
        return frame if color is None else dataclasses.replace(frame, color=color)

    def _expose(
        self,
        sensor: RGBDSensor,
        path: PoseInterpolation,
        time_s: float,
        index: int,
        seed: int,
        offset: Float64,
    ) -> RGBDFrame:
        """Frame of one of the two cameras, at pose ``offset`` in the depth camera's frame."""
        if not self._optics.readout_s:
            return sensor.capture(path(time_s) @ offset, index, time_s, seed)
        times = time_s + self._row_times()
        return sensor.capture_rolling(path(times) @ offset, index, time_s, seed, times)

    def _row_times(self) -> Float64:
        """Times (rolling_poses,) of row groups with one pose, relative to the time stamp."""
        height = self.sensor.intrinsics.height
        first = ROLLING_ROWS * np.arange(self.sensor.rolling_poses)
        last = np.minimum(first + ROLLING_ROWS, height) - 1
        return self._optics.readout_s * ((0.5 * (first + last) + 0.5) / height - 0.5)

    def _blurred(
        self, path: PoseInterpolation, time_s: float, index: int, seed: int
    ) -> NDArray[np.uint8]:
        """Colour integrated over the exposure, with the noise of one image."""
        optics = self._optics
        instants = (np.arange(optics.exposure_samples) + 0.5) / optics.exposure_samples - 0.5
        middles = time_s + optics.exposure_s * instants
        times = middles[:, None] + self._row_times()
        colors = self._color_sensor.ideal_colors(path(times) @ optics.T_depth_color, times)
        rng = random_numbers(seed, index, name="noise-of-blurred-colour")
        return self._linear_light.mean(colors, rng)
