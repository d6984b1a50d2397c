"""Frame-to-model tracking: the pose of the live frame relative to the rendered map.

ElasticFusion section IV, coarse to fine. In place of the paper's SO(3) pre-alignment, which finds
rotations only, several starting poses are aligned at the coarsest level with few points, and the
one that explains the frame best goes on. Nothing waits for the device before the decision.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert
from ms_slam_env.slam.shared.alignment_check import DeviceStatistics, DeviceThresholds
from ms_slam_env.slam.surfel.acceptance import Alignment, assess_alignment
from ms_slam_env.slam.surfel.device import KernelLaunchCache, SavedBuffer, threads_per_row
from ms_slam_env.slam.surfel.normal_equations import (
    NUM_SUMS,
    OFF,
    RUNNING,
    AlignedImages,
    Hypotheses,
    Photometry,
    Weights,
    accumulate_normal_equations,
)
from ms_slam_env.slam.surfel.photometry import same_exposure
from ms_slam_env.slam.surfel.pose_hypotheses import NUM_FIRST, expand_hypotheses, select_hypothesis
from ms_slam_env.slam.surfel.preprocessing import Level, LiveFrame, Pyramid
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.solver import gauss_newton_step, iterate_at_once, mat66d, reduce_sums
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

SMALLEST_STEP = (2.0e-4, 4.0e-4, 1.0e-3)  # metres and radians, per level, finest first
DAMPING = 1.0e-6
COARSE_TOLERANCE = 2.5
LATERAL_NOISE_PX = 0.3  # standard deviation of where a grey value was sampled
DEPTH_REDUNDANCY = 50.0  # see normal_equations
Passes = Sequence[tuple[int, int]]


class HypothesisBuffers:
    """Host-device buffers of K hypotheses per env."""

    def __init__(self, batch: int, k: int, slots: int, device: str) -> None:
        self.poses = SavedBuffer((batch, k), wp.mat44d, device)
        self.states = SavedBuffer((batch, k), wp.int32, device)
        self.photometry = SavedBuffer((batch, k), Photometry, device)
        arrays = Hypotheses()
        arrays.pose, arrays.state = self.poses.array, self.states.array
        arrays.photometry = self.photometry.array
        arrays.partial = wp.zeros((batch, k, slots, NUM_SUMS), dtype=wp.float32, device=device)
        arrays.sums = wp.zeros((batch, k, NUM_SUMS), dtype=wp.float64, device=device)
        self.arrays, self.shape = arrays, (batch, k)
        is_cpu = wp.get_device(device).is_cpu
        self._state_on_host = arrays.state.numpy() if is_cpu else None  # shares the memory

    def running(self) -> bool:
        """Whether a hypothesis may still move; always True on a GPU, where asking would stall."""
        return self._state_on_host is None or bool((self._state_on_host == RUNNING).any())


class GaussNewton:
    """Moves pose hypotheses of B envs towards the minimum of the cost, level by level.

    Attributes:
        at_once: whether one launch makes all iterations of a level, which is faster on a CPU.
    """

    def __init__(
        self,
        config: SurfelConfig,
        cameras: Sequence[Intrinsics],
        model_shapes: Sequence[tuple[int, int]],
        device: str,
    ) -> None:
        """Iterate at levels, finest first, with these cameras and shapes of the model's images."""
        self.at_once = wp.get_device(device).is_cpu
        self._cameras, self._model_shapes = cameras, model_shapes
        self._weights = [weights_of(config, level) for level in range(len(cameras))]
        self._columns, _ = threads_per_row(1 << 20, device, gpu_columns=32)
        self._launches = KernelLaunchCache(device)
        self._live: Sequence[Level] = ()
        self._model: Sequence[Level] = ()

    def slots(self, passes: Passes) -> int:
        """Partial sums of the largest of some passes, each a level and a stride."""
        return max(self._slots(*one) for one in passes)

    def _slots(self, level: int, stride: int) -> int:
        height, width = self._model_shapes[level]
        return -(-height // stride) * -(-width // min(self._columns, width))

    def set_images(self, live: Sequence[Level], model: Sequence[Level]) -> None:
        """Set the images to align, one per level; drop launches recorded for other arrays."""
        if not (_are_same(live, self._live) and _are_same(model, self._model)):
            self._launches.clear()
        self._live, self._model = live, model

    def iterate(
        self,
        level: int,
        stride: int,
        hypotheses: HypothesisBuffers,
        count: int,
        ends_with_sums: bool = False,
    ) -> None:
        """Make at most ``count`` iterations at one level on every ``stride``-th row and column.

        Converged hypotheses become active again at the end. The sums are those before the last
        step or, if asked for, after it.
        """
        key = (level, stride, id(hypotheses))
        if self.at_once:
            self._launches.launch(
                (*key, count, ends_with_sums),
                iterate_at_once,
                partial(self._iterations, level, stride, hypotheses, count, ends_with_sums),
            )
            return
        for iteration in range(count):
            self._accumulate(level, stride, hypotheses)
            is_last = iteration == count - 1
            self._launches.launch(
                ("step", is_last, *key),
                gauss_newton_step,
                partial(self._step, level, hypotheses, is_last),
            )
        if ends_with_sums:
            self._accumulate(level, stride, hypotheses)

    def _accumulate(self, level: int, stride: int, hypotheses: HypothesisBuffers) -> None:
        """Accumulate and reduce the sums of every active hypothesis."""
        key = (level, stride, id(hypotheses))
        slots = self._slots(level, stride)
        self._launches.launch(
            ("accumulate", *key),
            accumulate_normal_equations,
            partial(self._accumulation, level, stride, hypotheses),
        )
        self._launches.launch(
            ("reduce", *key),
            reduce_sums,
            lambda: ((*hypotheses.shape, NUM_SUMS), [hypotheses.arrays, slots]),
        )

    # Threads and arguments of the kernels, as ``KernelLaunchCache`` records them.

    def _iterations(
        self, level: int, stride: int, hypotheses: HypothesisBuffers, count: int, with_sums: bool
    ) -> tuple[tuple[int, int], list[Any]]:
        _, inputs = self._accumulation(level, stride, hypotheses)
        rule = [DAMPING, _smallest_step(level), count, int(with_sums)]
        return hypotheses.shape, [*inputs, *rule]

    def _accumulation(
        self, level: int, stride: int, hypotheses: HypothesisBuffers
    ) -> tuple[tuple[int, ...], list[Any]]:
        camera, model, live = self._cameras[level], self._model[level], self._live[level]
        height, width = self._model_shapes[level]
        rows = -(-height // stride)
        images = AlignedImages()
        for name in ("vertices", "normals", "intensity"):
            setattr(images, f"model_{name}", getattr(model, name).flatten())
        for name in ("vertices", "normals", "gradient"):
            setattr(images, f"live_{name}", getattr(live, name).flatten())
        images.model_size = wp.vec2i(width, height)
        images.live_size = wp.vec2i(camera.width, camera.height)
        images.focal, images.centre = wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy)
        columns = min(self._columns, width)
        inputs = [images, self._weights[level], stride, columns, hypotheses.arrays]
        return (*hypotheses.shape, rows, self._slots(level, stride) // rows), inputs

    def _step(
        self, level: int, hypotheses: HypothesisBuffers, is_last: bool
    ) -> tuple[tuple[int, int], list[Any]]:
        rule = [DAMPING, _smallest_step(level), int(is_last), self._weights[level].least_scale]
        return hypotheses.shape, [hypotheses.arrays, *rule]


def _are_same(levels: Sequence[Level], others: Sequence[Level]) -> bool:
    return len(levels) == len(others) and all(map(operator.is_, levels, others))


def _smallest_step(level: int) -> float:
    return SMALLEST_STEP[min(level, len(SMALLEST_STEP) - 1)]


def weights_of(config: SurfelConfig, level: int) -> Weights:
    """Scales and rules of the residuals at a level of the pyramid, 0 the finest."""
    # Far from the solution large residuals carry the information: coarse levels are tolerant.
    widening = COARSE_TOLERANCE**level
    weights = Weights()
    weights.icp = (1.0 - config.icp_rgb_weight) / DEPTH_REDUNDANCY
    weights.rgb = config.icp_rgb_weight
    weights.per_depth_noise = 1.0 / config.depth_noise_m
    weights.per_cauchy_icp = 1.0 / (config.cauchy_icp * widening)
    weights.per_cauchy_rgb = 1.0 / (config.cauchy_rgb * widening)
    weights.grey_variance = config.intensity_noise**2
    weights.pixel_variance = LATERAL_NOISE_PX**2
    weights.distance_m = config.icp_distance_m
    weights.cos_angle = float(np.cos(np.radians(config.icp_angle_deg)))
    for rule in ("inlier_sigmas", "conflict_sigmas", "texture", "photometric_inlier"):
        setattr(weights, rule, getattr(config.acceptance, rule))
    weights.least_scale = config.cauchy_rgb * widening
    return weights


SEARCH_POINTS = 400
SEARCH_ITERATIONS = 5
GOOD_SCORE = 0.4  # score of a first hypothesis that makes the others unnecessary
FINE_ITERATIONS = 11  # without the coarser levels
SPARSE = 0.3  # share of the points used by all iterations but the last


def model_stride(intrinsics: Intrinsics, config: SurfelConfig) -> int:
    """Step between the rows and columns of the model view that tracking uses: 1, 2 or 4.

    The others need not be drawn. Unlike the live image, coarse levels then lack the mean of 2x2
    pixels; discs overlap, so the model's view is smooth already.
    """
    stride = _point_stride(intrinsics.shape, config.points_per_level)
    return max(s for s in (1, 2, 4) if s <= stride)


def _point_stride(shape: tuple[int, int], points: float) -> int:
    """Step between rows and columns that picks about ``points`` pixels of an image."""
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
        searched = self.gauss_newton.slots([(num_levels - 1, self._search_stride())])

        # The last of the first is the guess.
        self._first = HypothesisBuffers(batch, NUM_FIRST + 1, searched, device)
        self._more = HypothesisBuffers(batch, num_hypotheses - NUM_FIRST, searched, device)
        self._one = HypothesisBuffers(batch, 1, self.gauss_newton.slots(passes), device)
        self._launches = KernelLaunchCache(device)
        self.good_score = GOOD_SCORE
        self._thresholds = SavedBuffer(batch, DeviceThresholds, device)
        self._T_world_model = SavedBuffer(batch, wp.mat44d, device)
        self._predicted = SavedBuffer(batch, wp.mat44d, device)
        self._T_world_live = SavedBuffer(batch, wp.mat44d, device)
        self._status = SavedBuffer(batch, wp.int32, device)
        self._statistics = SavedBuffer(batch, DeviceStatistics, device)
        self._covariance = SavedBuffer(batch, mat66d, device)
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
        return self._evaluate(thresholds)

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
        return self._evaluate(thresholds)

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
        """Align hypotheses at the coarsest level on few points; select the best one.

        Most frames need only the first hypotheses; the others run if those fit badly.
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

    def _evaluate(self, thresholds: NDArray[np.void]) -> Alignment:
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
            thresholds=thresholds.copy(),
        )
