"""Specify, play and measure one episode of one planner."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np

import ms_slam_env
from ms_slam_env import slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import Checked, bounded, chosen, nested_options
from ms_slam_env.env import Planner
from ms_slam_env.env.planners import check_planner, make_planner, planner_observation
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.gym_ids import ADAPTIVE_ID
from ms_slam_env.scenes import SEED_SPLITS, seeds_of
from ms_slam_env.scenes.registry import check_name, is_mesh_file
from ms_slam_env.tasks import find_task

if TYPE_CHECKING:
    from ms_slam_env.env import ActiveSlamEnv
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import fields

from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.report.records import Row

DEFAULT_PLANNERS = ("random", "stationary", "greedy", "max-information")
DEFAULT_SCENES = ("living_room", "corridor", "table", "wall")
DEFAULT_STEP_M = 0.12
DEFAULT_STEP_DEG = 12.0


OWN_OPTIONS = (
    *("scene", "scene_seed", "split", "observation", "step_m", "step_rad"),
    *("render_mode", "max_episode_steps", "frame_divergences"),
)
"""Options of ``gym.make`` that an episode or its planner sets."""


@dataclass(frozen=True)
class EpisodeSpec(Checked):
    """Everything that an episode depends on.

    Attributes:
        planner: ``NAME,option=value,...``.
        scene: a scene's name or a mesh file.
        seed: seed of the scene, the start pose, the sensor noise and the planner (through a child
            seed).
        env_id: one of ``ms_slam_env.ENV_IDS``.
        steps: length of the episode.
        step_m: translation of a motion.
        step_deg: rotation of a motion.
        options: further options of the environment.
        task: task that supplies missing options, the perturbations and the reference.
    """

    planner: str
    scene: str = "living_room"
    seed: int = 2000
    env_id: str = chosen("MSActiveSLAM-FreeCamera-v0", *ms_slam_env.ENV_IDS)
    steps: int = bounded(100, 1, 1_000_000)
    step_m: float = bounded(DEFAULT_STEP_M, 0, 1)
    step_deg: float = bounded(DEFAULT_STEP_DEG, 0, 90)
    options: dict[str, Any] = field(default_factory=dict)
    task: str = "room"

    def __post_init__(self) -> None:
        """Refuse unknown choices and values out of range."""
        try:
            super().__post_init__()
        except InputError as error:
            # Users know the fields as options of a command, not this class.
            raise InputError(str(error).replace("EpisodeSpec.", "")) from None
        find_task(self.task)
        name = self.planner.partition(",")[0]
        if self.env_id == ADAPTIVE_ID and ":" not in name:
            raise InputError(
                f"planner {name!r} chooses motions only, {ADAPTIVE_ID} also needs a "
                "SLAM configuration; valid choices: module:Class"
            )


def run_episode(spec: EpisodeSpec) -> dict[str, Any]:
    """Run one episode and measure it.

    Returns:
        metrics by name, see :mod:`.episode_scores`, with ``steps``, ``return``, ``decision_ms``
        (mean time of a decision), ``ate_over_steps`` (running RMSE, unaligned, metres, at the steps
        when the map is scored), ``time_s`` (simulated) and ``energy_j`` (mechanical work of the
        motion).
    """
    from ms_slam_env.benchmark.episode_scores import (
        MapScores,
        measure_losses,
        measure_trajectory,
    )

    env = make_env(spec)
    try:
        world = cast("ActiveSlamEnv", env.unwrapped)
        planner = make_planner(spec.planner, world, spec.seed)
        maps = MapScores(world, spec.scene, spec.seed, find_task(spec.task).reference)
        progress = play(env, planner, spec.seed, after_step=maps.after_step)
        trajectory = measure_trajectory(world)
        trajectory["lost"] |= progress["lost_steps_share"] > 0
        planned = spec.steps if progress["terminated"] else progress["steps"]
        map_scores = maps.result(progress["steps"], planned)
        ate = [0.0, *progress.pop("ate_over_time")]
        map_scores["ate_over_steps"] = [ate[step] for step in map_scores["looks_at_steps"]]
        return {**progress, **trajectory, **measure_losses(world), **map_scores}
    finally:
        env.close()


def planned_motion(spec: EpisodeSpec) -> tuple[Float64, Float64, dict[str, Any]]:
    """Play an episode and return the camera's motion, to be rendered again as a sequence.

    Returns:
        simulated seconds (N,) of each frame since the episode's start, true poses (N, 4, 4) of
        every frame, including those within a step, and a description of the episode.

    Raises:
        InputError: an unknown planner, scene or option, or no valid start pose.
    """
    check_planner(spec.planner)
    env = make_env(spec)
    try:
        world = cast("ActiveSlamEnv", env.unwrapped)
        progress = play(env, make_planner(spec.planner, world, spec.seed), spec.seed)
        lost = int((~world.episode.tracked).sum())
        about = {"episode_steps": progress["steps"], "episode_lost_frames": lost}
        return world.episode.timestamps, world.episode.trajectory_truth, about
    finally:
        env.close()


def check_episodes(specs: Sequence[EpisodeSpec]) -> None:
    """Fail early: make the environment and planner of each different kind of episode.

    Scenes are not built.

    Raises:
        InputError: options that the environment, SLAM or a planner refuses, or a planner that
            cannot be constructed.
    """
    different = {
        (spec.planner, spec.env_id, spec.step_m, spec.step_deg, str(spec.options)): spec
        for spec in specs
    }
    for spec in different.values():
        env = make_env(spec)
        try:
            make_planner(spec.planner, env.unwrapped, spec.seed)
        except InputError:
            raise
        except Exception as error:  # a third-party planner may raise anything
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise InputError(f"planner {spec.planner!r} cannot be made: {reason}") from error
        finally:
            env.close()


def make_env(spec: EpisodeSpec) -> gym.Env[Any, Any]:
    """Make the environment of an episode."""
    return gym.make(
        spec.env_id,
        max_episode_steps=spec.steps,
        disable_env_checker=True,
        **{
            "scene": spec.scene,
            "scene_seed": spec.seed,
            "step_m": spec.step_m,
            "step_rad": math.radians(spec.step_deg),
            "observation": planner_observation(spec.planner),
            "task": spec.task,
            **spec.options,
        },
    )


def play(
    env: gym.Env[Any, Any],
    planner: Planner,
    seed: int,
    seconds: float = math.inf,
    start: Float64 | None = None,
    after_step: Callable[[int], None] = lambda step: None,
) -> dict[str, Any]:
    """Play one episode to its end, or until ``seconds`` of simulated time have passed.

    The episode starts at ``start`` (4, 4) if given, else at a pose drawn with the seed.
    ``after_step`` is called with 0 after the reset, then with the step's number after each step.
    """
    options = None if start is None else {"T_world_camera": start}
    observation, info = env.reset(seed=seed, options=options)
    planner.reset()
    after_step(0)
    total, decision_s, lost = 0.0, 0.0, []
    ate: list[float] = []
    over = False
    while not over:
        began = time.perf_counter()
        action = planner.act(observation, planner.known(info))
        decision_s += time.perf_counter() - began
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated or info["time"] >= seconds
        total += float(reward)
        ate.append(round(float(info["ate"]), 6))
        lost.append(not info["tracking_ok"])
        after_step(len(ate))
    return {
        "steps": len(ate),
        "return": total,
        "decision_ms": 1e3 * decision_s / len(ate),
        "lost_steps_share": float(np.mean(lost)),
        "terminated": bool(terminated),
        "time_s": float(info["time"]),
        "energy_j": float(info["energy"]),
        "ate_over_time": ate,
    }


def parse_options(texts: Sequence[str]) -> dict[str, Any]:
    """Parse ``name.name=value`` into a nested mapping of ``EnvConfig`` and ``embodiment``.

    Values are YAML.

    Raises:
        InputError: no ``=``, an unknown name (the message lists the valid ones), a value out of
            range, or a name that the benchmark sets itself.
    """
    from ms_slam_env.env.embodiments import EMBODIMENTS
    from ms_slam_env.env.env_config import make_config

    result = nested_options(texts)
    for name in result:
        if name in OWN_OPTIONS:
            raise InputError(f"option {name!r} cannot be set: the benchmark sets it")
    embodiment = result.get("embodiment", next(iter(EMBODIMENTS)))
    if embodiment not in EMBODIMENTS:
        raise unknown("embodiment", embodiment, EMBODIMENTS)
    configured = {name: value for name, value in result.items() if name != "embodiment"}
    slam.POINT.find(make_config(configured, ("embodiment",), OWN_OPTIONS).slam)
    return result


def check_players(planners: Sequence[str], scenes: Sequence[str]) -> None:
    """Refuse unknown planners and scenes, and mesh files that cannot be read.

    Raises:
        InputError: lists the valid choices, or says what is wrong with the file.
    """
    for kind, names in (("planner", planners), ("scene", scenes)):
        if not names:
            raise InputError(f"no {kind} given")
        if len(set(names)) < len(names):
            raise InputError(f"a {kind} is given twice: {', '.join(names)}")
    for scene in scenes:  # cheapest check first: a planner may take seconds to import
        check_name(scene)
    for planner in planners:
        check_planner(planner)
    for scene in scenes:
        if is_mesh_file(scene):
            from ms_slam_env.scenes.mesh_file import load_soup

            load_soup(scene)


def seed_list(split: str, count: int) -> list[int]:
    """Return the first ``count`` seeds of a split; of explicit seeds, all.

    Raises:
        InputError: neither a split nor seeds, or more seeds than the split has.
    """
    seeds = seeds_of(split)
    if split not in SEED_SPLITS:
        return list(seeds)
    if not 1 <= count <= len(seeds):
        raise InputError(f"episodes = {count} is outside [1, {len(seeds)}] of split {split}")
    return list(seeds[:count])


def short_planner_names(planners: Iterable[str]) -> dict[str, str]:
    """Shorten planners for display: the name, with options only where names are equal.

    Paths in options lose the folders that are not needed to tell planners apart.
    """
    names = {planner: planner.split(",") for planner in planners}
    count = Counter(name for name, *_ in names.values())

    def texts(folders: int) -> dict[str, str]:
        return {
            planner: ", ".join([name, *(_with_folders(option, folders) for option in options)])
            if count[name] > 1
            else name
            for planner, (name, *options) in names.items()
        }

    most = max((planner.count("/") for planner in names), default=0)
    some = map(texts, range(most))
    return next((found for found in some if len(set(found.values())) == len(names)), texts(most))


def _with_folders(option: str, count: int) -> str:
    """An option whose value has the last ``count`` of its folders."""
    name, equals, value = option.partition("=")
    return name + equals + "/".join(value.split("/")[-1 - count :])


DOTS = "Small dots: episodes. Large mark and bar: median and its 95 % interval."
"""Caption of charts by `report.charts.by_group`."""


def episode_specs(
    given: Mapping[str, Any],
    scenes: Sequence[str],
    seeds: Sequence[int],
    compared: Sequence[Mapping[str, Any]],
) -> list[EpisodeSpec]:
    """Scenes x seeds x what is compared; ``given`` says the fields that all have.

    Raises:
        InputError: a value out of range, or an unknown option.
    """
    known = {field.name for field in fields(EpisodeSpec)}
    shared = {name: value for name, value in given.items() if name in known}
    shared["options"] = parse_options(given["options"])
    return [
        EpisodeSpec(**{**shared, "scene": scene, "seed": seed, **different})
        for scene in scenes
        for seed in seeds
        for different in compared
    ]


@dataclass(frozen=True)
class EpisodeExperiment(Experiment):
    """Scenes x seeds x what is compared, every episode of a seed from the same start pose.

    Options that are named as a field of `EpisodeSpec` are that field of every episode.
    """

    scenes: tuple[str, ...]
    """Names of scenes, or mesh files."""
    episodes: int
    """Seeds for each scene."""
    steps: int
    """Length of an episode."""
    seeds: str
    """Split that the seeds come from: train, validation or test; or your own, as 7000-7003."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in lookahead.reference=live targets.M_I=0.05."""

    unit = rows_key = "episodes"
    run = staticmethod(run_episode)

    @property
    @abstractmethod
    def planners(self) -> Sequence[str]:
        """Planners that play; a field where the user names them."""

    def compared(self) -> Sequence[Mapping[str, Any]]:
        """What differs between the episodes of a scene and seed, as fields of `EpisodeSpec`."""
        return [{"planner": planner} for planner in self.planners]

    def specs(self) -> list[EpisodeSpec]:
        """Every episode; those of one scene and seed are neighbours and share its geometry."""
        check_players(self.planners, self.scenes)
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        seeds = seed_list(self.seeds, self.episodes)
        return episode_specs(own, self.scenes, seeds, self.compared())

    def prepare(self) -> None:
        """Start one episode of each planner."""
        check_episodes(self.specs())

    def content(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """The seeds."""
        return {"seeds": seed_list(self.seeds, self.episodes)}


@dataclass(frozen=True)
class SteppedExperiment(EpisodeExperiment):
    """Episodes with steps of one size."""

    step_m: float = DEFAULT_STEP_M
    """Translation of a motion, metres."""
    step_deg: float = DEFAULT_STEP_DEG
    """Rotation of a motion, degrees."""
