"""The soak, with a tiny number of steps."""

from dataclasses import asdict

import numpy as np

from ms_slam_env import ENV_IDS
from ms_slam_env.experiments.soak import ARM_SHARE, IDS, Soak, SoakSpec, not_finite


def test_steps_are_spread_over_all_environments_in_turn():
    specs = Soak().specs()
    assert {spec.env_id for spec in specs} == set(IDS)
    assert sum(spec.steps for spec in specs) >= 1_000_000
    assert [spec.env_id for spec in specs[: len(IDS)]] == list(IDS)
    assert [spec.piece for spec in specs] == sorted(spec.piece for spec in specs)
    steps = {env_id: sum(spec.steps for spec in specs if spec.env_id == env_id) for env_id in IDS}
    arms = [steps[name] for name in ("MSActiveSLAM-v0", "MSActiveSLAM-Arm-v0")]
    assert arms == [steps["MSActiveSLAM-Home-v0"] // ARM_SHARE] * 2
    assert min(steps.values()) > 1000


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
