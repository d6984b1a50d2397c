"""The paper's robot experiment, four settings, ten runs each: is the map consistent?

Saeedi et al., ICRA 2017, section VI-C and Fig. 8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from ms_slam_experiments.shared.duplicate_objects import (
    ConsistencyRule,
    JudgedMap,
    judge_map,
    labelled_view,
)
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64, Image
from ms_slam_env.benchmark.episode_scores import LOST_ERROR_M, measure_trajectory
from ms_slam_env.benchmark.episodes import (
    DEFAULT_PLANNERS,
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    EpisodeSpec,
    check_episodes,
    check_players,
    make_env,
    parse_options,
    play,
    seed_list,
    short_planner_names,
)
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import check_range
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.planners import make_planner
from ms_slam_env.env.point_renderer import render_points
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, look_at, transform_points
from ms_slam_env.report.charts import Chart, bars
from ms_slam_env.report.figures import caption, new_figure, save
from ms_slam_env.report.statistics import fisher_p
from ms_slam_env.report.tables import Grouping, Row, Table, finished, make_table

SCENES = ("window", "table", "wall", "carpet")
FRAME_RATE_HZ = 30  # no motion is shorter than a frame of the fastest camera
MOST_VIEWS = 200  # evenly picked frames of an episode; judging them takes about 3 s
METRICS = (
    *("success", "success_tracked", "lost", "lost_frames_share", "mapped_area_m2", "ate_m"),
    *("ate_tracked_m", "tracked_share", "worst_apart_share", "path_length_m", "energy_j", "steps"),
)
LAMP = {"dim": 0.0, "lamp": 0.3, "speed_m_s": 0.001}  # "minor changes in illumination"
ACTIVE, BASELINE = "greedy", "random"
SHOWN_BELOW = 0.05  # p of a difference that counts as shown
PAPER = {"carpet": f"{BASELINE} 0 of 10, {ACTIVE} 5 of 10"}
"""Successes stated in the paper's text; the others are only bars in its Fig. 8."""


@dataclass(frozen=True)
class RunSpec(EpisodeSpec):
    """One run; see :class:`.episode.EpisodeSpec`.

    Attributes:
        seconds: simulated time after which the run ends.
        rule: rule by which its map fails.
        picture: file for a picture of the judged map; none if empty.
        same_start: whether the run starts at the start of a run with the scene's seed.
    """

    seconds: float = 60.0
    rule: ConsistencyRule = field(default_factory=ConsistencyRule)
    picture: str = ""
    same_start: bool = False

    def __post_init__(self) -> None:
        """Refuse unknown choices and values out of range."""
        super().__post_init__()
        try:
            check_range(self, "seconds", 0.1, 3600)
        except InputError as error:
            raise InputError(str(error).replace("RunSpec.", "")) from None


