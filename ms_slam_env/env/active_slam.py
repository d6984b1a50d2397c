"""The environment: plan, move, render, track, judge."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ms_slam_env import slam as slam_backends
from ms_slam_env.camera import Intrinsics, intensity_image, xtion
from ms_slam_env.divergence import Histograms, make_divergence
from ms_slam_env.env.config import make_config
from ms_slam_env.env.coverage import CoverageGrid
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.episode_record import EpisodeRecord
from ms_slam_env.env.frame_source import FrameSource
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.env.observations import RobotKnowledge, make_observation
from ms_slam_env.env.perturbed_frames import frames_with
from ms_slam_env.env.pose_sources import POSE_SOURCES
from ms_slam_env.env.rendering import Renderer
from ms_slam_env.env.reward import Outcome, reward_terms
from ms_slam_env.env.state import EpisodeState, check_same_settings
from ms_slam_env.env.worlds import get_scene, get_sensor
from ms_slam_env.errors import InputError, UnreachableError, unknown
from ms_slam_env.geometry import check_pose, invert
from ms_slam_env.robot import Movement
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.base import SlamBackend, Views
from ms_slam_env.timings import Timings

Float64 = NDArray[np.float64]

_START_TRIES = 10  # a drawn start sees surface in most of its view: one try is nearly always enough


class ActiveSlamEnv(EpisodeRecord):
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
        self.config = make_config(options)
        self.render_mode = render_mode
        self.intrinsics: Intrinsics = xtion(self.config.image_size)
        self.timings = Timings()
        backend = slam_backends.make(self.config.slam, self.intrinsics, **self.config.slam_config)
        # A step's only frame is not to be dropped unless frame management is asked for.
        self.adaptive: SlamBackend = self.config.adaptation.adapt(backend, drops_frames=False)
        self.slam: SlamBackend = self.config.frame_management.manage(self.adaptive)
        self._embodiment_type = EMBODIMENTS[embodiment]
        self._embodiment_type.check(self.config)
        self._pose_source = POSE_SOURCES[self.config.pose]()
        self._measure = make_divergence(self.config.divergence, self.intrinsics)
        self._lookahead = Lookahead(self.config.lookahead, self.config.divergence, self.intrinsics)
        num_actions = self._embodiment_type.num_actions
        self.action_space = spaces.Discrete(num_actions)
        self._observation = make_observation(self.config.observation, self.intrinsics, num_actions)
        self.observation_space = self._observation.space
        self.frames: FrameSource = frames_with(())
        self._renderer = Renderer()
        self._rays = self.intrinsics.rays()
        self._episode: EpisodeState | None = None

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

    # -- State -------------------------------------------------------------------------------

    def save_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly (the time limit's counter excepted)."""
        return {
            "settings": self._settings(),
            "episode": self._current().copy(),
            "slam": self.slam.get_state(),
            "embodiment": self.embodiment.get_state(),
            "coverage": self.coverage.get_state(),
            "frames": self.frames.get_state(),
            "T_world_kinematic": self._T_world_kinematic.copy(),
            "random": self.np_random.bit_generator.state,
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that ``save_state`` of an env with the same world and robot returned.

        Raises:
            InputError: options that shape the state differ; the environment is as it was.
        """
        check_same_settings(state["settings"], self._settings())
        episode: EpisodeState = state["episode"]
        self._enter_scene(episode.scene, episode.scene_seed)
        self._episode = episode.copy()
        self.slam.set_state(state["slam"])
        self.embodiment.set_state(state["embodiment"])
        self.coverage.set_state(state["coverage"])
        self.frames.set_state(state["frames"], self.scene, self.sensor, episode.truth[0])
        self._T_world_kinematic = state["T_world_kinematic"].copy()
        self.np_random.bit_generator.state = state["random"]

    def _settings(self) -> dict[str, Any]:
        """What two environments must have in common to go on from one state."""
        settings = self.config.of_state(self._options["embodiment"])
        return {**settings, "perturbations": self.frames.perturbations}

    # -- The world ---------------------------------------------------------------------------

    def _enter_scene(self, name: str, scene_seed: int) -> None:
        self.scene: Scene = get_scene(name, scene_seed)
        self.sensor: RGBDSensor = get_sensor(
            name, scene_seed, self.config.image_size, self.config.noise
        )
        self.embodiment = self._embodiment_type.build(self.scene, self.config, self.timings)
        self.coverage = CoverageGrid(self.scene)

    def _begin_episode(self, name: str, scene_seed: int, start: Float64) -> str:
        """Put the camera at ``start`` and take the first frame; return why not, or nothing."""
        try:
            self.embodiment.reset(start, self.np_random)
        except UnreachableError as error:
            return str(error)
        self._episode = EpisodeState(
            scene=name,
            scene_seed=scene_seed,
            noise_seed=int(self.np_random.integers(2**31)),
        )
        self.coverage = CoverageGrid(self.scene)
        here = self.embodiment.T_world_camera
        try:
            self.frames.begin(self.scene, self.sensor, here, self._episode.noise_seed)
        except InputError as error:
            return str(error)
        self.slam.reset(here)
        self._observe(here, here, timestamp=0.0)
        self._current().end_step(np.zeros(2), 0.0)
        self._T_world_kinematic = here @ invert(self.embodiment.T_world_camera_kinematic)
        if self.tracking_ok:
            return ""
        return f"too few depth readings there in scene {name}: SLAM has nothing to map"

    def _observe_world(self, movement: Movement) -> float:
        """Take and track the frames of a motion; return the newly mapped area, m2."""
        episode = self._current()
        begin = episode.time_s
        self.frames.set_out(
            np.concatenate([[begin], begin + movement.times_s]),
            np.concatenate([episode.truth[-1][None], movement.T_world_camera]),
        )
        area = 0.0
        for T_true, T_kinematic, after in zip(
            movement.T_world_camera,
            movement.T_world_camera_kinematic,
            movement.times_s,
            strict=True,
        ):
            area += self._observe(T_true, self._T_world_kinematic @ T_kinematic, begin + after)
        with self.timings.stage("divergence"):
            if len(movement.times_s) == 1:
                divergence = episode.frame_divergences[-1]
            else:
                divergence = self._divergence_from(episode.step_histograms)
        episode.end_step(divergence, movement.energy_j)
        return area

    def _observe(self, T_true: Float64, T_kinematic: Float64, timestamp: float) -> float:
        """Render, track, measure and judge one frame; return the newly mapped area, m2."""
        episode = self._current()
        with self.timings.stage("render"):
            frame = self.frames.take(T_true, episode.frame_index, timestamp)
        first = not episode.truth
        sighting = episode.sighting(frame, T_true, T_kinematic, timestamp)
        if frame is None:
            unseen = self._pose_source.pass_by(
                sighting, episode.tracking_ok, episode.inlier_fraction
            )
            episode.record(sighting, unseen, np.zeros(2))
            return 0.0
        with self.timings.stage("slam"):
            if first:
                result = self.slam.track(frame)
            else:
                result = self._pose_source.locate(self.slam, sighting)
        with self.timings.stage("divergence"):
            grey = intensity_image(frame.color)[None].astype(np.float32)
            before = episode.histograms
            episode.histograms = self._measure.histograms(grey, frame.depth[None])
            divergence = self._divergence_from(before)
        with self.timings.stage("coverage"):
            area = 0.0
            if result.tracking_ok and result.processed:
                seen = frame.depth, self.frames.true_depth()
                area = self.coverage.see(*seen, self._rays, T_true, result.T_world_camera)
        episode.record(sighting, result, divergence)
        return area

    def _divergence_from(self, before: Histograms | None) -> Float64:
        """(2,) divergence of the last frame from an earlier one; zero from none."""
        histograms = self._current().histograms
        if before is None or histograms is None:
            return np.zeros(2)
        return self._measure.divergence(histograms, before)[0]

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

    def _current(self) -> EpisodeState:
        if self._episode is None:
            raise InputError("the environment must be reset before it is used: call env.reset()")
        return self._episode

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
