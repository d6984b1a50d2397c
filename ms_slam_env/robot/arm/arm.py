"""An arm that holds the camera: base pose, candidate motions and their mask; without physics."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.timings import Timings
from ms_slam_env.geometry import invert
from ms_slam_env.robot.action_primitives import NUM_MOTIONS, decompose
from ms_slam_env.robot.arm.arm_config import ArmConfig
from ms_slam_env.robot.arm.base_placement import place_arm, reach_m, standing_chain
from ms_slam_env.robot.arm.clearance import ClearanceField, LinkClearance
from ms_slam_env.robot.arm.feasibility import LIMIT_MARGIN_RAD, Feasibility, FeasibilityResult
from ms_slam_env.robot.arm.inverse_kinematics import solve_pose
from ms_slam_env.robot.arm.model import load_arm
from ms_slam_env.robot.embodiment import Embodiment, HasClearance, MotionResult, parts_of
from ms_slam_env.scenes.scene import Scene


def frame_times(duration_s: float, config: ArmConfig) -> Float64:
    """Seconds (k,) after the start of a motion at which its frames are taken, the last at its end.

    With ``frames_per_action = k`` they divide the duration into k equal parts; a motion without
    duration takes k camera periods. Otherwise they arrive at ``camera_hz``, at least one, and the
    arm rests from the motion's end until the last of them, less than one period later.
    """
    k = config.frames_per_action
    if k is not None and duration_s > 0:
        return duration_s * np.arange(1, k + 1) / k
    if k is None:
        k = max(1, int(np.ceil(duration_s * config.camera_hz - 1e-6)))
    return np.arange(1, k + 1) / config.camera_hz


_STOPS = 16  # places at which a motion that is not possible as a whole may end


class ArmEmbodiment(Embodiment):
    """An arm on a fixed base, with the paper's 49 motions of the camera it holds.

    Attributes:
        scene: the world.
        config: of the arm.
        timings: charged with the stage ``mask``.
        model: the arm.
        chain: ``model.chain``, plus the column below the base if there is one.
        motions: (49, 4, 4) the candidate motions ``T_camera_next``.
        T_world_base: (4, 4) pose of the base.
        clearance_field: distances to furniture around it.
        feasibility: checks which motions are possible.
        q: (n,) current joint angles.
        T_world_camera: (4, 4) current camera pose.
    """

    num_actions = NUM_MOTIONS

    def __init__(
        self, scene: Scene, config: ArmConfig, step_m: float, step_rad: float, timings: Timings
    ) -> None:
        self.scene = scene
        self.config = config
        self.timings = timings
        self.model = load_arm(config.model, config.camera_site, config.joint_speed_rad_s)
        self.chain = standing_chain(self.model, config)
        self.motions = decompose(step_m, step_rad)
        self.motions.flags.writeable = False
        self.T_world_base = np.eye(4)
        self.set_joints(self.model.home)

    def reset(self, T_world_camera: Float64, rng: np.random.Generator) -> None:
        """Put the arm where it can hold the camera at a start pose (4, 4).

        Raises:
            UnreachableError: the camera cannot be held there; the message says why.
        """
        T_world_base, q = place_arm(self.model, self.scene, T_world_camera, self.config)
        self.stand_at(T_world_base)
        self.start_at(q, rng)

    def stand_at(self, T_world_base: Float64) -> None:
        """Move the base to a pose (4, 4) and build the clearance field around it."""
        self.T_world_base = np.array(T_world_base, dtype=np.float64)
        self.clearance_field = ClearanceField(self.scene, self.T_world_base, reach_m(self.chain))
        self.feasibility = Feasibility(self.chain, self.clearance_field, self.config)

    def start_at(self, q: Float64, rng: np.random.Generator) -> None:
        """Hold the arm at rest at joint angles (n,) at the start of an episode."""
        self.set_joints(q)

    def set_joints(self, q: Float64) -> None:
        """Set the joint angles (n,)."""
        self.q = np.array(q, dtype=np.float64)
        self.T_world_camera = self.T_world_base @ self.chain.camera_pose(self.q)
        self._probe: FeasibilityResult | None = None

    def planning_state(self) -> tuple[Float64, Float64]:
        """Joint angles (n,) and camera ``T_base_camera`` (4, 4) that motions are planned from.

        The arm's own belief; the truth for an arm without errors.
        """
        return self.q, self.chain.camera_pose(self.q)

    def probe(self) -> FeasibilityResult:
        """Check which of the 49 motions are possible from here, and how; cached per position."""
        if self._probe is None:
            with self.timings.stage("mask"):
                q, T_base_camera = self.planning_state()
                self._probe = self.feasibility.probe(q, T_base_camera @ self.motions)
        return self._probe

    @property
    def frames_per_motion(self) -> int:
        """Frames of the motion of median length among those possible from here."""
        probe = self.probe()
        durations = probe.duration_s[probe.ok & (probe.duration_s > 0)]
        return len(frame_times(float(np.median(durations)) if len(durations) else 0.0, self.config))

    def candidate_motions(self) -> Float64:
        """The 49 motions ``T_camera_next`` (49, 4, 4), the same everywhere."""
        return self.motions

    def action_masks(self) -> NDArray[np.bool_]:
        """(49,) whether the arm reaches each target on a straight line without collision."""
        return self.probe().ok.copy()

    def masks_in(self, world: HasClearance, T_world_camera: Float64) -> NDArray[np.bool_]:
        """(49,) masks in a known world, where the camera pose determines the base pose."""
        with self.timings.stage("mask"):
            q, T_base_camera = self.planning_state()
            T_world_base = T_world_camera @ invert(T_base_camera)
            known = ClearanceField(world, T_world_base, reach_m(self.chain))
            return (
                Feasibility(self.chain, known, self.config)
                .probe(q, T_base_camera @ self.motions)
                .ok
            )

    def free_part(self, twist: Float64) -> tuple[float, Float64, Float64, float]:
        """The longest part, in 16ths, of a motion by a twist (6,) that is possible from here.

        Returns:
            its share, 0 if there is none; the motion ``T_camera_next`` (4, 4); joint angles (W, n)
            along it; its duration in seconds.
        """
        shares, motions = parts_of(twist, _STOPS)
        parts = self.probe().q.shape[1] - 1  # as many as for one of the 49 motions
        with self.timings.stage("mask"):
            q, T_base_camera = self.planning_state()
            found = self.feasibility.probe(q, T_base_camera @ motions, parts)
        if not found.ok.any():
            return 0.0, np.eye(4), found.q[0, :1], 0.0
        k = int(np.flatnonzero(found.ok)[-1])
        return float(shares[k]), motions[k], found.q[k], float(found.duration_s[k])

    def get_state(self) -> dict[str, Any]:
        """The base pose and the joint angles; the rest follows from them."""
        return {"T_world_base": self.T_world_base.copy(), "q": self.q.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Resume from a state that ``get_state`` returned."""
        self.stand_at(state["T_world_base"])
        self.set_joints(state["q"])


