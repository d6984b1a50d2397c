"""Entry point through which Gymnasium makes environments in a batch."""

from __future__ import annotations

from typing import Any, NoReturn

from ms_slam_env.env.batched.batched_env import BatchedActiveSlam
from ms_slam_env.env.env_config import make_config
from ms_slam_env.env.make import options_for
from ms_slam_env.errors import InputError
from ms_slam_env.tasks import find_task

_OWN = ("task", "max_episode_steps", "device", "autoreset_mode", "start_pool")


def make_batched(
    num_envs: int = 1,
    task: Any = None,
    device: str = "cpu",
    autoreset_mode: Any = "NextStep",
    start_pool: int = 0,
    max_episode_steps: int | None = None,
    embodiment: str = "free",
    **options: Any,
) -> BatchedActiveSlam:
    """Make a batch of environments; entry point of the ids in ``batched/``.

    Raises:
        InputError: an unknown option or task, a value out of range, or something that environments
            in a batch do not have.
    """
    if embodiment != "free":
        raise InputError(f"in a batch embodiment must be free, not {embodiment!r}")
    if task is not None:
        found = find_task(task)
        if found.perturbations:
            raise InputError(f"in a batch there are no perturbations, as in task {task!r}")
        options = options_for(found, options)
    config = make_config(options, _OWN)
    own = device, max_episode_steps, autoreset_mode, start_pool
    return BatchedActiveSlam(num_envs, config, *own)


def refuse_single(**_: Any) -> NoReturn:
    """Say how to make a batch, where ``gym.make`` is given one of the ids in ``batched/``.

    Raises:
        InputError: always.
    """
    raise InputError(
        "the ids in batched/ are made by gym.make_vec(ID, num_envs=N), without a "
        "vectorization_mode; gym.make takes the id without batched/"
    )
