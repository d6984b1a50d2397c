"""Write trajectories and their errors as a Rerun recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env.errors import InputError

if TYPE_CHECKING:
    from ms_slam_env.evaluation.trajectory_files import Matched

_COLOURS = np.array(
    [(31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75)],
    dtype=np.uint8,
)
_TRUE_COLOUR = (120, 120, 120)


def write_paths(path: Path, runs: Mapping[str, Matched]) -> Path:
    """Write the aligned path of every run, the true path, and the errors over time.

    Entities: ``world/truth`` and, for each run, ``world/NAME/path``, ``world/NAME/camera`` at the
    times of its poses, and ``error/NAME`` in metres. The timeline ``time`` has the times of the
    files. View the file with `rerun FILE`.

    Raises:
        InputError: Rerun is not installed.
        OSError: the file cannot be written; the message names it.
    """
    try:
        import rerun as rr
    except ImportError:
        raise InputError("a recording needs Rerun: pip install 'ms-slam-env[view]'") from None
    stream = rr.RecordingStream("ms_slam_env")
    sink = rr.binary_stream(stream)
    longest = max(runs.values(), key=lambda run: len(run.true_path))
    strip = rr.LineStrips3D([longest.true_path], colors=[_TRUE_COLOUR], radii=0.006)
    stream.log("world/truth", strip, static=True)
    for number, (name, run) in enumerate(runs.items()):
        colour, entity = _COLOURS[number % len(_COLOURS)], name.replace("/", "_").replace(" ", "_")
        line = rr.LineStrips3D([run.estimate[:, :3, 3]], colors=[colour], radii=0.006)
        stream.log(f"world/{entity}/path", line, static=True)
        errors = np.linalg.norm(run.estimate[:, :3, 3] - run.truth[:, :3, 3], axis=1)
        times = rr.TimeColumn("time", duration=run.times - run.times[0])
        stream.send_columns(f"error/{entity}", [times], rr.Scalars.columns(scalars=errors))
        places = rr.Transform3D.columns(
            translation=run.estimate[:, :3, 3], mat3x3=run.estimate[:, :3, :3]
        )
        stream.send_columns(f"world/{entity}/camera", [times], places)
    write_bytes(path, sink.read() or b"")
    stream.disconnect()
    return path
