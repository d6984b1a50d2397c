"""The numbers of one tiny run of every experiment, and what compares and rewrites them.

Every function of ``RUNS`` runs one experiment as small as possible, on what computes the metrics of
one row, and returns what it found as plain data. ``measure`` flattens that to ``name -> number or
list of numbers`` and leaves out what differs from run to run: times, memory, measured energy.

``python tests/golden/experiments.py --update`` rewrites ``experiments.json``, on purpose;
``--dump FILE`` writes the numbers elsewhere and ``--compare FILE`` demands the same bits as there,
which holds on one machine with one version of the libraries.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).parents[1]))
import same_kernels  # noqa: F401  # before NumPy

# isort: split
import numpy as np

STORED = Path(__file__).with_name("experiments.json")

FREE = "MSActiveSLAM-FreeCamera-v0"
FIXED_TRANSLATION = "MSActiveSLAM-FixedTranslation-v0"
ARM = "MSActiveSLAM-v0"

Numbers = dict[str, Any]
Run = Callable[[Path], Any]
RUNS: dict[str, Run] = {}

EXACT = (1e-6, 1e-9)
"""Tolerance (relative, absolute) of plain arithmetic in double precision."""
DIVERGENCE = (1e-2, 1e-6)
"""Of what is counted in images: a grey value that is rounded the other way moves divergences by up
to 0.4 % (its variance most) with numpy's and BLAS's kernels of an older processor."""
FEW_PIXELS = (1e-1, 1e-6)
"""Of what is counted in an image of 80x60, where one pixel in a bin that is empty otherwise is 2 %:
up to 6 % between two kinds of processors, in a scene of many small things."""
TRACKED = (5e-2, 1e-5)
"""Of SLAM over a few frames, which amplifies the last bits of the rays and of the linear algebra: a
pixel more or less is matched or fused, then all that follows differs."""
CHAOTIC = (2e-1, 1e-4)
"""Of SLAM that is lost, relocalised or bent by a closed loop, over more frames."""
LEVER_M = 0.1
"""An absolute tolerance is of lengths; angles may turn a point so far away by as much."""

TOLERANCES: dict[str, tuple[float, float]] = {}

_UNREPEATABLE = re.compile(
    r"(^|\.)(cpu|ext|ene|mem|load)_"  # of the meters of cost
    r"|(^|[._])ms([._]|$)"
    r"|(^|\.)(merge_cpu_s|memory_mb|mb_per_env|frames_per_s|frames_per_cpu_s)$"
    r"|^(rows\.\d+|tracked|blind|trials\.\d+|held_out\.\d+)\.energy(_model)?_j"  # an arm's is kept
)


def experiment(name: str, tolerance: tuple[float, float] = TRACKED) -> Callable[[Run], Run]:
    """Enter a run under the name of its experiment, with its tolerance."""

    def enter(run: Run) -> Run:
        RUNS[name], TOLERANCES[name] = run, tolerance
        return run

    return enter


def measure(name: str) -> Numbers:
    """Run an experiment; its numbers by flat name, True and False as 1 and 0."""
    from ms_slam_env import scenes

    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(scenes, "make", _scene),
        _same_threads(),
    ):
        return dict(_flat("", RUNS[name](Path(folder))))


def _scene(name: str, seed: int = 0) -> Any:
    """A scene, kept for the next experiment."""
    return _kept_scene(name, seed)


@lru_cache(maxsize=8)
def _kept_scene(name: str, seed: int) -> Any:
    from ms_slam_env.scenes import registry

    return registry.make(name, seed)


@contextmanager
def _same_threads() -> Iterator[None]:
    """Take back that an experiment keeps its process on few cores."""
    import cv2

    threads = cv2.getNumThreads()
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        if cores is not None:
            os.sched_setaffinity(0, cores)


def _flat(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Names and numbers below a name; texts and what cannot be repeated are left out."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if _UNREPEATABLE.search(name) or isinstance(value, (str, Path)):
        return
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _flat(f"{name}.{key}" if name else str(key), part)
    elif isinstance(value, (list, tuple)) and not all(_is_number(part) for part in value):
        for index, part in enumerate(value):
            yield from _flat(f"{name}.{index}" if name else str(index), part)
    elif isinstance(value, (list, tuple)):
        yield name, [_number(part) for part in value]
    else:
        yield name, _number(value)


def _is_number(value: Any) -> bool:
    return value is None or isinstance(value, (bool, int, float, np.generic))


def _number(value: Any) -> float | int | None:
    if value is None:
        return None
    plain = value.item() if isinstance(value, np.generic) else value
    return plain if isinstance(plain, float) else int(plain)


def differences(name: str, found: Numbers, stored: Numbers) -> list[str]:
    """What of an experiment's numbers differs from the stored ones by more than its tolerance."""
    relative, absolute = TOLERANCES[name]
    return _differences(found, stored, relative, absolute)


