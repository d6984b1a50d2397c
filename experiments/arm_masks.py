"""How often the arm's action mask is right, and how far the arm is from its commands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

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
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.config import Checked, bounded, from_dict
from ms_slam_env.env import EnvConfig
from ms_slam_env.errors import InputError, UnreachableError
from ms_slam_env.geometry import invert, make_pose, relative_angle, transform_points
from ms_slam_env.report.statistics import bootstrap_interval, share_interval
from ms_slam_env.report.tables import Column, Row, Table, finished, make_table
from ms_slam_env.robot.arm import ArmModel
from ms_slam_env.robot.arm.arm import ArmEmbodiment
from ms_slam_env.robot.arm.base_placement import COLUMN_RADIUS_M
from ms_slam_env.robot.arm.dynamic_arm import DynamicArm
from ms_slam_env.robot.arm.feasibility import REASONS
from ms_slam_env.scenes import Scene
from ms_slam_env.sensor import RGBDSensor

A = TypeVar("A", bound=ArmEmbodiment)

DEFAULT_SCENES = ("window", "table", "wall", "carpet", "living_room")
_START_TRIES = 20
_RAY_STRIDE = 6  # pixels
_JUDGED_POSTURES = 16  # along each attempted motion, its end included


@dataclass(frozen=True)
class WalkSpec:
    """One random walk of the arm; see :class:`ArmMasks` for the other fields.

    Attributes:
        seed: seed of the scene, the start pose, the arm's errors and the walk.
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

    Along random walks, each of the 49 motions is attempted with controller and physics from the
    same saved state, whatever the mask says. A motion is possible if the arm reports success and,
    in truth, touched nothing. The mask is right if it allows exactly the possible motions.
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
    """Share of those that bring the camera closest to furniture; the others are random."""
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
            ``cases``, columns with one entry per attempted motion, and ``stops``, columns with one
            entry per stop; see the metric registry for each column.
        """
        config = from_dict(EnvConfig, {"arm": spec.arm}).arm
        scene = scene_library.make(spec.scene, spec.seed)
        rng = np.random.default_rng(spec.seed)
        arm = DynamicArm(scene, config, spec.step_m, math.radians(spec.step_deg), Timings())
        start_arm(arm, rng)
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
        options = parse_options(self.options)
        if set(options) - {"arm"}:
            raise InputError(f"options {sorted(options)}: only those of the arm, as in arm.model=x")
        seeds = seed_list(self.seeds, self.episodes)
        return self.each(WalkSpec, scene=self.scenes, seed=seeds, arm=(options.get("arm", {}),))

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """The mask by scene and by reason, causes of wrong permissions, errors of the arm."""
        return mask_tables(rows)


@lru_cache(maxsize=1)
def furniture_of(scene: str, seed: int) -> Cloud:
    """The true surface of a scene, cached for the next walk in it."""
    return furniture_cloud(scene_library.make(scene, seed))


def start_arm(arm: A, rng: np.random.Generator) -> A:
    """An arm at a start pose drawn from its scene."""
    for _ in range(_START_TRIES):
        try:
            arm.reset(arm.scene.sample_start(rng), rng)
        except UnreachableError:
            continue
        return arm
    raise UnreachableError(f"scene {arm.scene.name!r}: no start pose that the arm can hold")


def choose_move(arm: DynamicArm, approach: float, rng: np.random.Generator) -> int:
    """A permitted motion: with probability ``approach``, the one that ends closest to furniture."""
    allowed = np.flatnonzero(arm.action_masks())
    if rng.random() >= approach:
        return int(rng.choice(allowed))
    targets = (arm.T_world_camera @ arm.motions[allowed])[:, :3, 3]
    nearness = -arm.scene.clearance(targets)
    return int(rng.choice(allowed[nearness == nearness.max()]))


def judge(arm: DynamicArm, truth: ArmTruth, action: int) -> dict[str, Any]:
    """Attempt one motion and measure its gaps."""
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
    """Distance of the camera from its command and from a kinematic pose (4, 4)."""
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


FAR_M = 0.1
"""Gaps are exact up to this distance; larger ones count as this far."""

_SPACING_M = 0.005  # of a cloud's points; overestimates a gap of 2 cm by at most 0.3 mm
_CELL_M = 0.04  # of the coarse cloud
_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_BALL = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)


class Cloud:
    """Points (N, 3) of a surface, indexed by position."""

    def __init__(self, points: Float64) -> None:
        self._points = np.asarray(points, dtype=np.float64)
        self._tree = cKDTree(self._points)
        cells = np.unique(np.floor(self._points / _CELL_M).astype(np.int64), axis=0)
        self._coarse = cKDTree((cells + 0.5) * _CELL_M)

    def at_least(self, places: Float64) -> Float64:
        """A lower bound (n,) of the distance between places (n, 3) and the surface."""
        return np.asarray(self._coarse.query(places)[0] - 0.5 * np.sqrt(3) * _CELL_M)

    def around(self, place: Float64, radius: float) -> Float64:
        """The points (k, 3) within ``radius`` of a place (3,)."""
        return self._points[self._tree.query_ball_point(place, radius)]


def furniture_cloud(scene: Scene, spacing_m: float = _SPACING_M) -> Cloud:
    """The true surface of a scene."""
    return Cloud(scene.surface_points(spacing_m)[0])


def floor_below(scene: Scene, point: Float64) -> float:
    """Height of the surface below a point (3,), or the point's height if there is none."""
    camera = Intrinsics(fx=1, fy=1, cx=0, cy=0, width=1, height=1)
    start = point + np.array([0, 0, 0.01])
    down = make_pose(np.diag([1.0, -1.0, -1.0]), start)
    depth = float(RGBDSensor(scene, camera, noise="none").ground_truth(down).depth[0, 0])
    return float(start[2] - depth) if depth > 0 else float(point[2])


