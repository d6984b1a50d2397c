"""How well does the divergence predicted from the map rank the 49 motions?

At states along hand-held paths, SLAM's map predicts the divergence of every candidate motion; then
each candidate is really made, its noisy frame rendered and its divergence measured. The fidelity
of a state is Spearman's rank correlation of the two over the candidates. Run as
``python -m ms_slam_env.benchmark.fidelity --help``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from ms_slam_env import slam as slam_backends
from ms_slam_env.benchmark.fidelity_report import as_table, save_figure, summarise
from ms_slam_env.benchmark.planner_report import finished
from ms_slam_env.camera import RGBDFrame, intensity_image, xtion
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.divergence import Divergence, DivergenceConfig, Histograms, make_divergence
from ms_slam_env.env.config import EnvConfig, LookaheadConfig
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.errors import InputError
from ms_slam_env.experiments.harness.episodes import check_names, seed_list
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.robot import CAMERA_RADIUS_M
from ms_slam_env.robot.action_primitives import decompose
from ms_slam_env.scenes import ROOMS
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import handheld_trajectory

Float64 = NDArray[np.float64]

PROGRAM = "python -m ms_slam_env.benchmark.fidelity"
WARM_UP_FRAMES = 12  # before the first state, so that there is a map
FRAMES_BETWEEN_STATES = 6
PATH_SPEED_M, PATH_SPEED_DEG = 0.03, 2.0  # as a planner that keeps tracking moves
FIRST_TRIAL_FRAME = 1_000_000  # noise counter of the candidates' frames, far from the path's

SETTINGS: dict[str, tuple[DivergenceConfig, LookaheadConfig]] = {
    "paper (256 bins, all pixels, live reference, full size)": (
        DivergenceConfig.paper(),
        LookaheadConfig(reference="live", scale=1.0),
    ),
    "paper, predicted reference": (
        DivergenceConfig.paper(),
        LookaheadConfig(reference="predicted", scale=1.0),
    ),
    "default": (DivergenceConfig(), LookaheadConfig()),
    "default, live reference": (DivergenceConfig(), LookaheadConfig(reference="live")),
    "default, predicted at full size": (DivergenceConfig(), LookaheadConfig(scale=1.0)),
    "default, all pixels": (DivergenceConfig(intensity_pixels="all"), LookaheadConfig()),
    "default, no Parzen window": (DivergenceConfig(smoothing=0.0), LookaheadConfig()),
    "default, 16 bins, no Parzen window": (
        DivergenceConfig(bins=16, smoothing=0.0),
        LookaheadConfig(),
    ),
    "default, 32 bins, no Parzen window": (
        DivergenceConfig(bins=32, smoothing=0.0),
        LookaheadConfig(),
    ),
    "default, 256 bins, no Parzen window": (
        DivergenceConfig(bins=256, smoothing=0.0),
        LookaheadConfig(),
    ),
    "default, normals from the next pixels": (
        DivergenceConfig(normal_reach_deg=0.0),
        LookaheadConfig(),
    ),
    "default, N = 8, alpha = 30 degrees": (
        DivergenceConfig(inclinations=8, alpha_deg=30.0),
        LookaheadConfig(),
    ),
    "default, N = 12, alpha = 20 degrees": (
        DivergenceConfig(inclinations=12, alpha_deg=20.0),
        LookaheadConfig(),
    ),
    "spatial windows 2 x 2": (
        DivergenceConfig(measure="windowed-kl", windows=(2, 2)),
        LookaheadConfig(),
    ),
    "spatial windows 3 x 4": (
        DivergenceConfig(measure="windowed-kl", windows=(3, 4)),
        LookaheadConfig(),
    ),
    "earth mover's distance": (DivergenceConfig(measure="earth-movers"), LookaheadConfig()),
}
"""Name to (how divergence is measured, how candidates are predicted)."""


@dataclass(frozen=True)
class FidelitySpec:
    """The states of one path.

    Attributes:
        scene: a scene's name or a mesh file.
        seed: of the scene, the path and the sensor noise.
        states: how many.
        step_m: translation of a candidate motion, metres.
        step_deg: rotation of a candidate motion, degrees.
        image_size: width x height.
    """

    scene: str
    seed: int
    states: int
    step_m: float
    step_deg: float
    image_size: str


@dataclass(frozen=True)
class Arguments:
    """Rank correlation of predicted and met divergence over the 49 motions, by setting."""

    scenes: tuple[str, ...] = ROOMS
    """Names of scenes, or mesh files."""
    seeds: str = "validation"
    """Split that the seeds come from; the defaults read from the result may not use test seeds."""
    paths: int = 1
    """Seeds for each scene."""
    states: int = 20
    """States along each path."""
    step_m: float = EnvConfig.step_m
    """Translation of a motion, metres."""
    step_deg: float = round(float(np.degrees(EnvConfig.step_rad)), 6)
    """Rotation of a motion, degrees."""
    image_size: str = EnvConfig.image_size
    """Width x height of the camera's images."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/fidelity")
    """Folder of the results."""

    def specs(self) -> list[FidelitySpec]:
        """Every path."""
        return [
            FidelitySpec(scene, seed, self.states, self.step_m, self.step_deg, self.image_size)
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.paths)
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiment; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    check_names(("random",), args.scenes)
    if args.states < 1:
        raise InputError(f"states = {args.states} must be at least 1")
    rows = run_all(args.specs(), run_path, args.out, args.workers, "paths")
    check_any_finished(rows)
    summary = summarise(list(SETTINGS), [row["result"] for row in finished(rows)])
    write_json(
        args.out / "results.json",
        {
            "provenance": provenance(),
            "settings": {
                name: {"divergence": asdict(measure), "lookahead": asdict(prediction)}
                for name, (measure, prediction) in SETTINGS.items()
            },
            "summary": [asdict(line) for line in summary],
            "paths": rows,
        },
    )
    table = as_table(summary)
    (args.out / "table.md").write_text(table)
    save_figure(summary, args.out / "fidelity.png")
    print(table)
    return report_failures(failures(rows), PROGRAM)


