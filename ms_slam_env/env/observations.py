"""Observation variants: they show only what the robot itself has."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.robot import NUM_ROTATIONS, NUM_TRANSLATIONS

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

CONFIGURATION = "slam_configuration"
"""Key of the SLAM configuration in ``info``, and in an observation of several parts."""

NUM_STATE = 3 + 6 + 2 + 3 + NUM_TRANSLATIONS + NUM_ROTATIONS

_POSITION_SCALE_M = 5.0
_DIVERGENCE_CAP = 5.0  # in units of M_I, M_D
_MAX_DEPTH_M = 20.0
_DEPTH_SCALE_M = 4.0
_GREY_BINS = 16
_ROWS, _COLUMNS = 6, 8


@dataclass(frozen=True)
class RobotKnowledge:
    """What the robot knows after a step.

    Attributes:
        frame: the last live frame.
        T_start_camera: (4, 4) estimated pose relative to the start.
        divergence: (2,) of the last two live frames, in units of (M_I, M_D).
        tracking_ok: SLAM's own word on its last frame.
        inlier_fraction: share of pixels that the alignment explained.
        lost_share: consecutive steps lost, as a share of the patience.
        motion: the last motion as an index of the 49, of the 7 rotations alone where the
            translation is fixed, also where it was blocked; 0 before the first.
        motion_mask: (n,) which motions are possible now.
        configuration: index of the SLAM configuration in force; 0 where there is only one.
        lookahead: predicts the divergences (n, 2) of the candidates, in units of (M_I, M_D).
    """

    frame: RGBDFrame
    T_start_camera: Float64
    divergence: Float64
    tracking_ok: bool
    inlier_fraction: float
    lost_share: float
    motion: int
    motion_mask: NDArray[np.bool_]
    configuration: int
    lookahead: Callable[[], Float64]


class Observation(ABC):
    """One observation variant."""

    space: spaces.Space[Any]

    @abstractmethod
    def build(self, knowledge: RobotKnowledge) -> Any:
        """Return the observation, an element of ``space``."""


class RGBDObservation(Observation):
    """``color`` (H, W, 3) uint8, ``depth`` (H, W) float32 metres, ``state`` (28,) float32."""

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        self.space = spaces.Dict(
            {
                "color": spaces.Box(0, 255, (*intrinsics.shape, 3), np.uint8),
                "depth": spaces.Box(0, _MAX_DEPTH_M, intrinsics.shape, np.float32),
                "state": _unbounded(NUM_STATE),
            }
        )

    def build(self, knowledge: RobotKnowledge) -> dict[str, Any]:
        """Return copies of the live images and the state vector."""
        return {
            "color": knowledge.frame.color.copy(),
            "depth": np.minimum(knowledge.frame.depth, _MAX_DEPTH_M),
            "state": state_vector(knowledge),
        }


class FeaturesObservation(Observation):
    """State vector (28), grey histogram (16), coarse depth (96), motion mask (n): float32."""

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        self.space = _unbounded(NUM_STATE + _GREY_BINS + 2 * _ROWS * _COLUMNS + num_motions)

    def build(self, knowledge: RobotKnowledge) -> Float32:
        """Return the vector."""
        grey = intensity_image(knowledge.frame.color)
        histogram = np.bincount(grey.ravel() // (256 // _GREY_BINS), minlength=_GREY_BINS)
        return np.concatenate(
            [
                state_vector(knowledge),
                histogram.astype(np.float32) / grey.size,
                coarse_depth(knowledge.frame.depth),
                knowledge.motion_mask.astype(np.float32),
            ]
        )


class LookaheadObservation(Observation):
    """``features`` followed by the n x 2 predicted divergences / (M_I, M_D), clipped at 5."""

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        self._features = FeaturesObservation(intrinsics, num_motions)
        self.space = _longer(self._features.space, 2 * num_motions)

    def build(self, knowledge: RobotKnowledge) -> Float32:
        """Return the vector."""
        predicted = np.minimum(knowledge.lookahead(), _DIVERGENCE_CAP)
        return np.concatenate(
            [self._features.build(knowledge), predicted.ravel().astype(np.float32)]
        )


class WithConfiguration(Observation):
    """Another observation and which of K SLAM configurations is in force, one-hot (K,) float32.

    At the end of a vector, or as ``slam_configuration`` of an observation of several parts.
    """

    def __init__(self, observation: Observation, num_configurations: int) -> None:
        self._observation = observation
        self._one_hot = np.eye(num_configurations, dtype=np.float32)
        space = observation.space
        if isinstance(space, spaces.Dict):
            part = spaces.Box(0, 1, (num_configurations,), np.float32)
            self.space = spaces.Dict({**space.spaces, CONFIGURATION: part})
        else:
            self.space = _longer(space, num_configurations)

    def build(self, knowledge: RobotKnowledge) -> Any:
        """Return the observation with its new part."""
        observation = self._observation.build(knowledge)
        configuration = self._one_hot[knowledge.configuration]
        if isinstance(observation, dict):
            return {**observation, CONFIGURATION: configuration.copy()}
        return np.concatenate([observation, configuration])


OBSERVATIONS: dict[str, Callable[[Intrinsics, int], Observation]] = {
    "rgbd": RGBDObservation,
    "features": FeaturesObservation,
    "lookahead": LookaheadObservation,
}
"""Name of the option ``observation`` to variant."""


def make_observation(
    name: str, intrinsics: Intrinsics, num_motions: int, num_configurations: int = 1
) -> Observation:
    """Build variant ``name``, with the SLAM configuration in force if there are several."""
    observation = OBSERVATIONS[name](intrinsics, num_motions)
    if num_configurations == 1:
        return observation
    return WithConfiguration(observation, num_configurations)


def state_vector(knowledge: RobotKnowledge) -> Float32:
    """Pose estimate, divergences, tracking and last motion, (28,) float32 of order one.

    Position / 5 m (3), first two columns of the rotation (6), divergences / M clipped at 5 (2),
    tracking_ok, inlier fraction, lost share (3), last translation (7) and rotation (7) one-hot.
    """
    translation, rotation = divmod(knowledge.motion, NUM_ROTATIONS)
    return np.concatenate(
        [
            knowledge.T_start_camera[:3, 3] / _POSITION_SCALE_M,
            knowledge.T_start_camera[:3, :2].T.ravel(),
            np.minimum(knowledge.divergence, _DIVERGENCE_CAP),
            [knowledge.tracking_ok, knowledge.inlier_fraction, knowledge.lost_share],
            np.eye(NUM_TRANSLATIONS)[translation],
            np.eye(NUM_ROTATIONS)[rotation],
        ]
    ).astype(np.float32)


def coarse_depth(depth: Float32) -> Float32:
    """Mean valid depth / 4 m and share of valid pixels in 6 x 8 cells, (96,) float32."""
    valid = (depth > 0).astype(np.float32)
    total, count, cell = (_cell_sums(image) for image in (depth, valid, np.ones_like(valid)))
    mean = total / np.maximum(count, 1) / _DEPTH_SCALE_M
    return np.concatenate([mean.ravel(), (count / cell).ravel()]).astype(np.float32)


def _cell_sums(image: Float32) -> Float32:
    """Sums (6, 8) over the cells of an image (H, W)."""
    rows = np.arange(_ROWS) * image.shape[0] // _ROWS
    columns = np.arange(_COLUMNS) * image.shape[1] // _COLUMNS
    return np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)


def _unbounded(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


def _longer(space: spaces.Space[Any], more: int) -> spaces.Box:
    assert isinstance(space, spaces.Box)
    return _unbounded(space.shape[0] + more)
