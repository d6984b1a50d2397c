"""The terms of an episode's reward, summed and shown."""

import pytest
from ms_slam_experiments.reward_shares import TERMS, RewardShares

from ms_slam_env.env.reward import RewardConfig


@pytest.fixture(scope="module")
def rows():
    experiment = RewardShares(
        planners=("random", "stationary"), scenes=("table",), episodes=1, steps=4
    )
    return experiment, [
        {"spec": vars(spec), "result": RewardShares.run(spec), "error": None}
        for spec in experiment.specs()
    ]


def test_the_terms_sum_to_the_return(rows):
    for row in rows[1]:
        result = row["result"]
        assert sum(result[key] for key in TERMS) == pytest.approx(result["return"], abs=1e-9)
        expected = -RewardConfig().ate_growth * result["ate_unaligned_m"]
        assert result["return_ate"] == pytest.approx(expected, abs=1e-4)  # rounded to 1e-6 m
        assert result["return_divergence"] < 0


def test_a_line_for_each_planner(rows):
    experiment, played = rows
    table, pairs = experiment.tables(played)
    assert pairs.rows[0]["planner"] == "stationary"
    assert pairs.rows[0]["random"].value == 1
    assert "Share of 1 starts from which a line's planner has the larger return" in pairs.note
    assert [line["planner"] for line in table.rows] == ["random", "stationary"]
    assert table.rows[0]["return"] == played[0]["result"]["return"]
