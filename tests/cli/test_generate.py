"""``ms-slam generate``: a folder that ``ms-slam run`` reads."""

from __future__ import annotations

import json
from pathlib import Path

import gymnasium
import numpy as np
from ms_slam_baselines import GreedyDivergence

from ms_slam_env.cli import main
from ms_slam_env.sequences import read_trajectory, write_trajectory
from ms_slam_env.sequences.recording import open_recording
from ms_slam_env.sequences.rendering import RenderedFrames

SMALL = ["--scene", "table", "--seed", "4", "--image-size", "80x60"]


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_generate_then_run(tmp_path, capsys) -> None:
    out = tmp_path / "sequence"
    perturbations = ["--perturbations", "rolling-shutter,readout_s=0.02", "exposure-jumps,every=3"]
    command = ["generate", *SMALL, "--path.frames", "6", *perturbations, "--out", str(out)]
    assert main(command) == 0
    assert "6 frames" in capsys.readouterr().out
    about = json.loads((out / "sequence.json").read_text())
    assert about["perturbations"][0] == {"name": "rolling-shutter", "readout_s": 0.02}
    assert main(command) == 0
    assert "written before" in capsys.readouterr().out
    assert main(["run", str(out), "--out", str(tmp_path / "run")]) == 0
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["complete"]
    assert (metrics["poses"], metrics["registration"]) == (6, None)
    assert metrics["ate_m"] < 0.02


def test_a_given_trajectory_is_placed(tmp_path, capsys) -> None:
    poses = np.repeat(np.eye(4)[None], 5, axis=0)
    poses[:, 0, 3] = 0.01 * np.arange(5)
    write_trajectory(tmp_path / "given.txt", 3.0 + 0.1 * np.arange(5), poses)
    out = tmp_path / "sequence"
    given = ["--trajectory", str(tmp_path / "given.txt"), "--scale", "2.0"]
    assert main(["generate", *SMALL, *given, "--truth", "--out", str(out)]) == 0
    assert "placed at scale 2" in capsys.readouterr().err
    times, placed = read_trajectory(out / "groundtruth.txt")
    np.testing.assert_allclose(times, 3.0 + 0.1 * np.arange(5))
    np.testing.assert_allclose(np.linalg.norm(np.diff(placed[:, :3, 3], axis=0), axis=1), 0.02)
    assert (out / "depth_true/3.000000.png").is_file()
    assert len(open_recording(out)) == 5


def test_the_motion_of_a_planner_is_rendered(tmp_path) -> None:
    out = tmp_path / "sequence"
    given = ["--planner", "greedy", "--steps", "4", "--step-m", "0.05", "--step-deg", "5"]
    given += ["--options", "image_size=80x60", "--perturbations", "frame-skipping,keep_every=2"]
    command = ["generate", *SMALL, *given, "--out", str(out)]
    assert main(command) == 0
    env = gymnasium.make(
        "MSActiveSLAM-FreeCamera-v0",
        **{"scene": "table", "scene_seed": 4, "image_size": "80x60"},
        **{"step_m": 0.05, "step_rad": np.radians(5), "observation": GreedyDivergence.observation},
    )
    observation, info = env.reset(seed=4)
    planner = GreedyDivergence(env.unwrapped, seed=4)
    poses, times = [info["T_world_camera"]], [info["time"]]
    for _ in range(4):
        observation, *_, info = env.step(planner.act(observation, info))
        poses.append(info["T_world_camera"])
        times.append(info["time"])
    about = json.loads((out / "sequence.json").read_text())
    assert (about["planner"], about["episode_steps"]) == ("greedy", 4)
    assert about["episode_lost_frames"] == 0
    found_times, found = read_trajectory(out / "groundtruth.txt")
    index = [int(np.abs(np.array(times) - time).argmin()) for time in found_times]
    assert index == [0, 2, 4]
    np.testing.assert_allclose(found_times, np.array(times)[index], atol=1e-6)
    np.testing.assert_allclose(found, np.stack(poses)[index], atol=1e-6)
    assert main(command) == 0  # the episode is the same again, and so is the sequence


def test_an_interrupted_command_goes_on_to_the_same_files(tmp_path, monkeypatch, capsys) -> None:
    options = [*SMALL, "--path.frames", "5", "--perturbations", "motion-blur"]
    assert main(["generate", *options, "--out", str(tmp_path / "whole")]) == 0
    target, take = tmp_path / "stopped", RenderedFrames.__getitem__

    def interrupted(frames, index):
        if index == 2:
            raise KeyboardInterrupt  # what Ctrl-C raises
        return take(frames, index)

    with monkeypatch.context() as patch:
        patch.setattr(RenderedFrames, "__getitem__", interrupted)
        assert main(["generate", *options, "--out", str(target)]) == 130
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.endswith("stopped.partial; the same command continues")
    assert last.startswith("ms-slam: interrupted; finished frames are kept in ")
    assert not target.exists()
    assert len(list((tmp_path / "stopped.partial").glob("depth/*.png"))) == 2
    assert main(["generate", *options, "--out", str(target)]) == 0
    assert files(target) == files(tmp_path / "whole")
