"""Table II on a straight line: the line is as long as the path, and no step larger would fit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from ms_slam_experiments import paper_table2
from ms_slam_experiments.paper_table2 import STEP_SIZES_M, STRAIGHT, PaperTable2

from ms_slam_env.benchmark.episodes import EpisodeSpec, make_env
from ms_slam_env.errors import InputError


def way(spec: EpisodeSpec) -> float:
    """Distance between start and end of an episode of steps straight on."""
    env = make_env(spec)
    env.reset(seed=spec.seed)
    body = cast(Any, env.unwrapped).embodiment
    start = body.T_world_camera[:3, 3].copy()
    for _ in range(spec.steps):
        body.move(0)
    env.close()
    return float(np.linalg.norm(body.T_world_camera[:3, 3] - start))


def test_a_line_is_as_long_as_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    specs = PaperTable2(episodes=1, steps=40).specs()
    straight = [spec for spec in specs if spec.env_id == STRAIGHT]
    assert {spec.planner for spec in straight} == {"random", "greedy"}
    assert len({spec.step_m for spec in straight}) == 1
    assert {spec.step_m for spec in specs if spec.env_id != STRAIGHT} == {0.12}
    spec = straight[0]
    assert way(spec) == pytest.approx(40 * spec.step_m)
    larger = STEP_SIZES_M[STEP_SIZES_M.index(spec.step_m) - 1]
    assert way(replace(spec, step_m=larger)) < 40 * larger - 1e-6  # it would turn back
    monkeypatch.setattr(paper_table2, "STEP_SIZES_M", (0.12,))
    paper_table2._steps.clear()
    with pytest.raises(InputError, match="no straight line of 100 steps of 12 cm"):
        PaperTable2(episodes=1).specs()
    paper_table2._steps.clear()
