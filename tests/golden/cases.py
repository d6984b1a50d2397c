"""What must not change: SLAM backends and environments on fixed inputs, as arrays by name.

A case is a function without arguments that returns a flat mapping from name to array; ``CASES`` has
them all. They use only what users use: ``gymnasium.make``, ``ms_slam_env.slam.make`` and the
functions that render a sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from typing import Any

import gymnasium
import numpy as np

from ms_slam_env import ENV_IDS, PERTURBED_ENV_IDS, scenes, slam
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.geometry import invert, look_at, make_pose, se3_exp
from ms_slam_env.sequences import HandheldPath, render_sequence
from ms_slam_env.slam import adaptation, frame_selection

Arrays = dict[str, np.ndarray]
Frames = tuple[list[RGBDFrame], np.ndarray]  # and their true poses (N, 4, 4)

CAMERA: Intrinsics = xtion("160x120")
SCENE, SCENE_SEED = "living_room", 1

# -- Sequences ---------------------------------------------------------------------------------

FRAMES = 30
BLANK = slice(20, 23)  # frames without light or depth
BACK = 3  # the frame from whose place the occluded sequence goes on

TURN = 60  # frames for a whole turn
GIVEN = 48  # of them fused at their drifted poses; the rest is tracked
DRIFT = np.array([0.02, -0.01, 0.02, *np.radians([0.5, 1.8, -0.7])])  # 3 cm, 2 degrees


@cache
def handheld() -> Frames:
    """A camera carried through a room."""
    scene = scenes.make(SCENE, SCENE_SEED)
    poses = HandheldPath(frames=FRAMES).poses(scene, seed=3)
    return list(render_sequence(scene, poses, CAMERA, seed=3).frames), poses


@cache
def occluded() -> Frames:
    """A camera turns, 6 degrees a frame; its lens is covered, then it is back at the start."""
    poses = turning(BLANK.stop)
    poses = np.concatenate([poses, poses[BACK:][: FRAMES - BLANK.stop]])
    scene = scenes.make(SCENE, SCENE_SEED)
    frames = list(render_sequence(scene, poses, CAMERA, seed=4).frames)
    for index in range(BLANK.start, BLANK.stop):
        nothing = np.zeros_like(frames[index].color), np.zeros_like(frames[index].depth)
        frames[index] = replace(frames[index], color=nothing[0], depth=nothing[1])
    return frames, poses


@cache
def turn() -> Frames:
    """A camera that turns once in a room and a little on, without noise."""
    poses = turning(TURN + 6)
    scene = scenes.make(SCENE, SCENE_SEED)
    return list(render_sequence(scene, poses, CAMERA, noise="none").frames), poses


def turning(frames: int) -> np.ndarray:
    """Poses (frames, 4, 4) around a point with room about it."""
    scene = scenes.make(SCENE, SCENE_SEED)
    rng = np.random.default_rng(0)
    starts = np.stack([scene.sample_start(rng)[:3, 3] for _ in range(32)])
    centre = starts[scene.clearance(starts).argmax()]
    angles = 2 * np.pi * np.arange(frames) / TURN
    gaze = np.stack([np.cos(angles), np.sin(angles), -0.2 + 0 * angles], axis=1)
    eyes = centre + 0.2 * gaze
    return np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, gaze, strict=True)])


def drifted(poses: np.ndarray) -> np.ndarray:
    """Poses whose error grows evenly to DRIFT about the middle of the turn, and stays."""
    middle = make_pose(np.eye(3), poses[:, :3, 3].mean(axis=0))
    shares = np.minimum(np.arange(len(poses)) / GIVEN, 1.0)
    errors = [middle @ se3_exp(DRIFT * share) @ invert(middle) for share in shares]
    return np.stack(errors) @ poses


# -- SLAM --------------------------------------------------------------------------------------


def surfel(**params: Any) -> slam.SlamBackend:
    return slam.make("surfel", CAMERA, max_surfels=300_000, **params)


def selecting() -> slam.SlamBackend:
    """Behind a selection of frames that keeps a budget."""
    return frame_selection.make_config("budget", share=0.6).manage(surfel())


def adapting() -> slam.SlamBackend:
    """With run-time adaptation."""
    fast = {"slam_config": {"iterations": [2, 2, 2], "points_per_level": 1000}}
    options = {"configurations": [fast, {}], "thresholds": [0.06], "dwell_frames": 3}
    return adaptation.make_config("divergence", **options).adapt(surfel())


BACKENDS: dict[str, Callable[[], slam.SlamBackend]] = {
    "surfel": surfel,
    "surfel-local": partial(surfel, relocalisation="local"),
    "surfel-deformation": partial(surfel, loop_closure="deformation"),
    "surfel-fuses-all": partial(surfel, refuse_bad_fits=False),
    "surfel-budget": selecting,
    "surfel-divergence": adapting,
    "sparse": partial(slam.make, "sparse", CAMERA),
    "odometry": partial(slam.make, "odometry", CAMERA),
    "volumetric": partial(slam.make, "volumetric", CAMERA),
}


def run_backend(make: Callable[[], slam.SlamBackend], sequence: Callable[[], Frames]) -> Arrays:
    """Track a sequence from its true start."""
    frames, poses = sequence()
    backend = make()
    backend.reset(poses[0])
    return track_all(backend, frames)


def close_loop(**loops: Any) -> Arrays:
    """Build a map with drift, then track on until the loop is closed."""
    frames, poses = turn()
    backend = surfel(loop_closure="deformation", loops={"window": 20, "interval": 2, **loops})
    backend.reset(poses[0])
    for frame, pose in zip(frames[:GIVEN], drifted(poses), strict=False):
        backend.fuse(frame, pose)
    return track_all(backend, frames[GIVEN:])


def track_all(backend: slam.SlamBackend, frames: list[RGBDFrame]) -> Arrays:
    """Poses and statistics of each frame, then the map."""
    results, sizes = [], []
    for frame in frames:
        results.append(backend.track(frame))
        sizes.append(len(backend.map_points()))
    names = ("tracking_ok", "relocalised", "loop_closed", "processed", "degenerate_directions")
    numbers = ("T_world_camera", "inlier_fraction", "residual_m")
    every = {name: np.array([getattr(r, name) for r in results]) for name in (*names, *numbers)}
    nan = np.full((6, 6), np.nan)
    sigmas = [np.sqrt(np.diag(nan if r.covariance is None else r.covariance)) for r in results]
    indices, corrected = backend.corrected_trajectory()
    view = backend.predict(results[-1].T_world_camera[None], 0.5)
    surface, colors = backend.surface_points(), backend.surface_colors()
    return {
        **every,
        "lost_frames": np.array(len(frames) - every["tracking_ok"].sum()),
        "sigmas": np.stack(sigmas),
        "map_size": np.array(sizes),
        "surface_count": np.array(len(surface)),
        "surface_mean": surface.mean(axis=0),
        "surface_sum": surface.sum(axis=0),
        "color_mean": colors.mean(axis=0),
        "corrected_frames": indices,
        "corrected_poses": corrected,
        "predicted_intensity": view.intensity,
        "predicted_depth": view.depth,
        "predicted_normals": view.normals,
    }


# -- Environments ------------------------------------------------------------------------------

# Small steps: a camera that gets lost makes all that follows hang on the last bits.
OPTIONS: dict[str, Any] = {
    "scene": SCENE,
    "scene_seed": SCENE_SEED,
    "image_size": "80x60",
    "step_m": 0.04,
    "step_rad": 0.06,
}


def run_environment(env_id: str, steps: int, **options: Any) -> Arrays:
    """Observations, rewards and infos of a reset and of steps, and the lookahead at the end."""
    env = gymnasium.make(env_id, **{**OPTIONS, **options})
    rng = np.random.default_rng(5)
    observation, info = env.reset(seed=7)
    records = [flat({"observation": observation, "info": info})]
    for _ in range(steps):
        records.append(step(env, rng))
    return {**stacked(records), "lookahead": env.unwrapped.lookahead()}


def round_trip(env_id: str) -> Arrays:
    """Steps, and the same steps again from a saved state, in another environment."""
    env, other = (gymnasium.make(env_id, **OPTIONS) for _ in range(2))
    rng = np.random.default_rng(6)
    env.reset(seed=8)
    for _ in range(3):
        step(env, rng)
    state = env.unwrapped.save_state()
    first = stacked([step(env, np.random.default_rng(k)) for k in range(4)])
    other.reset(seed=9)
    other.unwrapped.load_state(state)
    again = stacked([step(other, np.random.default_rng(k)) for k in range(4)])
    return {
        **{f"first/{name}": array for name, array in first.items()},
        **{f"again/{name}": array for name, array in again.items()},
    }


def drawn_scenes() -> Arrays:
    """Scenes and starts as resets draw them."""
    options = {**OPTIONS, "scene": ("living_room", "table"), "scene_seed": None}
    options["num_scene_seeds"] = 1
    env = gymnasium.make("MSActiveSLAM-FreeCamera-v0", **options)
    resets = [env.reset(seed=seed) for seed in range(4)]
    return stacked([flat({"observation": seen, "info": info}) for seen, info in resets])


def step(env: gymnasium.Env[Any, Any], rng: np.random.Generator) -> Arrays:
    """One step with an action drawn among those that are possible."""
    mask = env.unwrapped.action_masks()  # type: ignore[attr-defined]
    space = env.action_space
    if isinstance(space, gymnasium.spaces.MultiDiscrete):
        parts = np.split(mask, np.cumsum(space.nvec)[:-1])
        action = np.array([rng.choice(np.flatnonzero(part)) for part in parts])
    else:
        action = rng.choice(np.flatnonzero(mask))
    observation, reward, terminated, truncated, info = env.step(action)
    said = {"reward": reward, "terminated": terminated, "truncated": truncated}
    return flat({"observation": observation, "info": info, "action": action, **said})


def flat(values: Mapping[str, Any], prefix: str = "") -> Arrays:
    """Numbers of nested mappings as arrays, by names joined with dots."""
    found: Arrays = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            found.update(flat(value, f"{prefix}{name}."))
        elif not isinstance(value, str):
            found[prefix + name] = np.asarray(value)
    return found


def stacked(records: list[Arrays]) -> Arrays:
    """Arrays over the records; one that the first records lack starts later."""
    names = dict.fromkeys(name for record in records for name in record)
    return {name: np.stack([r[name] for r in records if name in r]) for name in names}


# -- All of them -------------------------------------------------------------------------------

STEPS, PERTURBED_STEPS, VARIANT_STEPS = 50, 8, 8
FREE, ARM = "MSActiveSLAM-FreeCamera-v0", "MSActiveSLAM-v0"


def _slam_cases() -> Iterator[tuple[str, Callable[[], Arrays]]]:
    for backend, make in BACKENDS.items():
        for sequence in (handheld, occluded):
            name = f"slam/{backend}/{sequence.__name__}"
            yield name, partial(run_backend, make, sequence)
    yield "slam/surfel-deformation/turn", close_loop
    keyframes = {"largest_m": 0.001, "global_interval": 2}  # nothing is near enough but keyframes
    yield "slam/surfel-deformation/turn-keyframes", partial(close_loop, **keyframes)


def _env_cases() -> Iterator[tuple[str, Callable[[], Arrays]]]:
    for env_id in ENV_IDS:
        yield f"env/{env_id}", partial(run_environment, env_id, STEPS)
    for env_id in PERTURBED_ENV_IDS:
        yield f"env/{env_id}", partial(run_environment, env_id, PERTURBED_STEPS)
    for kind in ("rgbd", "lookahead"):
        yield f"env/observation-{kind}", partial(_variant, FREE, observation=kind)
    for pose in ("slam-kinematics", "kinematics", "ground_truth"):
        yield f"env/pose-{pose}", partial(_variant, ARM, pose=pose)
    yield "env/reference-live", partial(_variant, FREE, lookahead={"reference": "live"})
    yield "env/arm-kinematic", partial(_variant, ARM, embodiment="arm-kinematic")
    for backend in ("sparse", "odometry"):
        yield f"env/slam-{backend}", partial(_variant, FREE, slam=backend)
    for env_id in (ARM, FREE):
        yield f"env/round-trip-{env_id}", partial(round_trip, env_id)
    yield "env/drawn-scenes", drawn_scenes


def _variant(env_id: str, **options: Any) -> Arrays:
    return run_environment(env_id, VARIANT_STEPS, **options)


CASES: dict[str, Callable[[], Arrays]] = dict([*_slam_cases(), *_env_cases()])
"""Name to case."""


def why_not(name: str) -> str:
    """Why a case cannot be run on this machine; empty if it can."""
    for part, library in {"volumetric": "open3d", "sparse": "gtsam"}.items():
        if part in name:
            try:
                import_module(library)
            except ImportError as error:  # it may be installed and lack a system library
                return f"needs {library}: {error}"
    return ""
