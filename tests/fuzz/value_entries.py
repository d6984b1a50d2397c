"""Entry points that take values: options, states, frames, arguments of commands."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import tempfile
import zipfile
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import file_entries
import gymnasium as gym
import numpy as np
from fuzzing import Entry
from mutations import (
    ARRAYS,
    NUMBERS,
    PLAIN,
    Rng,
    mutated_bytes,
    mutated_text,
    mutated_tree,
    write_files,
)

import ms_slam_env
from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.cli import main
from ms_slam_env.config import nested_options
from ms_slam_env.env.make import make_env
from ms_slam_env.errors import InputError
from ms_slam_env.sequences import open_sequence, parse_sequence
from ms_slam_env.slam.configuration import read_configuration

SMALL = {"scene": "table", "scene_seed": 0, "image_size": "80x60"}


def is_finite(value: Any) -> bool:
    """Whether every number in an observation is."""
    parts = value.values() if isinstance(value, dict) else [value]
    return all(np.isfinite(part).all() for part in parts)


# --- configurations ----------------------------------------------------------------------------

SLAM_YAML = b"""slam: odometry
slam_config:
  depth_cutoff_m: 4.0
  keyframe_m: 0.3
  keyframe_deg: 10
image_size: 16x12
keep_every: 1
threads: 1
about: {trial: 3, made: 2026-01-01}
"""


def call_configuration(data: bytes, folder: Path) -> None:
    """Read a SLAM configuration and make what it says."""
    (folder / "c.yaml").write_bytes(data)
    configuration = read_configuration(folder / "c.yaml")
    if configuration.slam in ("odometry", "surfel"):
        slam.make(folder / "c.yaml", file_entries.K)


OPTION_TEXTS = (
    *("depth_cutoff_m=4", "acceptance.overlap=0.3", "icp_rgb_weight=0.1", "submaps=atlas"),
    *("motion_mask=geometric", "loop_closure=deformation", "iterations=[4,3,2]", "submap_rules={}"),
)


def call_option_texts(texts: list[str], folder: Path) -> None:
    """Options of the surfel backend as a command line takes them."""
    slam.registry.check_parameters("surfel", nested_options(texts))


def mutated_texts(texts: list[str], rng: Rng) -> list[str]:
    """Some of them, each changed."""
    some = [texts[k] for k in rng.integers(0, len(texts), rng.integers(1, 4))]
    return [mutated_text(text.encode(), rng).decode(errors="replace") for text in some]


def call_names(texts: list[str], folder: Path) -> None:
    """Names of sequences."""
    for text in texts:
        parse_sequence(text)


NAMES = (
    "living_room:2000:kinect+misregistration+motion-blur,exposure_s=0.02",
    *("table:7:uneven,frames=40+depth-dropout", "corridor:3:none", "carpet:1:wander,frames=9"),
)

ENV_OPTIONS = {
    **SMALL,
    "embodiment": "free",
    "slam": "surfel",
    "slam_config": {"depth_cutoff_m": 4.0, "icp_rgb_weight": 0.1, "max_surfels": 20_000},
    "observation": "features",
    "step_m": 0.05,
    "step_rad": 0.1,
    "noise": "kinect",
    "pose": "slam",
    "reward": {"name": "mapping", "ate_growth": 1.0},
    "lookahead": {"stride": 4},
    "perturbed_by": "motion-blur",
    "perturbation": {"samples": 2},
}


def seed_options() -> Any:
    """Those of the options that the environment takes."""
    options: dict[str, Any] = dict(ENV_OPTIONS)
    for name in ("reward", "lookahead"):
        try:
            make_env(**options)
        except InputError:
            options.pop(name)
    return options


def call_options(options: Any, folder: Path) -> None:
    """Make an environment of options."""
    if not isinstance(options, dict) or not all(isinstance(name, str) for name in options):
        return  # Python's own error: no keyword arguments
    env = make_env(**options)
    assert env.observation_space is not None
    env.close()


# --- states ------------------------------------------------------------------------------------


@cache
def environment(**options: Any) -> Any:
    """An environment, and its state after a few steps."""
    env = gym.make(ms_slam_env.ENV_IDS[1], **SMALL, **options).unwrapped
    env.reset(seed=0)
    for action in (0, 8, 16):
        env.step(action)
    return env, env.save_state()


def mutated_state(state: Any, rng: Rng) -> Any:
    """A state with some values changed; its arrays may be of any kind."""
    return mutated_tree(state, rng, (*PLAIN, np.zeros(3), np.eye(3), np.full((4, 4), np.nan)))


def call_state(options: dict[str, Any], state: Any, folder: Path) -> None:
    """Load a state; what is taken can be stepped from, what is refused changes nothing."""
    env, own = environment(**options)
    env.load_state(own)
    try:
        env.load_state(state)
    except InputError:
        mask = env.action_masks()
        env.load_state(own)
        assert (mask == env.action_masks()).all()
        raise
    for action in (0, 35):
        observation, reward, *_, info = env.step(action)
        assert is_finite(observation)
        assert np.isfinite(reward)
        assert np.isfinite(info["T_world_camera_estimate"]).all()
        assert np.isfinite(env.lookahead()).all()
    env.load_state(env.save_state())


# --- maps --------------------------------------------------------------------------------------


@cache
def saved_map(name: str) -> tuple[Any, dict[str, bytes]]:
    """The header of a map, and the arrays that it names."""
    system = backend(name)
    system.reset(np.eye(4))
    for frame in rendered()[:2]:
        system.track(RGBDFrame(*frame))
    with tempfile.TemporaryDirectory() as folder:
        system.save(Path(folder) / "map.npz")
        with zipfile.ZipFile(Path(folder) / "map.npz") as archive:
            members = {member: archive.read(member) for member in archive.namelist()}
    return json.loads(members.pop("tree.json")), members


def mutated_map(parts: Any, rng: Rng) -> Any:
    """Another header, or other bytes in an array."""
    header, members = parts
    if rng.random() < 0.7:
        return mutated_tree(header, rng), members
    member = list(members)[rng.integers(len(members))]
    return header, {**members, member: mutated_bytes(members[member], rng)}


def call_map(parts: Any, folder: Path) -> None:
    """Open a map; what is taken shows finite points and can be gone on in."""
    header, members = parts
    try:
        text = json.dumps(header)
    except (TypeError, ValueError):  # a value that no file can hold
        raise InputError("not JSON") from None
    with zipfile.ZipFile(folder / "map.npz", "w") as archive:
        for name, data in {"tree.json": text.encode(), **members}.items():
            archive.writestr(name, data)
    system = slam.open_map(folder / "map.npz")
    assert np.isfinite(system.surface_points()).all()
    frame = RGBDFrame(*rendered()[2])
    if system.intrinsics.shape == frame.depth.shape:
        assert np.isfinite(system.track(frame).T_world_camera).all()


def call_action(action: Any, folder: Path) -> None:
    """Step with anything."""
    env, own = environment()
    env.load_state(own)
    observation, *_ = env.step(action)
    assert is_finite(observation)


def mutated_value(value: Any, rng: Rng) -> Any:
    """Anything else."""
    return mutated_tree(value, rng, (*PLAIN, np.array(3), np.array([1, 2]), np.int8(3), "3"))


# --- frames ------------------------------------------------------------------------------------

STATES = ("odometry", "sparse")
"""Backends, besides the usual one, whose states are tried."""
MAKE: dict[str, dict[str, Any]] = {
    "surfel": {"max_surfels": 20_000},
    "odometry": {},
    "sparse": {},
    "volumetric": {"blocks": 1000},
    "kinectfusion": {},
}


@cache
def rendered() -> list[Any]:
    """Colour, depth and time of some frames: one to begin with, and few to be lost and found in."""
    frames = islice(open_sequence("table:0:none+handheld,frames=6", "80x60").frames, 4)
    return [[frame.color, frame.depth, frame.timestamp] for frame in frames]


@cache
def backend(name: str) -> slam.SlamBackend:
    """A backend for these frames."""
    sequence = open_sequence("table:0:none+handheld,frames=6", "80x60")
    return slam.make(name, sequence.intrinsics, **MAKE[name])


def mutated_frames(frames: Any, rng: Rng) -> Any:
    """Some frames hostile: what a sensor, a driver or a programmer may do."""
    frames = [list(frame) for frame in frames]
    for _ in range(rng.integers(1, 4)):
        frame = frames[rng.integers(len(frames))]
        color, depth = frame[0].copy(), np.array(frame[1])
        if depth.size == 0 or color.ndim != 3:
            continue
        rows, columns = np.arange(depth.shape[0]), np.arange(depth.shape[-1])
        match rng.integers(12):
            case 0:
                depth[rng.integers(len(rows))] = rng.choice([np.nan, np.inf, -1.0, 1e30, 1e-30])
            case 1:
                depth[...] = rng.choice([0.0, 1e-6, 1.0, 1e4, 3e38])
            case 2:
                color[...] = rng.choice([0, 255, 128])
            case 3:
                depth[...], color[...] = 0, 0
            case 4:
                depth[rows % 2 == 0] = 0
            case 5:
                color = rng.integers(0, 256, color.shape).astype(np.uint8)
            case 6:
                depth = rng.uniform(0.1, 9, depth.shape).astype(np.float32)
            case 7:
                half = len(columns) // 2  # the last axis of depth, whatever became of it before
                color, depth = color[:, :half], depth[..., :half]
            case 8:
                color, depth = color[::-1], depth[::-1]
            case 9:
                depth = np.where(rng.random(depth.shape) < 0.02, depth, 0).astype(np.float32)
            case 10:
                depth = ARRAYS[rng.integers(len(ARRAYS))](depth)
            case 11:
                color = ARRAYS[rng.integers(len(ARRAYS))](color)
        frame[:2] = color, depth
    return frames


def call_frames(name: str, frames: Any, folder: Path) -> None:
    """Track frames; some may be refused, poses and map stay finite, and SLAM can go on."""
    system = backend(name)
    system.reset(np.eye(4))
    refused: InputError | None = None
    for color, depth, time in frames:
        try:
            result = system.track(RGBDFrame(color, depth, time))
        except InputError as error:
            refused = error
            continue
        pose = result.T_world_camera
        assert np.isfinite(pose).all()
        assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-3
        assert result.covariance is None or np.isfinite(result.covariance).all()
    assert np.isfinite(system.surface_points()).all()
    if refused is not None:
        raise refused


# --- command lines -----------------------------------------------------------------------------

COMMANDS = (
    "evaluate s/groundtruth.txt s/groundtruth.txt --align se3 --delta 1 --segments 2 --out o",
    "run s --backend odometry --image-size 16x12 --params keyframe_m=0.3 --out o",
    "divergence s --image-size 16x12 --out o",
    "generate table:0:none+handheld,frames=2 --image-size 16x12 --out o",
    "compare --sequences s --backends odometry --image-size 16x12 --workers 1 --out o/nope/\0",
    "usme run --sequences nope --backends surfel --workers 1 --out o",
    "explore --sequences nope --trials 1 --objectives ate_m ext_ms --sampler tpe --out o",
    "benchmark --planners random,x=1 --scenes table --episodes 1 --steps 1 --workers 1 --out o",
    "train sb3 --timesteps 10 --nope 1 --seed 0 --out o",
    "report s --out o/report.html",
    "experiment env_speed --embodiments tripod --seconds 1 --out o",
)


def mutated_command(line: str, rng: Rng) -> str:
    """One command with a word changed, taken away, or more."""
    command, *words = COMMANDS[rng.integers(len(COMMANDS))].split(" ")
    for _ in range(rng.integers(1, 3)):
        k = int(rng.integers(len(words)))
        bad = [*NUMBERS, "$x^{", "\ud800", "../..", "s/rgb", "/dev/null", "-h", "--", "ü" * 300]
        new = bad[rng.integers(len(bad))]
        # The place of results is kept, so that nothing is written elsewhere.
        if words[k].startswith("o") or words[k - 1] == "--out" or words[k] == "--out":
            continue
        words[k : k + 1] = ([new], [], [words[k], new], [words[k] + new])[rng.integers(4)]
    return " ".join([command, *words])


def call_command(line: str, folder: Path) -> None:
    """A command ends with 0, 1 or 2, and in the end says why in one line."""
    write_files(file_entries.tum(), folder / "s")
    said, out = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stderr(said),
        contextlib.redirect_stdout(out),
    ):
        try:
            code = main(line.split(" "))
        except SystemExit as stop:  # after --help
            code = stop.code or 0
    assert code in (0, 1, 2), f"exit code {code}"
    if code:
        last = said.getvalue().strip().splitlines()[-1]
        assert "error: " in last, said.getvalue()
        raise InputError(last)


ENTRIES = [
    Entry("configuration", lambda: SLAM_YAML, mutated_text, call_configuration),
    Entry("option-texts", lambda: list(OPTION_TEXTS), mutated_texts, call_option_texts),
    Entry("sequence-names", lambda: list(NAMES), mutated_texts, call_names),
    Entry("env-options", cache(seed_options), mutated_tree, call_options, in_tests=10),
    *(
        Entry(
            f"env-state{name and '-'}{name}",
            lambda options=options: copy.copy(environment(**options)[1]),  # type: ignore[misc]
            mutated_state,
            partial(call_state, options),
            in_tests=15,
        )
        for name, options in {
            name: {"slam": name} if name else {} for name in ("", *STATES)
        }.items()
    ),
    *(
        Entry(f"map-{name}", partial(saved_map, name), mutated_map, call_map, in_tests=10)
        for name in ("surfel", "sparse")
    ),
    Entry("env-action", lambda: 0, mutated_value, call_action),
    *(
        Entry(f"frames-{name}", rendered, mutated_frames, partial(call_frames, name), in_tests=6)
        for name in MAKE
    ),
    Entry("command", lambda: COMMANDS[0], mutated_command, call_command),
]