def _differences(found: Numbers, stored: Numbers, relative: float, absolute: float) -> list[str]:
    wrong = [f"{key} is new" for key in found.keys() - stored.keys()]
    wrong += [f"{key} is missing" for key in stored.keys() - found.keys()]
    for key in found.keys() & stored.keys():
        values, truths = np.atleast_1d(found[key]), np.atleast_1d(stored[key])
        if values.shape != truths.shape:
            wrong.append(f"{key} has {len(values)} values, not {len(truths)}")
            continue
        is_angle = key.endswith("_deg")
        least = math.degrees(absolute / LEVER_M) if is_angle else absolute
        for value, truth in zip(values, truths, strict=True):
            if not _is_close(value, truth, relative, least):
                wrong.append(f"{key} = {value}, not {truth}")
    return sorted(wrong)


def _is_close(value: Any, truth: Any, relative: float, absolute: float) -> bool:
    if value is None or truth is None:
        return value is truth
    if math.isnan(value) or math.isnan(truth):
        return math.isnan(value) and math.isnan(truth)
    return bool(value == truth or abs(value - truth) <= absolute + relative * abs(truth))


# --- episodes -------------------------------------------------------------------------------------


def _episode(planner: str, env_id: str = FREE, steps: int = 3, **fields: Any) -> Any:
    from ms_slam_env.benchmark.episodes import EpisodeSpec, run_episode

    return run_episode(EpisodeSpec(planner, "carpet", 1000, env_id, steps, **fields))


@experiment("planner_benchmark")
def planner_benchmark(_: Path) -> Any:
    return {planner: _episode(planner) for planner in ("random", "greedy", "max-information")}


@experiment("paper_table2")
def paper_table2(_: Path) -> Any:
    return {planner: _episode(planner, FIXED_TRANSLATION) for planner in ("random", "greedy")}


@experiment("step_size")
def step_size(_: Path) -> Any:
    return {f"{cm} cm": _episode("random", step_m=cm / 100, step_deg=cm) for cm in (3, 24)}


@experiment("reward_shares")
def reward_shares(_: Path) -> Any:
    from ms_slam_experiments.reward_shares import RewardShares

    (spec,) = RewardShares(planners=("random",), scenes=("carpet",), episodes=1, steps=3).specs()
    return RewardShares.run(spec)


@experiment("pose_sources")
def pose_sources(_: Path) -> Any:
    options = {"embodiment": "arm-kinematic"}
    return {
        source: _episode("random", ARM, options={**options, "pose": source})
        for source in ("slam", "slam-kinematics", "kinematics", "ground_truth")
    }


@experiment("arm_experiment")
def arm_experiment(_: Path) -> Any:
    from ms_slam_experiments.arm_experiment import ArmExperiment, RunSpec

    return ArmExperiment.run(RunSpec("random", "carpet", 1000, ARM, steps=100, seconds=0.6))


@experiment("arm_masks")
def arm_mask_walk(_: Path) -> Any:
    from ms_slam_experiments import arm_masks

    coarse = arm_masks.furniture_cloud(_scene("carpet", 1000), spacing_m=0.04)  # quick to prepare
    with patch.object(arm_masks, "furniture_of", lambda *_: coarse):
        found = arm_masks.ArmMasks.run(arm_masks.WalkSpec("carpet", 1000, states=1, moves=1))
    reasons = Counter(found["cases"].pop("reason"))
    return {**found, "reasons": dict(sorted(reasons.items()))}