@dataclass(frozen=True)
class ArmExperiment(Experiment):
    """The paper's robot experiment: does a planner's map show an object twice?

    A camera that stands still succeeds trivially, so success must be read with the mapped area.
    """

    planners: tuple[str, ...] = DEFAULT_PLANNERS
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    scenes: tuple[str, ...] = SCENES
    """Names of scenes, or mesh files."""
    episodes: int = 10
    """Runs for each scene and planner, each with a different seed."""
    seconds: float = 60.0
    """Simulated time of a run."""
    step_m: float = DEFAULT_STEP_M
    """Translation of a motion, metres."""
    step_deg: float = DEFAULT_STEP_DEG
    """Rotation of a motion, degrees."""
    env_id: str = "MSActiveSLAM-v0"
    """Environment; the default one has the arm."""
    embodiment: str | None = None
    """Embodiment of the camera, if it differs from the environment's."""
    seeds: str = "test"
    """Split that the seeds come from."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in pose=kinematics."""
    same_scene: int | None = None
    """Seed of one scene and start for all runs, which then differ in light, noise and actuation."""
    rule: ConsistencyRule = field(default_factory=ConsistencyRule)
    """When an object counts as present twice."""
    pictures: Path | None = None
    """Folder of pictures of the judged maps; none by default."""

    rows_key = "runs"

    @staticmethod
    def run(spec: RunSpec) -> dict[str, Any]:
        """Play one run and judge its map."""
        env = make_env(spec)
        try:
            world = cast(ActiveSlamEnv, env.unwrapped)
            planner = make_planner(spec.planner, world, spec.seed)
            start = None
            if spec.same_start:
                start = env.reset(seed=spec.options["scene_seed"])[1]["T_world_camera"]
            played = play(env, planner, spec.seed, spec.seconds, start=start)
            judged = judge_episode(world, spec.rule)
            if spec.picture and len(judged.points):
                cameras = world.episode.trajectory_estimate[:, :3, 3]
                title = f"{Path(spec.scene).stem}, {spec.planner}, seed {spec.seed}"
                save_map_picture(judged, cameras, Path(spec.picture), title)
            return {
                **{name: played[name] for name in ("steps", "decision_ms", "time_s", "energy_j")},
                **measure_trajectory(world),
                **_outcome(world, judged),
            }
        finally:
            env.close()

    def specs(self) -> list[RunSpec]:
        """Every run; runs with the same scene and seed are neighbours and share its geometry."""
        check_players(self.planners, self.scenes)
        options = parse_options(self.options)
        # A run continues when tracking is lost, as in the paper.
        options.setdefault("lost_patience", 1_000_000)
        if self.embodiment is not None:
            options["embodiment"] = self.embodiment
        if self.same_scene is not None:
            options |= {"scene_seed": self.same_scene, "perturbed_by": "illumination"}
            options["perturbation"] = LAMP
        return [
            self.spec(
                RunSpec,
                planner=planner,
                scene=scene,
                seed=seed,
                steps=max(1, math.ceil(self.seconds * FRAME_RATE_HZ)),
                options=options,
                picture=self._picture(scene, planner, seed),
                same_start=self.same_scene is not None,
            )
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
            for planner in self.planners
        ]

    def _picture(self, scene: str, planner: str, seed: int) -> str:
        if self.pictures is None:
            return ""
        name = planner.replace("/", "_").replace(":", "_")
        return str(self.pictures / f"{Path(scene).stem}_{name}_{seed}.png")

    def prepare(self) -> None:
        """Start one run of each planner."""
        check_episodes(self.specs())

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per scene and planner; successes compared with the paper's."""
        note = (
            f"Runs of {self.seconds:g} simulated seconds. Shares of runs with 95 % Wilson "
            "intervals, medians with 95 % bootstrap intervals."
        )
        medians = Grouping(("scene", "planner"), METRICS, count="episodes").table(rows, note=note)
        successes = [f"{planner}_successes" for planner in (BASELINE, ACTIVE)]
        columns = ["scene", *successes, "fisher_p", "better_planner", "paper_claim"]
        beside = make_table(columns, compare(rows), "Beside the paper")
        return [medians, beside]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Success, success without being lost at the end, and the mapped area."""
        label = short_planner_names(row["spec"]["planner"] for row in rows).__getitem__
        keys = ("success", "success_tracked", "mapped_area_m2")
        caption = (
            "A map fails if it shows an object twice. Bars: share of runs (area: median); "
            "lines: 95 % intervals."
        )
        panels = bars(rows, "scene", "planner", keys, label)
        return [Chart("arm_experiment", "Maps that show no object twice", caption, panels)]


def judge_episode(world: ActiveSlamEnv, rule: ConsistencyRule | None = None) -> JudgedMap:
    """Judge the map of the episode just played.

    The frames are rendered again without noise from their true poses, with the objects' labels.
    """
    frames = np.flatnonzero(world.episode.tracked & world.episode.processed)
    picked = frames[np.unique(np.linspace(0, len(frames) - 1, MOST_VIEWS).astype(int))]
    truth, estimate = world.episode.trajectory_truth, world.episode.trajectory_estimate
    views = [labelled_view(world.sensor, truth[k], estimate[k]) for k in picked]
    return judge_map(
        world.slam.surface_points(), world.slam.surface_colors(), views, world.sensor, rule
    )


def _outcome(world: ActiveSlamEnv, judged: JudgedMap) -> dict[str, Any]:
    lost = ~world.episode.tracked | (world.episode.pose_errors > LOST_ERROR_M)
    return {
        **judged.verdict(),
        "success_tracked": judged.consistency.success and not lost[-1],
        "lost": bool(lost.any()),
        "lost_at_end": bool(lost[-1]),
        "lost_frames_share": float(lost.mean()),
        "mapped_area_m2": world.coverage.mapped_area,
        "map_points": len(judged.points),
        "frames": len(world.episode.timestamps),
    }


def compare(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Successes of the greedy planner and of random walk by scene, and which is shown to have more.

    Ignores options of a planner; neither is better if one has no runs, or if Fisher's exact test of
    the counts gives at least ``SHOWN_BELOW``.
    """
    flags: dict[tuple[str, str], list[bool]] = {}
    for row in finished(rows):
        key = row["spec"]["scene"], row["spec"]["planner"].partition(",")[0]
        flags.setdefault(key, []).append(bool(row["result"]["success"]))
    lines: list[dict[str, Any]] = []
    for scene in dict.fromkeys(scene for scene, _ in flags):
        runs = {planner: flags.get((scene, planner), []) for planner in (BASELINE, ACTIVE)}
        line: dict[str, Any] = {
            f"{planner}_successes": f"{sum(of)} of {len(of)}" for planner, of in runs.items()
        }
        better, p = None, None
        if all(runs.values()):
            random, greedy = (sum(of) / len(of) for of in runs.values())
            p = fisher_p(*runs.values())
            more = BASELINE if random > greedy else ACTIVE
            better = more if p < SHOWN_BELOW else "not shown"
        claim = f"{ACTIVE} better" + (f": {PAPER[scene]}" if scene in PAPER else "")
        result = {"fisher_p": p, "better_planner": better, "paper_claim": claim}
        lines.append({"scene": scene, **line, **result})
    return lines


