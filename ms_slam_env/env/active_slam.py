"""The environment: plan, move, render, track, judge."""

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
"""Name of the option ``render_mode`` to what shows an episode then, imported where it is chosen."""


class ActiveSlamEnv(gymnasium.Env[Any, Any]):
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
    ``MSActiveSLAM-Adaptive-v0``: ``MultiDiscrete([49, K])``, the motion and which of K SLAM
    configurations, from fast to robust, its frames are processed under: run-time adaptation
    (section V-B) as a decision of the agent. Its mask has 49 + K entries, the motions' first: the
    form that sb3-contrib's MaskablePPO takes; every configuration is always possible.

    ## Observation space
    Option ``observation``: ``features`` (vector: state, grey histogram, coarse depth, action mask),
    ``lookahead`` (features and the predicted divergences of every action), ``map`` (features and
    the space around), ``goals``, ``held`` and ``candidates`` (state, and what the planners look at
    of every action), ``pixels`` (a vector of state and small images) or ``rgbd`` (images and
    state). Only what the robot itself has; see
    :mod:`ms_slam_env.env.observations`. Where the agent chooses the SLAM configuration, also the
    one in force, one-hot (K,): at the end of the vector, or as ``slam_configuration``.

    ## Reward
    The sum of these terms (``info["reward_terms"]``), each times its weight (option ``reward``):
    ``intensity_divergence`` and ``depth_divergence``, -0.5 per M_I and M_D of distance to the
    target, of each at most 0.4, depth times lambda (0.1); ``trajectory_error``, -10 per metre that
    the pose error grew, at most 0.1 m either way; ``new_surface``, +1 per m2 newly mapped in its
    true place; ``lost``, -0.5 a step; ``lost_for_good``, -10 once; ``blocked``, -0.1 a masked
    action; where the agent chooses the SLAM configuration ``compute``, -0.1 times its cost, a
    number (``adaptation.costs``) and not a clock's, so that two runs agree.
    Scale: random possible motions in a living room brought -0.2 to 1.6 a step in 90 % of the
    steps with the arm and -0.4 to 1.3 with the free camera, from -1.7 (lost) to 4.0 at the
    extremes, and -10.8 to -11.7 at the end of an episode that was lost for good.

    ## Start
    A free pose of the scene, drawn from the seed; SLAM starts at the true pose with one frame.

    ## End
    Terminated when tracking was lost for ``lost_patience`` consecutive steps, or when for
    ``away_patience`` steps the camera was lost or in submaps that are not joined to the first;
    truncated by the time limit (``max_episode_steps`` of ``gym.make``, 150 by default), or when
    ``seconds`` of simulated time have passed.

    ## Info
    ``T_world_camera``, ``T_world_camera_estimate`` (4, 4); ``pose_covariance`` (6, 6) of the
    estimate, of the twist (rho, phi) in metres and radians in the camera's frame, infinite where
    SLAM gave none (at the start, while lost, by another backend or source of the pose);
    ``pose_error`` m; ``ate`` running RMSE of the pose error over all frames, m, no alignment;
    ``divergence`` (2,) intensity and depth between the last frames of this step and the one
    before, nats; ``tracking_ok``; ``submap``, 0 for the first and those joined to it: in
    another one ``tracking_ok`` is true and the pose as unsure as ``pose_covariance`` says;
    ``reward_terms``; ``action_mask`` (n,) bool; ``mapped_area`` m2;
    ``mapped_share`` of the surface that opens into free space, [0, 1]; ``time`` simulated seconds;
    ``energy`` mechanical work of the motion so far, J; ``scene``, ``scene_seed``.
    No clock: timings are in ``env.unwrapped.timings``. Where the agent chooses it:
    ``slam_configuration``, the index in force.

    ## Arguments
    The fields of :class:`ms_slam_env.env.EnvConfig`, by keyword; nested ones as dataclass or
    mapping.

    ## Version history
    v0: first version.

    Args:
        embodiment: ``arm`` (with physics), ``arm-kinematic``, ``free`` or ``fixed-translation``.
        render_mode: None, ``rgb_array``, or ``human``: every step is shown in the Rerun viewer.
        agent_configures_slam: whether an action has a second part, the SLAM configuration;
            ``adaptation`` is then ``agent``, by name or as a mapping with its options.
        **options: fields of ``EnvConfig``.

    Raises:
        InputError: an unknown option or choice, a value out of range, or another ``adaptation``
            where the agent chooses the SLAM configuration.
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
        # A step's only frame is not to be dropped unless frame management is asked for.
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
        self._observation = make_observation(
            config.observation, self.intrinsics, num_motions, self._actions.num_configurations
        )
        self.simulation.carves |= self._observation.needs_occupancy
        self._episodes_left = 0  # in the scene that was drawn last
        self.action_space = self._actions.space
        self.observation_space = self._observation.space
        self.on_load: Callable[[int], None] = _nothing
        self.make_view: Callable[[ActiveSlamEnv], Any] | None = None
        """Makes what shows an episode, step by step; see `rerun_view.EpisodeView`."""
        self._view: Any = None

    # -- Gymnasium ---------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seeds the environment's generator.
            options: ``T_world_camera`` (4, 4) to start from instead of a drawn pose; ``scene`` and
                ``scene_seed`` in place of drawn ones, for this episode: the name of one of our
                scenes or of this environment's. All else is as the seed has it.

        Raises:
            InputError: a bad option, or a start from where there is nothing to map; the
                environment must then be reset again before it is used.
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
        """Make one motion, track the frames that it brings, judge what came of it.

        Raises:
            InputError: no action of the action space, or no reset before.
        """
        reward, lost_for_good = self._advance(action)
        if self._view is not None:
            self._view.log()
        return self._observe(), reward, lost_for_good, self._time_is_up(), self._info()

    def _advance(self, action: Any) -> tuple[float, bool]:
        """Make a motion and judge it: the reward, and whether the camera is lost for good."""
        episode = self.episode
        episode.action = self._actions.decode(action)
        error_before = episode.pose_error
        made, new_surface = self.simulation.move(episode)
        lost_for_good = self._lost_share() >= 1
        outcome = Outcome(
            divergence=episode.divergence,
            pose_error_growth_m=episode.pose_error - error_before,
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
        """One picture that explains the moment, (480, 1120, 3) uint8; None in other modes."""
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
        """What the map predicts of here and of the candidates, in units of (M_I, M_D)."""
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
        """How much of the patience with a lost camera is used up; 1 or more ends the episode."""
        lost, away = self.episode.steps_lost, self.episode.steps_away
        if lost < away:  # in a submap, or lost after one
            return max(lost / self.config.lost_patience, away / self.config.away_patience)
        return lost / self.config.lost_patience

    def _time_is_up(self) -> bool:
        seconds = self.config.seconds
        return seconds is not None and self.episode.frames[-1].time_s >= seconds

    def _info(self) -> dict[str, Any]:
        info = {
            **self.episode.info(),
            "action_mask": self.action_masks(),
            "mapped_area": self.coverage.mapped_area,
            "mapped_share": self.coverage.mapped_share,
        }
        if self._actions.num_configurations > 1:
            info[CONFIGURATION] = self._actions.configuration
        return info

    # -- What evaluation may read ------------------------------------------------------------

    @property
    def episode(self) -> Episode:
        """The episode so far: trajectories and measures, which evaluation may read.

        Raises:
            InputError: the environment was not reset.
        """
        episode = self.simulation.episode
        if episode is None:
            raise InputError("the environment must be reset before it is used: call env.reset()")
        return episode

    @property
    def scene(self) -> Scene:
        """Where it is."""
        return self.simulation.world.scene

    @property
    def sensor(self) -> RGBDSensor:
        """The camera in the scene."""
        return self.simulation.world.sensor

    @property
    def embodiment(self) -> Embodiment:
        """What carries the camera."""
        return self.simulation.world.embodiment

    @property
    def coverage(self) -> CoverageGrid:
        """The true surface that was mapped in its place so far."""
        return self.simulation.world.coverage

    @property
    def camera_feed(self) -> CameraFeed:
        """Takes the frames."""
        return self.simulation.camera_feed

    @property
    def state_names(self) -> tuple[str, ...]:
        """What the numbers of the observations' state vector are; see ``STATE_NAMES``."""
        return STATE_NAMES

    # -- What planners use -------------------------------------------------------------------

    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) which actions are possible now; the name is sb3-contrib's.

        (n + K,) where the agent chooses the SLAM configuration too.
        """
        _ = self.episode  # none yet: say so
        return self._actions.masks(self.simulation.action_masks())

    def candidate_poses(self) -> Float64:
        """(n, 4, 4) where each motion would bring the camera, by SLAM's estimate of now."""
        return self.episode.T_world_camera_estimate @ self.embodiment.candidate_motions()

    def predict_candidates(self) -> Views:
        """The view of each candidate as the map predicts it."""
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
        """Rewards (k,) that each of some actions would bring now; nothing has changed after it.

        Raises:
            InputError: no action of the action space, or no reset before.
        """
        return np.array([sum(terms.values()) for terms in self.foresee_terms(actions)])

    def foresee_terms(self, actions: Iterable[Any]) -> list[dict[str, float]]:
        """The terms of those rewards, name to weighted value, as ``info["reward_terms"]``.

        Each action is made and taken back, in the order given: what a simulator can tell and a
        robot cannot. Of use to tree search and to teachers, and some 15 ms an action.

        Raises:
            InputError: no action of the action space, or no reset before.
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
        """Put perturbations on the camera, after those that it has; from the next reset on.

        Raises:
            InputError: one that changes how the camera moves, which is the agent's business.
        """
        every = (*self.camera_feed.perturbations, *perturbations)
        self.simulation.camera_feed = make_camera_feed(every)

    # -- State -------------------------------------------------------------------------------

    def save_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly (the time limit's counter excepted)."""
        _ = self.episode  # none yet: say so
        return save_state(self.simulation, self._settings(), self.np_random)

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that ``save_state`` of an env with the same world and robot returned.

        No reset is needed before. Gymnasium's own wrappers of an environment made by ``gym.make``
        follow: the time limit counts the steps of the state's episode. The next reset draws a
        scene, whatever ``episodes_per_scene`` is.

        Raises:
            InputError: options that shape the state differ, or it is not such a state; the
                environment is as it was.
        """
        load_state(self.simulation, state, self._settings(), self.np_random)
        self._episodes_left = 0
        self.on_load(len(self.episode.divergences_of_steps) - 1)

    def _settings(self) -> dict[str, Any]:
        """What two environments must have in common to go on from one state."""
        settings = self.config.of_state(self._arguments[0])
        return {**settings, "perturbations": self.camera_feed.perturbations}

    def __getstate__(self) -> dict[str, Any]:
        """Arguments and, once reset, the episode: device arrays are made anew."""
        return {
            "arguments": self._arguments,
            "perturbations": self.camera_feed.perturbations,
            "state": None if self.simulation.episode is None else self.save_state(),
            "episodes_left": self._episodes_left,
        }

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        """Build the environment anew and go on from where the pickled one was."""
        *arguments, options = pickled["arguments"]
        self.__init__(*arguments, **options)  # type: ignore[misc]
        self.perturb(*pickled["perturbations"])
        if pickled["state"] is not None:
            self.load_state(pickled["state"])
            self._episodes_left = pickled["episodes_left"]


def _nothing(steps: int) -> None:
    """What is done at a loaded state where nobody asked for more."""
