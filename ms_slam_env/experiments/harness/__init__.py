"""What all experiments share: finding, running, checking and writing them."""

from ms_slam_env.experiments.harness.experiment import (
    EXPERIMENTS,
    Experiment,
    experiment_class,
    experiment_names,
)
from ms_slam_env.experiments.harness.rows import Outcome, run_experiment

__all__ = [
    "EXPERIMENTS",
    "Experiment",
    "Outcome",
    "experiment_class",
    "experiment_names",
    "run_experiment",
]
