"""The viewer: everything of an episode is in the file, at every step, as Rerun itself reads it."""

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import gymnasium as gym
import pytest

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.cli import main
from ms_slam_env.env import make
from ms_slam_env.env.rerun_view import EpisodeView
from ms_slam_env.errors import InputError

pytest.importorskip("rerun")

STEPS = 3
ENTITIES = {
    *("world/camera", "world/camera/image/color", "world/estimate", "world/map", "depth"),
    *("world/path/true", "world/path/estimated", "world/candidates", "world/goal", "motion"),
    *("divergence/intensity", "divergence/depth", "divergence/intensity/maximum"),
    *("reward/new_surface", "error/ate_m", "error/pose_m", "mapped/share"),
}
FREE = "MSActiveSLAM-FreeCamera-v0"


def rows(path):
    """Entity to number of rows in a file; one is sent for each step."""
    tool = Path(sys.executable).with_name("rerun")
    done = subprocess.run([tool, "rrd", "print", path], capture_output=True, text=True, check=True)
    found = Counter()
    for count, entity in re.findall(r" with (\d+) rows \(.*?\) - /(\S+)", done.stdout):
        found[entity] += int(count)
    return found


def test_view_writes_every_step(tmp_path, capsys):
    path = tmp_path / "new" / "episode.rrd"
    words = ["view", "--planner", "nbv", "--scene", "table", "--steps", str(STEPS)]
    assert main([*words, "--options", "image_size=80x60", "--save", str(path)]) == 0
    assert f"rerun {path}" in capsys.readouterr().out
    found = rows(path)
    assert found.keys() >= ENTITIES
    for entity in ENTITIES - {"reward/new_surface"}:
        assert found[entity] == STEPS + 1, entity
    assert found["reward/new_surface"] == STEPS  # there is none at the start


@pytest.mark.slow
def test_the_arm_is_shown(tmp_path):
    path = tmp_path / "arm.rrd"
    words = ["view", "--planner", "greedy", "--env-id", "MSActiveSLAM-v0", "--scene", "table"]
    assert main([*words, "--steps", "1", "--save", str(path)]) == 0
    assert rows(path)["world/arm"] == 2


def test_render_mode_human_shows_each_episode_anew(tmp_path, monkeypatch):
    paths = iter([tmp_path / "first.rrd", tmp_path / "second.rrd"])
    made = []

    def to_file(env):
        made.append(EpisodeView(env, next(paths)))
        return made[-1]

    monkeypatch.setattr(make, "load_reference", lambda _: to_file)
    env = gym.make(FREE, scene="table", image_size="80x60", render_mode="human")
    env.reset(seed=0)
    env.step(14)
    env.reset(seed=1)
    assert env.render() is None
    env.close()
    assert [view.step for view in made] == [2, 1]
    assert rows(tmp_path / "first.rrd")["world/map"] == 2


def test_a_window_that_cannot_be_opened_is_one_line(monkeypatch):
    import rerun

    def fail(self, **options):
        raise RuntimeError("no display")

    monkeypatch.setattr(rerun.RecordingStream, "spawn", fail)
    monkeypatch.setenv("DISPLAY", ":0")
    env = gym.make(FREE, scene="table", image_size="80x60", render_mode="human")
    with pytest.raises(InputError, match="viewer cannot be opened: no display"):
        env.reset(seed=0)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_without_a_display_it_says_how_to_do_without(monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["view", "--scene", "table", "--steps", "1"]) == 2
    assert "no display: write a file with `ms-slam view --save" in capsys.readouterr().err


def test_without_rerun_it_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert (
        main(["view", "--scene", "table", "--steps", "1", "--save", str(tmp_path / "x.rrd")]) == 2
    )
    assert "pip install 'ms-slam-env[view]'" in capsys.readouterr().err
