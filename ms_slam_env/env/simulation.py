"""Run an episode: move the camera; capture, track and measure its frames."""

from __future__ import annotations

import dataclasses
from functools import cached_property, lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.timings import Timings
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.divergence import Histograms, make_divergence
from ms_slam_env.env.camera_feed import make_camera_feed
from ms_slam_env.env.coverage import CoverageGrid
from ms_slam_env.env.embodiments import EmbodimentType
from ms_slam_env.env.env_config import MAP, EnvConfig
from ms_slam_env.env.episode import Episode
from ms_slam_env.env.pose_sources import POSE_SOURCES
from ms_slam_env.errors import InputError, UnreachableError, unknown
from ms_slam_env.geometry import invert
from ms_slam_env.planning import OccupancyGrid
from ms_slam_env.robot import Embodiment, MotionResult
from ms_slam_env.scenes.registry import SCENES, SceneName, name_of
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.scene_cache import get_scene, get_sensor
from ms_slam_env.slam.slam_backend import SlamBackend, TrackResult

START_TRIES = 10
"""Starts drawn before an episode is refused; nearly always one sees enough surface."""


@lru_cache(maxsize=4)
def _rays(intrinsics: Intrinsics) -> Float64:
    return intrinsics.rays()


class World(NamedTuple):
    """A scene with an environment's sensor, carrier and coverage."""

    scene: Scene
    sensor: RGBDSensor
    embodiment: Embodiment
    coverage: CoverageGrid


