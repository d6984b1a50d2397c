"""Active SLAM as a reinforcement-learning problem: ``import ms_slam_env`` registers the envs."""

from ms_slam_env.gym_ids import (
    BATCHED_IDS,
    CONTINUOUS_IDS,
    ENV_IDS,
    PERTURBED_ENV_IDS,
    TASK_IDS,
    register_all,
)

__version__ = "0.1.0"

register_all()

__all__ = [
    "BATCHED_IDS",
    "CONTINUOUS_IDS",
    "ENV_IDS",
    "PERTURBED_ENV_IDS",
    "TASK_IDS",
    "__version__",
]