def column_cloud(radius: float, depth: float) -> Cloud:
    """The column below an arm's base at the origin, with a round top at the base's plane."""
    angles = np.arange(0, 2 * np.pi, _SPACING_M / radius)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    tilts = np.arange(0, np.pi / 2, _SPACING_M / radius)
    dome = [radius * (np.sin(t) * ring + [0, 0, np.cos(t) - 1]) for t in tilts]
    wall = [radius * ring + [0, 0, z] for z in np.arange(-radius, -depth, -_SPACING_M)]
    return Cloud(np.concatenate(dome + wall))


class ArmTruth:
    """Checks postures of a mounted arm by its colliding geoms, without the base.

    Args:
        model: the arm.
        furniture: surface around it, world frame.
        T_world_base: (4, 4) pose of the base.
        column: column below it, base frame; None if there is none.
    """

    def __init__(
        self, model: ArmModel, furniture: Cloud, T_world_base: Float64, column: Cloud | None = None
    ) -> None:
        self._mj, self._qpos, self._camera_site = model.mj, model.qpos, model.camera_site
        self._furniture, self._column = furniture, column
        self._T_world_base = np.array(T_world_base, dtype=np.float64)
        self._data = mujoco.MjData(model.mj)
        moved = set(_bodies_below(model.mj, int(model.mj.jnt_bodyid[0])))
        self._geoms = [
            geom
            for geom in range(model.mj.ngeom)
            if int(model.mj.geom_bodyid[geom]) in moved
            and (model.mj.geom_contype[geom] or model.mj.geom_conaffinity[geom])
        ]

    def gaps(self, q: Float64) -> Float64:
        """Smallest gap (k,) between moving links and furniture at joint angles (k, n), metres.

        Zero or negative if they touch.
        """
        result = np.empty(len(q))
        for i, one in enumerate(q):
            self._place(one)
            result[i] = self._gap(self._furniture, self._T_world_base)
        return result

    def touches_itself(self, q: Float64) -> NDArray[np.bool_]:
        """(k,) whether links touch each other or the column at joint angles (k, n)."""
        result = np.zeros(len(q), dtype=bool)
        for i, one in enumerate(q):
            self._place(one)
            mujoco.mj_collision(self._mj, self._data)
            result[i] = (self._data.contact.dist[: self._data.ncon] < 0).any()
            if self._column is not None and not result[i]:
                result[i] = self._gap(self._column, np.eye(4)) <= 0
        return result

    def sees_itself(self, q: Float64, rays: Float64) -> bool:
        """Whether the arm is in its own camera's view at joint angles (n,).

        Args:
            q: joint angles.
            rays: (r, 3) directions in the camera's frame.
        """
        self._place(q)
        data, mj, site = self._data, self._mj, self._camera_site
        directions = rays @ data.site_xmat[site].reshape(3, 3).T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        body, geom = int(mj.site_bodyid[site]), np.zeros(1, dtype=np.int32)
        return any(
            mujoco.mj_ray(mj, data, data.site_xpos[site], ray, None, 1, body, geom) >= 0
            for ray in directions
        )

    def _gap(self, cloud: Cloud, T_cloud_base: Float64) -> float:
        data, mj = self._data, self._mj
        centres = transform_points(T_cloud_base, data.geom_xpos[self._geoms])
        reach = mj.geom_rbound[self._geoms]
        at_least = cloud.at_least(centres) - reach
        gap = FAR_M
        for k in np.argsort(at_least):
            if at_least[k] >= gap:
                break
            near = cloud.around(centres[k], reach[k] + gap)
            if len(near) == 0:
                continue
            geom = self._geoms[k]
            T_base_geom = np.eye(4)
            T_base_geom[:3, :3] = data.geom_xmat[geom].reshape(3, 3)
            T_base_geom[:3, 3] = data.geom_xpos[geom]
            local = transform_points(invert(T_cloud_base @ T_base_geom), near)
            gap = min(gap, float(signed_distance(mj, geom, local).min()))
        return gap

    def _place(self, q: Float64) -> None:
        self._data.qpos[:] = self._mj.qpos0
        self._data.qpos[self._qpos] = q
        mujoco.mj_kinematics(self._mj, self._data)