class KinematicArm(ArmEmbodiment):
    """An arm with limits, furniture and speed, but without mass and errors."""

    def move(self, action: int) -> MotionResult:
        """Make motion ``action`` if possible, with the frames that arrive meanwhile.

        Action 0 and a masked action rest for one camera period, or for ``frames_per_action``
        periods.
        """
        probe = self.probe()
        made = bool(probe.ok[action])
        duration = float(probe.duration_s[action]) if made else 0.0
        poses, times = self._follow(self.motions[action], probe.q[action], duration)
        return MotionResult(made, poses, poses.copy(), times)

    def move_by(self, twist: Float64) -> MotionResult:
        """Move by a twist (6,), or by the part of it that is possible; see ``free_part``."""
        share, motion, waypoints, duration = self.free_part(twist)
        poses, times = self._follow(motion, waypoints, duration)
        return MotionResult(share == 1, poses, poses.copy(), times, travelled=share)

    def _follow(
        self, motion: Float64, waypoints: Float64, duration: float
    ) -> tuple[Float64, Float64]:
        """Camera poses (k, 4, 4) and times (k,) of the frames of a motion, which is made."""
        times = frame_times(duration, self.config)
        if duration > 0:
            q = self._along(waypoints, np.minimum(times / duration, 1.0))
            target = self.chain.camera_pose(self.q) @ motion
            q[times >= duration] = solve_pose(self.chain, q[-1:], target).q[0]
        else:
            q = np.tile(self.q, (len(times), 1))
        self.set_joints(q[-1])
        return self.T_world_base @ self.chain.camera_pose(q), times

    @staticmethod
    def _along(waypoints: Float64, share_of_time: Float64) -> Float64:
        """Joint angles (k, n) after shares (k,) of the time through waypoints (W, n)."""
        place = share_of_time * (len(waypoints) - 1)
        before = np.minimum(place.astype(np.int64), len(waypoints) - 2)
        part = (place - before)[:, None]
        return (1 - part) * waypoints[before] + part * waypoints[before + 1]


_LONGEST_RAD = 1.0  # of an edge of the tree, in the joint that turns farthest
_APART_RAD = 0.05  # between postures checked along an edge


def camera_poses(arm: ArmEmbodiment, edges: int = 600) -> Float64:
    """World poses (K, 4, 4) to which the arm can move its camera from its present posture.

    Ends of the collision-free edges of a rapidly exploring random tree in joint space (LaValle,
    1998), from a fixed seed.

    Args:
        arm: standing in a scene.
        edges: attempts to grow the tree.
    """
    chain, start = arm.chain, arm.planning_state()[0]
    links = LinkClearance(chain, arm.clearance_field, 0.0)
    least = min(
        0.0, float(links.least(start[None])[0])
    )  # an arm that already touches may move away
    low = np.maximum(chain.lower + LIMIT_MARGIN_RAD, start - np.pi)
    high = np.minimum(chain.upper - LIMIT_MARGIN_RAD, start + np.pi)
    rng = np.random.default_rng(0)
    tree = np.array([start])
    for target in rng.uniform(np.minimum(low, high), np.maximum(low, high), (edges, len(start))):
        nearest = tree[np.argmin(np.linalg.norm(tree - target, axis=1))]
        edge = target - nearest
        far = float(np.abs(edge).max())
        edge *= min(1.0, _LONGEST_RAD / max(far, 1e-9))
        parts = max(1, int(np.ceil(np.abs(edge).max() / _APART_RAD)))
        way = nearest + edge * (np.arange(1, parts + 1) / parts)[:, None]
        free = int(np.cumprod(links.least(way) >= least).sum())
        if free:
            tree = np.concatenate([tree, way[free - 1 : free]])
    return arm.T_world_base @ chain.camera_pose(tree)