def run_path(spec: FidelitySpec) -> dict[str, Any]:
    """Fidelity of every setting at every state of one path.

    Returns:
        ``states`` (used), ``lost`` (states skipped because tracking was lost) and ``settings``:
        name to lists over the states of ``correlation``, ``floor`` and ``median``, each a pair
        (intensity, depth). The floor is the divergence of two frames from the same pose, the
        median that over the candidates' frames.
    """
    scene = get_scene(spec.scene, spec.seed)
    camera = xtion(spec.image_size)
    sensor = RGBDSensor(scene, camera, seed=spec.seed)
    slam = slam_backends.make("surfel", camera)
    lookaheads = {
        name: Lookahead(prediction, measure, camera)
        for name, (measure, prediction) in SETTINGS.items()
    }
    measures = {name: make_divergence(measure, camera) for name, (measure, _) in SETTINGS.items()}
    motions = decompose(spec.step_m, np.radians(spec.step_deg))
    frames = WARM_UP_FRAMES + FRAMES_BETWEEN_STATES * spec.states
    path = handheld_trajectory(scene, frames, spec.seed, PATH_SPEED_M, PATH_SPEED_DEG)
    slam.reset(path[0])
    results: dict[str, list[Any]] = {name: [] for name in SETTINGS}
    lost = 0
    for index, pose in enumerate(path):
        live = sensor.capture(pose, index)
        tracked = slam.track(live)
        is_state = index >= WARM_UP_FRAMES and (index - WARM_UP_FRAMES) % FRAMES_BETWEEN_STATES == 0
        if not is_state:
            continue
        if not tracked.tracking_ok:
            lost += 1
            continue
        possible = _free_motions(scene, pose, motions)
        # Candidates, and two more frames from where the camera is for the sampling floor.
        trials = np.concatenate([pose @ possible, pose[None], pose[None]])
        counters = FIRST_TRIAL_FRAME + 100 * index + np.arange(len(trials))
        met_frames = sensor.capture_batch(trials, counters)
        estimate = tracked.T_world_camera
        for name, lookahead in lookaheads.items():
            predicted = lookahead.divergences(slam, estimate @ possible, estimate, live)
            met = _met_divergences(measures[name], met_frames, live)
            results[name].append(
                {
                    "correlation": _rank_correlations(predicted, met[:-2]),
                    "floor": met[-2:].mean(axis=0).tolist(),
                    "median": np.median(met[:-2], axis=0).tolist(),
                }
            )
    return {"states": spec.states - lost, "lost": lost, "settings": results}


def _free_motions(scene: Scene, pose: Float64, motions: Float64) -> Float64:
    """The motions (n, 4, 4) that nothing blocks."""
    targets = (pose @ motions)[:, :3, 3]
    free = [scene.segment_is_free(pose[:3, 3], target, CAMERA_RADIUS_M) for target in targets]
    free[:7] = [True] * 7  # turning on the spot is always possible
    return motions[np.array(free)]


def _met_divergences(measure: Divergence, frames: Sequence[RGBDFrame], live: RGBDFrame) -> Float64:
    """Divergences (n, 2) of n frames from the live one."""
    histograms = _histograms(measure, [*frames, live])
    return measure.divergence(histograms, histograms[-1])[:-1]


def _histograms(measure: Divergence, frames: Sequence[RGBDFrame]) -> Histograms:
    intensity = np.stack([intensity_image(frame.color) for frame in frames])
    return measure.histograms(
        intensity.astype(np.float32), np.stack([frame.depth for frame in frames])
    )


def _rank_correlations(predicted: Float64, met: Float64) -> list[float]:
    """Spearman's correlation of the columns of two (n, 2) arrays; 0 if a column is constant."""
    return [
        0.0 if np.ptp(p) == 0 or np.ptp(m) == 0 else float(spearmanr(p, m).statistic)
        for p, m in zip(predicted.T, met.T, strict=True)
    ]


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