@experiment("lookahead_ranking")
def lookahead_ranking(_: Path) -> Any:
    from ms_slam_experiments.lookahead_ranking import (
        JUDGED,
        KINDS,
        LookaheadRanking,
        RankingSpec,
    )

    found = LookaheadRanking.run(RankingSpec("carpet", 1000, 1, 0.06, 6.0, "80x60"))
    pairs = {
        state["variant"]: {name: [state[f"{name}_{kind}"] for kind in KINDS] for name in JUDGED}
        for state in found.pop("predictions")
    }
    return {**found, "variants": pairs}


# --- SLAM on sequences ----------------------------------------------------------------------------


@experiment("compare")
def compare(_: Path) -> Any:
    from ms_slam_env.benchmark.compare import Compare, CompareSpec

    text = "table:1000:kinect+exposure-ramp"
    return {
        backend: Compare.run(CompareSpec(text, backend, "80x60", frames=12))
        for backend in ("surfel", "odometry")
    }


@experiment("usme", CHAOTIC)
def usme(folder: Path) -> Any:
    from ms_slam_env.benchmark.usme import UsmeSpec, run_usme
    from ms_slam_env.sequences.usme_suite import make_suite

    name, size, seed, scale = "room-fast-black", "80x60", 2000, 0.3
    (made,) = make_suite(folder, (name,), size, seed, scale)
    return run_usme(UsmeSpec(name, "surfel", size, seed, scale, str(made)))


@experiment("adaptation", CHAOTIC)
def adaptation(_: Path) -> Any:
    from ms_slam_experiments.adaptation import Adaptation, AdaptationSpec

    from ms_slam_env.sequences import MotionSegments
    from ms_slam_env.slam.adaptation import DivergenceAdaptationConfig

    stretches = MotionSegments(frames=12, quiet=5, violent=5)
    adaptation = DivergenceAdaptationConfig()
    return Adaptation.run(AdaptationSpec("table", 1000, stretches, "80x60", adaptation))


@experiment("frame_selection")
def frame_selection(_: Path) -> Any:
    from ms_slam_experiments.frame_selection import FilterSpec, FrameSelection

    filters = ("none", "regular,every=2", "divergence,threshold=0.02")
    return FrameSelection.run(FilterSpec("table:1000", filters, image_size="80x60", frames=30))


@experiment("frame_skipping")
def frame_skipping(_: Path) -> Any:
    from ms_slam_experiments.frame_skipping import FrameSkipping, SkippingSpec

    return {
        f"every {interval}": FrameSkipping.run(SkippingSpec("table", 1000, interval, 18, "80x60"))
        for interval in (1, 3)
    }


@experiment("relocalization", CHAOTIC)
def relocalization(_: Path) -> Any:
    from ms_slam_experiments.relocalization import Relocalization, RelocalizationSpec

    settings, variants = ("near", "black", "foreign"), ("ferns", "local")
    spec = RelocalizationSpec("table", 1001, "80x60", settings, variants, 1, 50, 3)
    return Relocalization.run(spec)


@experiment("submaps", CHAOTIC)
def submaps(_: Path) -> Any:
    from ms_slam_experiments.submaps import SubmapsExperiment, SubmapsSpec

    spec = SubmapsSpec("table", 1000, "80x60", ("return",), ("atlas",), 1, 20, 10)
    return SubmapsExperiment.run(spec)


@experiment("loop_closure", CHAOTIC)
def loop_closure(_: Path) -> Any:
    from ms_slam_experiments.loop_closure import LoopClosure, LoopSpec

    recording = ("living_room", 1002, "around", 0.06, 5.0, "kinect", "80x60")
    return LoopClosure.run(LoopSpec(*recording, closure="deformation"))


