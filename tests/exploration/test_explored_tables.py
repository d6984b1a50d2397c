"""The tables of an exploration: what few trials cannot say."""

from __future__ import annotations

from typing import Any, cast

import pytest

from ms_slam_env.exploration.results import Explored


@pytest.mark.parametrize(("trials", "is_warned"), [(19, True), (20, False)])
def test_importances_from_few_trials_say_so(trials: int, is_warned: bool) -> None:
    explored = Explored(
        objectives=("ate_m", "ext_ms"),
        clock="ext_ms",
        parameters=("icp_rgb_weight", "depth_cutoff_m"),
        points=cast("Any", [None] * trials),
        chosen={},
        reference={},
        hypervolume=(),
        importance={"ate_m": {"icp_rgb_weight": 0.7, "depth_cutoff_m": 0.3}},
        held_out=(),
    )
    note = explored._importance().note
    assert f"From {trials} trials" in note
    assert ("chance" in note) == is_warned
