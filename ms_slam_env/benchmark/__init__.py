"""Find, run, check and write experiments."""

from ms_slam_env.benchmark.experiment import (
    EXPERIMENTS,
    HAS_RESEARCH,
    Experiment,
    experiment_class,
)
from ms_slam_env.benchmark.rows import Outcome, run_experiment

__all__ = [
    "EXPERIMENTS",
    "HAS_RESEARCH",
    "Experiment",
    "Outcome",
    "experiment_class",
    "run_experiment",
]
