"""Dataset difficulty: the statistics, the paper's order, the whole experiment."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ms_slam_experiments import difficulty
from ms_slam_experiments.difficulty import (
    CORRELATIONS,
    EASY,
    HARD,
    MOTIONS,
    Difficulty,
    DifficultySpec,
    judgements,
    statistics,
)
from PIL import Image

from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.sequence_divergence import statistics_of
from ms_slam_env.sequences import write_trajectory


def test_rates_are_weighed_by_time():
    values, gaps = np.array([2.0, 6.0]), np.array([1.0, 3.0])
    found = statistics_of(values, gaps)
    assert found["std"] == pytest.approx(2.0)
    assert found["mean_per_s"] == pytest.approx(2.0)
    assert found["variance_per_s"] == pytest.approx(0.0)


def fake_row(motion: str, mean: float, placement: int = 0, first: int = 0) -> dict[str, Any]:
    spec = DifficultySpec("s", motion, (), "", placement, 1.0, "80x60", "none", 1, first)
    line: dict[str, Any] = {"histograms": "paper", "divergence": "intensity"}
    line |= {f"divergence_{key}": mean for key in ("max", "mean", "variance")}
    line |= {f"divergence_{key}": 1.0 for key in ("std", "max_per_s", "mean_per_s", "std_per_s")}
    line |= {key: 0.1 * placement for key in CORRELATIONS}
    result = {"frames": 5, "contrast": 1.0, "depth_m": 1.0, "statistics": [line]}
    result |= {name: mean for name in MOTIONS}
    return {"spec": asdict(spec), "result": result, "error": None}


def test_statistics_are_means_over_places():
    rows = [fake_row("lr_kt3", 2.0), fake_row("lr_kt3", 4.0, 1), fake_row("lr_kt3", 1.0, 0, 4)]
    whole, cut = statistics(rows)
    assert (whole["motion"], whole["places"], whole["divergence_mean"]) == ("lr_kt3", 2, 3.0)
    assert (cut["motion"], cut["places"]) == ("lr_kt3, first 4 frames", 1)


def test_order_counts_pairs_and_places():
    means = {HARD[0]: (3, 3), HARD[1]: (4, 1), EASY[0]: (1, 2), EASY[1]: (2, 1)}
    rows = [fake_row(m, float(v), p) for m, found in means.items() for p, v in enumerate(found)]
    (intensity,) = judgements(
        [*rows, fake_row(HARD[0], 0.0, 0, 3)]
    )  # what is cut short has no part
    assert (intensity["divergence"], intensity["places"]) == ("intensity", 2)
    assert intensity["pairs_mean"] == 4  # means over the places: 3 and 2.5 against 1.5 and 1.5
    assert intensity["places_mean"] == 1
    assert intensity["places_std"] == 0
    assert intensity["turn_correlation"] == pytest.approx(0.05)  # median of the places' 0 and 0.1
    assert intensity["motions_turn_correlation"] == pytest.approx(1.0)


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data" / "icl_nuim"
    (folder / "trajectories").mkdir(parents=True)
    (folder / "lr_kt3_depth" / "depth").mkdir(parents=True)
    poses = np.repeat(np.eye(4)[None], 4, axis=0)
    for k in range(4):
        poses[:, 0, 3] = 0.005 * k * np.arange(4)
        write_trajectory(folder / f"trajectories/lr_kt{k}.tum.txt", np.arange(4) / 30, poses)
        slope = 1.0 + 0.01 * k + 0.01 * np.arange(80)[None] + np.zeros((60, 1))
        Image.fromarray((5000 * slope).astype(np.uint16)).save(
            folder / f"lr_kt3_depth/depth/{k}.png"
        )
    lines = "\n".join(f"{k / 30:.6f} depth/{k}.png" for k in range(4))
    (folder / "lr_kt3_depth/depth.txt").write_text(lines)
    (folder / "lr_kt3_depth/intrinsics.txt").write_text("60 60 39.5 29.5 80 60")
    return tmp_path / "data"


@pytest.fixture
def experiment(data, box_scene, monkeypatch):
    monkeypatch.setattr(difficulty, "get_scene", lambda *_: box_scene)
    return Difficulty(data=data, scenes=("box",), placements=1, image_size="80x60")


def test_what_was_recorded_only_in_part_is_also_rendered_in_part(experiment, data):
    path = data / "icl_nuim/lr_kt3_depth/depth.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:3]))
    cut = [spec for spec in experiment.specs() if spec.first]
    assert [(spec.motion, spec.first) for spec in cut] == [("lr_kt3", 3)]
    assert Difficulty.run(cut[0])["frames"] == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"data": None}, "--data is missing"),
        ({"data": Path("nowhere")}, "cannot read trajectory"),
        ({"image_size": "1x1"}, "image_size.*1x1"),
        ({"noise": ("loud",)}, "unknown noise model 'loud'"),
        ({"placements": 0}, "placements = 0"),
        ({"motions": ("lr_kt9",)}, "lr_kt9"),
    ],
)
def test_bad_input(options, message, data):
    with pytest.raises(InputError, match=message):
        Difficulty(**{"data": data, **options}).specs()


def test_places_without_depth_are_passed_over(experiment, monkeypatch):
    def places():
        return sorted({spec.placement for spec in experiment.specs() if spec.scene == "box"})

    first = places()
    assert len(first) == 1
    real = difficulty.render_sequence

    def blind_there(scene, poses, K, noise="kinect", seed=0, **given):
        made = real(scene, poses, K, noise, seed, **given)
        frames = [replace(frame, depth=frame.depth * (seed not in first)) for frame in made.frames]
        return SimpleNamespace(frames=frames)

    monkeypatch.setattr(difficulty, "render_sequence", blind_there)
    assert len(places()) == 1
    assert places() != first
    monkeypatch.setattr(difficulty, "LEAST_DEPTH_SHARE", 1.1)
    with pytest.raises(InputError, match="at 0 places of 21, but 1 are asked for"):
        places()
