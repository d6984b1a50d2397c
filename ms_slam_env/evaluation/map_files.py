"""Compare two map files: a reconstruction and the true surface.

Clouds are used unchanged, meshes are sampled, and the depth images of a sequence are placed by its
true poses.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env import metrics
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_quality import ComparedMap, share_keys
from ms_slam_env.evaluation.seen_surface import seen_surface
from ms_slam_env.geometry import MAX_COORDINATE_M, transform_points
from ms_slam_env.geometry.cloud_registration import CUTOFF_M, REGISTRATIONS
from ms_slam_env.geometry.point_clouds import ASKEW
from ms_slam_env.metrics.reconstruction import NOISE_SIGMA_M, SAMPLES
from ms_slam_env.scenes.mesh_formats import MESH_SUFFIXES, MeshFile
from ms_slam_env.sequences.recording import Recording, open_recording, recorded_sequence

MEASURES = (
    *("accuracy_cm", "completion_cm", "completion_ratio", "rer_m", "rcm"),
    *("c2c_mean_m", "c2c_std_m", "c2c_rms_m", "hausdorff_directed_m", "hausdorff_m"),
)


@dataclass(frozen=True)
class MapOptions(Checked):
    """How two maps are compared.

    Attributes:
        register: how to register the map to the truth first: ``none``, ``icp``, ``plane-icp`` or
            ``gicp``.
        cutoff_m: ignore pairs of points farther apart than this in the registration.
        remove_outliers: remove statistical outliers before everything else, as USME does.
        neighbours: number of neighbours for the outlier statistics.
        std_ratio: standard deviations from the mean beyond which a point is an outlier.
        two_sided: whether points whose neighbours are unusually close are outliers, too.
        noise_sigma_m: standard deviation of the sensor's depth, which decides from which distance
            on a point counts as noise, see `noise_distance`.
        thresholds_m: thresholds of precision, recall and F-score.
        voxel_m: keep one point per voxel of this side in both clouds, so that each surface counts
            by its area; 0 keeps all. The samples of a true mesh are uniform by area and all kept.
        samples: number of points sampled from a mesh.
        seed: seed of the sampling.
    """

    register: str = chosen("none", *REGISTRATIONS)
    cutoff_m: float = bounded(CUTOFF_M, 1e-6, 1e6)
    remove_outliers: bool = False
    neighbours: int = bounded(20, 2, 10_000)
    std_ratio: float = bounded(2.0, 1e-6, 1e6)
    two_sided: bool = False
    noise_sigma_m: float = bounded(NOISE_SIGMA_M, 0.0, 1e3)
    thresholds_m: Sequence[float] = (0.02, 0.05)
    voxel_m: float = bounded(0.01, 0.0, 1e3)
    samples: int = bounded(SAMPLES, 1, 100_000_000)
    seed: int = bounded(0, 0, 2**32 - 1)

    def __post_init__(self) -> None:
        """Refuse invalid options."""
        super().__post_init__()
        if len(self.thresholds_m) == 0:
            raise InputError("MapOptions.thresholds_m is empty")
        for threshold in self.thresholds_m:
            if not 0 < threshold <= 1e6:
                raise InputError(f"MapOptions.thresholds_m = {threshold} is outside (0, 1e+06]")


def evaluate_maps(
    estimate: Path, truth: Path, options: MapOptions | None = None
) -> tuple[dict[str, Any], ComparedMap]:
    """Compare the map in file ``estimate`` with the true surface in file ``truth``.

    Returns:
        The measures by registry key, and the compared clouds. ``rer_m`` is computed after
        point-to-point ICP unless another registration was chosen.

    Raises:
        InputError: a file that cannot be read, too few points for the outlier statistics.
    """
    options = options or MapOptions()
    read = read_surface(estimate, options.samples, options.seed)
    true = read_surface(truth, options.samples, options.seed)
    inliers = metrics.statistical_inliers(
        read.points, options.neighbours, options.std_ratio, options.two_sided
    )
    kept = read.points[inliers] if options.remove_outliers else read.points
    if len(kept) == 0:
        raise InputError(f"statistical outlier removal leaves nothing of {estimate}")
    points = _thin(kept, options.voxel_m)
    surface = true.points if true.kind == "mesh" else _thin(true.points, options.voxel_m)
    found = metrics.register_clouds(points, surface, options.register, options.cutoff_m)
    points = transform_points(found.T_target_source, points)
    every = points
    if options.remove_outliers:
        every = transform_points(found.T_target_source, _thin(read.points, options.voxel_m))
    unregistered = options.register == "none"
    compared = ComparedMap(points, surface, voxel_m=0, registered=not unregistered)
    result = {
        "map_kind": read.kind,
        "true_map_kind": true.kind,
        "map_points": len(read.points),
        "true_points": len(true.points),
        "compared_points": len(points),
        "compared_true_points": len(surface),
        "noise_ratio": metrics.noise_ratio(every, compared.surface, options.noise_sigma_m),
        "noise_beyond_m": metrics.noise_distance(compared.surface, options.noise_sigma_m),
        "outlier_share": 1.0 - float(inliers.mean()),
        "spacing_m": metrics.point_spacing(read.points),
        **compared.measure((*share_keys(options.thresholds_m), *MEASURES)),
        "registration_converged": None if unregistered else found.converged,
        "registration_share": None if unregistered else found.share,
        "T_true_map": found.T_target_source.tolist(),
    }
    return result, compared


def _thin(points: Float64, voxel_m: float) -> Float64:
    return metrics.voxel_downsample(points, voxel_m, ASKEW) if voxel_m > 0 else points


@dataclass(frozen=True)
class SurfaceFile:
    """Surface points read from a file.

    Attributes:
        points: (N, 3) metres.
        kind: ``cloud``, ``mesh``, ``true depth`` or ``recorded depth``.
    """

    points: Float64
    kind: str


def read_surface(path: Path, samples: int, seed: int = 0) -> SurfaceFile:
    """Read a cloud, a mesh, or the surface seen by a sequence.

    Args:
        path: file in one of the scene formats, with their options (see ``MeshOptions``); or folder
            of a sequence, for the surface that its depth images show from the true poses, up to
            5 m away. Images in ``depth_true`` are used if ``ms-slam generate --truth`` wrote them,
            otherwise the recorded ones with their noise.
        samples: number of points sampled evenly from the surface of a mesh.
        seed: seed of the sampling.

    Raises:
        InputError: no such file, one that cannot be read, no points in it, or points that are not
            finite.
    """
    import trimesh

    if os.path.isdir(path):
        return _sequence_surface(open_recording(path), path / "depth_true")
    file = MeshFile.named(path)
    if file is None:
        raise InputError(
            f"map file {str(path)!r} is neither a folder nor in a supported format: "
            + ", ".join(MESH_SUFFIXES)
        )
    parts = file.read()
    clouds = list({id(part.vertices): part.vertices for part in parts}.values())
    vertices = np.concatenate([np.empty((0, 3)), *clouds])
    if len(vertices) == 0:
        raise InputError(f"map file {str(path)!r} holds no points")
    if not (np.abs(vertices) <= MAX_COORDINATE_M).all():
        raise InputError(
            f"map file {str(path)!r} holds points that are not finite or beyond "
            f"{MAX_COORDINATE_M:g} m"
        )
    corners = np.concatenate([part.vertices[part.faces] for part in parts])  # (F, 3, 3)
    if len(corners) == 0:
        return SurfaceFile(vertices, "cloud")
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False)
    if not mesh.area > 0:
        raise InputError(f"map file {str(path)!r} holds a mesh without area")
    points, _ = trimesh.sample.sample_surface(mesh, samples, seed=seed)
    return SurfaceFile(np.asarray(points, dtype=np.float64), "mesh")


def _sequence_surface(recording: Recording, true_depth: Path) -> SurfaceFile:
    """Surface that the frames of a sequence with a true trajectory saw."""
    if recording.truth is None or recording.truth_times is None:
        raise InputError(f"sequence {recording.name} has no true trajectory to place its depth by")
    kind = "recorded depth"
    if true_depth.is_dir():
        kind = "true depth"
        entries = tuple(
            dataclasses.replace(entry, depth=true_depth / entry.depth.name)
            for entry in recording.entries
        )
        recording = dataclasses.replace(recording, entries=entries)
    sequence = recorded_sequence(recording)
    if not sequence.known.any():
        raise InputError(f"sequence {recording.name}: no frame has a true pose")
    placed = sequence.picked(np.flatnonzero(sequence.known))
    return SurfaceFile(seen_surface(placed), kind)
