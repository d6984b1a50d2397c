"""Skipped frames: divergence grows, and the targets are read where SLAM still copes."""

from __future__ import annotations

from typing import Any

import pytest

from ms_slam_env.errors import InputError
from ms_slam_env.experiments.frame_skipping import (
    DIVERGENCES,
    FrameSkipping,
    SkippingSpec,
    suggest_targets,
)
from ms_slam_env.report.statistics import Interval


def test_skipping_frames_raises_divergence() -> None:
    every = FrameSkipping.run(SkippingSpec("table", 1000, 1, 9, "80x60"))
    third = FrameSkipping.run(SkippingSpec("table", 1000, 3, 9, "80x60"))
    assert (every["frames"], third["frames"]) == (9, 3)
    assert third["depth_divergence_mean"] > every["depth_divergence_mean"]
    assert 0 < every["ate_m"] < 0.05


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


@pytest.mark.parametrize(
    "options", [{"intervals": (0,)}, {"intervals": (81,)}, {"desired_ate_m": 0}]
)
def test_bad_skipping_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        FrameSkipping(**options)
