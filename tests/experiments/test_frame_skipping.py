"""Skipped frames: divergence grows, and the targets are read where SLAM still copes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ms_slam_experiments import frame_skipping
from ms_slam_experiments.frame_skipping import (
    DIVERGENCES,
    FrameSkipping,
    SkippingSpec,
    suggest_targets,
)

from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.report.statistics import Interval
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import render_sequence, write_trajectory


@pytest.mark.parametrize(
    ("interval", "kept"),
    [
        (1, [0, 1, 2, 3, 4, 5, 6, 7, 8]),
        (1.5, [0, 1, 3, 4, 6, 7]),
        (1.333, [0, 1, 2, 4, 5, 6, 8]),
        (2, [0, 2, 4, 6, 8]),
        (4, [0, 4, 8]),
    ],
)
def test_an_interval_between_whole_ones_drops_one_in_so_many(
    interval: float, kept: list[int]
) -> None:
    assert SkippingSpec("table", 1000, interval, 9).kept.tolist() == kept


def test_motions_are_placed_as_they_were_and_skipped(tmp_path: Path) -> None:
    poses = np.repeat(np.eye(4)[None], 20, axis=0)
    poses[:, 0, 3] = 0.01 * np.arange(20)
    folder = tmp_path / "icl_nuim" / "trajectories"
    folder.mkdir(parents=True)
    write_trajectory(folder / "lr_kt1.tum.txt", np.arange(20) / 30, poses)
    experiment = FrameSkipping(
        scenes=("table",),
        sequences=1,
        intervals=(1, 3),
        frames=9,
        motions=("lr_kt1",),
        data=tmp_path,
    )
    whole, third = experiment.specs()
    steps = np.linalg.norm(np.diff(whole.trajectory()[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-6)
    assert len(whole.trajectory()) == 9
    np.testing.assert_array_equal(third.trajectory(), whole.trajectory()[::3])
    result = dict.fromkeys((*DIVERGENCES, "ate_m"), 0.1)
    rows = [
        {"spec": vars(spec), "error": None, "result": {**result, "lost": False}}
        for spec in (whole, third)
    ]
    table, correlations = experiment.tables(rows)
    assert {line["places"] for line in correlations.rows} == {1}
    assert [(line["motion"], line["keep_every"]) for line in table.rows] == [
        ("lr_kt1", 1),
        ("lr_kt1", 3),
    ]
    with pytest.raises(InputError, match="lr_kt9"):
        FrameSkipping(motions=("lr_kt9",), data=tmp_path).specs()
    with pytest.raises(InputError, match="--data"):
        FrameSkipping(motions=("lr_kt1",)).specs()


def line(interval: int, ate_m: float, lost: float, M: float) -> dict[str, Any]:
    values = {"ate_m": ate_m, "lost": lost, "M_I": M, "M_D": 2 * M}
    values |= {"intensity_divergence_mean": M / 2, "depth_divergence_mean": M}
    return {"keep_every": interval, **{name: Interval(v, v, v) for name, v in values.items()}}


def test_targets_are_read_at_the_last_interval_that_suffices() -> None:
    lines = [line(1, 0.002, 0, 0.01), line(2, 0.008, 0, 0.02), line(4, 0.003, 0.1, 0.04)]
    lines.append(line(8, 0.001, 0, 0.08))  # luck beyond the first failure does not count
    targets = suggest_targets(lines, 0.01)
    assert targets is not None
    assert (targets["keep_every"], targets["M_I"], targets["M_D"]) == (2, 0.02, 0.04)
    assert suggest_targets(lines, 0.001) is None


@pytest.mark.parametrize("ate_m", [0.001, 0.1])
def test_the_targets_stand_in_the_tables(ate_m: float) -> None:
    experiment = FrameSkipping(scenes=("table",), sequences=1, intervals=(2, 1), frames=9)
    result = {"frames": 9, "ate_m": ate_m, "lost": False}
    divergences = dict.fromkeys(DIVERGENCES, 0.1)
    rows = [
        {"spec": vars(spec), "error": None, "result": {**result, **divergences}}
        for spec in experiment.specs()
    ]
    table, *targets = experiment.tables(rows)
    assert [entry["keep_every"] for entry in table.rows] == [1, 2]
    if ate_m < experiment.desired_ate_m:
        assert targets[0].rows[0]["keep_every"] == 2
    else:
        assert len(targets) == 1  # the correlations
        assert "no interval suffices" in table.note
    (chart,) = experiment.charts(rows)
    assert [series.name for series in chart.panels[0].series] == ["every 2", "every frame"]


def smallest_share(spec: SkippingSpec) -> float:
    scene = get_scene(spec.scene, spec.seed)
    seen = render_sequence(scene, spec.whole()[::5], xtion("80x60"), seed=spec.seed).frames
    return min(float((frame.depth > 0).mean()) for frame in seen)


def test_blind_places_are_refused_and_every_interval_has_as_many_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = np.repeat(np.eye(4)[None], 40, axis=0)
    poses[:, 0, 3] = 0.005 * np.arange(40)
    folder = tmp_path / "icl_nuim" / "trajectories"
    folder.mkdir(parents=True)
    write_trajectory(folder / "lr_kt1.tum.txt", np.arange(40) / 30, poses)
    given: Any = {"scenes": ("table",), "motions": ("lr_kt1",), "data": tmp_path}
    experiment = FrameSkipping(intervals=(1, 1.5, 4), count=9, sequences=2, **given)
    for spec in experiment.specs():
        part, whole = spec.trajectory(), spec.whole()
        from_start = np.array([np.abs(whole - pose).sum(axis=(1, 2)).argmin() for pose in part])
        np.testing.assert_array_equal(from_start - from_start[0], spec.kept)
        assert len(part) == 9
    seeds: Any = {"intervals": (1,), "seeds": "1000,1001,1002,1003"}
    specs = FrameSkipping(**seeds, **given).specs()
    shares = sorted(map(smallest_share, specs))
    limit = (shares[0] + shares[1]) / 2
    monkeypatch.setattr(frame_skipping, "LEAST_DEPTH_SHARE", limit)
    frame_skipping._place_that_sees.cache_clear()
    elsewhere = FrameSkipping(**seeds, **given).specs()
    moved = [a.seed for a, b in zip(specs, elsewhere, strict=True) if a.placement != b.placement]
    assert moved == [spec.seed for spec in specs if smallest_share(spec) < limit]
    assert min(map(smallest_share, elsewhere)) >= limit
    monkeypatch.setattr(frame_skipping, "LEAST_DEPTH_SHARE", 1.1)
    frame_skipping._place_that_sees.cache_clear()
    with pytest.raises(InputError, match="at each of 20 places a frame has depth in less than"):
        FrameSkipping(**seeds, **given).specs()
    frame_skipping._place_that_sees.cache_clear()
    with pytest.raises(InputError, match="40 frames, too few for 9 at every 8-th"):
        FrameSkipping(intervals=(8,), count=9, **given).specs()
    with pytest.raises(InputError, match="count = 2"):
        FrameSkipping(count=2)
