"""``ms-slam record``: episodes of a planner as a dataset for offline reinforcement learning."""

from __future__ import annotations

import errno
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import ms_slam_env
from ms_slam_env._runtime.command_line import parse
from ms_slam_env._runtime.input_files import is_named
from ms_slam_env._runtime.interrupts import kept
from ms_slam_env._runtime.output_files import check_out_folder, naming
from ms_slam_env._runtime.parallel import open_pool, run_each
from ms_slam_env._runtime.progress import Bar
from ms_slam_env._runtime.result_folders import alone_in, lock_beside, result_folder
from ms_slam_env.config import Checked, bounded, chosen, free_options
from ms_slam_env.env.lerobot_dataset import DatasetWriter, Steps
from ms_slam_env.env.planners import check_planner, make_planner, planner_observation
from ms_slam_env.errors import InputError
from ms_slam_env.report.provenance import provenance

_STREAM = 2  # of an episode's seed, for the planner; the environment draws from the seed itself
_VARIABLE = "MINARI_DATASETS_PATH"
_INFOS = (
    *("action_mask", "travelled", "tracking_ok", "T_world_camera", "T_world_camera_estimate"),
    *("divergence", "pose_error", "mapped_share"),
)
"""Keys of ``info`` recorded at every step, where it has them."""

_OWN_OPTIONS = ("scene", "split", "num_scene_seeds", "observation")
_MARKERS = {"minari": "data/metadata.json", "lerobot": "meta/info.json"}
"""File that marks a complete dataset, by format."""
_NEEDS = {"minari": "minari", "lerobot": "pyarrow"}


@dataclass(frozen=True)
class Args(Checked):
    """Record episodes of a planner as a Minari or LeRobot dataset

    ``minari.load_dataset(NAME)`` finds it if the environment variable MINARI_DATASETS_PATH points
    to the ``--out`` folder.
    """

    planner: str = "nbv"
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    env_id: str = chosen("MSActiveSLAM-FreeCamera-v0", *ms_slam_env.ENV_IDS, *ms_slam_env.TASK_IDS)
    """Environment."""
    scenes: tuple[str, ...] = ("living_room", "corridor", "table")
    """Scenes, one of which is drawn for each episode."""
    seeds: str = "train"
    """Split of scene seeds: train, validation or test; or your own range, such as 7000-7003."""
    scene_seeds: int = bounded(100, 1, 100_000)
    """Number of seeds for each scene, from the start of the split."""
    episodes: int = bounded(10, 1, 1_000_000)
    """Number of episodes."""
    steps: int = bounded(100, 1, 1_000_000)
    """Time limit of an episode."""
    seed: int = bounded(0, 0, 2**31)
    """Seed of the first episode; each later episode adds one."""
    observation: str | None = None
    """Observation to record; by default the one that the planner sees."""
    options: tuple[str, ...] = ()
    """Further options of the environment, as name=value."""
    format: str = chosen("minari", *_MARKERS)
    """minari, or lerobot: a LeRobotDataset of format v3.0."""
    name: str | None = None
    """Name of the dataset; by default PLANNER-v0."""
    out: Path = field(default=Path("results/record"))
    """Folder of datasets."""

    def __post_init__(self) -> None:
        """Refuse values out of range and names that are not valid Minari dataset names."""
        super().__post_init__()
        if self.name is not None and not re.fullmatch(r"[\w-]+-v\d+", self.name):
            raise InputError(f"name {self.name!r} is not of the form NAME-v0")


def main(arguments: Sequence[str]) -> int:
    """Record; return the exit code."""
    args = parse(Args, arguments, "ms-slam record")
    record(args)
    return 0


def record(args: Args) -> Path:
    """Play the episodes and write the dataset; return its folder.

    Raises:
        InputError: the format's library is not installed, an option is bad, or a dataset of this
            name exists.
    """
    if find_spec(_NEEDS[args.format]) is None:  # fail before any work is done
        raise InputError(
            f"ms-slam record --format {args.format} needs {_NEEDS[args.format]}: "
            "pip install 'ms-slam-env[record]'"
        )
    check_planner(args.planner)
    check_out_folder(args.out)
    name = args.name or f"{args.planner.partition(',')[0].replace(':', '-')}-v0"
    folder = args.out / name
    with alone_in(folder, lock_beside(folder)):
        if is_named(folder):
            raise InputError(f"{folder} is there already: give another --name, or remove it")
        _make(args, name)
    print(f"{args.episodes} episodes in {folder}; in Python{_read_by(args, name)}")
    return folder


def _make(args: Args, name: str) -> None:
    """Play the episodes in a separate process; move the dataset into place once complete."""
    with (
        kept(f"nothing is left in {args.out / name}"),
        result_folder(args.out, f"{name}/{_MARKERS[args.format]}") as made,
        naming(made / name),
        open_pool(_attempt, 1) as pool,
    ):
        (outcome,) = run_each(pool, {name: (args, name, made)})
        if isinstance(outcome.value, OSError):
            raise outcome.value
        if outcome.is_bad_input:
            raise InputError(outcome.message)
        if outcome.died:  # HDF5 crashes when a write fails
            raise OSError(errno.EIO, "the process that wrote it died", str(made / name))
        if outcome.error:
            raise RuntimeError(outcome.traceback)


