"""The experiment on frame management: its sequences, pairs and summary."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env.benchmark import frame_management
from ms_slam_env.benchmark.frame_management_report import flat_runs, summarise, table
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import relative_angle
from ms_slam_env.sequences.paths.paced import PACES, UnevenPath


def test_an_uneven_path_stands_walks_and_hurries(box_scene: BoxScene):
    path = UnevenPath(frames=240)
    paces = path.paces(seed=1)
    for pace in PACES:
        assert np.mean(np.abs(paces - pace) < 1e-9) > 0.1
    assert paces.min() >= PACES[0] - 1e-9
    assert paces.max() <= PACES[-1] + 1e-9
    poses = path.poses(box_scene, 1)
    np.testing.assert_array_equal(poses, path.poses(box_scene, 1))
    assert not np.array_equal(poses, path.poses(box_scene, 2))
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = [relative_angle(a[:3, :3], b[:3, :3]) for a, b in itertools.pairwise(poses)]
    tremor_m, tremor_rad = 0.004, 0.006
    assert np.all(steps <= paces[1:] * 0.5 / 30 + tremor_m)
    assert np.all(turns <= paces[1:] * np.radians(1.0) + tremor_rad)
    fast = paces[1:] > 3.9
    effort = np.maximum(steps / (0.5 / 30), np.array(turns) / np.radians(1.0))
    assert np.median(effort[fast]) > 3  # whichever limit is reached first
    assert box_scene.clearance(poses[:, :3, 3]).min() > 0.05


def test_runs_pairs_and_reports(tmp_path, capsys):
    out = tmp_path / "out"
    words = ["--sequences", "wall:1000", "--frames", "40", "--image-size", "80x60"]
    words += ["--managements", "none", "regular,every=2", "divergence,threshold=0.02"]
    words += ["--workers", "1", "--out", str(out)]
    assert frame_management.main(words) == 0
    content = json.loads((out / "frame_management.json").read_text())
    assert content["provenance"]["command"]
    runs = {(run["management"], run["kind"]): run for run in content["runs"]}
    assert len(runs) == 4
    whole = runs["none", "none"]
    assert whole["processed"] == 1.0
    assert whole["ate_m"] == whole["ate_processed_m"]
    assert runs["regular,every=2", "regular"]["processed"] == 0.5
    own = runs["divergence,threshold=0.02", "divergence"]
    matched = runs["divergence,threshold=0.02", "matched"]
    assert 0 < own["processed"] < 1
    assert matched["processed"] >= own["processed"] - 1 / 40
    assert (out / "frame_management.png").stat().st_size > 10_000
    text = (out / "table.md").read_text()
    assert "divergence,threshold=0.02" in text
    assert text.strip() in capsys.readouterr().out


def test_a_summary_takes_medians_and_counts_pairs():
    def run(share: float, ate: float, f: float) -> dict[str, float]:
        names = ("lost", "failed", "ate_processed_m", "f_5cm", "cpu_ms", "filter_ms")
        return {"processed": share, "ate_m": ate, "f_2cm": f, **dict.fromkeys(names, 0.5)}

    rows = [
        {
            "error": None,
            "spec": {"sequence": f"a/b{k}"},
            "result": {
                "runs": [
                    {"management": "none", **run(1.0, ate, f), "regular": None},
                    {"management": "budget", **run(0.5, ate, f), "regular": run(0.5, 0.02, 0.7)},
                ]
            },
        }
        for k, (ate, f) in enumerate([(0.01, 0.9), (0.03, 0.8), (0.015, 0.6)])
    ]
    runs = flat_runs([*rows, {"error": "broken", "spec": {"sequence": "c"}, "result": None}])
    assert [run["sequence"] for run in runs] == ["b0"] * 3 + ["b1"] * 3 + ["b2"] * 3
    none, budget = summarise(runs)
    assert none["ate_m"] == budget["ate_m"] == 0.015
    assert budget["regular_ate_m"] == 0.02
    assert (budget["better_ate_m"], budget["better_f_2cm"], budget["better_ate_processed_m"]) == (
        *(2, 2),
        0,
    )
    assert budget["sequences"] == 3
    assert "better_ate_m" not in none
    assert "15.0 (20.0) | 2 of 3" in table([none, budget])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--sequences", "room"], "neither a folder nor scene:seed"),
        (["--sequences", "cellar:2000"], "unknown scene 'cellar'"),
        (["--managements", "some"], "valid choices: none, regular"),
        (["--managements", "budget,budget_per_s=1,measured=true"], "measures time"),
        (["--backend", "orb"], "unknown SLAM backend 'orb'"),
        (["--image-size", "3x2"], "unknown image size '3x2'"),
        (["--frames", "3"], "frames = 3 is outside"),
    ],
)
def test_bad_input_is_named(words, message):
    with pytest.raises(InputError, match=message):
        frame_management.main(words)
