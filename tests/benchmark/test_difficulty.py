"""Dataset difficulty: motion of the image against closed forms, the order, the whole command."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest
from PIL import Image

from ms_slam_env.benchmark import difficulty
from ms_slam_env.benchmark.difficulty import RECORDING, main
from ms_slam_env.benchmark.difficulty_report import EASY, HARD, order, statistics
from ms_slam_env.benchmark.image_motion import MOTIONS, contrast, frame_motion
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.evaluation.sequence_divergence import statistics_of
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.sequences import write_trajectory

K = xtion("160x120")
GAP_S = 0.1


def wall(distance_m: float) -> RGBDFrame:
    depth = np.full(K.shape, distance_m, np.float32)
    return RGBDFrame(np.zeros((*K.shape, 3), np.uint8), depth)


def test_a_roll_moves_the_image_as_its_rays_turn():
    angle = np.radians(2.0)
    motion = frame_motion(
        wall(2.0), np.eye(4), make_pose(so3_exp([0, 0, angle]), np.zeros(3)), K, GAP_S
    )
    found = dict(zip(MOTIONS, motion, strict=True))
    assert found["turn_deg_s"] == pytest.approx(20.0)
    assert found["speed_m_s"] == 0.0
    rays = K.rays()[::4, ::4].reshape(-1, 3)
    off_axis = np.linalg.norm(rays[:, :2], axis=1) / np.linalg.norm(rays, axis=1)
    chords = 2 * np.arcsin(off_axis * np.sin(angle / 2))
    assert found["image_motion_deg_s"] == pytest.approx(np.degrees(chords.mean()) / GAP_S, rel=1e-6)


def test_a_step_sideways_moves_near_things_more():
    step = make_pose(np.eye(3), [0.1, 0, 0])
    near, far = (frame_motion(wall(z), np.eye(4), step, K, GAP_S) for z in (1.0, 4.0))
    assert near[1] == far[1] == pytest.approx(1.0)
    assert near[2] > 3.5 * far[2]


def test_without_depth_the_image_motion_is_unknown():
    motion = frame_motion(wall(0.0), np.eye(4), np.eye(4), K, GAP_S)
    assert np.isnan(motion[2])
    assert not motion[:2].any()


def test_contrast_of_a_half_white_image():
    color = np.zeros((*K.shape, 3), np.uint8)
    color[:60] = 255
    assert contrast(RGBDFrame(color, np.ones(K.shape, np.float32))) == pytest.approx(127.5)


def test_rates_are_weighed_by_time():
    values, gaps = np.array([2.0, 6.0]), np.array([1.0, 3.0])
    found = statistics_of(values, gaps)
    assert found["std"] == pytest.approx(2.0)
    assert found["mean_per_s"] == pytest.approx(2.0)
    assert found["variance_per_s"] == pytest.approx(0.0)


def fake_row(motion: str, mean: float, placement: int) -> dict:
    values = [[mean, 1.0], [mean, 1.0]]
    spec = {"scene": "s", "noise": "none", "motion": motion, "placement": placement}
    return {"spec": spec, "result": {"gaps_s": [1.0, 1.0], "divergences": {"paper": values}}}


def test_a_rendered_motion_is_also_judged_over_what_was_recorded():
    rows = []
    for scene, count in ((RECORDING, 3), ("s", 5)):
        values = [[1.0 + k, 2.0] for k in range(count)]
        result = {
            **{"gaps_s": [1.0] * count, "times_s": list(range(count)), "contrast": 1.0},
            **{"depth_m": 1.0, "divergences": {"paper": values}},
            "motion": {name: [1.0] * count for name in MOTIONS},
        }
        spec = {"scene": scene, "noise": "none", "motion": "lr_kt3"}
        rows.append({"spec": spec, "result": result})
    found = {
        (row["scene"], row["motion"]): row["mean"]
        for row in statistics(rows)
        if row["divergence"] == "intensity"
    }
    assert found == {
        (RECORDING, "lr_kt3"): 2.0,
        ("s", "lr_kt3"): 3.0,
        ("s", "lr_kt3, first 4 frames"): 2.0,
    }


def test_order_counts_pairs_and_places():
    means = {HARD[0]: (3, 3), HARD[1]: (4, 1), EASY[0]: (1, 2), EASY[1]: (2, 1)}
    rows = [fake_row(m, float(v), p) for m, found in means.items() for p, v in enumerate(found)]
    intensity = order(rows)[0]
    assert (intensity["divergence"], intensity["places"]) == ("intensity", 2)
    assert intensity["pairs_mean"] == 4  # means over the places: 3 and 2.5 against 1.5 and 1.5
    assert intensity["places_mean"] == 1
    assert intensity["places_std"] == 0


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


def test_the_command_makes_tables_and_figures(data, box_scene, tmp_path, capsys, monkeypatch):
    def here(specs, run, *_):
        return [{"spec": asdict(spec), "result": run(spec), "error": None} for spec in specs]

    monkeypatch.setattr(difficulty, "run_all", here)
    monkeypatch.setattr(difficulty, "get_scene", lambda *_: box_scene)
    out = tmp_path / "out"
    options = ["--data", str(data), "--scenes", "box", "--placements", "1"]
    options += ["--image-size", "80x60", "--workers", "1", "--out", str(out)]
    assert main(options) == 0
    assert "Spearman" in capsys.readouterr().out
    found = json.loads((out / "difficulty.json").read_text())
    assert {row["scene"] for row in found["statistics"]} == {RECORDING, "box"}
    assert [r["divergence"] for r in found["statistics"] if r["scene"] == RECORDING] == [
        "depth"
    ] * 2
    # lr_kt0 stands still, and without noise nothing diverges then.
    still = [r["max"] for r in found["statistics"] if r["motion"] == "lr_kt0"]
    assert still == [0.0] * 4
    assert len(found["order"]) == 4
    assert (out / "box_none_paper.png").stat().st_size > 1000
    assert (out / "recorded_depth_none_paper.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--data", "nowhere"], "cannot read trajectory"),
        (["--image-size", "1x1"], "unknown image size '1x1'"),
        (["--noise", "loud"], "unknown noise model 'loud'"),
        (["--placements", "0"], "placements = 0"),
        (["--motions", "lr_kt9"], "lr_kt9"),
    ],
)
def test_bad_input(options, message, data, tmp_path):
    from ms_slam_env.errors import InputError

    with pytest.raises(InputError, match=message):
        main(["--data", str(data), *options, "--out", str(tmp_path / "out")])