def signed_distance(mj: mujoco.MjModel, geom: int, points: Float64) -> Float64:
    """Distance (N,) from points (N, 3) of a geom's frame to its surface, negative inside.

    Exact for balls, capsules, cylinders and boxes; for ellipsoids only close to the surface; meshes
    are treated as their bounding boxes.
    """
    kind, size = int(mj.geom_type[geom]), mj.geom_size[geom]
    if kind == _BALL:
        return np.asarray(np.linalg.norm(points, axis=1) - size[0])
    if kind == _CAPSULE:
        beyond = points.copy()
        beyond[:, 2] -= np.clip(points[:, 2], -size[1], size[1])
        return np.asarray(np.linalg.norm(beyond, axis=1) - size[0])
    if kind == _ELLIPSOID:
        scaled = np.linalg.norm(points / size, axis=1)
        slope = np.linalg.norm(points / size**2, axis=1)
        return np.asarray(scaled * (scaled - 1) / np.maximum(slope, 1e-12))
    if kind == _CYLINDER:
        across = np.hypot(points[:, 0], points[:, 1]) - size[0]
        outside = np.stack([across, np.abs(points[:, 2]) - size[1]], axis=1)
    else:
        box = mj.geom_aabb[geom]
        outside = np.abs(points - box[:3]) - box[3:]
    away = np.linalg.norm(np.maximum(outside, 0), axis=1)
    return np.asarray(away + np.minimum(outside.max(axis=1), 0))


def _bodies_below(mj: mujoco.MjModel, top: int) -> list[int]:
    found = [top]
    for body in range(top + 1, mj.nbody):  # parents come first
        if int(mj.body_parentid[body]) in found:
            found.append(body)
    return found


EVERYWHERE = "all"
ALLOWED = REASONS[0]
MASK = (
    "mask_allows",
    "mask_right",
    "mask_right_by_walks",
    "wrong_of_allowed",
    "wrong_of_forbidden",
)
MOVED = {
    "end of a motion against its command": ("error_m", "error_rad"),
    "least gap to furniture": ("gap_m",),
}
AT_REST = {
    "camera below its command at rest (sag)": ("sag_m",),
    "camera from its command at rest": ("offset_at_rest_m",),
    "kinematic pose from the true one": ("kinematic_m", "kinematic_rad"),
}
"""Errors of motions that were allowed and made, and of stops, to columns of a walk."""

Columns = Mapping[str, NDArray[Any]]


