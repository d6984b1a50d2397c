"""A camera that flies freely and arrives exactly where it was sent."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import UnreachableError
from ms_slam_env.geometry import invert
from ms_slam_env.robot.action_primitives import (
    NUM_ROTATIONS,
    NUM_TRANSLATIONS,
    TRANSLATION_DIRECTIONS,
    decompose,
)
from ms_slam_env.robot.embodiment import Embodiment, HasClearance, MotionResult, parts_of
from ms_slam_env.scenes.scene import Scene, outside, words

CAMERA_RADIUS_M = 0.1  # half the width of an ASUS Xtion (18 cm), rounded up
_LOOKED_AT_M = 0.05  # between points checked along a path in a known world
_STOPS = 32  # places at which a blocked motion may end


def check_room(scene: Scene, T_world_camera: Float64) -> Float64:
    """Return a copy of the pose (4, 4) if the camera's bounding ball is free there.

    Raises:
        UnreachableError: it is not.
    """
    position = T_world_camera[:3, 3]
    if scene.clearance(position[None])[0] < CAMERA_RADIUS_M:
        where = outside(scene, position)
        raise UnreachableError(
            f"no free space of {CAMERA_RADIUS_M} m around {words(position)} in scene {scene.name}"
            + (f": it lies {where}" if where else "")
        )
    return np.array(T_world_camera, dtype=np.float64)


class FreeCamera(Embodiment):
    """The 49 motions of the paper's decomposition, each made exactly.

    Args:
        scene: the scene to move in.
        step_m, step_rad: translation and rotation of a motion.
        frames: number of frames taken on a motion, the last at its end.
    """

    num_actions = NUM_TRANSLATIONS * NUM_ROTATIONS

    def __init__(self, scene: Scene, step_m: float, step_rad: float, frames: int = 1) -> None:
        self.scene = scene
        self.step_m = step_m
        self._frames = frames
        self._motions = decompose(step_m, step_rad)
        self._motions.flags.writeable = False
        self._masks: NDArray[np.bool_] | None = None  # of the current pose
        self.T_world_camera = np.eye(4)

    def reset(self, T_world_camera: Float64, rng: np.random.Generator) -> None:
        """Put the camera at a start pose (4, 4).

        Raises:
            UnreachableError: something is in the way.
        """
        self.T_world_camera = check_room(self.scene, T_world_camera)
        self._masks = None

    def candidate_motions(self) -> Float64:
        """The 49 motions ``T_camera_next`` (49, 4, 4), the same everywhere."""
        return self._motions

    def action_masks(self) -> NDArray[np.bool_]:
        """(49,) whether the bounding ball can move to each target; only translation matters."""
        if self._masks is None:
            R, position = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
            ends = (position + self.step_m * TRANSLATION_DIRECTIONS @ R.T)[1:]
            free = self.scene.segments_are_free(position, ends, CAMERA_RADIUS_M)
            self._masks = np.repeat([True, *free], NUM_ROTATIONS)
        return self._masks.copy()

    def masks_in(self, world: HasClearance, T_world_camera: Float64) -> NDArray[np.bool_]:
        """(49,) masks in a known world; a camera already too near may not come nearer."""
        R, position = T_world_camera[:3, :3], T_world_camera[:3, 3]
        ways = self.step_m * TRANSLATION_DIRECTIONS @ R.T
        parts = max(1, math.ceil(self.step_m / _LOOKED_AT_M))
        places = position + np.linspace(0, 1, parts + 1)[:, None, None] * ways
        room = world.clearance(places.reshape(-1, 3)).reshape(places.shape[:2])
        needed = CAMERA_RADIUS_M + 0.5 * self.step_m / parts
        free = (room >= np.minimum(needed, room[0])).all(axis=0)
        return np.repeat(free, NUM_ROTATIONS)

    def move(self, action: int) -> MotionResult:
        """Make motion ``action`` unless it is blocked."""
        made = bool(self.action_masks()[action])
        motion = self._motions[action] if made else np.eye(4)
        result = MotionResult.along(made, self.T_world_camera, motion, self._frames)
        if made:
            self.T_world_camera = result.T_world_camera[-1].copy()
            self._masks = None
        return result

    def move_by(self, twist: Float64) -> MotionResult:
        """Move by a twist (6,), or by the part of it, in 32nds, for which the ball is free."""
        shares, motions = parts_of(twist, _STOPS)
        R, position = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        ends = position + motions[:, :3, 3] @ R.T
        if twist[:3].any() and not self.scene.segment_is_free(position, ends[-1], CAMERA_RADIUS_M):
            free = self.scene.segments_are_free(position, ends[:-1], CAMERA_RADIUS_M)
            motions = np.stack([np.eye(4), *motions[:-1][free]])
            shares = np.append(0.0, shares[:-1][free])
        share, start = float(shares[-1]), self.T_world_camera
        result = MotionResult.along(share == 1, start, motions[-1], self._frames, share)
        self.T_world_camera = result.T_world_camera[-1].copy()
        self._masks = None
        return result

    def get_state(self) -> dict[str, Any]:
        """The pose."""
        return {"T_world_camera": self.T_world_camera.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
        self.T_world_camera = state["T_world_camera"].copy()
        self._masks = None


class FixedTranslation(Embodiment):
    """The paper's second simulation: straight-line translation, and a choice of rotation.

    The line's direction is drawn at the start among those with the most room. Where the camera
    would collide it reverses along the same line. Arguments as for `FreeCamera`.
    """

    num_actions = NUM_ROTATIONS
    _DIRECTIONS_TRIED = 16

    def __init__(self, scene: Scene, step_m: float, step_rad: float, frames: int = 1) -> None:
        self.scene = scene
        self.step_m = step_m
        self._frames = frames
        self._rotations = decompose(0.0, step_rad)[:NUM_ROTATIONS]
        self.T_world_camera = np.eye(4)
        self._direction = np.zeros(3)

    def reset(self, T_world_camera: Float64, rng: np.random.Generator) -> None:
        """Put the camera at a start pose (4, 4) and choose the longest of 16 level lines.

        Raises:
            UnreachableError: something is in the way.
        """
        self.T_world_camera = check_room(self.scene, T_world_camera)
        offset = rng.uniform(0, 2 * np.pi)
        angles = offset + np.arange(self._DIRECTIONS_TRIED) * 2 * np.pi / self._DIRECTIONS_TRIED
        directions = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
        self._direction = max(directions, key=self._free_steps)

    def steps_ahead(self, most: int = 100) -> int:
        """Steps along the line, at most ``most``, before it reverses."""
        return self._free_steps(self._direction, most)

    def _free_steps(self, direction: Float64, most: int = 100) -> int:
        position = self.T_world_camera[:3, 3]
        for steps in range(most):
            following = position + self.step_m * direction
            if not self.scene.segment_is_free(position, following, CAMERA_RADIUS_M):
                return steps
            position = following
        return most

    def _translation(self) -> Float64:
        """The next step (3,) along the line in the world frame; zero if both ways are blocked."""
        position = self.T_world_camera[:3, 3]
        for direction in (self._direction, -self._direction):
            step = self.step_m * direction
            if self.scene.segment_is_free(position, position + step, CAMERA_RADIUS_M):
                return step
        return np.zeros(3)

    def candidate_motions(self) -> Float64:
        """The 7 motions ``T_camera_next`` (7, 4, 4): one translation, seven rotations."""
        motions = self._rotations.copy()
        motions[:, :3, 3] = invert(self.T_world_camera)[:3, :3] @ self._translation()
        return motions

    def action_masks(self) -> NDArray[np.bool_]:
        """(7,) all true: rotation is always possible, and the line reverses by itself."""
        return np.ones(NUM_ROTATIONS, dtype=bool)

    def move(self, action: int) -> MotionResult:
        """Step along the line and turn; always possible."""
        step, motion = self._translation(), self.candidate_motions()[action]
        result = MotionResult.along(True, self.T_world_camera, motion, self._frames)
        self.T_world_camera = result.T_world_camera[-1].copy()
        if step @ self._direction < 0:
            self._direction = -self._direction
        return result

    def get_state(self) -> dict[str, Any]:
        """The pose and the line."""
        return {"T_world_camera": self.T_world_camera.copy(), "direction": self._direction.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
        self.T_world_camera = state["T_world_camera"].copy()
        self._direction = state["direction"].copy()