@experiment("multi_robot", CHAOTIC)
def multi_robot(_: Path) -> Any:
    from ms_slam_experiments.multi_robot import MultiRobot, MultiRobotSpec

    from ms_slam_env.slam.team.map_merging import MergeConfig

    merge = MergeConfig(queries=6, lost_queries=1, patience=2)
    spec = MultiRobotSpec(
        "table", 1000, frames=12, image_size="80x60", least_overlap=0.5, merge=merge
    )
    return MultiRobot.run(spec)


@experiment("pose_covariance", CHAOTIC)
def pose_covariance(_: Path) -> Any:
    from ms_slam_experiments.pose_covariance import PoseCovariance

    seeds = {"validation_seeds": (1000,), "test_seeds": (1001,)}
    experiment = PoseCovariance(("wall",), **seeds, size="80x60", frames=16)
    rows = [
        {"spec": dataclasses.asdict(spec), "result": PoseCovariance.run(spec), "error": None}
        for spec in experiment.specs()
    ]
    return {"rows": experiment.tables(rows)[0].rows, **experiment.content(rows)}


@experiment("acceptance_roc", CHAOTIC)
def acceptance_roc(_: Path) -> Any:
    from ms_slam_experiments.acceptance_roc import AcceptanceRoc

    experiment = AcceptanceRoc(("wall:1000",), image_size="80x60", frames=31)
    return AcceptanceRoc.run(experiment.specs()[0])


@experiment("slam_batch")
def slam_batch(_: Path) -> Any:
    from ms_slam_experiments.slam_batch import SlamBatch

    sequence = {"scene": "table", "seed": 1000, "size": "80x60", "frames": 6, "sequences": 2}
    (spec,) = SlamBatch(batch=(3,), warm_up=1, max_surfels=8000, **sequence).specs()
    return SlamBatch.run(spec)


@experiment("slam_speed")
def slam_speed(_: Path) -> Any:
    """Surfels and lost frames; the rest are times."""
    from ms_slam_experiments.shared.slam_speed_child import measure
    from ms_slam_experiments.slam_speed import stored_sequence

    _, path = stored_sequence("table", 1000, 6, "80x60")
    rows = measure(path, "80x60", (1, 30_000), 2, {"compaction_interval": 7})
    return [{key: row[key] for key in ("target", "surfels", "lost_frames")} for row in rows]


@experiment("lookahead_speed")
def lookahead_speed(_: Path) -> Any:
    """Size of the map and number of views; the rest are times."""
    from ms_slam_experiments.lookahead_speed import LookaheadSpeed

    (spec,) = LookaheadSpeed("table", 1000, "80x60", surfels=3000, repeats=1).specs()
    found = LookaheadSpeed.run(spec)
    return {key: found[key] for key in ("surfels", "views")}


@experiment("env_speed")
def env_speed(_: Path) -> Any:
    """Frames a step; the rest are times."""
    from ms_slam_experiments.env_speed import EnvSpeed, EnvSpeedSpec

    spec = EnvSpeedSpec("free", 1, "features", scene="table", seconds=0.01, warm_up=1)
    return {"frames_per_step": EnvSpeed.run(spec)["frames_per_step"]}


# --- maps -----------------------------------------------------------------------------------------


