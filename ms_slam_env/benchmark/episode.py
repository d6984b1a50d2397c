"""One episode of one planner: what to run, and what came of it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import ms_slam_env
from ms_slam_env import metrics
from ms_slam_env.benchmark.map_truth import reference_of, true_surface
from ms_slam_env.benchmark.planners import make_planner, planner_class
from ms_slam_env.config import check_choice, check_range, parse_named
from ms_slam_env.env import ActiveSlamEnv, Planner
from ms_slam_env.errors import InputError
from ms_slam_env.registration import ADAPTIVE_ID

Float64 = NDArray[np.float64]

DEFAULT_STEP_M = 0.12
DEFAULT_STEP_DEG = 12.0
LOST_ERROR_M = 0.3  # an estimate this far off is lost even where SLAM does not say so
THRESHOLDS_M = (0.02, 0.05)
MAP_VOXEL_M = 0.01  # a surface counts by its area, not by how often it was seen


@dataclass(frozen=True)
class EpisodeSpec:
    """Everything that an episode depends on.

    Attributes:
        planner: ``NAME,option=value,...``.
        scene: a scene's name or a mesh file.
        seed: of the scene, the start pose, the sensor noise and the planner.
        env_id: one of ``ms_slam_env.ENV_IDS``.
        steps: length of the episode.
        step_m: translation of a motion.
        step_deg: rotation of a motion.
        options: further options of the environment.
    """

    planner: str
    scene: str = "living_room"
    seed: int = 2000
    env_id: str = "MSActiveSLAM-FreeCamera-v0"
    steps: int = 100
    step_m: float = DEFAULT_STEP_M
    step_deg: float = DEFAULT_STEP_DEG
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse unknown choices and values out of range."""
        try:
            check_choice(self, "env_id", ms_slam_env.ENV_IDS)
            check_range(self, "steps", 1, 1_000_000)
            check_range(self, "step_m", 0, 1)
            check_range(self, "step_deg", 0, 90)
        except InputError as error:
            # Users know the fields as options of a command, not this class.
            raise InputError(str(error).replace("EpisodeSpec.", "")) from None
        name = self.planner.partition(",")[0]
        if self.env_id == ADAPTIVE_ID and ":" not in name:
            raise InputError(
                f"planner {name!r} chooses motions only, {ADAPTIVE_ID} asks for a SLAM "
                "configuration too; valid choices: module:Class"
            )


def run_episode(spec: EpisodeSpec) -> dict[str, Any]:
    """Run one episode and measure it.

    Returns:
        the metrics by name, see :func:`measure_trajectory` and :func:`measure_map`, with
        ``steps``, ``return``, ``decision_ms`` (mean time of a decision), ``ate_over_time``
        (running RMSE after each step, unaligned, metres), ``time_s`` (simulated) and ``energy_j``
        (mechanical work of the motion).
    """
    env = make_env(spec)
    try:
        world = cast(ActiveSlamEnv, env.unwrapped)
        planner = make_planner(spec.planner, world, spec.seed)
        progress = play(env, planner, spec.seed)
        trajectory = measure_trajectory(world)
        trajectory["lost"] |= progress["lost_steps_share"] > 0
        return {**progress, **trajectory, **measure_map(world, spec)}
    finally:
        env.close()


