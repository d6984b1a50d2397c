"""Frames are found where they were mapped, and every attempt is counted."""

from __future__ import annotations

from ms_slam_experiments.own_map import OwnMap

from ms_slam_env.benchmark.rows import run_experiment

SMALL = {"sequences": ("table:2000",), "image_sizes": ("80x60",), "frames": 40, "every": 12}


def test_frames_are_found_in_their_own_map(tmp_path) -> None:
    (row,) = run_experiment(OwnMap(**SMALL), tmp_path / "own_map").results.rows
    found = row["result"]["attempts"]
    assert (row["result"]["frames"], row["result"]["lost_share"]) == (40, 0.0)
    assert [one["frame"] for one in found] == [0, 12, 24]
    assert all(one["found"] and not one["wrong"] for one in found)
    assert max(one["first_error_m"] for one in found) < 0.005


def test_the_table_counts_attempts_over_all_sequences() -> None:
    experiment = OwnMap(**SMALL)
    one = {"found": True, "wrong": False, "frames_to_pose": 1.0}
    lost = {"found": False, "wrong": True, "frames_to_pose": float("inf")}
    rows = [
        {
            "spec": {"sequence": name, "image_size": "80x60"},
            "result": {"attempts": [one, lost]},
            "error": None,
        }
        for name in ("a", "b")
    ]
    lines = experiment.tables(rows)[0].rows
    assert [line["attempts_count"] for line in lines] == [2, 2, 4]
    assert lines[-1]["found"].value == lines[-1]["wrong"].value == 0.5
