"""Write episodes as a LeRobotDataset v3.0 (Parquet, JSON and PNG), without the LeRobot library.

LeRobot needs other versions of PyTorch, OpenCV and Rerun than this package; the files need only
``pyarrow`` and ``pandas``. A row is a step: the observation before the action, the action, and its
outcome (``next.*``). The observation after the last action has no row.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.report.records import write_json

VERSION = "v3.0"
INFO = "meta/info.json"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"
_FILES_A_CHUNK = 1000
_FILE_MB = 100
_COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Steps:
    """Data of an episode of N steps.

    Attributes:
        observations: name to (N + 1, ...); ``""`` names an observation without parts.
        infos: name to (N + 1, ...).
        actions: (N,) or (N, numbers).
        rewards: (N,).
        terminated: (N,) bool.
        truncated: (N,) bool.
    """

    observations: Mapping[str, NDArray[Any]]
    infos: Mapping[str, NDArray[Any]]
    actions: NDArray[Any]
    rewards: NDArray[Any]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]

    def columns(self) -> Columns:
        """Columns by LeRobot's names: images (N, H, W, 3) uint8, all others (N, k)."""
        last = slice(None, -1)
        images = {f"observation.images.{k}": v[last] for k, v in self.observations.items()
                  if v.shape[3:] == (3,)}  # fmt: skip
        seen = {f"observation.{k or 'state'}": v[last] for k, v in self.observations.items()
                if v.shape[3:] != (3,)}  # fmt: skip
        known = {f"info.{k}": v[last] for k, v in self.infos.items()}
        after = {
            "next.reward": np.asarray(self.rewards, np.float32),
            "next.done": np.asarray(self.terminated) | np.asarray(self.truncated),
            "next.truncated": np.asarray(self.truncated),
        }
        actions = np.asarray(self.actions)
        if actions.dtype.kind != "f":
            actions = actions.astype(np.int64)
        rows = {**seen, "action": actions, **after, **known}
        return images | {name: value.reshape(len(value), -1) for name, value in rows.items()}


class DatasetWriter:
    """Writes episodes into a folder, one after another.

    Args:
        folder: of the dataset; it is created.
        task: description of the task in words.
        fps: steps per second, from which timestamps follow.
        robot: name of the camera's carrier.
    """

    def __init__(self, folder: Path, task: str, fps: int, robot: str) -> None:
        self.folder, self.task, self.fps, self.robot = folder, task, fps, robot
        self.features: dict[str, dict[str, Any]] = {}
        self.episodes: list[dict[str, Any]] = []
        self.writer: Any = None
        self.file = 0
        self.frames = 0

    def add(self, steps: Steps) -> None:
        """Write an episode."""
        columns = steps.columns()
        count, number = len(columns["action"]), len(self.episodes)
        ticks = np.arange(count, dtype=np.int64)
        seconds: NDArray[Any] = (ticks / self.fps).astype(np.float32)
        counters = (seconds, ticks, ticks * 0 + number, ticks + self.frames, ticks * 0)
        columns |= {k: v[:, None] for k, v in zip(_COUNTERS, counters, strict=True)}
        self.features = {name: _feature(name, value) for name, value in columns.items()}
        where = self._write(columns)
        stats = {name: _stats(value) for name, value in columns.items()}
        episode: dict[str, Any] = {
            "episode_index": number,
            "tasks": [self.task],
            "length": count,
            **{f"data/{key}": value for key, value in where.items()},
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + count,
            **{f"meta/episodes/{key}": 0 for key in where},
            **{f"stats/{n}/{k}": v.tolist() for n, of in stats.items() for k, v in of.items()},
        }
        self.episodes.append(episode)
        self.frames += count

    def _write(self, columns: Columns) -> dict[str, int]:
        """Write a row group to the open file; return its indices."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pa.table({name: _array(value) for name, value in columns.items()})
        chunk, file = divmod(self.file, _FILES_A_CHUNK)
        where = {"chunk_index": chunk, "file_index": file}
        path = self.folder / _DATA.format(**where)
        if self.writer is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.writer = pq.ParquetWriter(path, table.schema)
        self.writer.write_table(table)
        if path.stat().st_size >= _FILE_MB * 2**20:
            self._close_file()
        return where

    def _close_file(self) -> None:
        if self.writer is not None:
            self.writer.close()
            self.writer, self.file = None, self.file + 1

    def close(self) -> None:
        """Write the metadata of the episodes; without it the folder is not a dataset."""
        import pandas as pd
        import pyarrow as pa
        import pyarrow.parquet as pq

        self._close_file()
        path = self.folder / _EPISODES
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(self.episodes), path)
        tasks = pd.DataFrame({"task_index": [0]}, index=[self.task])
        tasks.to_parquet(self.folder / "meta/tasks.parquet")
        write_json(self.folder / "meta/stats.json", dict(self._stats()))
        write_json(self.folder / INFO, self._info())

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "robot_type": self.robot,
            "total_episodes": len(self.episodes),
            "total_frames": self.frames,
            "total_tasks": 1,
            "chunks_size": _FILES_A_CHUNK,
            "data_files_size_in_mb": _FILE_MB,
            "video_files_size_in_mb": 2 * _FILE_MB,
            "fps": self.fps,
            "splits": {"train": f"0:{len(self.episodes)}"},
            "data_path": _DATA,
            "video_path": None,
            "features": self.features,
        }

    def _stats(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Statistics of all episodes, combined from those of each."""
        for name in self.features:
            low, high, mean, std, count = (
                np.array([episode[f"stats/{name}/{key}"] for episode in self.episodes])
                for key in ("min", "max", "mean", "std", "count")
            )
            share = (count / count.sum()).reshape(-1, *[1] * (mean.ndim - 1))
            center = (share * mean).sum(axis=0)
            variance = (share * (std**2 + (mean - center) ** 2)).sum(axis=0)
            whole = {"min": low.min(axis=0), "max": high.max(axis=0), "mean": center}
            whole |= {"std": np.sqrt(variance), "count": count.sum(axis=0)}
            yield name, {key: value.tolist() for key, value in whole.items()}


def _feature(name: str, values: NDArray[Any]) -> dict[str, Any]:
    if values.ndim == 4:
        names = ["height", "width", "channels"]
        return {"dtype": "image", "shape": list(values.shape[1:]), "names": names}
    return {"dtype": str(values.dtype), "shape": list(values.shape[1:]), "names": None}


def _array(values: NDArray[Any]) -> Any:
    """A column (N, ...) of numbers, lists of a fixed length, or PNG files."""
    import pyarrow as pa

    if values.ndim == 4:
        kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        return pa.array([{"bytes": _png(image), "path": None} for image in values], kind)
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    width = values.shape[1]
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


def _png(image: NDArray[np.uint8]) -> bytes:
    import cv2

    return bytes(cv2.imencode(".png", image[..., ::-1])[1])


def _stats(values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Statistics of a column; for images per channel (3, 1, 1), values in [0, 1]."""
    wide = values.astype(np.float64)
    if values.ndim == 4:
        wide = wide.reshape(-1, values.shape[3])
    found = {
        "min": wide.min(axis=0),
        "max": wide.max(axis=0),
        "mean": wide.mean(axis=0),
        "std": wide.std(axis=0),
    }
    if values.ndim == 4:
        found = {key: value.reshape(3, 1, 1) / 255 for key, value in found.items()}
    return found | {"count": np.array([len(values)])}
