"""A planner that knows the scene: an upper bound and a teacher."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.held_nbv import HeldNextBestView

from ms_slam_env._runtime.arrays import Bool, Float32, Float64
from ms_slam_env.config import check_choice
from ms_slam_env.env import PrivilegedPlanner
from ms_slam_env.evaluation.map_truth import reference_surface
from ms_slam_env.planning.expected_gain import held_ways
from ms_slam_env.scenes.mesh_queries import RayCaster
from ms_slam_env.tasks import REFERENCES

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import PrivilegedView


_NEAREST_M, _FARTHEST_M = 0.3, 4.0  # range in which a frame maps well
_SLACK = 0.01  # share of its distance by which a visible point may lie behind the nearest surface
_PLACED_M = 0.04  # pose error up to which a frame maps surface in its true place
_CLEARANCE_M = 0.12


class Oracle(PrivilegedPlanner, HeldNextBestView):
    """`held-nbv` that knows from the true scene how much of the task's surface a motion shows.

    It follows the same rules, with motions that SLAM can follow. Since it sees the true scene, it
    is an upper bound rather than a competitor, and a teacher of where to look ("privileged"
    teacher: Chen et al., "Learning by cheating", CoRL 2020).

    Args:
        robot: the robot's view, including the truth.
        seed: for drawing goals.
        reference: the surface to map, as in a task: nearby, scene or arm.
        points: number of points sampled on that surface.
        least: share of them that a motion should show, discounted.
        slip_cost: share of them that a slip would cost.
        **options: see `HeldNextBestView`.

    Raises:
        InputError: an option out of its range.
    """

    def __init__(
        self,
        robot: PrivilegedView,
        seed: int = 0,
        reference: str = "nearby",
        points: int = 2000,
        least: float = 1e-3,
        slip_cost: float = 1.0,
        **options: Any,
    ) -> None:
        given: dict[str, Any] = {"least_m3": least, "enough_m3": least, "slip_cost": slip_cost}
        super().__init__(robot, seed, **given, **options)
        self.reference, self.points = reference, points
        check_choice(self, "reference", REFERENCES)
        self.check({"points": (1, 1_000_000)}, "points")

    def reset(self) -> None:
        """Forget the last episode."""
        super().reset()
        self.looked_at = 0
        self.left: Float32 | None = None
        """Points (N, 3) that are not mapped; None before the first decision."""

    def values(self, here: Float64) -> Float64:
        """Discounted share (n,) of the surface that each motion newly maps."""
        if self.left is None:
            self._begin()
        self._look()
        assert self.left is not None
        motions = self.robot.candidate_motions()
        way = held_ways(self.robot.episode.frames[-1].T_world_camera, motions, self.horizon)
        fits = self.robot.scene.clearance(way[:, :, :3, 3].reshape(-1, 3)) > _CLEARANCE_M
        goes_on = np.logical_and.accumulate(fits.reshape(way.shape[:2]), axis=1)
        seen = np.zeros((*way.shape[:2], len(self.left)), dtype=bool)
        seen[goes_on] = self._sees(way[goes_on])
        by_then = np.logical_or.accumulate(seen, axis=1).sum(axis=2) / self.total
        new = np.diff(by_then, axis=1, prepend=0.0)
        return np.asarray(new @ self.discount ** np.arange(self.horizon))

    def gain_of(self, poses: Float64) -> Float64:
        """Share (N,) of the surface that is newly mapped from poses (N, 4, 4)."""
        return np.asarray(self._sees(poses).sum(axis=1) / self.total)

    def _begin(self) -> None:
        """Draw the points of the surface."""
        scene, start = self.robot.scene, self.robot.episode.frames[0].T_world_camera[:3, 3]
        given = scene, start, self.robot.embodiment, self.robot.intrinsics
        every = reference_surface(self.reference, *given)
        drawn = np.random.default_rng(0).permutation(len(every))[: self.points]
        self.left, self.total = every[drawn].astype(np.float32), max(1, len(drawn))
        self.caster = RayCaster(scene.mesh.vertices, scene.mesh.faces)

    def _look(self) -> None:
        """Remove the points that the frames since the last decision have mapped in their place."""
        assert self.left is not None
        frames = self.robot.episode.frames
        for frame in frames[self.looked_at :]:
            if frame.tracking_ok and frame.pose_error < _PLACED_M:
                self.left = self.left[~self._sees(frame.T_world_camera[None])[0]]
        self.looked_at = len(frames)

    def _sees(self, poses: Float64) -> Bool:
        """Which points (M, N) cameras at poses (M, 4, 4) see."""
        assert self.left is not None
        sees = self._in_view(poses)
        pose, point = np.nonzero(sees)
        places = poses[pose, :3, 3]
        reached, _ = self.caster.first_hit(places, self.left[point] - places)
        sees[pose, point] = reached >= 1 - _SLACK
        return sees

    def _in_view(self, poses: Float64) -> Bool:
        """Which points (M, N) lie in the image of cameras at poses (M, 4, 4)."""
        assert self.left is not None
        camera = self.robot.intrinsics
        to_camera = np.linalg.inv(poses).astype(np.float32)
        x, y, z = np.moveaxis(
            self.left @ to_camera[:, :3, :3].transpose(0, 2, 1) + to_camera[:, None, :3, 3], 2, 0
        )
        across = np.abs(x) <= camera.width / (2 * camera.fx) * z
        down = np.abs(y) <= camera.height / (2 * camera.fy) * z
        return np.asarray((z > _NEAREST_M) & (z < _FARTHEST_M) & across & down)
