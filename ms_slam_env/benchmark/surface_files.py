"""Points of a surface from a file or a sequence: clouds as they are, meshes sampled, depth back-
projected from the true poses."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.seen_surface import seen_surface
from ms_slam_env.sequences.recording import Recording, open_recording, recorded_sequence

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceFile:
    """What a file holds.

    Attributes:
        points: (N, 3) metres.
        kind: ``cloud``, ``mesh``, ``true depth`` or ``recorded depth``.
    """

    points: Float64
    kind: str


def read_surface(path: Path, samples: int, seed: int = 0) -> SurfaceFile:
    """Read a cloud or a mesh (PLY, or what else trimesh reads).

    Args:
        path: of the file; or of a sequence's folder, for the surface that its depth images show
            from its true poses, up to 3 m away. Those of ``depth_true`` are taken if
            ``ms-slam generate --truth`` wrote them, else the recorded ones with their noise.
        samples: points taken evenly from the surface of a mesh.
        seed: of that choice.

    Raises:
        InputError: no such file, one that cannot be read, no points in it, or points that are not
            finite.
    """
    import trimesh

    if path.is_dir():
        return _sequence_surface(open_recording(path), path / "depth_true")
    if not path.is_file():
        raise InputError(f"map file {str(path)!r} does not exist")
    try:
        loaded = trimesh.load(path, process=False)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_geometry()
    except Exception as error:  # trimesh raises whatever its many readers raise
        raise InputError(f"map file {str(path)!r} cannot be read: {error}") from None
    vertices = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64)
    if vertices.ndim != 2 or len(vertices) == 0:
        raise InputError(f"map file {str(path)!r} holds no points")
    if not np.isfinite(vertices).all():
        raise InputError(f"map file {str(path)!r} holds points that are not finite")
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        return SurfaceFile(vertices, "cloud")
    if not loaded.area > 0:
        raise InputError(f"map file {str(path)!r} holds a mesh without area")
    points, _ = trimesh.sample.sample_surface(loaded, samples, seed=seed)
    return SurfaceFile(np.asarray(points, dtype=np.float64), "mesh")


def _sequence_surface(recording: Recording, true_depth: Path) -> SurfaceFile:
    """What the frames of a sequence with a true trajectory saw."""
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
