"""Frame-to-model tracking: the pose of the live frame relative to the rendered map.

ElasticFusion section IV, coarse to fine. In place of the paper's SO(3) pre-alignment, which finds
rotations only, several starting poses are aligned at the coarsest level with few points, and the
one that explains the frame best goes on. Nothing waits for the device before the decision.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert
from ms_slam_env.slam.shared.alignment_check import DeviceStatistics, DeviceThresholds
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel.acceptance import Alignment, assess_alignment
from ms_slam_env.slam.surfel.alignment_arrays import OFF, RUNNING
from ms_slam_env.slam.surfel.degeneracy import mat66d
from ms_slam_env.slam.surfel.device import HostDeviceBuffer, KernelLaunchCache
from ms_slam_env.slam.surfel.gauss_newton import GaussNewton, HypothesisBuffers
from ms_slam_env.slam.surfel.photometry import same_exposure
from ms_slam_env.slam.surfel.pose_hypotheses import NUM_FIRST, expand_hypotheses, select_hypothesis
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.pyramid import Level, Pyramid
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

SEARCH_POINTS = 400
SEARCH_ITERATIONS = 5
GOOD_SCORE = 0.4  # of a first hypothesis, which makes the other hypotheses needless
FINE_ITERATIONS = 11  # without the coarser levels
SPARSE = 0.3  # share of the points that all iterations but the last look at


def model_stride(intrinsics: Intrinsics, config: SurfelConfig) -> int:
    """Every how many-th row and column of the model view tracking looks at: 1, 2 or 4.

    The others need not be drawn. Coarse levels lose the mean of 2x2 pixels that the live image
    has there; discs overlap, so the model's view is smooth already.
    """
    stride = _point_stride(intrinsics.shape, config.points_per_level)
    return max(s for s in (1, 2, 4) if s <= stride)


def _point_stride(shape: tuple[int, int], points: float) -> int:
    """Step between rows and columns that picks about so many pixels of an image."""
    return max(1, round((shape[0] * shape[1] / points) ** 0.5))


class Tracker:
    """Aligns live frames with model views for B envs; owns the device buffers."""

    def __init__(
        self,
        batch: int,
        num_hypotheses: int,
        intrinsics: Intrinsics,
        config: SurfelConfig,
        device: str = "cpu",
        model_stride: int = 1,
    ) -> None:
        """Allocate for ``batch`` envs that each try ``num_hypotheses`` starting poses a frame.

        The model views hold every ``model_stride``-th row and column of the image (1, 2, 4).
        """
        self.config = config
        self.device = device
        self.batch = batch
        num_levels = len(config.iterations)
        cameras = [intrinsics.pyramid_level(level) for level in range(num_levels)]
        self._live = Pyramid(batch, [camera.shape for camera in cameras], True, device)
        # A level takes the model's image of its own spacing, or else the finest.
        skipped = model_stride.bit_length() - 1
        self._model_level = [max(0, level - skipped) for level in range(num_levels)]
        drawn = intrinsics.every_nth(model_stride)
        shapes = [drawn.pyramid_level(n).shape for n in range(self._model_level[-1] + 1)]
        self._model_shapes = [shapes[level] for level in self._model_level]
        self._model = Pyramid(batch, shapes, False, device)
        self.gauss_newton = GaussNewton(config, cameras, self._model_shapes, device)
        passes = [(level, self._stride(level)) for level in range(num_levels)]
        slots = self.gauss_newton.slots([*passes, (num_levels - 1, self._search_stride())])

        # The last of the first is the guess.
        self._first = HypothesisBuffers(batch, NUM_FIRST + 1, slots, device)
        self._more = HypothesisBuffers(batch, num_hypotheses - NUM_FIRST, slots, device)
        self._one = HypothesisBuffers(batch, 1, slots, device)
        self._launches = KernelLaunchCache(device)
        self.good_score = GOOD_SCORE
        self._thresholds = HostDeviceBuffer(batch, DeviceThresholds, device)
        self._T_world_model = HostDeviceBuffer(batch, wp.mat44d, device)
        self._predicted = HostDeviceBuffer(batch, wp.mat44d, device)
        self._T_world_live = HostDeviceBuffer(batch, wp.mat44d, device)
        self._status = HostDeviceBuffer(batch, wp.int32, device)
        self._statistics = HostDeviceBuffer(batch, DeviceStatistics, device)
        self._covariance = HostDeviceBuffer(batch, mat66d, device)
        self._live_levels: list[Level] = []

    def _stride(self, level: int, share: float = 1.0) -> int:
        return _point_stride(self._model_shapes[level], share * self.config.points_per_level)

    def _search_stride(self) -> int:
        return _point_stride(self._model_shapes[-1], SEARCH_POINTS)

    def set_frame(self, live: LiveFrame) -> None:
        """Build the pyramid of the live frames; ``align`` may then be called several times."""
        self._live_levels = self._live.build(live.vertices, live.normals, live.intensity)

    def align(
        self,
        model: ModelView,
        T_world_model: Float64,
        hypotheses: Float64,
        thresholds: NDArray[np.void],
        guesses: Float64 | None = None,
        photometry: NDArray[Any] | None = None,
    ) -> Alignment:
        """Align the frames set before with ``model``.

        Args:
            model: rendered at ``T_world_model``.
            T_world_model: (B, 4, 4).
            hypotheses: (B, K, 4, 4) starting poses T_model_live.
            thresholds: (B,) structured array of ``DeviceThresholds``.
            guesses: (B, 4, 4) one more starting pose T_world_live, NaN for an env without; None
                if no env has one.
            photometry: (B,) ``Photometry`` to start from; exposed like the model if None.
        """
        self._set_model(model, T_world_model, thresholds)
        self._start_from(hypotheses, T_world_model, guesses)
        photometry = same_exposure(self.batch) if photometry is None else photometry
        for state in (self._first, self._more):
            state.photometry.write(photometry[:, None])
        self._search()
        self._refine(len(self._model_level) - 1, self.config.iterations)
        return self._evaluate()

    def refine(
        self,
        model: ModelView,
        T_world_model: Float64,
        starts: Float64,
        thresholds: NDArray[np.void],
        photometry: NDArray[Any],
    ) -> Alignment:
        """Align at the finest level alone, from one pose (B, 4, 4) T_model_live; see ``align``."""
        self._set_model(model, T_world_model, thresholds)
        self._predicted.write(starts)
        self._one.poses.write(starts[:, None])
        self._one.photometry.write(photometry[:, None])
        self._one.states.write(np.full((self.batch, 1), RUNNING, dtype=np.int32))
        self._refine(0, (FINE_ITERATIONS,))
        return self._evaluate()

    def _set_model(
        self, model: ModelView, T_world_model: Float64, thresholds: NDArray[np.void]
    ) -> None:
        images = self._model.build(model.vertices, model.normals, model.intensity)
        self.gauss_newton.set_images(
            self._live_levels, [images[index] for index in self._model_level]
        )
        self._T_world_model.write(T_world_model)
        self._thresholds.write(thresholds)

    def _start_from(
        self, hypotheses: Float64, T_world_model: Float64, guesses: Float64 | None
    ) -> None:
        """Set the poses of all hypotheses; an env without a guess leaves that one out."""
        states = np.full((self.batch, NUM_FIRST + 1), OFF, dtype=np.int32)
        states[:, :NUM_FIRST] = RUNNING
        starts = np.zeros((self.batch, NUM_FIRST + 1, 4, 4))
        starts[:, :NUM_FIRST] = hypotheses[:, :NUM_FIRST]
        predicted = starts[:, NUM_FIRST - 1].copy()  # at constant velocity, or the guess
        if guesses is not None:
            given = np.isfinite(guesses[:, 0, 0])
            starts[given, NUM_FIRST] = (invert(T_world_model) @ guesses)[given]
            states[given, NUM_FIRST] = RUNNING
            predicted[given] = starts[given, NUM_FIRST]
        self._predicted.write(predicted)
        self._first.poses.write(starts)
        self._first.states.write(states)
        self._more.poses.write(hypotheses[:, NUM_FIRST:])

    def _search(self) -> None:
        """Align hypotheses at the coarsest level on few points; the best one goes on.

        Most frames need the first hypotheses only; the others run where those fit badly.
        """
        first, more, one = self._first, self._more, self._one
        self._settle(first)
        self._launches.launch(
            "expand",
            expand_hypotheses,
            lambda: (self.batch, [first.arrays, more.arrays, self.good_score]),
        )
        if more.running():
            self._settle(more)
        self._launches.launch(
            "select",
            select_hypothesis,
            lambda: (self.batch, [first.arrays, more.arrays, one.arrays]),
        )

    def _settle(self, state: HypothesisBuffers) -> None:
        """A few steps for every active hypothesis, and the sums at the pose they lead to."""
        coarsest, stride = len(self._model_level) - 1, self._search_stride()
        self.gauss_newton.iterate(coarsest, stride, state, SEARCH_ITERATIONS, ends_with_sums=True)

    def _refine(self, coarsest: int, iterations: Sequence[int]) -> None:
        """Align the one hypothesis from the coarsest level to the finest."""
        for level in range(coarsest, -1, -1):
            last = int(level == 0)  # the last iteration sees more points than the others
            count = iterations[level] - last
            self.gauss_newton.iterate(level, self._stride(level, SPARSE), self._one, count)
        # The decision is on what the last step starts from, which has all but converged.
        step = min(iterations[0], 1)
        self.gauss_newton.iterate(0, self._stride(0), self._one, step, ends_with_sums=step == 0)

    def _evaluate(self) -> Alignment:
        one, given = self._one, (self._predicted, self._thresholds, self._T_world_model)
        found = (self._T_world_live, self._status, self._statistics, self._covariance)
        arrays = [buffer.array for buffer in (*given, *found)]
        self._launches.launch(
            "assess", assess_alignment, lambda: (self.batch, [one.arrays, *arrays])
        )
        return Alignment(
            T_world_live=self._T_world_live.read(),
            T_model_live=self._one.poses.read()[:, 0],
            status=self._status.read(),
            statistics=self._statistics.read(),
            photometry=self._one.photometry.read()[:, 0],
            covariance=self._covariance.read(),
        )
