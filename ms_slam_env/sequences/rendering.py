"""Sequences rendered in a scene, frame by frame on request."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import FRAME_RATE_HZ, NoiseConfig, TrueView
from ms_slam_env.sequences.perturbations.perturbation import Perturbation, random_numbers
from ms_slam_env.sequences.perturbed_camera import Imperfections, PerturbedCamera
from ms_slam_env.sequences.sequence import Frames, Sequence
from ms_slam_env.sequences.trajectory import PoseInterpolation


class RenderedFrames(Frames):
    """Frames of a camera on a trajectory; each depends on its index alone, and none is stored.

    Attributes:
        kept: (N,) indices of the frames on the trajectory, after retiming.
        timestamps: (N,) seconds.
        poses: (N, 4, 4) true T_world_camera of the depth camera at the time stamp.
        object_trajectories: (N, 4, 4) T_world_object of each moving object by name.
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
            InputError: unknown noise model, a bad seed, something that is not a perturbation, or no
                free route for a moving object.
        """
        random_numbers(seed, name="check of the seed")
        self._seed = seed
        imperfections = Imperfections.of(perturbations)
        for motion in imperfections.motion:
            trajectory = motion.retime(trajectory, seed)
        self._trajectory = trajectory
        self.kept = np.arange(len(trajectory.poses))
        for selection in imperfections.selection:
            self.kept = self.kept[selection.keep(len(self.kept), seed)]
        self.timestamps: Float64 = trajectory.times_s[self.kept]
        self.poses: Float64 = trajectory.poses[self.kept]
        movers = imperfections.movers(scene, trajectory, intrinsics, seed)
        light = imperfections.changing_light(scene, trajectory, intrinsics, seed)
        self.object_trajectories: dict[str, Float64] = {
            mover.name: mover.pose(self.timestamps) for mover in movers
        }
        self._camera = PerturbedCamera(scene, intrinsics, noise, imperfections, movers, light)
        self._brightness: Float64 | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.kept)

    def frame(self, index: int) -> RGBDFrame:
        """Render a frame."""
        number = int(self.kept[index])
        return self._camera.take(
            self._trajectory,
            float(self._trajectory.times_s[number]),
            number,
            len(self._trajectory.poses),
            self._seed,
            self._metering,
        )

    def picked(self, indices: NDArray[np.integer]) -> RenderedFrames:
        """Select the frames with these numbers (M,), unchanged."""
        some = copy.copy(self)
        some.kept, some.timestamps = self.kept[indices], self.timestamps[indices]
        some.poses = self.poses[indices]
        some.object_trajectories = {
            name: poses[indices] for name, poses in self.object_trajectories.items()
        }
        return some

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the objects in the scene; indexed by the labels of ``truth``."""
        return self._camera.sensor.labels

    def truth(self, index: int) -> TrueView:
        """Noise-free view (colour, depth, normals, labels, points) from the true pose of a frame.

        It is not perturbed: it shows what a perfect camera sees at the time stamp, including moving
        objects and the light at that time.
        """
        return self._camera.sensor.ground_truth(self.poses[index], float(self.timestamps[index]))

    def _metering(self) -> Float64:
        """Mean intensity (count,) in [0, 255] from every pose of the trajectory."""
        if self._brightness is None:
            path = zip(self._trajectory.poses, self._trajectory.times_s, strict=True)
            self._brightness = np.array(
                [self._camera.brightness(T, float(time)) for T, time in path]
            )
        return self._brightness


@dataclass(frozen=True)
class RenderedSequence(Sequence):
    """A sequence whose frames are rendered on request.

    Attributes:
        frames: the renderer; ``frames.truth(index)`` is the noise-free view from a frame's pose,
            ``frames.kept`` (N,) the frames' indices on the trajectory, ``frames.timestamps`` (N,).
    """

    frames: RenderedFrames

    @property
    def timestamps(self) -> Float64:
        """(N,) seconds."""
        return self.frames.timestamps

    def true_depth(self, index: int) -> NDArray[np.float32]:
        """Noise-free depth (H, W) in metres from the true pose of frame ``index``."""
        return self.frames.truth(index).depth

    def picked(self, indices: NDArray[np.integer]) -> RenderedSequence:
        """Select the frames with these numbers (M,), increasing."""
        frames = self.frames.picked(indices)
        return replace(self, frames=frames, poses=frames.poses)


def render_sequence(
    scene: Scene,
    trajectory: ArrayLike,
    intrinsics: Intrinsics,
    noise: str | NoiseConfig = "kinect",
    seed: int = 0,
    name: str | None = None,
    *,
    perturbations: Iterable[Perturbation] = (),
    timestamps: ArrayLike | None = None,
) -> RenderedSequence:
    """Render one frame from every pose of a trajectory, except those that a perturbation skips.

    Args:
        scene: the scene.
        trajectory: (N, 4, 4) T_world_camera of the depth camera.
        intrinsics: intrinsics of the frames.
        noise: noise model of the sensor: "kinect", "none" or a NoiseConfig.
        seed: seed of noise and perturbations: equal arguments give equal frames, bit for bit, in
            whatever order they are rendered.
        name: name for tables and files.
        perturbations: applied in this order; first those that select frames, then those of the
            optics, then those of the images.
        timestamps: (N,) seconds; index / 30 Hz by default.

    Raises:
        InputError: a bad pose, time or seed, an unknown noise model, or something that is not a
            perturbation.
    """
    poses = np.asarray(trajectory, dtype=np.float64)
    times = np.arange(len(poses)) / FRAME_RATE_HZ if timestamps is None else timestamps
    path = PoseInterpolation(times, poses)
    frames = RenderedFrames(scene, path, intrinsics, noise, seed, perturbations)
    return RenderedSequence(frames, frames.poses, intrinsics, name or f"{scene.name}-{scene.seed}")
