"""A camera in a world, and the SLAM that tracks and maps what it sees."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import slam as slam_backends
from ms_slam_env.camera import Intrinsics, intensity_image, xtion
from ms_slam_env.divergence import Histograms, make_divergence
from ms_slam_env.env.config import EnvConfig
from ms_slam_env.env.coverage import CoverageGrid
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.episode_record import EpisodeRecord
from ms_slam_env.env.frame_source import FrameSource
from ms_slam_env.env.perturbed_frames import frames_with
from ms_slam_env.env.pose_sources import POSE_SOURCES
from ms_slam_env.env.state import EpisodeState, check_same_settings
from ms_slam_env.errors import InputError, UnreachableError
from ms_slam_env.geometry import invert
from ms_slam_env.robot import MotionResult
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.scene_cache import get_scene, get_sensor
from ms_slam_env.slam.base import SlamBackend
from ms_slam_env.timings import Timings

Float64 = NDArray[np.float64]


class MappingRobot(EpisodeRecord):
    """Takes the frames of every motion, has SLAM track them, and records the episode.

    Args:
        embodiment: what carries the camera, by name.
        config: the environment's.
    """

    def __init__(self, embodiment: str, config: EnvConfig) -> None:
        self.config = config
        self.intrinsics: Intrinsics = xtion(config.image_size)
        self.timings = Timings()
        backend = slam_backends.make(config.slam, self.intrinsics, **config.slam_config)
        # A step's only frame is not to be dropped unless frame management is asked for.
        self.adaptive: SlamBackend = config.adaptation.adapt(backend, drops_frames=False)
        self.slam: SlamBackend = config.frame_management.manage(self.adaptive)
        self.frames: FrameSource = frames_with(())
        self._embodiment_name = embodiment
        self._embodiment_type = EMBODIMENTS[embodiment]
        self._embodiment_type.check(config)
        self._pose_source = POSE_SOURCES[config.pose]()
        self._measure = make_divergence(config.divergence, self.intrinsics)
        self._rays = self.intrinsics.rays()
        self._episode: EpisodeState | None = None

    def _current(self) -> EpisodeState:
        if self._episode is None:
            raise InputError("the environment must be reset before it is used: call env.reset()")
        return self._episode

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

    def _observe_world(self, movement: MotionResult) -> float:
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
        settings = self.config.of_state(self._embodiment_name)
        return {**settings, "perturbations": self.frames.perturbations}
