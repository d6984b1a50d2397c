"""The measurement of the environment's speed, with a tiny budget."""

import json

import pytest

from ms_slam_env.benchmark.env_speed import Arguments, Case, cases, main
from ms_slam_env.errors import InputError


def test_a_free_camera_is_measured_once_whatever_the_frames():
    args = Arguments(
        embodiments=("free", "fixed-translation"),
        observations=("features",),
        frames_per_action=(1, None, 5),
    )
    assert cases(args) == [Case("free", 1, "features"), Case("fixed-translation", 1, "features")]


def test_split_adds_up_to_the_step(tmp_path, capsys):
    words = "--embodiments free --observations lookahead --scene carpet --seconds 0.05 --warm-up 1"
    assert main([*words.split(), "--out", str(tmp_path)]) == 0
    [row] = json.loads((tmp_path / "env_speed.json").read_text())["results"]
    assert row["steps"] >= 1
    assert row["frames_per_step"] == 1
    assert row["steps_per_s"] == pytest.approx(1000 / row["step_ms"])
    assert sum(row["split_ms"].values()) == pytest.approx(row["step_ms"])
    assert min(row["split_ms"].values()) >= 0
    assert {"render", "slam", "lookahead", "rest"} <= set(row["split_ms"])
    header, _, line = capsys.readouterr().out.strip().splitlines()
    assert header.count("|") == line.count("|")
    assert line.startswith("| free | 1.0 | lookahead |")


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"embodiments": ("tripod",)}, "unknown embodiment 'tripod'"),
        ({"observations": ("smell",)}, "unknown observation 'smell'"),
        ({"seconds": 0}, "Arguments.seconds = 0 is outside"),
    ],
)
def test_bad_input(fields, reason):
    with pytest.raises(InputError, match=reason):
        Arguments(**{"embodiments": ("free",), **fields})
