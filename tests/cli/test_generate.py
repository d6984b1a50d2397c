"""``ms-slam generate``: a folder that ``ms-slam run`` reads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from ms_slam_baselines import GreedyDivergence

from ms_slam_env.cli import main
from ms_slam_env.sequences import read_trajectory, write_trajectory
from ms_slam_env.sequences.recording import open_recording

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


INTERRUPTED = """
import os, signal, sys
from ms_slam_env.cli import main
from ms_slam_env.sequences.rendering import RenderedFrames

take = RenderedFrames.__getitem__

def interrupted(frames, index):
    if index == 2:
        os.kill(os.getpid(), signal.SIGINT)
    return take(frames, index)

RenderedFrames.__getitem__ = interrupted
# A test run in the background of a shell was told to ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_an_interrupted_command_goes_on_to_the_same_files(tmp_path) -> None:
    options = [*SMALL, "--path.frames", "5", "--perturbations", "motion-blur"]
    assert main(["generate", *options, "--out", str(tmp_path / "whole")]) == 0
    target = tmp_path / "stopped"
    command = [sys.executable, "-c", INTERRUPTED, "generate", *options, "--out", str(target)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 130, done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert last.endswith("stopped.partial; the same command goes on")
    assert last.startswith("ms-slam: interrupted; finished frames are kept in ")
    assert not target.exists()
    assert len(list((tmp_path / "stopped.partial").glob("depth/*.png"))) == 2
    assert main(["generate", *options, "--out", str(target)]) == 0
    assert files(target) == files(tmp_path / "whole")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scene", "mars"], "unknown scene 'mars'"),
        (["--image-size", "1x1"], "unknown image size '1x1'"),
        (["--noise", "loud"], "unknown noise model 'loud'"),
        (["--perturbations", "rain"], "unknown perturbation 'rain'; valid choices: rolling"),
        (["--perturbations", "motion-blur,time=1"], "unknown option of MotionBlur"),
        (["--perturbations", "motion-blur,samples"], "'samples' is not option=value"),
        (["--perturbations", "motion-blur,samples=x"], "MotionBlur.samples = 'x' is outside"),
        (["--path.frames", "1"], "HandheldPath.frames = 1 is outside"),
        (["--trajectory", "none.txt"], "cannot read trajectory none.txt"),
        (["--planner", "dreamer"], "unknown planner 'dreamer'; valid choices: "),
        (["--planner", "greedy,depth=3"], "unknown option of planner greedy 'depth'"),
        (["--planner", "greedy", "--trajectory", "t.txt"], "exclude each other"),
        (["--steps", "5"], "the options of an episode need --planner"),
        (["--scale", "0.5"], "--scale is of the motion of a --trajectory"),
        (["--planner", "greedy", "--steps", "0"], "steps = 0 is outside"),
        (["--planner", "greedy", "--options", "speed=3"], "speed"),
        (["--planner", "greedy", "--env-id", "Mars-v0"], "Mars-v0"),
        (["--seed", "-1"], "scene seed -1 must be an integer"),
    ],
)
def test_bad_input_is_one_line(arguments, message, tmp_path, capsys) -> None:
    command = ["generate", "--scene", "table", *arguments, "--out", str(tmp_path / "out")]
    assert main(command) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert message in lines[0]
    assert not list(tmp_path.iterdir())
