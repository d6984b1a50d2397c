"""How often the arm's action mask is right, and how far the arm is from where it should be.

Along random walks every one of the 49 motions is really attempted, with controller and physics,
from the saved state, whatever the mask says. Run as
``python -m ms_slam_env.benchmark.arm_masks --help``.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import scenes as scene_library
from ms_slam_env.benchmark.arm_masks_report import as_markdown, summarise
from ms_slam_env.benchmark.planner_report import finished
from ms_slam_env.camera import xtion
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.config import check_range, from_dict
from ms_slam_env.env import EnvConfig
from ms_slam_env.errors import InputError, UnreachableError, unknown
from ms_slam_env.experiments.harness.arm_truth import (
    ArmTruth,
    Cloud,
    column_cloud,
    floor_below,
    furniture_cloud,
)
from ms_slam_env.experiments.harness.episodes import (
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    parse_options,
    seed_list,
)
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.geometry import invert, relative_angle
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.robot.arm import ArmConfig
from ms_slam_env.robot.arm.base_placement import COLUMN_RADIUS_M
from ms_slam_env.robot.arm.dynamic_arm import DynamicArm
from ms_slam_env.robot.arm.feasibility import REASONS
from ms_slam_env.scenes import SCENES, Scene
from ms_slam_env.timings import Timings

PROGRAM = "python -m ms_slam_env.benchmark.arm_masks"
DEFAULT_SCENES = ("window", "table", "wall", "carpet", "living_room")
_START_TRIES = 20
_RAY_STRIDE = 6  # pixels
_JUDGED_POSTURES = 16  # along each attempted motion, its end included

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class WalkSpec:
    """One random walk of the arm.

    Attributes:
        scene: a scene's name.
        seed: of the scene, the start pose, the arm's errors and the walk.
        states: how often the walk stops to attempt all motions.
        moves: permitted motions between two stops.
        approach: share of them that go where the camera comes nearest to furniture; the others
            are random.
        step_m: translation of a motion.
        step_deg: rotation of a motion.
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
class Arguments:
    """Share of motions of an arm that its mask judges rightly; tracking error, sag."""

    scenes: tuple[str, ...] = DEFAULT_SCENES
    """Names of scenes."""
    episodes: int = 4
    """Walks in each scene."""
    states: int = 8
    """Places of a walk at which all 49 motions are attempted."""
    moves: int = 3
    """Permitted motions before each of them."""
    approach: float = 0.5
    """Share of those that go where the camera comes nearest to furniture; the others are random."""
    step_m: float = DEFAULT_STEP_M
    """Translation of a motion, metres."""
    step_deg: float = DEFAULT_STEP_DEG
    """Rotation of a motion, degrees."""
    seeds: str = "validation"
    """Split that the seeds come from."""
    options: tuple[str, ...] = ()
    """Options of the arm, as in arm.clearance_m=0.03."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/arm_masks")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse unknown scenes and numbers out of range."""
        for name in self.scenes:
            if name not in SCENES:
                raise unknown("scene", name, SCENES)
        check_range(self, "states", 1, 10_000)
        check_range(self, "moves", 0, 10_000)
        check_range(self, "approach", 0, 1)
        check_range(self, "step_m", 0, 1)
        check_range(self, "step_deg", 0, 90)

    def specs(self) -> list[WalkSpec]:
        """Every walk."""
        options = parse_options(self.options)
        if set(options) - {"arm"}:
            raise InputError(f"options {sorted(options)}: only those of the arm, as in arm.model=x")
        return [
            WalkSpec(
                scene,
                seed,
                self.states,
                self.moves,
                self.approach,
                self.step_m,
                self.step_deg,
                options.get("arm", {}),
            )
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiment; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    rows = run_all(args.specs(), run_walk, args.out, args.workers, "walks")
    check_any_finished(rows)
    summary = summarise(finished(rows))
    content = {
        "provenance": provenance(),
        "config": asdict(args) | {"out": str(args.out)},
        "summary": summary,
    }
    write_json(args.out / "arm_masks.json", content)
    text = as_markdown(summary)
    (args.out / "table.md").write_text(text)
    print(text)
    return report_failures(failures(rows), PROGRAM)


def run_walk(spec: WalkSpec) -> dict[str, Any]:
    """Walk, and attempt every motion at every stop.

    Returns:
        ``cases``: columns with one entry a motion attempted: ``state``, ``action``, ``reason`` of
        the mask (``ok`` where it allows), ``reached`` and ``stopped`` as the arm reports, smallest
        ``gap_m`` to furniture and ``touches_itself`` as :class:`ArmTruth` finds, ``error_m`` and
        ``error_rad`` between command and end; ``states``: columns with one entry a stop: ``sag_m``
        by which the camera hangs below its command, ``offset_m`` its whole distance from it,
        ``kinematic_m`` and ``kinematic_rad`` of the kinematic pose, tied to the true start;
        ``sees_itself``: the arm is in its camera's view, where the images do not show it.
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
    states: dict[str, list[Any]] = {}
    for state in range(spec.states):
        for _ in range(spec.moves):
            arm.move(choose_move(arm, spec.approach, rng))
        stop = at_rest(arm, T_world_kinematic @ arm.T_world_camera_kinematic)
        _append(states, {**stop, "sees_itself": truth.sees_itself(arm.q, _view_rays())})
        reason = arm.probe().reason
        for action in range(arm.num_actions):
            case = {"state": state, "action": action, "reason": REASONS[int(reason[action])]}
            _append(cases, {**case, **judge(arm, truth, action)})
    return {"cases": cases, "states": states}


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
        "offset_m": round(float(np.linalg.norm(here[:3, 3] - commanded)), 6),
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


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