def _glide(frames: int, offset_m: float) -> tuple[Any, list[Any], Any]:
    """A sensor, its views of a glide past a table and the map made of them at given poses.

    From half way on, the poses are off by ``offset_m`` to the left.
    """
    from ms_slam_experiments.shared.duplicate_objects import labelled_view

    from ms_slam_env import scenes, slam
    from ms_slam_env.camera import xtion
    from ms_slam_env.geometry import make_pose
    from ms_slam_env.sensor import RGBDSensor

    sensor = RGBDSensor(scenes.make("table", 1000), xtion("160x120"), seed=1000)
    start = sensor.scene.sample_start(np.random.default_rng(1000))
    system, views = slam.make("surfel", sensor.intrinsics), []
    for k in range(frames):
        truth = start @ make_pose(np.eye(3), np.array([0.01 * k, 0.0, 0.0]))
        estimate = truth.copy()
        estimate[:3, 3] += offset_m * truth[:3, 0] * (k >= frames // 2)
        system.fuse(sensor.capture(truth, index=k, seed=0), estimate)
        views.append(labelled_view(sensor, truth, estimate))
    return sensor, views, system


@experiment("map_consistency")
def map_consistency(_: Path) -> Any:
    from ms_slam_experiments.shared.duplicate_objects import judge_map

    sensor, views, system = _glide(8, 0.15)
    judged = judge_map(system.surface_points(), system.surface_colors(), views, sensor)
    objects = {judged.name(item): item for item in judged.consistency.objects}
    return {"points": len(judged.points), "success": judged.consistency.success, **objects}


@experiment("map_evaluation", EXACT)
def map_evaluation(folder: Path) -> Any:
    from ms_slam_env.evaluation.map_files import MapOptions, evaluate_maps
    from ms_slam_env.evaluation.run_files import write_ply

    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 1, (4000, 3)) * (1, 1, 0.3)
    truth[::2, 2] = 0.0
    noisy = truth[:3000] + rng.normal(0, 0.01, (3000, 3)) + (0.02, 0.0, 0.01)
    for name, points in (("map.ply", noisy), ("truth.ply", truth)):
        write_ply(folder / name, points, {})
    return {
        register: evaluate_maps(
            folder / "map.ply", folder / "truth.ply", MapOptions(register, remove_outliers=True)
        )[0]
        for register in ("none", "icp")
    }


# --- exploration ----------------------------------------------------------------------------------


@cache
def _evaluator(*sequences: str) -> Any:
    from ms_slam_env.tuning import SlamEvaluator

    return SlamEvaluator(sequences, 12, image_size="80x60", map_error=True)


@experiment("explore", CHAOTIC)
def explore(folder: Path) -> Any:
    from ms_slam_env.tuning import Exploration, ExplorationSettings, run_exploration

    exploration = Exploration(
        _evaluator("table:1000"),
        ExplorationSettings(("ate_m", "map_error_mm"), sampler="random", seed=1),
        ("points_per_level", "depth_cutoff_m", "keep_every=1:3"),
        held_out=("table:1001",),
    )
    results = run_exploration(exploration, folder, 3)
    return {
        "trials": [{**row["spec"], **row["result"]} for row in results.rows],
        "reference": results.content["reference"],
        "hypervolume": results.content["hypervolume"],
        "held_out": results.tables[1].rows,
    }


@experiment("explore_evaluation")
def explore_evaluation(_: Path) -> Any:
    from ms_slam_env.slam.configuration import SlamConfiguration

    evaluator = _evaluator("table:1000", "table:1001")
    return {
        "tracked": evaluator(SlamConfiguration(slam_config={"icp_rgb_weight": 0.2}, keep_every=2)),
        "blind": evaluator(SlamConfiguration(slam_config={"depth_cutoff_m": 0.01})),
    }


@experiment("explore_divergence")
def explore_divergence(_: Path) -> Any:
    from ms_slam_experiments.explore_divergence import METRICS, ExploreDivergence, RateSpec

    specs = [
        RateSpec(text, every, "80x60", 12)
        for text in ("table:1000", "table:1001")
        for every in (1, 4)
    ]
    rows = [
        {"spec": dataclasses.asdict(spec), "result": ExploreDivergence.run(spec), "error": None}
        for spec in specs
    ]
    lines: Any = ExploreDivergence().tables(rows)[0].rows
    return {
        "rows": [{"keep_every": row["spec"]["keep_every"], **row["result"]} for row in rows],
        "summary": [{key: line[key].value for key in METRICS} for line in lines],
    }


@dataclasses.dataclass(frozen=True)
class _Formula:
    """Stands for the measurement of a configuration, of which one objective is a time."""

    height: float = 1.0

    def __call__(self, configuration: Any) -> Numbers:
        every, weight = configuration.keep_every, configuration.slam_config["icp_rgb_weight"]
        return {"ate_m": self.height * every * (1.1 - weight), "load_ms": (0.5 + weight**2) / every}


