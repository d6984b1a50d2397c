"""The environment: plan, move, render, track, judge."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ms_slam_env import slam as slam_backends
from ms_slam_env.camera import RGBDFrame, intensity_image
from ms_slam_env.divergence import Histograms, make_divergence
from ms_slam_env.env.actions import ActionDecoder, MotionActions, MotionAndConfigurationActions
from ms_slam_env.env.camera_feed import make_camera_feed
from ms_slam_env.env.config import make_config
from ms_slam_env.env.coverage import CoverageGrid
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.episode import Episode
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.env.observations import (
    CONFIGURATION,
    STATE_NAMES,
    RobotKnowledge,
    make_observation,
)
from ms_slam_env.env.pose_sources import POSE_SOURCES
from ms_slam_env.env.rendering import draw_moment
from ms_slam_env.env.reward import Outcome, reward_terms
from ms_slam_env.env.state import check_episode, check_parts, check_same_settings
from ms_slam_env.errors import InputError, UnreachableError, unknown
from ms_slam_env.geometry import check_pose, invert
from ms_slam_env.robot import Embodiment, MotionResult
from ms_slam_env.scenes.base import Scene
from ms_slam_env.scenes.registry import SceneName
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.scene_cache import get_scene, get_sensor
from ms_slam_env.sequences.perturbations.base import Perturbation
from ms_slam_env.slam.base import SlamBackend, TrackResult, Views
from ms_slam_env.slam.state_check import check_like, is_open
from ms_slam_env.timings import Timings

Float64 = NDArray[np.float64]


class World(NamedTuple):
    """A scene and what an environment has in it."""

    scene: Scene
    sensor: RGBDSensor
    embodiment: Embodiment
    coverage: CoverageGrid


_START_TRIES = 10  # a drawn start sees surface in most of its view: one try is nearly always enough


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
    ``lookahead`` (features and the predicted divergences of every action) or ``rgbd`` (images and
    state). Only what the robot itself has; see :mod:`ms_slam_env.env.observations`. Where the agent
    chooses the SLAM configuration, also the one in force, one-hot (K,): at the end of the vector,
    or as ``slam_configuration``.

    ## Reward
    The sum of these terms (``info["reward_terms"]``), each times its weight (option ``reward``):
    ``intensity_divergence`` and ``depth_divergence``, -0.1 per M_I and M_D of distance to the
    target, of each at most 2, depth times lambda (0.1); ``trajectory_error``, -10 per metre that
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
    truncated by the time limit (``max_episode_steps`` of ``gym.make``, 150 by default).

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
        render_mode: None or ``rgb_array``.
        agent_configures_slam: whether an action has a second part, the SLAM configuration;
            ``adaptation`` is then ``agent``, by name or as a mapping with its options.
        **options: fields of ``EnvConfig``.

    Raises:
        InputError: an unknown option or choice, a value out of range, or another ``adaptation``
            where the agent chooses the SLAM configuration.
    """

    metadata = {  # noqa: RUF012 -- Gymnasium declares it as an instance variable
        "render_modes": ["rgb_array"],
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
                "(render() returns a picture; no window is opened)"
            )
        if not isinstance(embodiment, str) or embodiment not in EMBODIMENTS:
            raise unknown("embodiment", embodiment, EMBODIMENTS)
        if agent_configures_slam:
            options.setdefault("adaptation", "agent")
        self._arguments = (embodiment, render_mode, agent_configures_slam, options)
        self.render_mode = render_mode
        self.config = config = make_config(options)
        self.intrinsics = config.camera
        self._rays = self.intrinsics.rays()
        self.timings = Timings()

        backend = slam_backends.make(config.slam, self.intrinsics, **config.slam_config)
        # A step's only frame is not to be dropped unless frame management is asked for.
        adapted = config.adaptation.adapt(backend, drops_frames=False)
        self.slam: SlamBackend = config.frame_management.manage(adapted)
        self._embodiment_type = EMBODIMENTS[embodiment]
        self._embodiment_type.check(config)
        self.camera_feed = make_camera_feed(())
        self._pose_source = POSE_SOURCES[config.pose]()
        self._divergence = make_divergence(config.divergence, self.intrinsics)
        self._lookahead = Lookahead(config.lookahead, config.divergence, self.intrinsics)

        num_motions = self._embodiment_type.num_motions
        self._actions: ActionDecoder = MotionActions(num_motions)
        if agent_configures_slam:
            self._actions = MotionAndConfigurationActions(num_motions, adapted, config.adaptation)
        self._observation = make_observation(
            config.observation, self.intrinsics, num_motions, self._actions.num_configurations
        )
        self.action_space = self._actions.space
        self.observation_space = self._observation.space
        self._episode: Episode | None = None
        self._place: tuple[SceneName, int] | None = None
        self._fresh_slam = self.slam.get_state()
        self.on_load: Callable[[int], None] = _nothing

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
        _check_reset(seed, options)
        super().reset(seed=seed)
        self._episode = None  # the world of the old episode may be gone before this one begins
        name, scene_seed = self.config.draw_scene(self.np_random)
        self._place = name, scene_seed
        self.scene, self.sensor, self.embodiment, self.coverage = self._world(name, scene_seed)
        start = (options or {}).get("T_world_camera")
        if start is None:
            self._start_somewhere(name, scene_seed)
        else:
            start = check_pose(start, "reset option T_world_camera")
            why = self._start_at(start, name, scene_seed)
            if why:
                raise InputError(f"reset option T_world_camera: {why}")
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make one motion, track the frames that it brings, judge what came of it.

        Raises:
            InputError: no action of the action space, or no reset before.
        """
        episode = self.episode
        episode.action = self._actions.decode(action)
        with self.timings.stage("move"):
            motion = self.embodiment.move(episode.action)
        error_before = episode.pose_error
        new_surface = self._track_motion(motion)
        lost_for_good = self._lost_share() >= 1
        outcome = Outcome(
            divergence=episode.divergence,
            pose_error_growth_m=episode.pose_error - error_before,
            new_surface_m2=new_surface,
            tracking_ok=episode.tracking_ok,
            lost_for_good=lost_for_good,
            blocked=not motion.made,
            configuration_cost=self._actions.configuration_cost,
        )
        episode.reward_terms = reward_terms(outcome, self.config.reward, self.config.targets)
        reward = float(sum(episode.reward_terms.values()))
        return self._observe(), reward, lost_for_good, False, self._info()

    def render(self) -> NDArray[np.uint8] | None:
        """One picture that explains the moment, (480, 1120, 3) uint8; None without render mode."""
        if self.render_mode is None:
            return None
        return draw_moment(
            self.episode, self.config.targets, self.slam, self.embodiment, self.scene
        )

    # -- One motion --------------------------------------------------------------------------

    def _track_motion(self, motion: MotionResult) -> float:
        """Take and track the frames of a motion; return the newly mapped area, m2."""
        episode = self.episode
        last = episode.frames[-1]
        times_s = last.time_s + motion.times_s
        self.camera_feed.set_trajectory(
            np.concatenate([[last.time_s], times_s]),
            np.concatenate([last.T_world_camera[None], motion.T_world_camera]),
        )
        kinematics = self._T_world_kinematic @ motion.T_world_camera_kinematic
        moments = zip(motion.T_world_camera, kinematics, times_s, strict=True)
        new_surface = sum(self._track_frame(*moment) for moment in moments)
        divergence = episode.frames[-1].divergence
        if len(times_s) > 1:
            with self.timings.stage("divergence"):
                divergence = self._divergence_from(episode.step_histograms)
        episode.end_step(divergence, motion.energy_j)
        return new_surface

    def _track_frame(self, T_true: Float64, T_kinematic: Float64, time_s: float) -> float:
        """Take, track and measure one frame; return the newly mapped area, m2."""
        episode = self.episode
        with self.timings.stage("render"):
            frame = self.camera_feed.capture(T_true, len(episode.frames), time_s)
        seen = episode.observe(frame, T_true, T_kinematic, time_s)
        if frame is None:
            state = episode.tracking_ok, episode.inlier_fraction
            result = self._pose_source.handle_dropped_frame(seen, *state)
            result = dataclasses.replace(result, submap=episode.frames[-1].submap)
            episode.record(seen, result, np.zeros(2))
            return 0.0
        with self.timings.stage("slam"):
            if episode.frames:
                result = self._pose_source.locate(self.slam, seen)
            else:
                result = self.slam.track(frame)
        with self.timings.stage("divergence"):
            grey = intensity_image(frame.color)[None].astype(np.float32)
            now = self._divergence.histograms(grey, frame.depth[None])
            before, episode.histograms = episode.histograms, now
            divergence = self._divergence_from(before)
        with self.timings.stage("coverage"):
            new_surface = self._cover(frame, T_true, result)
        episode.record(seen, result, divergence)
        return new_surface

    def _divergence_from(self, before: Histograms | None) -> Float64:
        """(2,) divergence of the last frame from an earlier one; zero from none."""
        now = self.episode.histograms
        if before is None or now is None:
            return np.zeros(2)
        return self._divergence.divergence(now, before)[0]

    def _cover(self, frame: RGBDFrame, T_true: Float64, result: TrackResult) -> float:
        """Mark what a frame added to the map; return the newly mapped area, m2."""
        if not result.fused:
            return 0.0
        depths = frame.depth, self.camera_feed.true_depth()
        return self.coverage.see(*depths, self._rays, T_true, result.T_world_camera)

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
                    motion_mask=self.embodiment.action_masks(),
                    configuration=self._actions.configuration,
                    lookahead=lambda: self.lookahead() / maxima,
                )
            )

    def _lost_share(self) -> float:
        """How much of the patience with a lost camera is used up; 1 or more ends the episode."""
        lost, away = self.episode.steps_lost, self.episode.steps_away
        if lost < away:  # in a submap, or lost after one
            return max(lost / self.config.lost_patience, away / self.config.away_patience)
        return lost / self.config.lost_patience

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

    # -- The start of an episode -------------------------------------------------------------

    def _world(self, name: SceneName, scene_seed: int) -> World:
        """A scene and what stands in it."""
        scene = get_scene(name, scene_seed)
        sensor = get_sensor(name, scene_seed, self.intrinsics, self.config.noise)
        robot = self._embodiment_type.build(scene, self.config, self.timings)
        return World(scene, sensor, robot, CoverageGrid(scene))

    def _here(self) -> World:
        return World(self.scene, self.sensor, self.embodiment, self.coverage)

    def _start_somewhere(self, name: SceneName, scene_seed: int) -> None:
        """Begin at the first pose drawn that can be used.

        Raises:
            InputError: none of some can.
        """
        for _ in range(_START_TRIES):
            why = self._start_at(self.scene.sample_start(self.np_random), name, scene_seed)
            if not why:
                return
        if self.config.arm.base is not None:
            why += "; give one with reset(options={'T_world_camera': ...})"
        raise InputError(f"none of {_START_TRIES} drawn start poses can be used, the last: {why}")

    def _start_at(self, start: Float64, name: SceneName, scene_seed: int) -> str:
        """Put the camera at a pose (4, 4) and take the first frame; return why not, or nothing."""
        self._episode = None
        try:
            self.embodiment.reset(start, self.np_random)
        except UnreachableError as error:
            return str(error)
        noise_seed = int(self.np_random.integers(2**31))
        self.coverage = CoverageGrid(self.scene)
        here = self.embodiment.T_world_camera
        try:
            self.camera_feed.begin(self.scene, self.sensor, here, noise_seed)
        except InputError as error:
            return str(error)
        self.slam.reset(here)
        self._T_world_kinematic = here @ invert(self.embodiment.T_world_camera_kinematic)
        self._episode = Episode(getattr(name, "__name__", str(name)), scene_seed, noise_seed)
        self._track_frame(here, here, time_s=0.0)
        self._episode.end_step(np.zeros(2), energy_j=0.0)
        if self._episode.tracking_ok:
            return ""
        self._episode = None
        return f"too few depth readings there in scene {name}: SLAM has nothing to map"

    @property
    def episode(self) -> Episode:
        """The episode so far: trajectories and measures, which evaluation may read.

        Raises:
            InputError: the environment was not reset.
        """
        if self._episode is None:
            raise InputError("the environment must be reset before it is used: call env.reset()")
        return self._episode

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
        return self._actions.masks(self.embodiment.action_masks())

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

    def perturb(self, *perturbations: Perturbation) -> None:
        """Put perturbations on the camera, after those that it has; from the next reset on.

        Raises:
            InputError: one that changes how the camera moves, which is the agent's business.
        """
        self.camera_feed = make_camera_feed((*self.camera_feed.perturbations, *perturbations))

    # -- State -------------------------------------------------------------------------------

    def save_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly (the time limit's counter excepted)."""
        return {
            "settings": self._settings(),
            "episode": self.episode.copy(),
            "slam": self.slam.get_state(),
            "embodiment": self.embodiment.get_state(),
            "coverage": self.coverage.get_state(),
            "camera_feed": self.camera_feed.get_state(),
            "T_world_kinematic": self._T_world_kinematic.copy(),
            "random": self.np_random.bit_generator.state,
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that ``save_state`` of an env with the same world and robot returned.

        No reset is needed before. Gymnasium's own wrappers of an environment made by ``gym.make``
        follow: the time limit counts the steps of the state's episode.

        Raises:
            InputError: options that shape the state differ, or it is not such a state; the
                environment is as it was.
        """
        check_parts(state)
        check_same_settings(state["settings"], self._settings())
        motions, blank = self._embodiment_type.num_motions, self._blank
        check_episode(state["episode"], self._episode, blank, self.intrinsics.shape, motions)
        episode = state["episode"]
        place = episode.scene, episode.scene_seed
        world = self._here() if place == self._place else self._world(*place)
        self._check_state(state, world)
        self._take_up(state, world)
        self._place = place
        self.scene, self.sensor, self.embodiment, self.coverage = world
        self.coverage.set_state(state["coverage"])
        self._T_world_kinematic = state["T_world_kinematic"].copy()
        self.np_random.bit_generator.state = state["random"]
        self._episode = episode.copy()
        self.on_load(len(episode.divergences_of_steps) - 1)

    def _check_state(self, state: Mapping[str, Any], world: World) -> None:
        """Refuse parts of a state that do not belong into a world."""
        like = {
            "slam": self._fresh_slam,
            "embodiment": world.embodiment.get_state(),
            "coverage": world.coverage.get_state(),
            "T_world_kinematic": np.eye(4),
            "random": self.np_random.bit_generator.state,
            "camera_feed": self.camera_feed.example,
        }
        for name, own in like.items():
            check_like(state[name], own, name)
        if state["camera_feed"]["noise_seed"] != state["episode"].noise_seed:
            raise InputError("this is no state to go on from: camera_feed is of another episode")

    def _take_up(self, state: Mapping[str, Any], world: World) -> None:
        """Give SLAM, camera and robot their states; all or none."""
        robot, start = world.embodiment, state["episode"].frames[0].T_world_camera
        undo = [partial(robot.set_state, robot.get_state())]
        if self._episode is not None and self.camera_feed.has_begun:
            own = self.camera_feed.get_state(), self.scene, self.sensor
            began = self._episode.frames[0].T_world_camera
            undo.append(partial(self.camera_feed.set_state, *own, began))
        if is_open(self._fresh_slam):
            undo.append(partial(self.slam.set_state, self.slam.get_state()))
        try:
            robot.set_state(state["embodiment"])
            self.camera_feed.set_state(state["camera_feed"], world.scene, world.sensor, start)
            self.slam.set_state(state["slam"])
        except Exception as error:  # whatever a part makes of what only looks like its state
            for back in undo:
                back()
            raise InputError(f"this is no state to go on from: {error!r}") from error

    @cached_property
    def _blank(self) -> Histograms:
        """Histograms of a frame with nothing in it."""
        nothing = np.zeros((1, *self.intrinsics.shape), np.float32)
        return self._divergence.histograms(nothing, nothing)

    def _settings(self) -> dict[str, Any]:
        """What two environments must have in common to go on from one state."""
        settings = self.config.of_state(self._arguments[0])
        return {**settings, "perturbations": self.camera_feed.perturbations}

    def __getstate__(self) -> dict[str, Any]:
        """Arguments and, once reset, the episode: device arrays are made anew."""
        return {
            "arguments": self._arguments,
            "perturbations": self.camera_feed.perturbations,
            "state": None if self._episode is None else self.save_state(),
        }

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        """Build the environment anew and go on from where the pickled one was."""
        *arguments, options = pickled["arguments"]
        self.__init__(*arguments, **options)  # type: ignore[misc]
        self.perturb(*pickled["perturbations"])
        if pickled["state"] is not None:
            self.load_state(pickled["state"])


def _nothing(steps: int) -> None:
    """What is done at a loaded state where nobody asked for more."""


def _check_reset(seed: Any, options: Any) -> None:
    """Refuse arguments of ``reset`` of the wrong type, and unknown options."""
    is_seed = isinstance(seed, (int, np.integer)) and not isinstance(seed, bool) and seed >= 0
    if seed is not None and not is_seed:
        raise InputError(f"reset(seed={seed!r}): must be an integer >= 0 or None")
    if options is not None and not isinstance(options, Mapping):
        raise InputError(f"reset(options={options!r}): must be a mapping or None")
    unknown_options = set(options or {}) - {"T_world_camera"}
    if unknown_options:
        names = sorted(map(str, unknown_options))
        raise InputError(f"unknown reset option {names}; valid choices: T_world_camera")
