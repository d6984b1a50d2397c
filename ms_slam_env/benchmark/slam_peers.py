"""Our SLAM beside Open3D's and OpenCV's, on the same rendered noisy sequences.

``python -m ms_slam_env.benchmark.slam_peers --out DIR`` writes ``slam_peers.json`` and
``slam_peers.md``. All run in this process, one after the other, on the same number of cores.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ms_slam_env import scenes, slam
from ms_slam_env.benchmark.slam_peers_open3d import Open3DSlam
from ms_slam_env.benchmark.slam_peers_opencv import OpenCVOdometry
from ms_slam_env.benchmark.slam_peers_report import markdown_report
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError
from ms_slam_env.metrics import ate_rmse, path_length
from ms_slam_env.parallel import limit_threads
from ms_slam_env.report.provenance import provenance
from ms_slam_env.scenes import Scene
from ms_slam_env.sequences import (
    Sequence,
    handheld_trajectory,
    render_sequence,
    repeated_trajectory,
)

Float64 = NDArray[np.float64]

PROGRAM = "python -m ms_slam_env.benchmark.slam_peers"
_WARM_UP = 5  # frames left out of the timing: buffers grow, caches fill
DEFAULT_SEQUENCES = (
    "living_room:2000",
    "living_room:2001",
    "table:2000",
    "window:2000",
    "corridor:2000",
    "carpet:2000",
    "wall:2000",
)


@dataclass(frozen=True)
class SlamPeersConfig:
    """Our SLAM beside Open3D's and OpenCV's, on the same rendered noisy sequences.

    Attributes:
        out: folder for the results.
        sequences: ``scene:seed`` each; the trajectory has the scene's seed.
        sizes: image sizes.
        frames: length of each sequence.
        threads: cores that every system may use.
        backend: our SLAM.
        noise: of the sensor.
        speed_m: largest translation from frame to frame.
        rot_deg: largest rotation from frame to frame.
        growth_frames: length of one pass of the repeated path; 0 leaves this test out.

    Raises:
        InputError: a value out of range.
    """

    out: Path
    sequences: tuple[str, ...] = DEFAULT_SEQUENCES
    sizes: tuple[str, ...] = ("160x120", "320x240")
    frames: int = 220
    threads: int = 1
    backend: str = "surfel"
    noise: str = "kinect"
    speed_m: float = 0.015
    rot_deg: float = 1.0
    growth_frames: int = 200

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "frames", 10, 100_000)
        check_range(self, "threads", 1, 1024)
        check_range(self, "growth_frames", 0, 100_000)


class Peer(Protocol):
    """What the comparison asks of a system."""

    name: str
    settings: str

    def reset(self, T_world_camera: Float64) -> None:
        """Start at a pose (4, 4)."""

    def track(self, frame: RGBDFrame) -> Float64:
        """Estimated T_world_camera (4, 4) of a frame."""


class OurSlam:
    """A SLAM backend of this package with its default parameters."""

    def __init__(self, backend: str, intrinsics: Intrinsics) -> None:
        """Make the backend."""
        self.name = backend
        self.slam = slam.make(backend, intrinsics)
        self.settings = f"ms_slam_env {backend}, default parameters"
        self.lost_frames = 0

    def reset(self, T_world_camera: Float64) -> None:
        """Start at a pose (4, 4)."""
        self.slam.reset(T_world_camera)
        self.lost_frames = 0

    def track(self, frame: RGBDFrame) -> Float64:
        """Estimated T_world_camera (4, 4) of a frame."""
        result = self.slam.track(frame)
        self.lost_frames += not result.tracking_ok
        return result.T_world_camera

    def surfels(self) -> int:
        """Number of points in the map."""
        return len(self.slam.surface_points())


@dataclass(frozen=True)
class PeerResult:
    """How one system did on one sequence; errors in metres, time in milliseconds.

    Processor time is what the table shows: on a shared machine wall time measures the neighbours.
    """

    system: str
    sequence: str
    size: str
    ate_rmse_m: float  # no alignment: all start at the true pose
    ate_rmse_aligned_m: float  # after the best rigid motion
    frame_cpu_ms: float  # median processor time of all threads
    frame_ms: float  # median wall time
    path_m: float
    surfels: int | None = None
    lost_frames: int | None = None


@dataclass
class PeersReport:
    """Everything the comparison found."""

    provenance: dict[str, Any]
    config: dict[str, Any]
    settings: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    results: list[PeerResult] = field(default_factory=list)
    growth: list[dict[str, Any]] = field(default_factory=list)


def run_peer(peer: Peer, sequence: Sequence, size: str) -> PeerResult:
    """Track a sequence from its true first pose."""
    peer.reset(sequence.poses[0])
    estimates, times, processor_times = [], [], []
    for frame in sequence.frames:
        start, processor_start = time.perf_counter(), time.process_time()
        estimates.append(np.array(peer.track(frame)))
        processor_times.append(time.process_time() - processor_start)
        times.append(time.perf_counter() - start)
    ours = peer if isinstance(peer, OurSlam) else None
    return PeerResult(
        system=peer.name,
        sequence=sequence.name,
        size=size,
        ate_rmse_m=ate_rmse(estimates, sequence.poses, align="none"),
        ate_rmse_aligned_m=ate_rmse(estimates, sequence.poses),
        frame_cpu_ms=float(np.median(processor_times[_WARM_UP:]) * 1e3),
        frame_ms=float(np.median(times[_WARM_UP:]) * 1e3),
        path_m=path_length(sequence.poses),
        surfels=ours.surfels() if ours else None,
        lost_frames=ours.lost_frames if ours else None,
    )


def map_growth(ours: OurSlam, sequence: Sequence, frames: int) -> dict[str, Any]:
    """Surfels after each pass of a repeated path, and the growth over the last pass."""
    ours.reset(sequence.poses[0])
    counts = []
    for index, frame in enumerate(sequence.frames, start=1):
        ours.track(frame)
        if index % frames == 0:
            counts.append(ours.surfels())
    return {
        "sequence": sequence.name,
        "surfels_after_pass": counts,
        "growth": counts[-1] / max(counts[-2], 1) - 1.0,
        "lost_frames": ours.lost_frames,
    }


def parse_sequence(text: str) -> tuple[str, int]:
    """Scene and seed of ``scene:seed``.

    Raises:
        InputError: another form.
    """
    scene, colon, seed = text.partition(":")
    if not colon or not seed.isdigit():
        raise InputError(f"a sequence is given as scene:seed, such as table:2000, got {text!r}")
    return scene, int(seed)


def available_peers(
    backend: str, intrinsics: Intrinsics, missing: dict[str, str]
) -> list[OurSlam | OpenCVOdometry | Open3DSlam]:
    """All systems that can run here; why another cannot is put into ``missing``."""
    makers: dict[str, Callable[[], OurSlam | OpenCVOdometry | Open3DSlam]] = {
        backend: lambda: OurSlam(backend, intrinsics),
        "opencv": lambda: OpenCVOdometry(intrinsics),
        "open3d": lambda: Open3DSlam(intrinsics),
    }
    peers = []
    for name, make in makers.items():
        try:
            peers.append(make())
        except (ImportError, OSError) as error:
            if name not in missing:
                print(f"{name} steps aside: {error}", file=sys.stderr)
            missing[name] = str(error)
    return peers


def run(config: SlamPeersConfig) -> PeersReport:
    """Run every system on every sequence, writing the report anew after each scene.

    Raises:
        InputError: unknown scene, size, noise or backend.
    """
    limit_threads(config.threads)
    report = PeersReport(provenance(), {k: str(v) for k, v in asdict(config).items()})
    for text in tqdm(config.sequences, desc="sequences", file=sys.stderr):
        scene_name, seed = parse_sequence(text)
        scene = scenes.make(scene_name, seed)
        for size in config.sizes:
            _compare(config, report, scene, seed, text, size)
        if config.growth_frames:
            report.growth.append(_grow(config, scene, seed, text))
        write_report(report, config.out)
    return report


def _compare(
    config: SlamPeersConfig, report: PeersReport, scene: Scene, seed: int, name: str, size: str
) -> None:
    """Run every system on one sequence."""
    intrinsics = xtion(size)
    poses = handheld_trajectory(scene, config.frames, seed, config.speed_m, config.rot_deg)
    sequence = render_sequence(scene, poses, intrinsics, config.noise, seed, name)
    for peer in available_peers(config.backend, intrinsics, report.missing):
        report.settings[peer.name] = peer.settings
        report.results.append(run_peer(peer, sequence, size))


def _grow(config: SlamPeersConfig, scene: Scene, seed: int, name: str) -> dict[str, Any]:
    """Map growth of our SLAM in one scene, at the first size."""
    intrinsics = xtion(config.sizes[0])
    poses = repeated_trajectory(
        scene, config.growth_frames, seed, 2, config.speed_m, config.rot_deg
    )
    sequence = render_sequence(scene, poses, intrinsics, config.noise, seed, name)
    return map_growth(OurSlam(config.backend, intrinsics), sequence, config.growth_frames)


def write_report(report: PeersReport, out: Path) -> None:
    """Write ``slam_peers.json`` and ``slam_peers.md`` into ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    data = asdict(report)
    (out / "slam_peers.json").write_text(json.dumps(data, indent=1), encoding="utf-8")
    (out / "slam_peers.md").write_text(markdown_report(data), encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Run the comparison and print its tables; return the exit code."""
    config = parse(SlamPeersConfig, arguments, PROGRAM)
    run(config)
    print((config.out / "slam_peers.md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
