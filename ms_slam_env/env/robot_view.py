"""Views of an episode for planners: what the robot knows and, for teachers, the truth too."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.slam.shared.submap_frames import Submaps
from ms_slam_env.slam.slam_backend import Views

if TYPE_CHECKING:
    from ms_slam_env.divergence import DivergenceConfig
    from ms_slam_env.env.active_slam import ActiveSlamEnv
    from ms_slam_env.env.episode import Episode
    from ms_slam_env.env.reward import TargetConfig
    from ms_slam_env.planning import OccupancyGrid
    from ms_slam_env.robot import Embodiment
    from ms_slam_env.scenes.scene import Scene


TRUTH = (
    *("T_world_camera", "pose_error", "ate", "reward_terms"),
    *("mapped_area", "mapped_share", "scene", "scene_seed"),
)
"""Keys of ``info`` that only a simulator knows."""


def without_truth(info: dict[str, Any]) -> dict[str, Any]:
    """``info`` without the keys that only a simulator knows."""
    return {key: value for key, value in info.items() if key not in TRUTH}


class RobotView:
    """The robot's knowledge of the episode so far; planners see nothing else.

    Poses are in SLAM's world frame, which begins at the true start pose. No public attribute
    leads to the environment, the scene or a true pose: a convention, not a wall. Do not write to
    the arrays.

    Args:
        env: the unwrapped environment.
    """

    def __init__(self, env: ActiveSlamEnv) -> None:
        self._env = env

    # -- The robot ---------------------------------------------------------------------------

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the camera."""
        return self._env.intrinsics

    @property
    def action_space(self) -> Any:
        """Space of the motions and, where the agent chooses it, of the SLAM configuration."""
        return self._env.action_space

    @property
    def observation_space(self) -> Any:
        """Space of the observations that ``act`` gets."""
        return self._env.observation_space

    @property
    def step_m(self) -> float:
        """Translation of a motion, metres."""
        return self._env.config.step_m

    @property
    def step_rad(self) -> float:
        """Rotation of a motion, radians."""
        return self._env.config.step_rad

    @property
    def targets(self) -> TargetConfig:
        """M_I, M_D and the shares of them to aim at."""
        return self._env.config.targets

    @property
    def divergence_config(self) -> DivergenceConfig:
        """How divergence is measured."""
        return self._env.config.divergence

    @property
    def seconds(self) -> float | None:
        """Limit of an episode's simulated time; None where only its steps are limited."""
        return self._env.config.seconds

    @property
    def frames_per_motion(self) -> int:
        """Expected number of frames of a motion from here."""
        return self._env.embodiment.frames_per_motion

    # -- Past frames -------------------------------------------------------------------------

    @property
    def T_world_camera_estimate(self) -> Float64:
        """(4, 4) the last estimated pose."""
        return self._env.episode.T_world_camera_estimate

    @property
    def pose_covariance(self) -> Float64 | None:
        """(6, 6) covariance of the pose's twist (rho, phi) in the camera frame, or None."""
        return self._env.episode.pose_covariance

    @property
    def trajectory_estimate(self) -> Float64:
        """(N, 4, 4) poses of the frames, estimated when they were current."""
        return self._env.episode.trajectory_estimate

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """(N,) whether tracking held at each frame."""
        return self._env.episode.tracked

    @property
    def step_divergences(self) -> Float64:
        """(S + 1, 2) ``info["divergence"]`` at the start and after each of the S steps."""
        return self._env.episode.step_divergences

    @property
    def last_frame(self) -> RGBDFrame:
        """The last live frame."""
        return self._env.episode.last_frame

    @property
    def occupancy(self) -> OccupancyGrid | None:
        """The occupancy grid; None where neither the observation nor the mask needs it."""
        return self._env.episode.occupancy

    # -- Possible motions and their views ----------------------------------------------------

    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) which actions are possible now; see the environment's option ``mask``."""
        return self._env.action_masks()

    def candidate_motions(self) -> Float64:
        """The motions ``T_camera_next`` (n, 4, 4) that the actions would make from here."""
        return self._env.embodiment.candidate_motions()

    def candidate_poses(self) -> Float64:
        """(n, 4, 4) poses that the motions would lead to from SLAM's current estimate."""
        return self._env.candidate_poses()

    def predict_candidates(self) -> Views:
        """Views from the candidate poses, predicted from the map."""
        return self._env.predict_candidates()

    def lookahead(self) -> Float64:
        """(n, 2) predicted intensity and depth divergence of each motion, nats."""
        return self._env.lookahead()

    # -- The map -----------------------------------------------------------------------------

    def predict(self, poses: Float64, scale: float = 1.0) -> Views:
        """Views of the map from poses (N, 4, 4), of ``scale`` times the camera's size."""
        return self._env.slam.predict(poses, scale)

    def project(self, poses: Float64, scale: float = 1.0) -> Views:
        """As ``predict``, each view rendered from the map itself instead of from nearby views."""
        return self._env.slam.project(poses, scale)

    def surface_points(self) -> Float64:
        """Points (M, 3) of the estimated surface, metres."""
        return self._env.slam.surface_points()

    def submaps(self) -> Submaps:
        """The submaps, and which of them are joined now."""
        return self._env.slam.submaps()

    def corrected_trajectory(self) -> tuple[NDArray[np.int32], Float64]:
        """Frames (N,) and their poses (N, 4, 4) as the map has them now; see ``SlamBackend``."""
        return self._env.slam.corrected_trajectory()

    @property
    def frames_counted(self) -> int:
        """Number of the next frame, as counted by ``corrected_trajectory`` and ``submaps``."""
        return self._env.slam.frames_counted

    if not TYPE_CHECKING:  # mypy would take every name for an attribute

        def __getattr__(self, name: str) -> Any:
            """Raise an error that says which planners may use the attribute."""
            raise AttributeError(
                f"a {type(self).__name__} has no {name!r}: planners know what the robot knows; one "
                "that needs the truth is a subclass of ms_slam_env.env.PrivilegedPlanner"
            )


class PrivilegedView(RobotView):
    """A view that includes the truth, for teachers and upper bounds."""

    @property
    def episode(self) -> Episode:
        """The episode so far, with the true poses."""
        return self._env.episode

    @property
    def scene(self) -> Scene:
        """The current scene."""
        return self._env.scene

    @property
    def embodiment(self) -> Embodiment:
        """The embodiment that carries the camera."""
        return self._env.embodiment

    def foresee_terms(self, actions: Iterable[Any]) -> list[dict[str, float]]:
        """Reward terms that each of some actions would earn now."""
        return self._env.foresee_terms(actions)
