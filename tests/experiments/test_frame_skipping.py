"""Skipped frames: divergence grows, and the targets are read where SLAM still copes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ms_slam_experiments.frame_skipping import (
    DIVERGENCES,
    FrameSkipping,
    SkippingSpec,
    suggest_targets,
)

from ms_slam_env.camera import xtion
from ms_slam_env.divergence import depth_divergence, intensity_divergence
from ms_slam_env.errors import InputError
from ms_slam_env.report.statistics import Interval
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import handheld_trajectory, render_sequence, write_trajectory


def test_skipping_frames_raises_divergence() -> None:
    every = FrameSkipping.run(SkippingSpec("table", 1000, 1, 9, "80x60"))
    third = FrameSkipping.run(SkippingSpec("table", 1000, 3, 9, "80x60"))
    assert (every["frames"], third["frames"]) == (9, 3)
    assert third["depth_divergence_mean"] > every["depth_divergence_mean"]
    assert 0 < every["ate_m"] < 0.05


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
    (table,) = experiment.tables(rows)
    assert [(line["motion"], line["keep_every"]) for line in table.rows] == [
        ("lr_kt1", 1),
        ("lr_kt1", 3),
    ]
    with pytest.raises(InputError, match="lr_kt9"):
        FrameSkipping(motions=("lr_kt9",), data=tmp_path).specs()
    with pytest.raises(InputError, match="--data"):
        FrameSkipping(motions=("lr_kt1",)).specs()


def test_backends_are_compared_on_the_same_frames() -> None:
    backends = ("surfel", "surfel,check_slips=true")
    experiment = FrameSkipping(("table",), intervals=(3,), frames=9, backends=backends, sequences=1)
    specs = [replace(spec, image_size="80x60") for spec in experiment.specs()]
    rows = [
        {"spec": vars(spec), "error": None, "result": FrameSkipping.run(spec)} for spec in specs
    ]
    assert rows[0]["result"]["M_I"] == rows[1]["result"]["M_I"]
    (table,) = experiment.tables(rows)
    assert [line["backend"] for line in table.rows] == list(backends)
    assert "suggested_targets" not in experiment.content(rows)
    with pytest.raises(InputError, match="nothing"):
        FrameSkipping(backends=("nothing",))
    with pytest.raises(InputError, match="nothing"):
        FrameSkipping(backends=("surfel,nothing=1",))
    with pytest.raises(InputError, match="backends is empty"):
        FrameSkipping(backends=())


def test_the_papers_histograms_have_divergences_of_their_own() -> None:
    experiment = FrameSkipping(("table",), intervals=(3,), frames=9, histograms="paper")
    found = FrameSkipping.run(replace(experiment.specs()[0], image_size="80x60"))
    scene = get_scene("table", 1000)
    poses = handheld_trajectory(scene, 9, 1000)[::3]
    frames = render_sequence(scene, poses, xtion("80x60"), seed=1000).frames
    pairs = list(zip(frames[1:], frames[:-1], strict=True))
    M_I = max(intensity_divergence(*pair) for pair in pairs)
    M_D = max(depth_divergence(*pair, xtion("80x60")) for pair in pairs)
    assert (found["M_I"], found["M_D"]) == pytest.approx((M_I, M_D), rel=1e-5)


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
        assert not targets
        assert "no interval suffices" in table.note
    (chart,) = experiment.charts(rows)
    assert [series.name for series in chart.panels[0].series] == ["every 2", "every frame"]