@experiment("explore_samplers", EXACT)
def explore_samplers(folder: Path) -> Any:
    """Samplers on a formula: with real runs, an objective is a time."""
    from ms_slam_experiments.explore_samplers import run_study, summarise
    from ms_slam_experiments.shared.sampler_studies import Grid

    from ms_slam_env.tuning import make_space

    space = make_space(["icp_rgb_weight=0:1", "keep_every=1:6"])
    grid = Grid(space, _Formula(), 4, folder / "evaluations.jsonl")  # type: ignore[arg-type]
    reference = {"ate_m": 7.0, "load_ms": 1.5}
    histories = {
        sampler: [run_study(grid, sampler, seed, 12, reference) for seed in (0, 1)]
        for sampler in ("random", "nsga2", "tpe")
    }
    rows = [
        {
            "spec": {"sampler": sampler, "seed": seed},
            "result": {"hypervolume_half": history[5], "hypervolume": history[-1]},
            "error": None,
        }
        for sampler, found in histories.items()
        for seed, history in enumerate(found)
    ]
    return {"measured": grid.measured, "histories": histories, "summary": summarise(rows)}


# --- recordings -----------------------------------------------------------------------------------


def _recorded(folder: Path, frames: int) -> Any:
    """A short rendered sequence, written and read again."""
    from ms_slam_env import scenes
    from ms_slam_env.camera import xtion
    from ms_slam_env.sequences import HandheldPath, open_sequence, render_sequence
    from ms_slam_env.sequences.writing import write_sequence

    scene, path = scenes.make("table", 1000), HandheldPath(frames)
    sequence = render_sequence(
        scene, path.poses(scene, 1000), xtion("80x60"), seed=1000, timestamps=path.timestamps
    )
    write_sequence(sequence, folder / "sequence", {})
    return open_sequence(folder / "sequence")


@experiment("sequence_run")
def sequence_run(folder: Path) -> Any:
    from ms_slam_env.evaluation.run_to_folder import run_to_folder
    from ms_slam_env.slam.frame_selection import parse_frame_selection

    recording, every_other = _recorded(folder, 12), parse_frame_selection("regular,every=2")
    loops = {"loop_closure": "deformation"}
    found = {
        "all": run_to_folder(recording, "surfel", loops, folder / "all"),
        "regular": run_to_folder(recording, "surfel", {}, folder / "regular", None, every_other),
    }
    trajectory = np.loadtxt(folder / "all" / "trajectory.txt")
    return {
        **found,
        "trajectory": trajectory[::3],
        "map_bytes": (folder / "all" / "map.ply").stat().st_size,
    }


@experiment("sequence_divergence", DIVERGENCE)
def sequence_divergence(folder: Path) -> Any:
    from ms_slam_env.evaluation.sequence_divergence import as_metrics, sequence_divergence

    recording = _recorded(folder, 9)
    return as_metrics([sequence_divergence(recording, every=every) for every in (1, 2)])


@experiment("difficulty", FEW_PIXELS)
def difficulty(folder: Path) -> Any:
    from ms_slam_experiments.difficulty import RECORDING, DifficultySpec, watch
    from PIL import Image

    from ms_slam_env.sequences import write_trajectory

    data = folder / "icl_nuim"
    (data / "trajectories").mkdir(parents=True)
    (data / "lr_kt3_depth" / "depth").mkdir(parents=True)
    motions = ("lr_kt0", "lr_kt3")
    for k, name in enumerate(motions):
        poses = np.repeat(np.eye(4)[None], 5, axis=0)
        poses[:, 0, 3] = (0.005 + 0.005 * k) * np.arange(5)
        write_trajectory(data / f"trajectories/{name}.tum.txt", np.arange(5) / 30, poses)
    for k in range(5):
        slope = 1.0 + 0.01 * k + 0.01 * np.arange(80)[None] * (1 + 0.1 * k) + np.zeros((60, 1))
        Image.fromarray((5000 * slope).astype(np.uint16)).save(data / f"lr_kt3_depth/depth/{k}.png")
    lines = "\n".join(f"{k / 30:.6f} depth/{k}.png" for k in range(5))
    (data / "lr_kt3_depth/depth.txt").write_text(lines)
    (data / "lr_kt3_depth/intrinsics.txt").write_text("60 60 39.5 29.5 80 60")
    return {
        scene: watch(
            DifficultySpec(scene, "lr_kt3", motions, str(folder), 0, 1.0, "80x60", "kinect", 1)
        )
        for scene in (RECORDING, "table")
    }


