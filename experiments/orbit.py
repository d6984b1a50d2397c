"""USME's relocalisation test: an orbit around an object, with black frames after the first lap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ms_slam_env import metrics, scenes, sequences
from ms_slam_env._runtime.threads import limit_threads
from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import run_backend
from ms_slam_env.report.tables import Grouping, Row, Table, finished, make_table

METRICS = (
    *("relocalisation_found_s", "relocalisations", "never_relocalised"),
    *("tracked_pieces", "robustness", "ate_m", "ate_tracked_m", "tracked_share"),
)


@dataclass(frozen=True)
class OrbitSpec:
    """A backend on an orbit; see :class:`Orbit` for the fields."""

    scene: str
    seed: int
    backend: str
    black_frames: int
    stretches: int
    laps: int
    image_size: str


@dataclass(frozen=True)
class Orbit(Experiment, Checked):
    """Relocalisation time on an orbit around an object

    As USME describes it, the camera orbits a textured object a few times, and stretches of frames
    after the first lap are black. Measures the time from the end of a stretch to the next pose
    (equation 11) and, separately, the number of stretches after which no pose came before the next.
    """

    scenes: tuple[str, ...] = ("table", "living_room")
    """Names of scenes."""
    backends: tuple[str, ...] = ("surfel", "sparse", "odometry")
    """NAME, parameters appended as in surfel,relocalisation=local."""
    black_frames: tuple[int, ...] = (10, 40)
    """Lengths of the black stretches, frames at 30 Hz."""
    stretches: int = bounded(2, 1, 100)
    """Black stretches in each lap after the first."""
    laps: int = bounded(3, 2, 100)
    """Number of laps around the object."""
    image_size: str = "160x120"
    """Image size of the camera."""
    seeds: str = "validation"
    """Split that the seeds come from: train, validation or test; or your own, as 7000-7003."""
    recordings: int = bounded(2, 1, 1000)
    """Seeds for each scene."""

    def specs(self) -> list[OrbitSpec]:
        """Every run.

        Raises:
            InputError: an unknown name, or no length.
        """
        if not self.black_frames or min(self.black_frames) < 1:
            raise InputError(f"black_frames {self.black_frames} must be numbers of frames, >= 1")
        return self.each(
            OrbitSpec,
            scene=self.scenes,
            seed=seed_list(self.seeds, self.recordings),
            black_frames=self.black_frames,
            backend=self.backends,
        )

    @staticmethod
    def run(spec: OrbitSpec) -> dict[str, Any]:
        """Track the orbit, including black frames, and measure."""
        from ms_slam_experiments.shared.loop_paths import around_object

        limit_threads(1)
        scene = scenes.make(spec.scene, spec.seed)
        poses, lap = around_object(scene, spec.seed, spec.laps)
        every = lap // spec.stretches
        if spec.black_frames >= every:
            raise InputError(f"{spec.black_frames} black frames leave nothing of {every} to see")
        dark = sequences.make_perturbation(
            "black-frames", {"start": lap, "length": spec.black_frames, "every": every}
        )
        sequence = sequences.render_sequence(
            scene, poses, xtion(spec.image_size), "kinect", spec.seed, perturbations=[dark]
        )
        black: list[bool] = []
        run = run_backend(
            spec.backend,
            sequence,
            on_step=lambda step: black.append(not step.frame.color.any()),
        )
        found = metrics.relocalisation(run.timestamps, black, run.anchored)
        robustness = metrics.tracking_robustness(run.estimates, poses, run.tracking_ok)
        return {
            "frames": len(run),
            "relocalisation_found_s": found.mean_s,
            "relocalisations": found.found,
            "never_relocalised": found.never,
            "tracked_pieces": len(robustness.segments),
            "robustness": robustness.error,
            "ate_m": metrics.ate_rmse(run.estimates, poses),
            **metrics.tracked_errors(run.estimates, poses, run.tracking_ok),
            "black_tracked": int((np.array(black) & run.tracking_ok).sum()),
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Medians by length of the black stretches and backend, then every run."""
        grouping = Grouping(("black_frames", "backend"), METRICS, count="recordings")
        lines = [{**row["spec"], **row["result"]} for row in finished(rows)]
        columns = ("scene", "seed", "black_frames", "backend", *METRICS, "black_tracked")
        return [grouping.table(rows), make_table(columns, lines, "Runs")]