def check_episodes(specs: Sequence[EpisodeSpec]) -> None:
    """Refuse now what would make episodes fail at their start, by starting one of each planner.

    Scenes are not built.

    Raises:
        InputError: options that the environment, SLAM or a planner refuses, or a planner that
            fails as it is made.
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
        except Exception as error:  # a planner of somebody else may raise anything
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise InputError(f"planner {spec.planner!r} cannot be made: {reason}") from error
        finally:
            env.close()


def make_env(spec: EpisodeSpec) -> gym.Env[Any, Any]:
    """The environment of an episode."""
    planner_type = planner_class(parse_named(spec.planner, "planner")[0])
    return gym.make(
        spec.env_id,
        max_episode_steps=spec.steps,
        disable_env_checker=True,
        **{
            "scene": spec.scene,
            "scene_seed": spec.seed,
            "step_m": spec.step_m,
            "step_rad": math.radians(spec.step_deg),
            "observation": planner_type.observation,
            **spec.options,
        },
    )


def play(
    env: gym.Env[Any, Any], planner: Planner, seed: int, seconds: float = math.inf
) -> dict[str, Any]:
    """Play one episode to its end, or until ``seconds`` of simulated time have passed."""
    observation, info = env.reset(seed=seed)
    planner.reset()
    total, decision_s, lost = 0.0, 0.0, []
    ate: list[float] = []
    over = False
    while not over:
        start = time.perf_counter()
        action = planner.act(observation, info)
        decision_s += time.perf_counter() - start
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated or info["time"] >= seconds
        total += float(reward)
        ate.append(round(float(info["ate"]), 6))
        lost.append(not info["tracking_ok"])
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


def measure_trajectory(world: ActiveSlamEnv) -> dict[str, Any]:
    """Trajectory metrics of the episode just played.

    ``ate_m`` (RMSE) and ``ate_max_m`` after SE(3) alignment, ``ate_unaligned_m`` with the common
    start as the only tie, ``rpe_m`` and ``rpe_rad`` per step, ``path_length_m`` of the true
    trajectory, ``M_I`` and ``M_D`` (equations 11 and 12), and ``lost``: SLAM reported lost tracking
    at some step, or was off by more than ``LOST_ERROR_M`` without noticing.
    """
    truth, estimate = world.episode.trajectory_truth, world.episode.trajectory_estimate
    aligned = metrics.ate_statistics(estimate, truth)
    maxima = world.episode.divergences.max(axis=0)
    return {
        "ate_m": aligned.rmse,
        "ate_max_m": aligned.max,
        "ate_unaligned_m": metrics.ate_rmse(estimate, truth, align="none"),
        "rpe_m": metrics.rpe_rmse(estimate, truth),
        "rpe_rad": metrics.rpe_rmse(estimate, truth, kind="rotation"),
        "path_length_m": metrics.path_length(truth),
        "M_I": float(maxima[0]),
        "M_D": float(maxima[1]),
        "lost": bool(world.episode.pose_errors.max() > LOST_ERROR_M),
    }


def measure_map(world: ActiveSlamEnv, spec: EpisodeSpec) -> dict[str, float]:
    """Map metrics, the map placed by its estimated poses; see :mod:`.map_truth` for the truth.

    ``precision_*``, ``recall_*`` and ``f_score_*`` at 2 and 5 cm, ``rcm`` (the recall at 5 cm),
    ``rer_m`` (RMS distance to the true surface after ICP), ``mapped_area_m2`` (true surface that a
    tracked frame put less than 5 cm from its place, in faces of 5 cm voxels).

    Judged is the whole map. Surfels that SLAM calls stable were seen in some ten frames: counting
    only those would reward looking at one place for long.
    """
    x, y, z = map(float, world.episode.trajectory_truth[0][:3, 3])
    surface = true_surface(spec.scene, spec.seed)
    reference = reference_of(spec.scene, spec.seed, (x, y, z))
    area = {"mapped_area_m2": world.coverage.mapped_area}
    return {**judge_map(world.slam.map_points(), surface, reference), **area}


def judge_map(points: Float64, surface: Float64, reference: Float64) -> dict[str, float]:
    """Map metrics from points (N, 3) of the map, of the true surface and of the reference."""
    result: dict[str, float] = {}
    if len(points):
        cloud = metrics.voxel_thin(points, MAP_VOXEL_M)
        to_surface = metrics.nearest_distances(cloud, surface)
        to_map = metrics.nearest_distances(reference, cloud)
        rer = metrics.rer(cloud, surface)
    else:
        to_surface, to_map, rer = np.array([np.inf]), np.array([np.inf]), float("nan")
    for threshold in THRESHOLDS_M:
        name = f"{round(100 * threshold)}cm"
        precision = float((to_surface < threshold).mean())
        recall = float((to_map < threshold).mean())
        both = precision + recall
        result[f"precision_{name}"] = precision
        result[f"recall_{name}"] = recall
        result[f"f_score_{name}"] = 2 * precision * recall / both if both else 0.0
    return {**result, "rcm": result["recall_5cm"], "rer_m": rer, "map_points": len(points)}
