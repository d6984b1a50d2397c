"""Observation variants; they show only what the robot itself knows."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.camera import Intrinsics, intensity_image
from ms_slam_env.env.registry import POINT, Observation
from ms_slam_env.env.robot_knowledge import (
    DIVERGENCE_CAP,
    POSITION_SCALE_M,
    STATE_BOUNDS,
    RobotKnowledge,
    state_vector,
)
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert
from ms_slam_env.planning import (
    OccupancyGrid,
    expected_gain,
    held_gain,
    reachable_positions,
    surrounding_occupancy,
)
from ms_slam_env.planning.candidates import (
    GRID_HIGHS,
    GRID_LOWS,
    GRID_NAMES,
    HIGHS,
    LOWS,
    NAMES,
    candidate_numbers,
    grid_numbers,
)
from ms_slam_env.planning.goals_around import NUM_GOALS, gain_around
from ms_slam_env.planning.view_goals import GOAL_RADIUS_M, best_goal, distance_in_steps

CONFIGURATION = "slam_configuration"
"""Key of the SLAM configuration in ``info``, and in an observation of several parts."""

_MAX_DEPTH_M = 20.0
DEPTH_SCALE_M = 4.0
"""Unit of depth in vectors."""
DEPTH_CAP = _MAX_DEPTH_M / DEPTH_SCALE_M
"""Largest depth in vectors, in that unit."""
DEPTH_LEVEL_M = 0.02
"""Unit of depth in ``images``; 255 levels reach as far as a Kinect, 5 m."""
GREY_BINS = 16
"""Bins of the grey histogram of ``features``."""
ROWS, COLUMNS = 6, 8
"""Cells of the coarse depth of ``features``."""
_BLOCKS = (((10, 6, 10), 0.4), ((8, 4, 8), 1.2))  # around the camera: number, edge in metres
_GAIN_RAYS = (8, 6)
_GAIN_CAP_M3 = 20.0  # more than a view of 4 m holds
_HELD_STEPS, _HELD_DISCOUNT = 6, 0.93
_SMALLEST_STEP = 1e-6  # avoids a division by zero for a motion of length zero


_GOAL_LOW, _GOAL_HIGH = [-2.0] * 3 + [-1.0] * 3 + [0.0] * 2, [2.0] * 3 + [1.0] * 3 + [5.0] * 2


class RGBDObservation(Observation):
    """``color`` (H, W, 3) uint8, ``depth`` (H, W, 1) float32 metres, ``state`` (28,) float32."""

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        self.space = spaces.Dict(
            {
                "color": spaces.Box(0, 255, (*intrinsics.shape, 3), np.uint8),
                "depth": spaces.Box(0, _MAX_DEPTH_M, (*intrinsics.shape, 1), np.float32),
                "state": spaces.Box(*STATE_BOUNDS),
            }
        )

    def build(self, knowledge: RobotKnowledge) -> dict[str, Any]:
        """Return copies of the live images and the state vector."""
        return {
            "color": knowledge.frame.color.copy(),
            "depth": np.minimum(knowledge.frame.depth, _MAX_DEPTH_M)[..., None],
            "state": state_vector(knowledge),
        }


class ImagesObservation(Observation):
    """``image`` (4, H, W) uint8: red, green, blue, depth; ``state`` (28,) float32.

    What convolutional networks of other libraries take. A level of depth is `DEPTH_LEVEL_M`: 0
    where there is no reading, 1 to 254 for 2 cm to 5.08 m, 255 for what is farther.
    """

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        image = spaces.Box(0, 255, (4, *intrinsics.shape), np.uint8)
        self.space = spaces.Dict({"image": image, "state": spaces.Box(*STATE_BOUNDS)})

    def build(self, knowledge: RobotKnowledge) -> dict[str, Any]:
        """Return the images, channels first, and the state vector."""
        color, depth = knowledge.frame.color, knowledge.frame.depth
        levels = np.where(depth > 0, np.clip(np.rint(depth / DEPTH_LEVEL_M), 1, 255), 0)
        image = np.stack([*color.transpose(2, 0, 1), levels.astype(np.uint8)])
        return {"image": image, "state": state_vector(knowledge)}


class PixelsObservation(Observation):
    """State vector (28), then small colour and depth images, channel by channel: float32.

    Red, green, blue / 255 and depth / 4 m (4, 30, 40), each the mean over a block of the live
    image. Depth averages the valid readings of a block; 0 if it has none.
    """

    image_shape = (4, 30, 40)

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        pixels = self.image_shape[1] * self.image_shape[2]
        highs = [*(1,) * (3 * pixels), *(DEPTH_CAP,) * pixels]
        self.space = space = _longer(spaces.Box(*STATE_BOUNDS), highs)
        self._bounds = space.low, space.high

    def build(self, knowledge: RobotKnowledge) -> Float32:
        """Return the vector."""
        depth = np.minimum(knowledge.frame.depth, _MAX_DEPTH_M).astype(np.float32)
        color = self._small(knowledge.frame.color.astype(np.float32)) / 255
        readings = self._small((depth > 0).astype(np.float32))
        mean_depth = self._small(depth) / np.maximum(readings, 1e-6) / DEPTH_SCALE_M
        image = np.concatenate([color.transpose(2, 0, 1), mean_depth[None]])
        vector = np.concatenate([state_vector(knowledge), image.ravel()]).astype(np.float32)
        return np.clip(vector, *self._bounds)

    def _small(self, image: Float32) -> Float32:
        """Block means of an image (H, W, ...)."""
        _, rows, columns = self.image_shape
        small = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.float32)


class FeaturesObservation(Observation):
    """State vector (28), grey histogram (16), coarse depth (96), motion mask (n): float32."""

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        cells = ROWS * COLUMNS
        highs = [*(1,) * GREY_BINS, *(DEPTH_CAP,) * cells, *(1,) * (cells + num_motions)]
        self.space = _longer(spaces.Box(*STATE_BOUNDS), highs)

    def build(self, knowledge: RobotKnowledge) -> Float32:
        """Return the vector."""
        grey = intensity_image(knowledge.frame.color)
        histogram = np.bincount(grey.ravel() // (256 // GREY_BINS), minlength=GREY_BINS)
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
        self.space = _longer(self._features.space, [DIVERGENCE_CAP] * (2 * num_motions))

    def build(self, knowledge: RobotKnowledge) -> Float32:
        """Return the vector."""
        predicted = np.clip(knowledge.lookahead(), 0, DIVERGENCE_CAP)
        return np.concatenate(
            [self._features.build(knowledge), predicted.ravel().astype(np.float32)]
        )


class MapObservation(Observation):
    """``features``, the gain of each motion, and the occupancy around the camera: float32.

    After the features: each motion's `expected_gain` (n) relative to the largest, and the largest
    itself, m3; then free and occupied shares of blocks of 0.4 m (2 x 10 x 6 x 10) and of 1.2 m
    (2 x 8 x 4 x 8), from `surrounding_occupancy`.
    """

    needs_occupancy = True

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        self._intrinsics = intrinsics
        self._features = FeaturesObservation(intrinsics, num_motions)
        blocks = sum(2 * int(np.prod(count)) for count, _ in _BLOCKS)
        highs = [*(1,) * num_motions, _GAIN_CAP_M3, *(1,) * blocks]
        self.space = _longer(self._features.space, highs)

    def build(self, knowledge: RobotKnowledge) -> Float32:
        """Return the vector."""
        grid, poses = knowledge.occupancy, knowledge.candidates()
        assert grid is not None
        parts = _relative_gain(grid, poses, self._intrinsics)
        parts += [surrounding_occupancy(grid, knowledge.here, *each).ravel() for each in _BLOCKS]
        return np.concatenate([self._features.build(knowledge), *parts]).astype(np.float32)


class GoalsObservation(Observation):
    """Goals and motions rated by the occupancy grid and one predicted view: float32.

    The state: ``features`` without the mask (140), the world's up axis in the camera frame (3), the
    gain of the views of `planning.goals_around`, m3 (232), 0 where they cannot be reached through
    free space, the largest gain of a motion, m3, and the best goal as in ``candidates`` (8). Then
    ``planning.candidates.GRID_NAMES`` of each of the n motions, motion by motion.
    """

    needs_occupancy = True
    candidate_numbers = len(GRID_NAMES)

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        self._intrinsics = intrinsics
        space = _longer(FeaturesObservation(intrinsics, 0).space, [1] * 3, [-1] * 3)
        space = _longer(space, [_GAIN_CAP_M3] * (NUM_GOALS + 1))
        space = _longer(space, _GOAL_HIGH, _GOAL_LOW)
        self._features = FeaturesObservation(intrinsics, 0)
        self._state_bounds = space.low, space.high
        rows = np.tile(GRID_HIGHS, num_motions), np.tile(GRID_LOWS, num_motions)
        self.space = _longer(space, *rows)

    def build(self, knowledge: RobotKnowledge) -> Float32:
        """Return the vector."""
        state, numbers = self._parts(knowledge)
        return np.concatenate([state, numbers.ravel()]).astype(np.float32)

    def _parts(self, knowledge: RobotKnowledge) -> tuple[Float64, Float64]:
        """The state (k,), and the values of each motion (n, values)."""
        grid, poses, steps = knowledge.occupancy, knowledge.candidates(), _least(knowledge.steps)
        assert grid is not None
        here, camera = knowledge.here, self._intrinsics
        free = reachable_positions(grid, here[:3, 3], GOAL_RADIUS_M)
        goal = best_goal(grid, here, camera, steps, free)
        known = knowledge.motion_mask, grid, goal, camera, steps, knowledge.frames
        numbers, most = grid_numbers(here, poses, knowledge.view(), *known)
        features = self._features.build(knowledge)[: -len(knowledge.motion_mask)]
        parts: list[Any] = [features, here[2, :3]]
        parts += [gain_around(grid, here, camera, free), [most], _seen_goal(here, goal, steps)]
        return np.clip(np.concatenate(parts), *self._state_bounds), numbers


class HeldObservation(GoalsObservation):
    """``goals``, and the volume each motion would reveal if repeated for six steps: float32.

    Four more values per motion, from the gain that ``held-nbv`` uses (`planning.held_gain`): the
    revealed volume, discounted by 0.93 a step, relative to that of the best motion, and the volumes
    that steps 1-2, 3-4 and 5-6 reveal, m3.
    """

    candidate_numbers = len(GRID_NAMES) + 1 + _HELD_STEPS // 2

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        super().__init__(intrinsics, num_motions)
        held = [1.0, *(2 * _GAIN_CAP_M3,) * (_HELD_STEPS // 2)]
        state = spaces.Box(*self._state_bounds)
        lows = np.concatenate([GRID_LOWS, np.zeros(len(held))])
        rows = np.tile([*GRID_HIGHS, *held], num_motions), np.tile(lows, num_motions)
        self.space = _longer(state, *rows)
        self._cap = np.array(held)

    def _parts(self, knowledge: RobotKnowledge) -> tuple[Float64, Float64]:
        """See the base class."""
        state, numbers = super()._parts(knowledge)
        grid, here = knowledge.occupancy, knowledge.here
        assert grid is not None
        motions = invert(here) @ knowledge.candidates()
        gain = held_gain(grid, here, motions, _HELD_STEPS, self._intrinsics)
        worth = gain @ _HELD_DISCOUNT ** np.arange(_HELD_STEPS)
        pairs = gain.reshape(len(gain), -1, 2).sum(axis=2)
        held = np.column_stack([worth / max(worth.max(), 1e-9), pairs])
        return state, np.column_stack([numbers, np.minimum(held, self._cap)])


class CandidatesObservation(Observation):
    """A state of 37 values, then 18 for each of the n motions, candidate by candidate: float32.

    The state: the state vector (28), the largest expected gain of a motion, m3, and the best goal
    (`planning.view_goals.best_goal`): its position in the camera frame, in units of 5 m (3), its
    viewing direction (3), and its distance in steps of translation and of rotation, / 10 (2). The
    values of a motion are ``planning.candidates.NAMES``.
    """

    needs_occupancy = True
    candidate_numbers = len(NAMES)

    def __init__(self, intrinsics: Intrinsics, num_motions: int) -> None:
        self._intrinsics = intrinsics
        state = _longer(spaces.Box(*STATE_BOUNDS), [_GAIN_CAP_M3, *_GOAL_HIGH], [0, *_GOAL_LOW])
        self._state_bounds = state.low, state.high
        self.space = _longer(state, np.tile(HIGHS, num_motions), np.tile(LOWS, num_motions))

    def build(self, knowledge: RobotKnowledge) -> Float32:
        """Return the vector."""
        grid, predicted = knowledge.occupancy, knowledge.predicted()
        assert grid is not None
        here = predicted.poses[0]
        steps = _least(knowledge.steps)
        goal = best_goal(grid, here, self._intrinsics, steps)
        known = knowledge.motion_mask, grid, goal, self._intrinsics, steps
        numbers, most = candidate_numbers(predicted, *known)
        state: list[Any] = [state_vector(knowledge), [most], _seen_goal(here, goal, steps)]
        vector: Float64 = np.clip(np.concatenate(state), *self._state_bounds)
        return np.concatenate([vector, numbers.ravel()]).astype(np.float32)


class WithConfiguration(Observation):
    """Another observation, plus the current one of K SLAM configurations, one-hot (K,) float32.

    Added at the end of a vector, or as ``slam_configuration`` to an observation of several parts.
    """

    def __init__(self, observation: Observation, num_configurations: int) -> None:
        self._observation = observation
        self.needs_occupancy = observation.needs_occupancy
        self._one_hot = np.eye(num_configurations, dtype=np.float32)
        space = observation.space
        if isinstance(space, spaces.Dict):
            part = spaces.Box(0, 1, (num_configurations,), np.float32)
            self.space = spaces.Dict({**space.spaces, CONFIGURATION: part})
        else:
            self.space = _longer(space, [1] * num_configurations)

    def build(self, knowledge: RobotKnowledge) -> Any:
        """Return the extended observation."""
        observation = self._observation.build(knowledge)
        configuration = self._one_hot[knowledge.configuration]
        if isinstance(observation, dict):
            return {**observation, CONFIGURATION: configuration.copy()}
        return np.concatenate([observation, configuration])


def make_observation(
    name: str | type[Observation],
    intrinsics: Intrinsics,
    num_motions: int,
    num_configurations: int = 1,
) -> Observation:
    """Build variant ``name``, with the current SLAM configuration if there are several."""
    observation: Observation = POINT.find(name)(intrinsics, num_motions)
    if not isinstance(getattr(observation, "space", None), spaces.Space):
        raise InputError(f"observation {name!r} has no space; its constructor must set one")
    if num_configurations == 1:
        return observation
    return WithConfiguration(observation, num_configurations)


def _least(steps: tuple[float, float]) -> tuple[float, float]:
    """The length of a motion, bounded away from zero for division."""
    return max(steps[0], _SMALLEST_STEP), max(steps[1], _SMALLEST_STEP)


def _seen_goal(here: Float64, goal: Float64, steps: tuple[float, float]) -> Float64:
    """Position (3), viewing direction (3) and distance in steps (2) of a goal, as observed."""
    T_here_goal = invert(here) @ goal
    away = distance_in_steps(here[None], goal, *steps)[0]
    return np.concatenate([T_here_goal[:3, 3] / POSITION_SCALE_M, T_here_goal[:3, 2], away / 10])


def _relative_gain(grid: OccupancyGrid, poses: Float64, intrinsics: Intrinsics) -> list[Any]:
    """Expected gain of poses (n, 4, 4) relative to the largest (n,), and the largest (1,), m^3."""
    gain = expected_gain(grid, poses, intrinsics, _GAIN_RAYS)
    most = gain.max()
    return [gain / max(most, 1e-9), [min(most, _GAIN_CAP_M3)]]


def coarse_depth(depth: Float32) -> Float32:
    """Mean valid depth / 4 m and share of valid pixels in 6 x 8 cells, (96,) float32."""
    valid = (depth > 0).astype(np.float32)
    total, count, cell = (_cell_sums(image) for image in (depth, valid, np.ones_like(valid)))
    mean = np.minimum(total / np.maximum(count, 1) / DEPTH_SCALE_M, DEPTH_CAP)
    return np.concatenate([mean.ravel(), (count / cell).ravel()]).astype(np.float32)


def _cell_sums(image: Float32) -> Float32:
    """Sums (6, 8) over the cells of an image (H, W)."""
    rows = np.arange(ROWS) * image.shape[0] // ROWS
    columns = np.arange(COLUMNS) * image.shape[1] // COLUMNS
    return np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)


def _longer(
    space: spaces.Space[Any], highs: ArrayLike, lows: ArrayLike | None = None
) -> spaces.Box:
    """Extend a vector's space by values from ``lows``, or 0, to ``highs``."""
    assert isinstance(space, spaces.Box)
    high = np.asarray(highs, dtype=np.float32)
    low = np.zeros_like(high) if lows is None else np.asarray(lows, dtype=np.float32)
    return spaces.Box(np.concatenate([space.low, low]), np.concatenate([space.high, high]))
