"""An arm that goes exactly where it plans to, at once: no physics, no noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.robot.arm.arm_base import ArmEmbodiment, frame_times
from ms_slam_env.robot.arm.inverse import solve_pose
from ms_slam_env.robot.base import MotionResult

Float64 = NDArray[np.float64]


class KinematicArm(ArmEmbodiment):
    """The arm's kinematics alone: limits, furniture and speed count, mass and errors do not."""

    def move(self, action: int) -> MotionResult:
        """Make motion ``action`` if the arm can, with the frames that arrive meanwhile.

        Action 0 and a masked action rest for one period of the camera, or for
        ``frames_per_action`` of them.
        """
        probe = self.probe()
        made = bool(probe.ok[action])
        duration = float(probe.duration_s[action]) if made else 0.0
        times = frame_times(duration, self.config)
        if duration > 0:
            q = self._along(probe.q[action], np.minimum(times / duration, 1.0))
        else:
            q = np.tile(self.q, (len(times), 1))
        if made and duration > 0:
            target = self.chain.camera_pose(self.q) @ self.motions[action]
            q[times >= duration] = solve_pose(self.chain, q[-1:], target).q[0]
        self.set_joints(q[-1])
        poses = self.T_world_base @ self.chain.camera_pose(q)
        return MotionResult(made, poses, poses.copy(), times)

    @staticmethod
    def _along(waypoints: Float64, share_of_time: Float64) -> Float64:
        """Joint angles (k, n) after shares (k,) of the time through waypoints (W, n)."""
        place = share_of_time * (len(waypoints) - 1)
        before = np.minimum(place.astype(np.int64), len(waypoints) - 2)
        part = (place - before)[:, None]
        return (1 - part) * waypoints[before] + part * waypoints[before + 1]
