"""The soak, with a tiny number of steps."""

from dataclasses import asdict

import numpy as np
from ms_slam_experiments.soak import (
    ARM_SHARE,
    IDS,
    PLAIN_IDS,
    SHARE,
    Soak,
    SoakSpec,
    not_finite,
)

from ms_slam_env import ENV_IDS


def test_steps_are_spread_over_all_environments():
    specs = Soak().specs()
    assert {spec.env_id for spec in specs} == set(IDS)
    assert len(set(specs)) == len(specs)
    assert sum(spec.steps for spec in specs) >= 1_000_000
    steps = {env_id: sum(spec.steps for spec in specs if spec.env_id == env_id) for env_id in IDS}
    assert {steps[name] for name in PLAIN_IDS} == {max(steps.values())}
    assert min(steps.values()) > 1000
    assert steps["MSActiveSLAM-Home-v0"] == max(steps.values()) // SHARE
    assert steps["MSActiveSLAM-Arm-v0"] == max(steps.values()) // ARM_SHARE


def test_pieces_of_environments_without_the_arm_come_in_turn():
    specs = Soak(env_ids=(*PLAIN_IDS, "MSActiveSLAM-v0"), steps=20, piece_steps=4).specs()
    pieces = [(IDS.index(spec.env_id), spec.piece, spec.steps) for spec in specs]
    assert pieces == [(1, 0, 4), (2, 0, 4), (1, 1, 4), (2, 1, 4), (0, 0, 4)]


def test_places_that_are_not_finite_are_found():
    held = {"a": [1.0, {"b": np.array([0.0, np.nan])}], "c": (np.float32(np.inf), None, "nan")}
    assert list(not_finite(held)) == ["a[1].b", "c[0]"]
    assert list(not_finite({"a": np.ones(2), "n": np.arange(3), "f": 0.5, "b": True})) == []


def test_a_piece_counts_its_steps_episodes_and_memory():
    spec = SoakSpec(ENV_IDS[1], 0, 4, "80x60")
    result = Soak.run(spec)
    assert result["measured_steps"] == 4
    assert result["soak_episodes"] == 1
    assert result["not_finite"] == 0
    assert result["mem_process_mb"] > 50
    assert abs(result["mem_growth"]) < 0.5
    rows = [{"spec": asdict(spec), "result": result, "error": None}] * 2
    (table,) = Soak().tables(rows)
    assert table.rows[0]["measured_steps"] == 8
    assert "8 steps in all" in table.note
