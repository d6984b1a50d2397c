"""The benchmark of run-time adaptation: its sequences, its judgement, its files."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest

from ms_slam_env import slam
from ms_slam_env.benchmark import adaptation
from ms_slam_env.benchmark.adaptation_report import comparison, summarise, tables
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import relative_angle
from ms_slam_env.sequences import MotionSegments, open_sequence
from ms_slam_env.slam.adaptation import make_config
from ms_slam_env.slam.configuration import read_configuration

SHORT = MotionSegments(frames=24, quiet=12, violent=10, factor=8.0, rate_hz=30.0)


def test_the_same_path_is_travelled_faster_in_haste():
    pace = SHORT.pace()
    violent = SHORT.is_violent()
    assert pace[0] == pace[11] == 1.0
    assert pace.max() == pytest.approx(8.0, rel=0.2)
    assert not violent[:12].any()
    assert violent[15:19].all()
    assert (MotionSegments(frames=50, violent=0).pace() == 1.0).all()


def test_a_sequence_moves_at_its_pace_and_is_the_same_twice():
    sequence = open_sequence("table:1000", "80x60", path=SHORT)
    again = open_sequence("table:1000", "80x60", path=SHORT)
    np.testing.assert_array_equal(sequence.poses, again.poses)
    np.testing.assert_array_equal(sequence.frames[5].depth, again.frames[5].depth)
    np.testing.assert_allclose(np.diff(sequence.frames.timestamps), 1 / 30)
    P = sequence.poses
    steps = np.linalg.norm(np.diff(P[:, :3, 3], axis=0), axis=1)
    turns = np.array([relative_angle(a[:3, :3], b[:3, :3]) for a, b in itertools.pairwise(P)])
    motion = steps + turns  # it moves where it does not turn
    violent = SHORT.is_violent()[1:]
    assert motion[violent].mean() > 4 * motion[:11].mean()


def test_judging_an_adaptive_run():
    sequence = open_sequence("table:1000", "160x120", path=SHORT)
    frames = list(sequence.frames)
    backend = make_config(
        "divergence",
        configurations=[{"keep_every": 3}, {}],
        thresholds=[1.0],
        dwell_frames=1,
        start=0,
    ).adapt(slam.make("surfel", sequence.intrinsics))
    figures, levels, changes = adaptation.judge(backend, frames, sequence.poses, SHORT.is_violent())
    assert levels == [0] * 24
    assert figures["processed"] == pytest.approx(8 / 24)
    assert changes[0] == 0
    assert min(changes[1:]) > 0
    assert figures["lost"] == 0
    assert 0 < figures["ate_m"] <= figures["ate_max_m"]
    assert figures["cpu_ms"] > 0


def row(seed: int, factor: float) -> dict:
    """A row of which everything is known."""
    run = {"cpu_ms": 10.0, "ate_m": 0.01, "ate_online_m": 0.01, "processed": 1.0, "lost": 0.0}
    half = {**run, "cpu_ms": 5.0 * factor, "ate_m": 0.02}
    return {"result": {"runs": {"slow": run, "adaptive": half}}, "spec": {"seed": seed}}


def test_the_comparison_is_paired():
    rows = [row(1, 0.9), row(2, 1.0), row(3, 1.1)]
    (cut,) = comparison(rows)
    assert cut["against"] == "slow"
    assert cut["cpu_ms_cut"]["value"] == pytest.approx(0.5)
    assert cut["ate_m_cut"]["value"] == pytest.approx(-1.0)
    assert (cut["cpu_ms_lower_share"], cut["ate_m_lower_share"]) == (1.0, 0.0)
    assert [line["name"] for line in summarise(rows)] == ["slow", "adaptive"]
    assert "| adaptive | 5.0 [4.5, 5.5] |" in tables(rows)


@pytest.mark.slow
def test_one_command_writes_table_figures_and_configurations(tmp_path, capsys):
    words = "--scenes table --sequences 1 --image-size 80x60 --stretches.frames 12"
    words += f" --stretches.quiet 5 --stretches.violent 5 --out {tmp_path}"
    assert adaptation.main(words.split()) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {"table.md", "results.json", "error_time.png", "time_line.png"} <= names
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["provenance"]["command"]
    assert [one["name"] for one in content["summary"]][-1] == "adaptive"
    assert len(content["sequences"][0]["result"]["level"]) == 12
    assert read_configuration(tmp_path / "configuration_0.yaml").keep_every > 1
    assert "adaptive against" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--image-size 1x1", "unknown image size"),
        ("--scenes mars", "unknown scene"),
        ("--thresholds 0.1", "thresholds"),
        ("--stretches.factor 0", "MotionSegments.factor = 0.0 is outside"),
        ("--configurations a.yaml b.yaml", "a.yaml: cannot be read"),
    ],
)
def test_bad_options(tmp_path, words, message):
    with pytest.raises(InputError, match=message):
        adaptation.main([*words.split(), "--out", str(tmp_path / "out")])
