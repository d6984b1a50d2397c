"""How often the arm's action mask is right, and how far the arm is from where it should be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from ms_slam_experiments.shared.arm_truth import (
    ArmTruth,
    Cloud,
    column_cloud,
    floor_below,
    furniture_cloud,
)
from ms_slam_experiments.shared.mask_tables import mask_tables

from ms_slam_env import scenes as scene_library
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.timings import Timings
from ms_slam_env.benchmark.episodes import (
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    parse_options,
    seed_list,
)
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import xtion
from ms_slam_env.config import Checked, bounded, from_dict
from ms_slam_env.env import EnvConfig
from ms_slam_env.errors import InputError, UnreachableError
from ms_slam_env.geometry import invert, relative_angle
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Table
from ms_slam_env.robot.arm import ArmConfig
from ms_slam_env.robot.arm.base_placement import COLUMN_RADIUS_M
from ms_slam_env.robot.arm.dynamic_arm import DynamicArm
from ms_slam_env.robot.arm.feasibility import REASONS
from ms_slam_env.scenes import Scene
from ms_slam_env.scenes.registry import check_name

DEFAULT_SCENES = ("window", "table", "wall", "carpet", "living_room")
_START_TRIES = 20
_RAY_STRIDE = 6  # pixels
_JUDGED_POSTURES = 16  # along each attempted motion, its end included


@dataclass(frozen=True)
class WalkSpec:
    """One random walk of the arm; see :class:`ArmMasks` for the other fields.

    Attributes:
        seed: of the scene, the start pose, the arm's errors and the walk.
        arm: options of the arm.
    """

    scene: str
    seed: int
    states: int = 8
    moves: int = 3
    approach: float = 0.5
    step_m: float = DEFAULT_STEP_M
    step_deg: float = DEFAULT_STEP_DEG
    arm: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ArmMasks(Checked, Experiment):
    """Is the arm's mask of motions right?

    Along random walks every one of the 49 motions is really attempted, with controller and physics,
    from the saved state, whatever the mask says. A motion is possible if the arm says it made it
    and the truth finds that it touched nothing; the mask is right if it allows exactly those.
    """

    scenes: tuple[str, ...] = DEFAULT_SCENES
    """Names of scenes."""
    episodes: int = 4
    """Walks in each scene."""
    states: int = bounded(8, 1, 10_000)
    """Places of a walk at which all 49 motions are attempted."""
    moves: int = bounded(3, 0, 10_000)
    """Permitted motions before each of them."""
    approach: float = bounded(0.5, 0, 1)
    """Share of those that go where the camera comes nearest to furniture; the others are random."""
    step_m: float = bounded(DEFAULT_STEP_M, 0, 1)
    """Translation of a motion, metres."""
    step_deg: float = bounded(DEFAULT_STEP_DEG, 0, 90)
    """Rotation of a motion, degrees."""
    seeds: str = "validation"
    """Split that the seeds come from."""
    options: tuple[str, ...] = ()
    """Options of the arm, as in arm.clearance_m=0.03."""

    unit = rows_key = "walks"

    @staticmethod
    def run(spec: WalkSpec) -> dict[str, Any]:
        """Walk, and attempt every motion at every stop.

        Returns:
            ``cases``, columns with one entry a motion attempted, and ``stops``, columns with one
            entry a stop; see the registry of metrics for each.
        """
        config = from_dict(EnvConfig, {"arm": spec.arm}).arm
        scene = scene_library.make(spec.scene, spec.seed)
        rng = np.random.default_rng(spec.seed)
        arm = start_arm(scene, config, spec, rng)
        truth = ArmTruth(
            arm.model, furniture_of(spec.scene, spec.seed), arm.T_world_base, _column(scene, arm)
        )
        T_world_kinematic = arm.T_world_camera @ invert(arm.T_world_camera_kinematic)
        cases: dict[str, list[Any]] = {}
        stops: dict[str, list[Any]] = {}
        for number in range(spec.states):
            for _ in range(spec.moves):
                arm.move(choose_move(arm, spec.approach, rng))
            stop = at_rest(arm, T_world_kinematic @ arm.T_world_camera_kinematic)
            _append(stops, {**stop, "sees_itself": truth.sees_itself(arm.q, _view_rays())})
            reason = arm.probe().reason
            for action in range(arm.num_actions):
                case = {"stop": number, "action": action, "reason": REASONS[int(reason[action])]}
                _append(cases, {**case, **judge(arm, truth, action)})
        return {"cases": cases, "stops": stops}

    def specs(self) -> list[WalkSpec]:
        """Every walk."""
        for name in self.scenes:
            check_name(name)
        options = parse_options(self.options)
        if set(options) - {"arm"}:
            raise InputError(f"options {sorted(options)}: only those of the arm, as in arm.model=x")
        return [
            self.spec(WalkSpec, scene=scene, seed=seed, arm=options.get("arm", {}))
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
        ]

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """The mask by scene and by what it says, causes of wrong permissions, errors of the arm."""
        return mask_tables(rows)


@lru_cache(maxsize=1)
def furniture_of(scene: str, seed: int) -> Cloud:
    """The true surface of a scene, kept for the next walk in it."""
    return furniture_cloud(scene_library.make(scene, seed))


def start_arm(
    scene: Scene, config: ArmConfig, spec: WalkSpec, rng: np.random.Generator
) -> DynamicArm:
    """An arm at a start pose drawn from the scene."""
    arm = DynamicArm(scene, config, spec.step_m, math.radians(spec.step_deg), Timings())
    for _ in range(_START_TRIES):
        try:
            arm.reset(scene.sample_start(rng), rng)
        except UnreachableError:
            continue
        return arm
    raise UnreachableError(f"scene {scene.name!r}: no start pose that the arm can hold")


def choose_move(arm: DynamicArm, approach: float, rng: np.random.Generator) -> int:
    """A permitted motion: with probability ``approach`` the one nearest to furniture."""
    allowed = np.flatnonzero(arm.action_masks())
    if rng.random() >= approach:
        return int(rng.choice(allowed))
    targets = (arm.T_world_camera @ arm.motions[allowed])[:, :3, 3]
    nearness = -arm.scene.clearance(targets)
    return int(rng.choice(allowed[nearness == nearness.max()]))


def judge(arm: DynamicArm, truth: ArmTruth, action: int) -> dict[str, Any]:
    """Attempt one motion and see what it came near to."""
    attempt = arm.attempt(action)
    index = np.linspace(0, len(attempt.q) - 1, min(_JUDGED_POSTURES, len(attempt.q)))
    postures = attempt.q[np.rint(index).astype(np.int64)]
    return {
        "reached": attempt.reached,
        "stopped": attempt.stopped,
        "gap_m": round(float(truth.gaps(postures).min()), 5),
        "touches_itself": bool(truth.touches_itself(postures).any()),
        "error_m": round(attempt.error_m, 6),
        "error_rad": round(attempt.error_rad, 6),
    }


def at_rest(arm: DynamicArm, T_world_kinematic: Float64) -> dict[str, float]:
    """How far the camera is from its command and from a kinematic pose (4, 4)."""
    _, T_base_commanded = arm.planning_state()
    commanded = (arm.T_world_base @ T_base_commanded)[:3, 3]
    here = arm.T_world_camera
    return {
        "sag_m": round(float(commanded[2] - here[2, 3]), 6),
        "offset_at_rest_m": round(float(np.linalg.norm(here[:3, 3] - commanded)), 6),
        "kinematic_m": round(float(np.linalg.norm(here[:3, 3] - T_world_kinematic[:3, 3])), 6),
        "kinematic_rad": round(float(relative_angle(here[:3, :3], T_world_kinematic[:3, :3])), 6),
    }


def _view_rays() -> Float64:
    """Directions (r, 3) all over the camera's view."""
    rays = xtion("160x120").rays()[::_RAY_STRIDE, ::_RAY_STRIDE]
    return np.asarray(rays.reshape(-1, 3), dtype=np.float64)


def _column(scene: Scene, arm: DynamicArm) -> Cloud | None:
    if arm.config.base is not None:
        return None
    base = arm.T_world_base[:3, 3]
    return column_cloud(COLUMN_RADIUS_M, float(base[2]) - floor_below(scene, base))


def _append(columns: dict[str, list[Any]], row: dict[str, Any]) -> None:
    for name, value in row.items():
        columns.setdefault(name, []).append(value)
