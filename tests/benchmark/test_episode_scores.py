"""Losses of an episode, and which submaps its map is judged by."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ms_slam_env.benchmark.episode_scores import anchored_points, measure_losses
from ms_slam_env.benchmark.episodes import EpisodeSpec, run_episode
from ms_slam_env.errors import InputError
from ms_slam_env.slam.shared.submap_frames import Submaps


def world_of(states: str) -> Any:
    """An episode: `.` tracked, `x` lost, `s` in another submap, `!` far off without noticing."""
    frames = [
        SimpleNamespace(
            tracking_ok=state != "x",
            submap=int(state == "s"),
            pose_error=0.4 if state == "!" else 0.01,
        )
        for state in states
    ]
    return SimpleNamespace(episode=SimpleNamespace(frames=frames))


@pytest.mark.parametrize(
    ("states", "losses", "for_good"),
    [("....", 0, 0), (".xx.", 1, 0), (".x.x", 2, 1), (".xss", 1, 1), (".xs..!", 2, 1), ("x", 1, 1)],
)
def test_a_loss_lasts_until_the_camera_is_where_it_thinks(
    states: str, losses: int, for_good: int
) -> None:
    found = measure_losses(world_of(states))
    assert found == {"losses": losses, "losses_not_recovered": for_good}


def test_submaps_that_hang_together_with_the_first_count() -> None:
    points = np.arange(12.0).reshape(4, 3)
    labels = np.array([0, 1, 2, 2], dtype=np.int32)
    whole = Submaps(
        first_frames=np.array([0, 4, 12], dtype=np.int32),
        joined_to=np.array([0, 0, 2], dtype=np.int32),
        joined_at=np.array([-1, 9, -1], dtype=np.int32),
        links=np.zeros((3, 6, 6)),
    )
    slam: Any = SimpleNamespace(
        map_points=lambda: points, map_attributes=lambda: {"submap": labels}, submaps=lambda: whole
    )
    np.testing.assert_array_equal(anchored_points(slam), points[:2])


def test_the_curve_ends_with_the_episode() -> None:
    result = run_episode(EpisodeSpec("stationary", "table", seed=1000, steps=6))
    assert result["looks_at_steps"] == [0, 5, 6]
    scores = result["f_score_5cm_over_steps"]
    assert scores[-1] == pytest.approx(result["f_score_5cm"], abs=0.02)
    assert min(scores) - 1e-4 <= result["f_score_5cm_area"] <= max(scores) + 1e-4


def test_a_task_for_an_arm_needs_one() -> None:
    free = EpisodeSpec("stationary", "table", seed=1000, steps=1, task="arm")
    with pytest.raises(InputError, match="needs embodiment 'arm'"):
        run_episode(free)
