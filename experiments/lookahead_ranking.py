"""How well does the divergence predicted from the map rank the 49 motions?

At states along hand-held paths, the divergence of every candidate motion is predicted from SLAM's
map. Then each motion is executed, its noisy frame rendered, and its divergence measured. The
quality of a state's ranking is Spearman's rank correlation of the two over the candidates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from ms_slam_env import slam as slam_backends
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import RGBDFrame, intensity_image, xtion
from ms_slam_env.divergence import Divergence, DivergenceConfig, make_divergence
from ms_slam_env.env.env_config import EnvConfig, LookaheadConfig
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import SequenceRun
from ms_slam_env.report.charts import Chart, Guide, Panel, Series
from ms_slam_env.report.tables import Row, Table, flattened, grouped, make_table, summary
from ms_slam_env.robot import CAMERA_RADIUS_M, NUM_ROTATIONS
from ms_slam_env.robot.action_primitives import decompose
from ms_slam_env.scenes import PUBLISHED_ROOMS
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import handheld_trajectory

WARM_UP_FRAMES = 12  # before the first state, so that there is a map
FRAMES_BETWEEN_STATES = 6
PATH_SPEED_M, PATH_SPEED_DEG = 0.03, 2.0  # like a planner that keeps tracking
FIRST_TRIAL_FRAME = 1_000_000  # noise counter of the candidates' frames, far from the path's
KINDS = ("intensity", "depth")
JUDGED = ("rank_correlation", "divergence_floor", "divergence_met")
AIMS = {"intensity": 0.7, "depth": 0.8}  # rank correlations to reach

_MEASURES = {
    "default, all pixels": DivergenceConfig(intensity_pixels="all"),
    "default, no Parzen window": DivergenceConfig(smoothing=0.0),
    "default, 16 bins, no Parzen window": DivergenceConfig(bins=16, smoothing=0.0),
    "default, 32 bins, no Parzen window": DivergenceConfig(bins=32, smoothing=0.0),
    "default, 256 bins, no Parzen window": DivergenceConfig(bins=256, smoothing=0.0),
    "default, normals from the next pixels": DivergenceConfig(normal_reach_deg=0.0),
    "default, N = 8, alpha = 30 degrees": DivergenceConfig(inclinations=8, alpha_deg=30.0),
    "default, N = 12, alpha = 20 degrees": DivergenceConfig(inclinations=12, alpha_deg=20.0),
    "spatial windows 2 x 2": DivergenceConfig(measure="windowed-kl", windows=(2, 2)),
    "spatial windows 3 x 4": DivergenceConfig(measure="windowed-kl", windows=(3, 4)),
    "earth mover's distance": DivergenceConfig(measure="earth-movers"),
}
_PAPER = DivergenceConfig.paper()
SETTINGS: dict[str, tuple[DivergenceConfig, LookaheadConfig]] = {
    "paper (256 bins, all pixels, live reference, full size)": (
        _PAPER,
        LookaheadConfig(reference="live", scale=1.0),
    ),
    "paper, each view projected": (
        _PAPER,
        LookaheadConfig(reference="live", scale=1.0, projection="exact"),
    ),
    "paper, predicted reference": (_PAPER, LookaheadConfig(reference="predicted", scale=1.0)),
    "default": (DivergenceConfig(), LookaheadConfig()),
    "default, each view projected": (DivergenceConfig(), LookaheadConfig(projection="exact")),
    "default, live reference": (DivergenceConfig(), LookaheadConfig(reference="live")),
    "default, predicted at full size": (DivergenceConfig(), LookaheadConfig(scale=1.0)),
    **{name: (measure, LookaheadConfig()) for name, measure in _MEASURES.items()},
}
"""Name to settings of the divergence and of the lookahead."""


@dataclass(frozen=True)
class RankingSpec:
    """The states of one path; see :class:`LookaheadRanking` for the fields."""

    scene: str
    seed: int
    states: int
    step_m: float
    step_deg: float
    image_size: str


@dataclass(frozen=True)
class LookaheadRanking(Experiment):
    """Rank correlation of predicted and met divergence over the 49 motions

    Measures how well the map predicts the divergence of a motion before it is made, for several
    settings of divergence and lookahead.
    """

    scenes: tuple[str, ...] = PUBLISHED_ROOMS
    """Names of scenes, or mesh files."""
    seeds: str = "validation"
    """Split that the seeds come from; do not derive defaults from test seeds."""
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

    unit = "paths"

    @staticmethod
    def run(spec: RankingSpec) -> dict[str, Any]:
        """Judge every setting at every state of one path.

        Returns:
            ``states`` (used), ``lost_states`` (left out because tracking was lost) and
            ``predictions``: the measures in ``JUDGED``, for intensity and depth, by state and
            setting (``variant``).
        """
        scene = get_scene(spec.scene, spec.seed)
        camera = xtion(spec.image_size)
        sensor = RGBDSensor(scene, camera, seed=spec.seed)
        slam = slam_backends.make("surfel", camera)
        stages = {
            name: (Lookahead(prediction, measure, camera), make_divergence(measure, camera))
            for name, (measure, prediction) in SETTINGS.items()
        }
        motions = decompose(spec.step_m, np.radians(spec.step_deg))
        frames = WARM_UP_FRAMES + FRAMES_BETWEEN_STATES * spec.states
        path = handheld_trajectory(scene, frames, spec.seed, PATH_SPEED_M, PATH_SPEED_DEG)
        shown = (sensor.capture(pose, k) for k, pose in enumerate(path))
        predictions: list[dict[str, Any]] = []
        lost = 0
        for step in SequenceRun(slam, shown, start=path[0]):
            index = step.index - WARM_UP_FRAMES
            if index < 0 or index % FRAMES_BETWEEN_STATES:
                continue
            if not step.result.tracking_ok:
                lost += 1
                continue
            pose, estimate = path[step.index], step.result.T_world_camera
            possible = _free_motions(scene, pose, motions)
            # Candidates, and two more frames from the current pose for the noise floor.
            trials = np.concatenate([pose @ possible, pose[None], pose[None]])
            counters = FIRST_TRIAL_FRAME + 100 * step.index + np.arange(len(trials))
            met_frames = sensor.capture_batch(trials, counters)
            for name, (lookahead, measure) in stages.items():
                predicted = lookahead.divergences(slam, estimate @ possible, estimate, step.frame)
                met = _met_divergences(measure, met_frames, step.frame)
                predictions.append({"variant": name, **_judge(predicted, met[:-2], met[-2:])})
        return {"states": spec.states - lost, "lost_states": lost, "predictions": predictions}

    def specs(self) -> list[RankingSpec]:
        """Every path."""
        if self.states < 1:
            raise InputError(f"states = {self.states} must be at least 1")
        return self.each(RankingSpec, scene=self.scenes, seed=seed_list(self.seeds, self.paths))

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per setting, over the states of all paths."""
        columns = [f"{name}_{kind}" for kind in KINDS for name in JUDGED]
        lines: list[dict[str, Any]] = []
        for variant, states in by_variant(rows).items():
            line: dict[str, Any] = {"variant": variant, "states": len(states)}
            for key in columns:
                found = summary(states, key)
                line[key] = found if key.startswith(JUDGED[0]) else found.value
            lines.append(line)
        note = "Medians over states, of the correlations with their 95 % intervals."
        return [make_table(["variant", "states", *columns], lines, note=note)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """The correlations of every setting."""
        panels = []
        for kind, aim in AIMS.items():
            key = f"rank_correlation_{kind}"
            found = {name: summary(of, key) for name, of in by_variant(rows).items()}
            low, middle, high = np.array([(v.low, v.value, v.high) for v in found.values()]).T
            ends = low.tolist(), high.tolist()
            marks = Series("median over states", middle.tolist(), list(found), *ends, "markers")
            panels.append(Panel(key, "", [marks], guides=[Guide(aim, "x")]))
        caption = "Mark and bar: median over states and its 95 % interval; dashed: the aim."
        return [Chart("lookahead_ranking", "Predicted and met divergence", caption, panels)]

    def content(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """The settings in full."""
        return {
            "settings": {
                name: {"divergence": asdict(measure), "lookahead": asdict(prediction)}
                for name, (measure, prediction) in SETTINGS.items()
            }
        }


def by_variant(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """States of all paths by setting; settings without states are left out."""
    found = grouped(flattened(rows, "predictions"), ("variant",))
    return {name: found[name,] for name in SETTINGS if (name,) in found}


def _free_motions(scene: Scene, pose: Float64, motions: Float64) -> Float64:
    """The motions (n, 4, 4) that are not blocked."""
    targets = (pose @ motions)[:, :3, 3]
    free = [scene.segment_is_free(pose[:3, 3], target, CAMERA_RADIUS_M) for target in targets]
    free[:NUM_ROTATIONS] = [True] * NUM_ROTATIONS  # turning on the spot is always possible
    return motions[np.array(free)]


def _met_divergences(measure: Divergence, frames: Sequence[RGBDFrame], live: RGBDFrame) -> Float64:
    """Divergences (n, 2) of n frames from the live one."""
    shown = [*frames, live]
    intensity = np.stack([intensity_image(frame.color) for frame in shown]).astype(np.float32)
    histograms = measure.histograms(intensity, np.stack([frame.depth for frame in shown]))
    return measure.divergence(histograms, histograms[-1])[:-1]


def _judge(predicted: Float64, met: Float64, still: Float64) -> dict[str, float]:
    """Measures from predicted and measured divergences (n, 2), and those at rest (m, 2)."""
    pairs = rank_correlations(predicted, met), still.mean(axis=0), np.median(met, axis=0)
    return {
        f"{name}_{kind}": float(pair[k])
        for name, pair in zip(JUDGED, pairs, strict=True)
        for k, kind in enumerate(KINDS)
    }


def rank_correlations(predicted: Float64, met: Float64) -> list[float]:
    """Spearman's correlation of the columns of two (n, 2) arrays; 0 if a column is constant."""
    return [
        0.0 if np.ptp(p) == 0 or np.ptp(m) == 0 else float(spearmanr(p, m).statistic)
        for p, m in zip(predicted.T, met.T, strict=True)
    ]