def mask_tables(rows: Sequence[Row]) -> list[Table]:
    """Tables by scene and by reason, of causes of wrong permissions, and of errors."""
    walks = finished(rows)
    places = {place: [row for row in walks if row["spec"]["scene"] == place]
              for place in dict.fromkeys(row["spec"]["scene"] for row in walks)}  # fmt: skip
    if len(places) > 1:
        places[EVERYWHERE] = walks
    cases, stops = _joined(walks, "cases"), _joined(walks, "stops")
    seen = share_interval(stops["sees_itself"])
    lines = [{"scene": place, **_mask(of)} for place, of in places.items()]
    note = (
        "Shares with 95 % Wilson intervals, as if motions were independent; by walks: whole walks "
        f"resampled. The arm is in its own camera's view at {100 * seen.value:.2g} % of stops."
    )
    return [
        make_table(["scene", "walks", "motions", *MASK], lines, note=note),
        make_table(["reason", "motions", "mask_right"], _reasons(cases), "By what the mask says"),
        make_table(["cause", "motions"], _causes(cases), "Where it allowed wrongly"),
        _errors(cases, stops),
    ]


def _joined(rows: Sequence[Row], part: str) -> Columns:
    columns = [row["result"][part] for row in rows]
    return {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}


def _possible(cases: Columns) -> NDArray[np.bool_]:
    return np.asarray(cases["reached"] & (cases["gap_m"] > 0) & ~cases["touches_itself"])


def _mask(rows: Sequence[Row]) -> dict[str, Any]:
    cases = _joined(rows, "cases")
    allowed, possible = cases["reason"] == ALLOWED, _possible(cases)
    right, total = [], []
    for row in rows:
        walk = _joined([row], "cases")
        agrees = (walk["reason"] == ALLOWED) == _possible(walk)
        right.append(int(agrees.sum()))
        total.append(len(agrees))
    walks = bootstrap_interval(
        (right, total), lambda a, b, axis: np.sum(a, axis=axis) / np.sum(b, axis=axis)
    )
    shares = (
        share_interval(allowed),
        share_interval(allowed == possible),
        walks,
        share_interval(~possible[allowed]),
        share_interval(possible[~allowed]),
    )
    return {"walks": len(rows), "motions": len(allowed), **dict(zip(MASK, shares, strict=True))}


def _reasons(cases: Columns) -> list[dict[str, Any]]:
    """Number of motions, and share that was right, by the mask's reason."""
    possible, lines = _possible(cases), []
    for reason in REASONS:
        said = cases["reason"] == reason
        if said.any():
            right = share_interval(possible[said] == (reason == ALLOWED))
            lines.append({"reason": reason, "motions": int(said.sum()), "mask_right": right})
    return lines


def _causes(cases: Columns) -> list[dict[str, Any]]:
    """Why allowed motions were not possible; a motion can have several causes."""
    allowed, stopped = cases["reason"] == ALLOWED, cases["stopped"]
    causes = {
        "not followed": ~cases["reached"] & ~stopped,
        "protective stop": stopped,
        "touched furniture": cases["gap_m"] <= 0,
        "touched itself": cases["touches_itself"],
    }
    return [{"cause": name, "motions": int((allowed & of).sum())} for name, of in causes.items()]


def _errors(cases: Columns, stops: Columns) -> Table:
    """Smallest, median and 95th percentile of each error, length and angle on one line."""
    moved = (cases["reason"] == ALLOWED) & cases["reached"] & (cases["action"] > 0)
    lines = []
    for columns, kinds in (({n: c[moved] for n, c in cases.items()}, MOVED), (stops, AT_REST)):
        for name, keys in kinds.items():
            line: dict[str, Any] = {"error_kind": name, "values": len(columns[keys[0]])}
            for key in keys:
                unit = key.rpartition("_")[2]
                line |= {f"{s}_{unit}": value for s, value in _spread(columns[key]).items()}
            lines.append(line)
    statistics = {"least": "least", "median": "median", "p95": "95 %"}
    shown = [
        Column(f"{name}_{unit}", f"arm_error_{unit}", heading)
        for unit in ("m", "rad")
        for name, heading in statistics.items()
    ]
    return make_table(["error_kind", "values", *shown], lines, "Errors of the arm")


def _spread(values: NDArray[np.float64]) -> dict[str, float]:
    """Smallest, median and 95th percentile."""
    if not len(values):
        return dict.fromkeys(("least", "median", "p95"), float("nan"))
    least, median, p95 = np.percentile(values, [0, 50, 95])
    return {"least": float(least), "median": float(median), "p95": float(p95)}
