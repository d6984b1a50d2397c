"""The environment: plan, move, render, track, score."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ms_slam_env import slam as slam_backends
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.extension import load_reference
from ms_slam_env._runtime.timings import Timings
from ms_slam_env.env.actions import ActionDecoder, MotionActions, MotionAndConfigurationActions
from ms_slam_env.env.camera_feed import CameraFeed, make_camera_feed
from ms_slam_env.env.coverage import CoverageGrid
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.env_config import check_reset, make_config
from ms_slam_env.env.episode import Episode
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.env.observations import CONFIGURATION, make_observation
from ms_slam_env.env.reward import Outcome, reward_terms
from ms_slam_env.env.robot_knowledge import STATE_NAMES, RobotKnowledge
from ms_slam_env.env.saved_state import load_state, save_state
from ms_slam_env.env.simulation import Simulation
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import check_pose
from ms_slam_env.planning.candidates import PredictedViews
from ms_slam_env.planning.trackability import SCALE
from ms_slam_env.robot import Embodiment
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences.perturbations.perturbation import Perturbation
from ms_slam_env.slam.slam_backend import SlamBackend, Views

VIEWS = {
    "rgb_array": "ms_slam_env.env.rendering:draw_moment",
    "human": "ms_slam_env.env.rerun_view:EpisodeView",
}
"""Viewer of each ``render_mode``, imported when that mode is chosen."""


class ActiveSlamEnv(gymnasium.Env[Any, Any]):
    """An agent chooses the camera's next motion while dense RGB-D SLAM estimates its pose.

    In each step the camera makes one of 49 small motions (Saeedi et al., ICRA 2017, section V-D), a
    noisy RGB-D frame is rendered, and SLAM tracks and fuses it. The information divergence between
    consecutive frames measures how hard the motion was to track.

    ## Action space
    ``Discrete(49)``: ``7 * translation + rotation`` with translations none, up, down, left, right,
    forward, backward and rotations none, roll right, roll left, pitch forward, pitch backward, yaw
    anticlockwise, yaw clockwise, along and about the axes of the current camera frame.
    ``MSActiveSLAM-FixedTranslation-v0``: ``Discrete(7)``, the rotation; the translation follows a
    fixed straight line. A masked action does nothing.
    ``MSActiveSLAM-Adaptive-v0``: ``MultiDiscrete([49, K])``, the motion and which of K SLAM
    configurations, from fast to robust, processes its frames: run-time adaptation (section V-B)
    decided by the agent. The mask has 49 + K entries, motions first, as sb3-contrib's MaskablePPO
    expects; every configuration is always possible.
    ``actions="continuous"`` (``MSActiveSLAM-Continuous-v0``): ``Box(-1, 1, (6,))``, a translation
    in units of ``step_m`` and a rotation vector in units of ``step_rad``, along and about the same
    axes. There are no masks: a motion that is blocked stops short.

    ## Observation space
    Option ``observation``: ``features`` (vector: state, grey histogram, coarse depth, action mask),
    ``lookahead`` (features and the predicted divergences of every action), ``map`` (features and
    the occupancy around the camera), ``goals``, ``held`` and ``candidates`` (state, and the values
    by which the planners rank every action), ``pixels`` (a vector of state and small images),
    ``images`` (colour and depth as one uint8 image, and state) or ``rgbd`` (both as measured, and
    state). All show only what the robot itself knows; see
    :mod:`ms_slam_env.env.observations`. Where the agent chooses the SLAM configuration, the current
    one is added one-hot (K,): at the end of the vector, or as ``slam_configuration``.

    ## Reward
    The sum of these terms (``info["reward_terms"]``), each times its weight (option ``reward``).
    ``divergence-and-error``, without a task: ``intensity_divergence`` and ``depth_divergence``,
    -0.5 per M_I and M_D of distance to the target, each distance capped at 0.4, depth times lambda
    (0.1); ``ate_growth``, -100 per metre of growth of ``info["ate"]``, in all -100 times the final
    ATE; ``lost``, -0.5 per lost step; ``lost_for_good``, -30 once; ``blocked``, -0.1 per masked
    action; where the agent chooses the SLAM configuration, ``compute``, -0.1 times its cost, a
    fixed number (``adaptation.costs``) rather than a measured time, so that runs are reproducible.
    ``mapping``, with a task: the same, but ``new_surface``, +1 per m2 newly mapped in its true
    place, and ``trajectory_error``, -10 per metre of growth of the pose error, capped at 0.1 m
    either way, instead of ``ate_growth``; ``lost_for_good`` is -10.
    Scale of ``mapping``: random possible motions in a living room earned -0.2 to 1.6 in 90 % of the
    steps with the arm and -0.4 to 1.3 with the free camera. The extremes were -1.7 (lost) and 4.0,
    and -10.8 to -11.7 in the last step of an episode whose tracking was never recovered.

    ## Start
    A free pose of the scene, drawn from the seed; SLAM starts at the true pose with one frame.

    ## End
    Terminated when tracking was lost for ``lost_patience`` consecutive steps, or when the camera
    was lost or in submaps not joined to the first for ``away_patience`` consecutive steps.
    Truncated by the time limit (``max_episode_steps`` of ``gym.make``, 150 by default), or when
    ``seconds`` of simulated time have passed.

    ## Info
    ``T_world_camera``, ``T_world_camera_estimate`` (4, 4); ``pose_covariance`` (6, 6) of the
    estimate relative to the map, without the map's drift, for the twist (rho, phi) in metres and
    radians in the camera frame, infinite where SLAM gave none (at the start, while lost, or from
    a backend or pose source without one);
    ``pose_error`` m; ``ate`` running RMSE of the pose error over all frames, m, no alignment;
    ``divergence`` (2,) intensity and depth between the last frames of this step and the one
    before, nats; ``tracking_ok``; ``submap``, 0 for the first and those joined to it: in
    another one ``tracking_ok`` is true and ``pose_covariance`` gives the uncertainty of the pose;
    ``reward_terms``; ``action_mask`` (n,) bool; ``mapped_area`` m2; ``mapped_share`` of the surface
    adjacent to free space, [0, 1]; ``time`` simulated seconds; ``energy`` mechanical work of the
    motion so far, J; ``scene``, ``scene_seed``.
    No clock is in it: timings are in ``env.unwrapped.timings``. Where the agent chooses the SLAM
    configuration, ``slam_configuration`` is the current index. Where actions are continuous,
    ``travelled``, the share of the way that was free, takes the place of ``action_mask``.

    ## Arguments
    The fields of :class:`ms_slam_env.env.EnvConfig`, by keyword; nested ones as dataclass or
    mapping.

    ## Version history
    v0: first version.

    Args:
        embodiment: ``arm`` (with physics), ``arm-kinematic``, ``free`` or ``fixed-translation``.
        render_mode: None, ``rgb_array``, or ``human``, which shows every step in the Rerun viewer.
        agent_configures_slam: whether an action has a second part, the SLAM configuration;
            ``adaptation`` must then be ``agent``, by name or as a mapping with its options.
        **options: fields of ``EnvConfig``.

    Raises:
        InputError: an unknown option or choice, a value out of range, or an ``adaptation`` other
            than ``agent`` where the agent chooses the SLAM configuration.
    """

    metadata = {  # noqa: RUF012 -- Gymnasium declares it as an instance variable
        "render_modes": [*VIEWS],
        "render_fps": 10,
    }

    def __init__(
        self,
        embodiment: str = "free",
        render_mode: str | None = None,
        agent_configures_slam: bool = False,
        **options: Any,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(
                f"unknown render_mode {render_mode!r}; valid choices: None, rgb_array "
                "(render() returns a picture), human (a viewer is opened)"
            )
        if not isinstance(embodiment, str) or embodiment not in EMBODIMENTS:
            raise unknown("embodiment", embodiment, EMBODIMENTS)
        if agent_configures_slam:
            options.setdefault("adaptation", "agent")
        self._arguments = (embodiment, render_mode, agent_configures_slam, options)
        self.render_mode = render_mode
        self.config = config = make_config(options)
        self.intrinsics = config.camera
        self.timings = Timings()

        backend = slam_backends.make(config.slam, self.intrinsics, **config.slam_config)
        # Do not drop the only frame of a step unless frame management is asked for.
        adapted = config.adaptation.adapt(backend, drops_frames=False)
        self.slam: SlamBackend = config.frame_management.manage(adapted)
        embodiment_type = EMBODIMENTS[embodiment]
        embodiment_type.check(config)
        self.simulation = Simulation(config, embodiment_type, self.slam, self.timings)
        self._lookahead = Lookahead(config.lookahead, config.divergence, self.intrinsics)

        num_motions = embodiment_type.num_motions
        self._actions: ActionDecoder = MotionActions(num_motions)
        if agent_configures_slam:
            self._actions = MotionAndConfigurationActions(num_motions, adapted, config.adaptation)
        if config.actions == "continuous":
            make = load_reference("ms_slam_env.env.continuous:ContinuousActions")
            self._actions = make(num_motions, agent_configures_slam)
        self._observation = make_observation(
            config.observation, self.intrinsics, num_motions, self._actions.num_configurations
        )
        self.simulation.carves |= self._observation.needs_occupancy
        self._episodes_left = 0  # in the scene drawn last
        self.action_space = self._actions.space
        self.observation_space = self._observation.space
        self.on_load: Callable[[int], None] = _nothing
        self.make_view: Callable[[ActiveSlamEnv], Any] | None = None
        """Creates the viewer of an episode; see `rerun_view.EpisodeView`."""
        self._view: Any = None

    # -- Gymnasium ---------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seeds the environment's generator.
            options: ``T_world_camera`` (4, 4) to start from instead of a drawn pose; ``scene`` and
                ``scene_seed`` to use in this episode instead of drawn ones. ``scene`` names a
                built-in scene or one of this environment. Everything else follows the seed.

        Raises:
            InputError: a bad option, or a start from which there is nothing to map; reset again
                before using the environment.
        """
        check_reset(seed, options, self.config.scenes)
        super().reset(seed=seed)
        place = self.simulation.place
        chosen = {key: (options or {}).get(key) for key in ("scene", "scene_seed")}
        is_chosen = any(value is not None for value in chosen.values())
        if seed is not None or not self._episodes_left or place is None or is_chosen:
            place = self.config.draw_scene(self.np_random, chosen)
            self._episodes_left = 1 if is_chosen else self.config.episodes_per_scene
        self._episodes_left -= 1
        self.simulation.enter(*place)
        start = (options or {}).get("T_world_camera")
        if start is None:
            self.simulation.start_somewhere(self.np_random)
        else:
            start = check_pose(start, "reset option T_world_camera")
            why = self.simulation.start_at(start, self.np_random)
            if why:
                raise InputError(f"reset option T_world_camera: {why}")
        if self.make_view is not None:
            self.close()
            self._view = self.make_view(self)
            self._view.log()
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make one motion, track its frames, and compute the reward.

        Raises:
            InputError: the action is not in the action space, or there was no reset.
        """
        reward, lost_for_good = self._advance(action)
        if self._view is not None:
            self._view.log()
        return self._observe(), reward, lost_for_good, self._time_is_up(), self._info()

    def _advance(self, action: Any) -> tuple[float, bool]:
        """Make a motion; return its reward and whether tracking is lost beyond recovery."""
        episode = self.episode
        episode.action = self._actions.decode(action)
        error_before, ate_before = episode.pose_error, episode.ate
        made, new_surface = self.simulation.move(episode)
        lost_for_good = self._lost_share() >= 1
        outcome = Outcome(
            divergence=episode.divergence,
            pose_error_growth_m=episode.pose_error - error_before,
            ate_growth_m=episode.ate - ate_before,
            new_surface_m2=new_surface,
            tracking_ok=episode.tracking_ok,
            lost_for_good=lost_for_good,
            blocked=not made,
            configuration_cost=self._actions.configuration_cost,
        )
        episode.reward_terms = reward_terms(outcome, self.config.reward, self.config.targets)
        return float(sum(episode.reward_terms.values())), lost_for_good

    def close(self) -> None:
        """Close the viewer's connection; the window stays."""
        if self._view is not None:
            self._view.close()
            self._view = None

    def render(self) -> NDArray[np.uint8] | None:
        """One picture of the current state, (480, 1120, 3) uint8; None unless ``rgb_array``."""
        if self.render_mode != "rgb_array":
            return None
        shown = self.config.targets, self.slam, self.embodiment, self.scene
        picture: NDArray[np.uint8] = load_reference(VIEWS["rgb_array"])(self.episode, *shown)
        return picture

    def _observe(self) -> Any:
        """The observation: what the robot itself knows."""
        episode, maxima = self.episode, self.config.targets.maxima
        with self.timings.stage("observation"):
            return self._observation.build(
                RobotKnowledge(
                    frame=episode.last_frame,
                    T_start_camera=episode.T_start_camera,
                    divergence=episode.divergence / maxima,
                    tracking_ok=episode.tracking_ok,
                    inlier_fraction=episode.inlier_fraction,
                    lost_share=min(1.0, self._lost_share()),
                    motion=episode.action,
                    motion_mask=self.simulation.action_masks(),
                    configuration=self._actions.configuration,
                    lookahead=lambda: self.lookahead() / maxima,
                    here=episode.T_world_camera_estimate,
                    candidates=self.candidate_poses,
                    view=lambda: self.slam.predict(episode.T_world_camera_estimate[None], SCALE),
                    predicted=self._predicted,
                    steps=(self.config.step_m, self.config.step_rad),
                    frames=self.embodiment.frames_per_motion,
                    occupancy=episode.occupancy,
                )
            )

    def _predicted(self) -> PredictedViews:
        """Predicted views of the current pose and the candidates, divergences / (M_I, M_D)."""
        targets, poses = self.config.targets, self.candidate_poses()
        seen_from = np.concatenate([self.episode.T_world_camera_estimate[None], poses])
        divergences = self.lookahead()
        return PredictedViews(
            poses=seen_from,
            views=self.slam.predict(seen_from, SCALE),
            divergences=divergences / targets.maxima,
            criterion=targets.distances(divergences) @ (1.0, targets.depth_weight),
            frames=self.embodiment.frames_per_motion,
        )

    def _lost_share(self) -> float:
        """Share of the patience for lost tracking used up; 1 or more ends the episode."""
        lost, away = self.episode.steps_lost, self.episode.steps_away
        if lost < away:  # in a submap, or lost after one
            return max(lost / self.config.lost_patience, away / self.config.away_patience)
        return lost / self.config.lost_patience

    def _time_is_up(self) -> bool:
        seconds = self.config.seconds
        return seconds is not None and self.episode.frames[-1].time_s >= seconds

    def _info(self) -> dict[str, Any]:
        of_motions: dict[str, Any] = {"travelled": self.simulation.travelled}
        if self.config.actions == "discrete":
            of_motions = {"action_mask": self.action_masks()}
        info = {
            **self.episode.info(),
            **of_motions,
            "mapped_area": self.coverage.mapped_area,
            "mapped_share": self.coverage.mapped_share,
        }
        if self._actions.num_configurations > 1:
            info[CONFIGURATION] = self._actions.configuration
        return info

    # -- For evaluation ----------------------------------------------------------------------

    @property
    def episode(self) -> Episode:
        """The episode so far, trajectories and measures, for evaluation.

        Raises:
            InputError: the environment was not reset.
        """
        episode = self.simulation.episode
        if episode is None:
            raise InputError("the environment must be reset before it is used: call env.reset()")
        return episode

    @property
    def scene(self) -> Scene:
        """The current scene."""
        return self.simulation.world.scene

    @property
    def sensor(self) -> RGBDSensor:
        """The simulated RGB-D sensor."""
        return self.simulation.world.sensor

    @property
    def embodiment(self) -> Embodiment:
        """The embodiment that carries the camera."""
        return self.simulation.world.embodiment

    @property
    def coverage(self) -> CoverageGrid:
        """The true surface mapped in its true place so far."""
        return self.simulation.world.coverage

    @property
    def camera_feed(self) -> CameraFeed:
        """Takes the frames."""
        return self.simulation.camera_feed

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the entries of the observations' state vector; see ``STATE_NAMES``."""
        return STATE_NAMES

    # -- For planners ------------------------------------------------------------------------

    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) which actions are possible now, under the name that sb3-contrib expects.

        (n + K,) where the agent also chooses the SLAM configuration.

        Raises:
            InputError: actions are continuous, or there was no reset.
        """
        _ = self.episode  # none yet: say so
        return self._actions.masks(self.simulation.action_masks())

    def candidate_poses(self) -> Float64:
        """(n, 4, 4) poses that the motions would lead to from SLAM's current estimate."""
        return self.episode.T_world_camera_estimate @ self.embodiment.candidate_motions()

    def predict_candidates(self) -> Views:
        """Views from the candidate poses, predicted from the map."""
        with self.timings.stage("lookahead"):
            return self._lookahead.predict(self.slam, self.candidate_poses())

    def lookahead(self) -> Float64:
        """(n, 2) predicted intensity and depth divergence of each motion, nats."""
        episode = self.episode
        if episode.predicted_divergences is None:
            with self.timings.stage("lookahead"):
                episode.predicted_divergences = self._lookahead.divergences(
                    self.slam,
                    self.candidate_poses(),
                    episode.T_world_camera_estimate,
                    episode.last_frame,
                )
        return episode.predicted_divergences.copy()

    def foresee(self, actions: Iterable[Any]) -> Float64:
        """Rewards (k,) that each of k actions would earn now; the environment is left unchanged.

        Raises:
            InputError: an action is not in the action space, or there was no reset.
        """
        return np.array([sum(terms.values()) for terms in self.foresee_terms(actions)])

    def foresee_terms(self, actions: Iterable[Any]) -> list[dict[str, float]]:
        """Reward terms of each action, name to weighted value, as in ``info["reward_terms"]``.

        Simulates each action and undoes it, in the order given, which a real robot cannot do.
        Useful for tree search and teachers; takes some 15 ms an action.

        Raises:
            InputError: an action is not in the action space, or there was no reset.
        """
        if not isinstance(actions, Iterable):
            raise InputError(f"actions = {actions!r} must be several")
        state = self.save_state()
        foreseen = []
        for action in actions:
            try:
                self._advance(action)
                foreseen.append(dict(self.episode.reward_terms))
            finally:
                load_state(self.simulation, state, self._settings(), self.np_random)
        return foreseen

    def perturb(self, *perturbations: Perturbation) -> None:
        """Add perturbations after the camera's present ones; they apply from the next reset.

        Raises:
            InputError: a perturbation that changes how the camera moves; the agent decides that.
        """
        every = (*self.camera_feed.perturbations, *perturbations)
        self.simulation.camera_feed = make_camera_feed(every)

    # -- State -------------------------------------------------------------------------------

    def save_state(self) -> dict[str, Any]:
        """Everything needed to resume bit-exactly, except the time limit's counter."""
        _ = self.episode  # none yet: say so
        return save_state(self.simulation, self._settings(), self.np_random)

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Resume from a state saved by ``save_state`` of an env with the same world and robot.

        No reset is needed first. The Gymnasium wrappers that ``gym.make`` adds follow: the time
        limit counts the steps of the state's episode. The next reset draws a scene, whatever
        ``episodes_per_scene`` is.

        Raises:
            InputError: not a saved state, or options that shape the state differ; the environment
                is left unchanged.
        """
        load_state(self.simulation, state, self._settings(), self.np_random)
        self._episodes_left = 0
        self.on_load(len(self.episode.divergences_of_steps) - 1)

    def _settings(self) -> dict[str, Any]:
        """Settings that two environments must share to resume from the same state."""
        settings = self.config.of_state(self._arguments[0])
        return {**settings, "perturbations": self.camera_feed.perturbations}

    def __getstate__(self) -> dict[str, Any]:
        """Arguments and, once reset, the saved episode; device arrays are allocated again."""
        return {
            "arguments": self._arguments,
            "perturbations": self.camera_feed.perturbations,
            "state": None if self.simulation.episode is None else self.save_state(),
            "episodes_left": self._episodes_left,
        }

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        """Rebuild the environment and resume where the pickled one was."""
        *arguments, options = pickled["arguments"]
        self.__init__(*arguments, **options)  # type: ignore[misc]
        self.perturb(*pickled["perturbations"])
        if pickled["state"] is not None:
            self.load_state(pickled["state"])
            self._episodes_left = pickled["episodes_left"]


def _nothing(steps: int) -> None:
    """Default callback for a loaded state: do nothing."""