class Simulation:
    """A camera on its carrier in a scene, and the SLAM that follows it.

    Args:
        config: of the environment.
        embodiment_type: type of the carrier.
        slam: SLAM, including its frame selection and run-time adaptation.
        timings: of the stages.

    Attributes:
        world: scene, sensor, carrier and coverage; set at the first start.
        place: name and seed of the scene.
        camera_feed: captures the frames.
        divergence: measures divergence.
        T_world_kinematic: (4, 4) origin of the carrier's kinematics.
        episode: the episode so far; None before the first and if none could begin.
        carves: whether episodes keep an occupancy grid.
        travelled: share of the last continuous motion that was free.
    """

    world: World
    T_world_kinematic: Float64

    def __init__(
        self,
        config: EnvConfig,
        embodiment_type: EmbodimentType,
        slam: SlamBackend,
        timings: Timings,
    ) -> None:
        self.config, self.embodiment_type = config, embodiment_type
        self.slam, self.timings = slam, timings
        self.intrinsics = config.camera
        self.camera_feed = make_camera_feed(())
        self.divergence = make_divergence(config.divergence, self.intrinsics)
        self._pose_source = POSE_SOURCES[config.pose]()
        self.place: tuple[SceneName, int] | None = None
        self.episode: Episode | None = None
        self.carves = config.mask == MAP
        self.travelled = 1.0
        nothing = np.zeros(0, dtype=bool)
        self._known_mask: tuple[NDArray[np.bool_], Episode | None, int] = nothing, None, 0
        self.fresh_slam = slam.state_like()

    # -- The start of an episode -------------------------------------------------------------

    def enter(self, name: SceneName, scene_seed: int) -> None:
        """Go to a scene."""
        self.episode = None  # its world may be replaced before the next episode begins
        self.place = name, scene_seed
        self.world = self.world_of(name, scene_seed)

    def place_of(self, episode: Episode) -> tuple[SceneName, int]:
        """The scene and seed of an episode: a scene of the options or a built-in one.

        Raises:
            InputError: any other name, which might refer to code or a file.
        """
        if self.place is not None:
            name, seed = self.place
            if (name_of(name), seed) == (episode.scene, episode.scene_seed):
                return self.place
        own = {name_of(name): name for name in self.config.scenes}
        own |= {name: name for name in SCENES if name not in own}
        if episode.scene not in own:
            raise unknown("scene of a state", episode.scene, own)
        return own[episode.scene], episode.scene_seed

    def world_of(self, name: SceneName, scene_seed: int) -> World:
        """Build a scene with its sensor, carrier and coverage."""
        scene = get_scene(name, scene_seed)
        sensor = get_sensor(name, scene_seed, self.intrinsics, self.config.noise)
        robot = self.embodiment_type.build(scene, self.config, self.timings)
        return World(scene, sensor, robot, self._coverage(scene))

    def start_somewhere(self, rng: np.random.Generator) -> None:
        """Begin at the first drawn pose that is usable.

        Raises:
            InputError: no usable pose in several tries.
        """
        for _ in range(START_TRIES):
            why = self.start_at(self.world.scene.sample_start(rng), rng)
            if not why:
                return
        if self.config.arm.base is not None:
            why += "; give one with reset(options={'T_world_camera': ...})"
        raise InputError(f"none of {START_TRIES} drawn start poses can be used, the last: {why}")

    def start_at(self, start: Float64, rng: np.random.Generator) -> str:
        """Start at a pose (4, 4) with one frame; return why that failed, or an empty string."""
        self.episode, self.travelled = None, 1.0
        robot, scene = self.world.embodiment, self.world.scene
        try:
            robot.reset(start, rng)
        except UnreachableError as error:
            return str(error)
        noise_seed = int(rng.integers(2**31))
        self.world = self.world._replace(coverage=self._coverage(scene))
        here = robot.T_world_camera
        try:
            self.camera_feed.begin(scene, self.world.sensor, here, noise_seed)
        except InputError as error:
            return str(error)
        self.slam.reset(here)
        self.T_world_kinematic = here @ invert(robot.T_world_camera_kinematic)
        assert self.place is not None
        name, scene_seed = self.place
        self.episode = Episode(name_of(name), scene_seed, noise_seed)
        self.episode.occupancy = OccupancyGrid() if self.carves else None
        self._track_frame(self.episode, here, here, time_s=0.0)
        self._end_step(self.episode, np.zeros(2), energy_j=0.0)
        if self.episode.tracking_ok:
            return ""
        self.episode = None
        return f"too few depth readings there in scene {name}: SLAM has nothing to map"

    # -- One motion --------------------------------------------------------------------------

    def move(self, episode: Episode) -> tuple[bool, float]:
        """Make the episode's motion; return whether it was made, and the newly mapped area, m2."""
        by_map, action, robot = self.config.mask == MAP, episode.action, self.world.embodiment
        if isinstance(action, np.ndarray):
            twist = action * np.repeat((self.config.step_m, self.config.step_rad), 3)
            may, offset, move = True, twist[:3], partial(robot.move_by, twist)
        else:
            may = not by_map or bool(self.action_masks()[action])
            offset = robot.candidate_motions()[action][:3, 3] if by_map else np.zeros(3)
            move = partial(robot.move, action if may else 0)
        with self.timings.stage("move"):
            motion = move()
        self.travelled = motion.travelled
        if by_map and may and not motion.made and offset.any():
            assert episode.occupancy is not None
            here = episode.T_world_camera_estimate
            episode.occupancy.touch(here[:3, 3] + here[:3, :3] @ offset)
        return may and motion.made, self._track_motion(episode, motion)

    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) which motions are possible now, by the truth or by the robot's map."""
        robot, episode = self.world.embodiment, self.episode
        if self.config.mask != MAP or episode is None:
            return robot.action_masks()
        known, of, count = self._known_mask
        if of is not episode or count != len(episode.frames):
            assert episode.occupancy is not None
            known = robot.masks_in(episode.occupancy, episode.T_world_camera_estimate)
            self._known_mask = known, episode, len(episode.frames)
        return known.copy()

    def _track_motion(self, episode: Episode, motion: MotionResult) -> float:
        """Capture and track the frames of a motion; return the newly mapped area, m2."""
        last = episode.frames[-1]
        times_s = last.time_s + motion.times_s
        self.camera_feed.set_trajectory(
            np.concatenate([[last.time_s], times_s]),
            np.concatenate([last.T_world_camera[None], motion.T_world_camera]),
        )
        kinematics = self.T_world_kinematic @ motion.T_world_camera_kinematic
        moments = zip(motion.T_world_camera, kinematics, times_s, strict=True)
        new_surface = sum(self._track_frame(episode, *moment) for moment in moments)
        divergence = episode.frames[-1].divergence
        if not self.config.frame_divergences:
            with self.timings.stage("divergence"):
                before = episode.step_histograms
                divergence = self._divergence_of(episode.last_frame, episode, before)
        elif len(times_s) > 1:
            with self.timings.stage("divergence"):
                divergence = self._divergence_from(episode, episode.step_histograms)
        self._end_step(episode, divergence, motion.energy_j)
        return new_surface

    def _end_step(self, episode: Episode, divergence: Float64, energy_j: float) -> None:
        """Close a step; carve its last frame, if delivered, at its tracked pose."""
        episode.end_step(divergence, energy_j)
        came = episode.frames[-1].processed
        if episode.occupancy is not None and episode.tracking_ok and came:
            with self.timings.stage("occupancy"):
                seen = episode.last_frame.depth, episode.T_world_camera_estimate
                episode.occupancy.integrate(*seen, self.intrinsics)

    def _track_frame(
        self, episode: Episode, T_true: Float64, T_kinematic: Float64, time_s: float
    ) -> float:
        """Capture, track and measure one frame; return the newly mapped area, m2."""
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
        divergence = np.full(2, -1.0)  # not measured
        if self.config.frame_divergences or not episode.frames:
            with self.timings.stage("divergence"):
                before = episode.histograms
                divergence = self._divergence_of(frame, episode, before)
        with self.timings.stage("coverage"):
            new_surface = self._cover(frame, T_true, result)
        episode.record(seen, result, divergence)
        return new_surface

    def _divergence_of(
        self, frame: RGBDFrame, episode: Episode, before: Histograms | None
    ) -> Float64:
        """(2,) divergence of the last frame from an earlier one; zero if there is none."""
        grey = intensity_image(frame.color)[None]
        episode.histograms = self.divergence.histograms(grey, frame.depth[None])
        return self._divergence_from(episode, before)

    def _divergence_from(self, episode: Episode, before: Histograms | None) -> Float64:
        """(2,) divergence of the frame measured last from an earlier one; zero if there is none."""
        now = episode.histograms
        if before is None or now is None:
            return np.zeros(2)
        return self.divergence.divergence(now, before)[0]

    def _coverage(self, scene: Scene) -> CoverageGrid:
        """Empty coverage of a scene; uncorrected lens distortion applies to the true rays."""
        bent = dataclasses.replace(self.intrinsics, distortion=self.camera_feed.lens)
        return CoverageGrid(scene, _rays(bent))

    def _cover(self, frame: RGBDFrame, T_true: Float64, result: TrackResult) -> float:
        """Mark the surface that a frame mapped; return the newly mapped area, m2."""
        if not result.fused:
            return 0.0
        depths = frame.depth, self.camera_feed.true_depth()
        return self.world.coverage.see(*depths, T_true, result.T_world_camera)

    @cached_property
    def blank(self) -> Histograms:
        """Histograms of an empty frame."""
        nothing = np.zeros((1, *self.intrinsics.shape), np.float32)
        return self.divergence.histograms(nothing, nothing)