CAMERA = Intrinsics(fx=460.0, fy=460.0, cx=319.5, cy=239.5, width=640, height=480)
RED = (225, 30, 30)
_NEAREST_M = 0.35  # closer points would hide the rest of the view
_DOT_M = 0.014  # the points are 1 cm apart


def save_map_picture(judged: JudgedMap, cameras: ArrayLike, path: Path, title: str) -> Path:
    """Draw a judged map twice, seen obliquely from behind the cameras that made it.

    Args:
        judged: the map and its verdict.
        cameras: (K, 3) estimated positions of the camera.
        path: PNG file to write.
        title: title, to which the verdict is appended.
    """
    pose = overview_pose(judged.points, np.asarray(cameras))
    panels = {
        "the map": overview(judged.points, judged.colors, pose),
        "second copies in red, seen through the rest": _marked(judged, pose),
    }
    figure = new_figure(2, width=5.0, height=4.3)
    for ax, (name, image) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        ax.imshow(image)
        ax.set_title(name, fontsize="small")
        ax.axis("off")
    caption(figure, f"{title}: {describe(judged)}")
    return save(figure, path)


def _marked(judged: JudgedMap, pose: Float64) -> Image:
    """The map, faded, with second copies drawn on top."""
    faded = (0.35 * judged.colors + 0.65 * 235).astype(np.uint8)
    image = overview(judged.points, faded, pose)
    copies = judged.points[judged.consistency.apart]
    over = overview(copies, np.tile(RED, (len(copies), 1)), pose)
    return np.where((over == RED).all(axis=2, keepdims=True), over, image)


def describe(judged: JudgedMap) -> str:
    """The verdict in words, with the five worst objects that the map shows twice."""
    twice = judged.consistency.duplicated
    if not twice:
        return "success, no object is there twice"
    names = [f"{judged.name(item)} ({100 * item.apart_share:.0f} %)" for item in twice[:5]]
    more = f" and {len(twice) - 5} more" if len(twice) > 5 else ""
    return "failure, twice there: " + ", ".join(names) + more


def overview_pose(points: Float64, cameras: Float64) -> Float64:
    """A pose (4, 4) behind and above the cameras (K, 3) that looks at the points (N, 3)."""
    target, eye = np.median(points, axis=0), cameras.mean(axis=0)
    back = eye - target
    back[2] = 0.0
    back /= max(float(np.linalg.norm(back)), 1e-6)
    return look_at(eye + 0.7 * back + np.array([0.0, 0.0, 0.5]), target)


def overview(points: Float64, colors: ArrayLike, T_world_camera: Float64) -> Image:
    """Points (N, 3) with colours (N, 3) uint8 as seen by `CAMERA`, without those close to it."""
    ahead = transform_points(invert(T_world_camera), points)[:, 2] > _NEAREST_M
    points, shades = points[ahead], np.asarray(colors, dtype=np.uint8)[ahead]
    return render_points(CAMERA, T_world_camera, points, shades, np.full(len(points), _DOT_M))