@experiment("trajectory_evaluation", EXACT)
def trajectory_evaluation(folder: Path) -> Any:
    from ms_slam_env.evaluation.trajectory_files import TrajectoryOptions
    from ms_slam_env.evaluation.trajectory_measures import evaluate_files
    from ms_slam_env.geometry import se3_exp
    from ms_slam_env.sequences import write_trajectory

    rng = np.random.default_rng(0)
    pose, truth = np.eye(4), []
    for _ in range(60):
        pose = pose @ se3_exp(rng.normal([0.04, 0, 0, 0, 0, 0.05], 0.05))
        truth.append(pose)
    estimate = np.stack([T @ se3_exp(rng.normal(0, 0.01, 6)) for T in truth])
    times = np.arange(60) / 30
    kept = np.r_[0:25, 32:60]  # lost in between
    write_trajectory(folder / "truth.txt", times, np.stack(truth))
    write_trajectory(folder / "estimate.txt", times[kept] + 0.001, estimate[kept])
    options = {
        "se3": TrajectoryOptions(segments=2, segment_lengths_m=(0.5, 1.0)),
        "sim3": TrajectoryOptions(
            align="sim3", delta=0.3, delta_unit="m", segment_lengths_m=(1.0,)
        ),
    }
    return {
        name: evaluate_files(folder / "estimate.txt", folder / "truth.txt", option)
        for name, option in options.items()
    }


# --- command line ---------------------------------------------------------------------------------


def measured(names: list[str]) -> dict[str, Numbers]:
    """The numbers of several experiments, saying what each took."""
    found = {}
    for name in names:
        start, cpu = time.perf_counter(), time.process_time()
        found[name] = measure(name)
        took = time.process_time() - cpu, time.perf_counter() - start
        print(
            f"{name}: {len(found[name])} names, {took[0]:.1f} s of processor time, {took[1]:.1f} s",
            file=sys.stderr,
        )
    return found


def read(path: Path) -> dict[str, Numbers]:
    """Numbers as ``write`` left them."""
    return json.loads(path.read_text(encoding="utf-8"))


def write(path: Path, numbers: dict[str, Numbers]) -> None:
    """One line a name; a float is written so that it is read again to the last bit."""
    parts = []
    for name in sorted(numbers):
        lines = [f"  {json.dumps(key)}: {json.dumps(v)}" for key, v in numbers[name].items()]
        parts.append(f" {json.dumps(name)}: {{\n" + ",\n".join(lines) + "\n }")
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Run, then rewrite, write elsewhere, or compare; with nothing said, compare with tolerance."""
    parser = argparse.ArgumentParser(description="Golden numbers of the experiments.")
    parser.add_argument("--update", action="store_true", help="rewrite the stored numbers")
    parser.add_argument("--dump", type=Path, metavar="FILE", help="write the numbers to FILE")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="demand the bits of FILE")
    parser.add_argument("--only", nargs="+", choices=list(RUNS), default=list(RUNS))
    options = parser.parse_args(arguments)
    found = measured(options.only)
    if options.dump:
        write(options.dump, found)
    if options.update:
        write(STORED, {**(read(STORED) if STORED.exists() else {}), **found})
    if options.compare:
        stored = read(options.compare)
        wrong = {n: _differences(found[n], stored.get(n, {}), 0.0, 0.0) for n in found}
    elif options.update or options.dump:
        return 0
    else:
        stored = read(STORED)
        wrong = {n: differences(n, found[n], stored.get(n, {})) for n in found}
    for name, lines in wrong.items():
        print(f"{name}: {'the same' if not lines else f'{len(lines)} differences'}")
        for line in lines[:20]:
            print(f"  {line}")
    return int(any(wrong.values()))


if __name__ == "__main__":
    sys.exit(main())