def _read_by(args: Args, name: str) -> str:
    """Describe how to load the dataset in Python."""
    place = str(args.out.resolve())
    if args.format == "lerobot":
        return f": LeRobotDataset({name!r}, root={str(Path(place, name))!r})"
    return f", with MINARI_DATASETS_PATH={place}: minari.load_dataset({name!r})"


def _attempt(job: tuple[Args, str, Path]) -> OSError | None:
    """Play and write in a separate process; return the error of a failed write, if any."""
    args, name, folder = job
    try:
        env = _environment(args)
        try:
            write = _write_lerobot if args.format == "lerobot" else _write_minari
            write(env, args, name, folder)
        finally:
            env.close()
    except OSError as error:
        return error
    return None


def _environment(args: Args) -> gym.Env[Any, Any]:
    return gym.make(
        args.env_id,
        max_episode_steps=args.steps,
        disable_env_checker=True,
        scene=list(args.scenes),
        split=args.seeds,
        num_scene_seeds=args.scene_seeds,
        observation=args.observation or planner_observation(args.planner),
        **free_options(args.options, _OWN_OPTIONS),
    )


def _write_minari(env: gym.Env[Any, Any], args: Args, name: str, folder: Path) -> None:
    """Play the episodes and write them one by one as dataset ``name`` under ``folder``."""
    import minari
    from minari.data_collector import EpisodeBuffer

    def buffers() -> Iterator[Any]:
        for seed, played in _episodes(env, args):
            seen = played.observations
            yield EpisodeBuffer(
                None,
                seed,
                None,
                {k: list(v) for k, v in seen.items()} if _has_parts(env) else list(seen[""]),
                list(played.actions),
                played.rewards.tolist(),
                played.terminated.tolist(),
                played.truncated.tolist(),
                {k: list(v) for k, v in played.infos.items()},
            )

    with _datasets_in(folder):
        made = buffers()
        dataset = minari.create_dataset_from_buffers(
            name,
            [next(made)],
            env=env,
            algorithm_name=args.planner,
            description=f"{provenance()['command']}; {_told(args)}",
            requirements=[f"ms-slam-env=={ms_slam_env.__version__}"],
            jpeg_encoding=False,
        )
        for buffer in made:
            dataset.update_dataset_from_buffer([buffer])


def _write_lerobot(env: gym.Env[Any, Any], args: Args, name: str, folder: Path) -> None:
    """Play the episodes and write them as a LeRobotDataset, one video frame per step."""
    assert env.spec is not None
    robot = env.spec.kwargs["embodiment"]
    writer = DatasetWriter(folder / name, _told(args), env.metadata["render_fps"], robot)
    for _, played in _episodes(env, args):
        writer.add(played)
    writer.close()


def _told(args: Args) -> str:
    where = f"{args.env_id}, scenes {', '.join(args.scenes)}, {args.seeds} seeds"
    return f"{args.episodes} episodes of {args.planner} in {where}"


def _episodes(env: gym.Env[Any, Any], args: Args) -> Iterator[tuple[int, Steps]]:
    """Play the episodes; yield the seed and steps of each."""
    bar = Bar(range(args.seed, args.seed + args.episodes), "episodes", unit="episode")
    for seed in bar:
        yield seed, _play(env, args, seed)


def _play(env: gym.Env[Any, Any], args: Args, seed: int) -> Steps:
    """Play one episode to its end."""
    observation, info = env.reset(seed=seed)
    stream = np.random.default_rng([seed, _STREAM])
    planner = make_planner(args.planner, env.unwrapped, seed=int(stream.integers(2**31)))
    planner.reset()
    seen, known, steps = [observation], [info], []
    is_over = False
    while not is_over:
        action = planner.act(observation, planner.known(info))
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append(observation)
        known.append(info)
        steps.append((np.asarray(action), reward, terminated, truncated))
        is_over = terminated or truncated
    by_part = (
        {k: np.array([each[k] for each in seen]) for k in seen[0]} if _has_parts(env) else None
    )
    keys = [key for key in _INFOS if key in info]
    infos = {key: np.array([each[key] for each in known]) for key in keys}
    return Steps(by_part or {"": np.array(seen)}, infos, *map(np.array, zip(*steps, strict=True)))


def _has_parts(env: gym.Env[Any, Any]) -> bool:
    return isinstance(env.observation_space, gym.spaces.Dict)


@contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    """Make Minari write under ``folder``."""
    before = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = str(folder.resolve())
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*is set to None", UserWarning)  # the author, ...
            yield
    finally:
        if before is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = before
