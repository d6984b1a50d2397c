"""``ms-slam generate``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import tyro

from ms_slam_env._runtime.command_line import parse
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.paths.handheld import HandheldPath


@dataclass(frozen=True)
class EpisodeOptions:
    """Options of a planner's episode; only with --planner."""

    steps: int = 100
    """Length of the episode."""
    step_m: float = 0.12
    """Translation of a motion."""
    step_deg: float = 12.0
    """Rotation of a motion."""
    env_id: str = "MSActiveSLAM-FreeCamera-v0"
    """Environment that the planner moves in."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in targets.M_I=0.05."""


@dataclass(frozen=True)
class Arguments:
    """Render an RGB-D sequence with true poses, in the TUM layout that ms-slam run reads.

    Repeat the same command to resume an interrupted run; until it is done the folder's name ends in
    .partial.
    """

    scene: str = "living_room"
    """Name of a scene, or a mesh file."""
    seed: int = 0
    """Seed of the scene, the path, the noise and the perturbations."""
    path: HandheldPath = field(default_factory=HandheldPath)
    """Seeded hand-held path; not used with --trajectory or --planner."""
    route: tuple[str, ...] = ()
    """Walk along these places of a street, hall or home instead, as in SW NW N, or hall kitchen;
    A-B is half-way."""
    trajectory: Path | None = None
    """Place this recorded camera motion (TUM file) into the scene instead."""
    scale: float | None = None
    """Scale of that motion; by default the largest up to 1 that fits."""
    planner: str | None = None
    """Render the motion of this planner's episode instead: NAME or module:Class, options appended
    as in greedy,rho_I=0.3."""
    episode: tyro.conf.OmitArgPrefixes[EpisodeOptions] = field(default_factory=EpisodeOptions)
    """Episode of the planner."""
    image_size: str = "320x240"
    """Size of the images."""
    noise: str = "kinect"
    """Noise of the sensor: kinect, range (up to 12 m, for streets and halls) or none."""
    perturbations: tuple[str, ...] = ()
    """NAME, options appended as in motion-blur,exposure_s=0.02,samples=8."""
    truth: bool = False
    """Also write true depth and object labels."""
    out: Path = Path("results/sequence")
    """Folder of the sequence."""


def main(arguments: Sequence[str]) -> int:
    """Render and write."""
    args = parse(Arguments, arguments, "ms-slam generate")
    if args.planner is not None and args.trajectory is not None:
        raise InputError("--planner and --trajectory exclude each other")
    if args.route and (args.planner is not None or args.trajectory is not None):
        raise InputError("--route excludes --planner and --trajectory")
    if args.scale is not None and args.trajectory is None:
        raise InputError("--scale needs --trajectory")
    if args.planner is None and args.episode != EpisodeOptions():
        raise InputError("the options of an episode need --planner")
    from ms_slam_env import __version__, scenes
    from ms_slam_env.camera import xtion
    from ms_slam_env.config import parse_named
    from ms_slam_env.sensor.noise import noise_config
    from ms_slam_env.sequences import make_perturbation, read_trajectory, render_sequence
    from ms_slam_env.sequences.writing import write_sequence

    named = [parse_named(text, "perturbation") for text in args.perturbations]
    perturbations = [make_perturbation(name, options) for name, options in named]
    intrinsics = xtion(args.image_size)
    noise = noise_config(args.noise)
    recorded = None if args.trajectory is None else read_trajectory(args.trajectory)
    scene = scenes.make(args.scene, args.seed)
    times, poses, placed = _motion(args, recorded, scene)
    sequence = render_sequence(
        scene,
        poses,
        intrinsics,
        noise,
        args.seed,
        args.out.name,
        perturbations=perturbations,
        timestamps=times,
    )
    strengths = [
        {"name": name, **vars(made)} for (name, _), made in zip(named, perturbations, strict=True)
    ]
    description = {
        "version": __version__,
        **{name: value for name, value in asdict(args).items() if name != "out"},
        "trajectory": None if args.trajectory is None else str(args.trajectory),
        "perturbations": strengths,
        **placed,
    }
    is_new = write_sequence(sequence, args.out, description, args.truth)
    print(f"{len(sequence)} frames in {args.out}" + ("" if is_new else ", written before"))
    return 0


def _motion(args: Arguments, recorded: Any, scene: Any) -> tuple[Any, Any, dict[str, Any]]:
    """Return times (N,), poses (N, 4, 4), and the description of a placed trajectory or episode."""
    if args.planner is not None:
        return _planned(args, args.planner)
    if args.route:
        from ms_slam_env.sequences import RoutePath

        return *RoutePath(args.route).motion(scene, args.seed), {}
    if recorded is None:
        return args.path.timestamps, args.path.poses(scene, args.seed), {}
    from ms_slam_env.sequences import place_trajectory

    times, poses = recorded
    placement = place_trajectory(scene, poses, args.seed, args.scale)
    print(f"{args.trajectory}: placed at scale {placement.scale:g}", file=sys.stderr)
    return times, placement.poses, {"placed_at_scale": placement.scale}


def _planned(args: Arguments, planner: str) -> tuple[Any, Any, dict[str, Any]]:
    """Return times, poses and description of a planner's episode."""
    from ms_slam_env.benchmark.episodes import (
        EpisodeSpec,
        parse_options,
        planned_motion,
    )

    return planned_motion(
        EpisodeSpec(
            planner,
            args.scene,
            args.seed,
            args.episode.env_id,
            args.episode.steps,
            args.episode.step_m,
            args.episode.step_deg,
            parse_options(args.episode.options),
        )
    )
