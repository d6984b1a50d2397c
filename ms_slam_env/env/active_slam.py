"""The environment: plan, move, render, track, judge."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ms_slam_env.env.config import make_config
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.env.mapping_robot import MappingRobot
from ms_slam_env.env.observations import RobotKnowledge, make_observation
from ms_slam_env.env.perturbed_frames import frames_with
from ms_slam_env.env.rendering import Renderer
from ms_slam_env.env.reward import Outcome, reward_terms
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import check_pose, invert
from ms_slam_env.slam.base import Views

Float64 = NDArray[np.float64]

_START_TRIES = 10  # a drawn start sees surface in most of its view: one try is nearly always enough


class ActiveSlamEnv(MappingRobot):
    """A camera chooses its next motion while a dense RGB-D SLAM estimates where it is.

    Each step the camera makes one of 49 small motions (Saeedi et al., ICRA 2017, section V-D), a
    noisy RGB-D frame is rendered, SLAM tracks and fuses it, and the information divergence
    between consecutive frames says how hard the motion was.

    ## Action space
    ``Discrete(49)``: ``7 * translation + rotation`` with translations none, up, down, left, right,
    forward, backward and rotations none, roll right, roll left, pitch forward, pitch backward, yaw
    anticlockwise, yaw clockwise, along and about the axes of the current camera frame.
    ``MSActiveSLAM-FixedTranslation-v0``: ``Discrete(7)``, the rotation; the camera translates along
    a straight line by itself. A masked action does nothing.

    ## Observation space
    Option ``observation``: ``features`` (vector: state, grey histogram, coarse depth, action mask),
    ``lookahead`` (features and the predicted divergences of every action) or ``rgbd`` (images and
    state). Only what the robot itself has; see :mod:`ms_slam_env.env.observations`.

    ## Reward
    Weighted sum of the terms of :func:`ms_slam_env.env.reward.reward_terms`.

    ## Start
    A free pose of the scene, drawn from the seed; SLAM starts at the true pose with one frame.

    ## End
    Terminated when tracking was lost for ``lost_patience`` consecutive steps; truncated by the time
    limit (``max_episode_steps`` of ``gym.make``, 150 by default).

    ## Info
    ``T_world_camera``, ``T_world_camera_estimate`` (4, 4); ``pose_error`` m; ``ate`` running RMSE
    of the pose error over all frames, m, no alignment; ``divergence`` (2,) intensity and depth
    between the last frames of this step and the one before, nats; ``tracking_ok``;
    ``reward_terms``; ``action_mask`` (n,) bool; ``mapped_area`` m2; ``time`` simulated seconds;
    ``energy`` mechanical work of the motion so far, J; ``scene``, ``scene_seed``.
    No clock: timings are in ``env.unwrapped.timings``.

    ## Arguments
    The fields of :class:`ms_slam_env.env.EnvConfig`, by keyword; nested ones as dataclass or
    mapping.

    ## Version history
    v0: first version.

    Args:
        embodiment: ``arm`` (with physics), ``arm-kinematic``, ``free`` or ``fixed-translation``.
        render_mode: None or ``rgb_array``.
        **options: fields of ``EnvConfig``.

    Raises:
        InputError: an unknown option or choice, or a value out of range.
    """

    metadata = {  # noqa: RUF012 -- Gymnasium declares it as an instance variable
        "render_modes": ["rgb_array"],
        "render_fps": 10,
    }

    def __init__(
        self, embodiment: str = "free", render_mode: str | None = None, **options: Any
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(
                f"unknown render_mode {render_mode!r}; valid choices: None, rgb_array "
                "(render() returns a picture; no window is opened)"
            )
        if embodiment not in EMBODIMENTS:
            raise unknown("embodiment", embodiment, EMBODIMENTS)
        self._options = {"embodiment": embodiment, "render_mode": render_mode, **options}
        super().__init__(embodiment, make_config(options))
        self.render_mode = render_mode
        self._lookahead = Lookahead(self.config.lookahead, self.config.divergence, self.intrinsics)
        num_actions = self._embodiment_type.num_actions
        self.action_space = spaces.Discrete(num_actions)
        self._observation = make_observation(self.config.observation, self.intrinsics, num_actions)
        self.observation_space = self._observation.space
        self._renderer = Renderer()

    # -- Gymnasium ---------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seeds the environment's generator.
            options: ``T_world_camera`` (4, 4) to start from instead of a drawn pose.

        Raises:
            InputError: a bad option, or a start from where there is nothing to map; the
                environment must then be reset again before it is used.
        """
        super().reset(seed=seed)
        self._episode = None  # the world of the old episode may be gone before this one begins
        unknown_options = set(options or {}) - {"T_world_camera"}
        if unknown_options:
            raise InputError(
                f"unknown reset option {sorted(unknown_options)}; valid choices: T_world_camera"
            )
        name, scene_seed = self.config.draw_scene(self.np_random)
        self._enter_scene(name, scene_seed)
        given = options["T_world_camera"] if options else None
        if given is not None:
            start = check_pose(given, "reset option T_world_camera")
            why = self._begin_episode(name, scene_seed, start)
        else:
            for _ in range(_START_TRIES):
                drawn = self.scene.sample_start(self.np_random)
                why = self._begin_episode(name, scene_seed, drawn)
                if not why:
                    break
        if why:
            self._episode = None
            where = "reset option T_world_camera"
            if given is None:
                where = f"none of {_START_TRIES} drawn start poses can be used, the last"
                if self.config.arm.base is not None:
                    why += "; give one with reset(options={'T_world_camera': ...})"
            raise InputError(f"{where}: {why}")
        return self._build_observation(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make one motion and track the frame that follows.

        Raises:
            InputError: an action that is not an integer of the action space, or no reset before.
        """
        chosen = self._check_action(action)
        episode = self._current()
        episode.action = chosen
        with self.timings.stage("move"):
            movement = self.embodiment.move(chosen)
        error_before = episode.pose_error
        new_surface = self._observe_world(movement)
        lost_for_good = episode.steps_lost >= self.config.lost_patience
        outcome = Outcome(
            divergence=episode.divergence,
            pose_error_growth_m=episode.pose_error - error_before,
            new_surface_m2=new_surface,
            tracking_ok=episode.tracking_ok,
            lost_for_good=lost_for_good,
            blocked=not movement.made,
        )
        episode.reward_terms = self._reward_terms(outcome)
        reward = float(sum(episode.reward_terms.values()))
        return self._build_observation(), reward, lost_for_good, False, self._info()

    def render(self) -> NDArray[np.uint8] | None:
        """One picture that explains the moment, (480, 1120, 3) uint8; None without render mode."""
        if self.render_mode is None:
            return None
        return self._renderer.draw(self)

    # -- What planners use -------------------------------------------------------------------

    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) which actions are possible now; the name is sb3-contrib's."""
        self._current()
        return self.embodiment.action_masks()

    def candidate_poses(self) -> Float64:
        """(n, 4, 4) where each action would bring the camera, by SLAM's estimate of now."""
        return self._current().T_world_camera_estimate @ self.embodiment.candidate_motions()

    def predict_candidates(self) -> Views:
        """The view of each candidate as the map predicts it."""
        with self.timings.stage("lookahead"):
            return self._lookahead.predict(self.slam, self.candidate_poses())

    def lookahead(self) -> Float64:
        """(n, 2) predicted intensity and depth divergence of each action, nats."""
        episode = self._current()
        if episode.predicted_divergences is None:
            with self.timings.stage("lookahead"):
                episode.predicted_divergences = self._lookahead.divergences(
                    self.slam,
                    self.candidate_poses(),
                    episode.T_world_camera_estimate,
                    episode.last_frame,
                )
        return episode.predicted_divergences.copy()

    def __getstate__(self) -> dict[str, Any]:
        """Options and, once reset, the episode: device arrays are made anew."""
        state = None if self._episode is None else self.save_state()
        return {
            "options": self._options,
            "perturbations": self.frames.perturbations,
            "state": state,
        }

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        """Build the environment anew and go on from where the pickled one was."""
        self.__init__(**pickled["options"])  # type: ignore[misc]
        self.frames = frames_with(pickled["perturbations"])
        if pickled["state"] is not None:
            self.load_state(pickled["state"])

    def _reward_terms(self, outcome: Outcome) -> dict[str, float]:
        """Weighted terms of one step, name to value."""
        return reward_terms(outcome, self.config.reward, self.config.targets)

    # -- Checks and views --------------------------------------------------------------------

    def _check_action(self, action: Any) -> int:
        self._current()
        array = np.asarray(action)
        is_integer = array.shape == () and np.issubdtype(array.dtype, np.integer)
        last = self._embodiment_type.num_actions - 1
        if not is_integer or not 0 <= int(array) <= last:
            raise InputError(f"action {action!r} is not an integer in [0, {last}]")
        return int(array)

    def _build_observation(self) -> Any:
        episode = self._current()
        with self.timings.stage("observation"):
            return self._observation.build(
                RobotKnowledge(
                    frame=episode.last_frame,
                    T_start_camera=invert(episode.estimates[0]) @ episode.T_world_camera_estimate,
                    divergence=episode.divergence / self.config.targets.maxima,
                    tracking_ok=episode.tracking_ok,
                    inlier_fraction=episode.inlier_fraction,
                    lost_share=min(1.0, episode.steps_lost / self.config.lost_patience),
                    motion=episode.action,
                    action_mask=self.embodiment.action_masks(),
                    lookahead=lambda: self.lookahead() / self.config.targets.maxima,
                )
            )

    def _info(self) -> dict[str, Any]:
        return {
            **self._current().info(),
            "action_mask": self.action_masks(),
            "mapped_area": self.coverage.mapped_area,
        }
