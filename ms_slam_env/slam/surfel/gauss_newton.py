"""Gauss-Newton iterations at the levels of an image pyramid: launches of ``solver``'s kernels."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.alignment_arrays import (
    NUM_SUMS,
    RUNNING,
    AlignedImages,
    Hypotheses,
    Photometry,
    Weights,
)
from ms_slam_env.slam.surfel.device import HostDeviceBuffer, KernelLaunchCache, threads_per_row
from ms_slam_env.slam.surfel.normal_equations import accumulate_normal_equations
from ms_slam_env.slam.surfel.pyramid import Level
from ms_slam_env.slam.surfel.solver import gauss_newton_step, iterate_at_once, reduce_sums
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

SMALLEST_STEP = (2.0e-4, 4.0e-4, 1.0e-3)  # metres and radians, per level, finest first
DAMPING = 1.0e-6
COARSE_TOLERANCE = 2.5
DEPTH_REDUNDANCY = 50.0  # see normal_equations
Passes = Sequence[tuple[int, int]]


class HypothesisBuffers:
    """Host-device buffers of K hypotheses per env."""

    def __init__(self, batch: int, k: int, slots: int, device: str) -> None:
        self.poses = HostDeviceBuffer((batch, k), wp.mat44d, device)
        self.states = HostDeviceBuffer((batch, k), wp.int32, device)
        self.photometry = HostDeviceBuffer((batch, k), Photometry, device)
        arrays = Hypotheses()
        arrays.pose, arrays.state = self.poses.array, self.states.array
        arrays.photometry = self.photometry.array
        arrays.partial = wp.zeros((batch, k, slots, NUM_SUMS), dtype=wp.float32, device=device)
        arrays.sums = wp.zeros((batch, k, NUM_SUMS), dtype=wp.float64, device=device)
        self.arrays, self.shape = arrays, (batch, k)
        is_cpu = wp.get_device(device).is_cpu
        self._state_on_host = arrays.state.numpy() if is_cpu else None  # shares the memory

    def running(self) -> bool:
        """Whether a hypothesis may still move; on a GPU always True: asking would mean waiting."""
        return self._state_on_host is None or bool((self._state_on_host == RUNNING).any())


class GaussNewton:
    """Moves pose hypotheses of B envs towards the minimum of the cost, level by level.

    Attributes:
        at_once: whether one launch makes all iterations of a level, as a CPU likes it.
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
        """Align these, a level each; the launches recorded for other arrays are forgotten."""
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
        """At most ``count`` iterations at one level on every ``stride``-th row and column.

        Hypotheses that converged wake in the end. The sums are then those where the last step
        started, or, if asked for, where it led to.
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
    weights.pixel_variance = config.lateral_noise_px**2
    weights.distance_m = config.icp_distance_m
    weights.cos_angle = float(np.cos(np.radians(config.icp_angle_deg)))
    for rule in ("inlier_sigmas", "conflict_sigmas", "texture", "photometric_inlier"):
        setattr(weights, rule, getattr(config.acceptance, rule))
    weights.least_scale = config.cauchy_rgb * widening
    return weights
