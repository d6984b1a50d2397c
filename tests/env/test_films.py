"""Films of episodes: what is on them, and what is missing without FFmpeg."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest

import ms_slam_env  # noqa: F401 -- registers
from ms_slam_env.env.wrappers import RecordVideo
from ms_slam_env.errors import InputError


class Colours(gym.Env):
    """Draws a picture of odd size and of one colour, brighter from step to step."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012
    render_mode = "rgb_array"
    action_space = observation_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.brightness = 40
        return 0, {}

    def step(self, action):
        self.brightness += 20
        return 0, 0.0, False, False, {}

    def render(self):
        return np.full((61, 83, 3), self.brightness, dtype=np.uint8)


def test_a_film_shows_every_step(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    env = RecordVideo(Colours(), str(tmp_path / "films"), episode_trigger=lambda _: True)
    for steps in (4, 2):
        env.reset()
        for _ in range(steps):
            env.step(0)
    env.close()
    assert [path.name for path in sorted((tmp_path / "films").iterdir())] == [
        "rl-video-episode-0.mp4",
        "rl-video-episode-1.mp4",
    ]
    for episode, steps in enumerate((4, 2)):
        film = tmp_path / "films" / f"rl-video-episode-{episode}.mp4"
        frames = iio.imread(film, plugin="FFMPEG")
        assert frames.shape == (steps + 1, 60, 82, 3)
        assert iio.immeta(film, plugin="FFMPEG")["fps"] == 5
        seen = frames.mean(axis=(1, 2, 3))
        np.testing.assert_allclose(seen, 40 + 20 * np.arange(steps + 1), atol=4)


def test_without_a_trigger_the_episodes_are_filmed_that_gymnasium_films(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    env = RecordVideo(Colours(), tmp_path / "films")
    for _ in range(10):
        env.reset()
        env.step(0)
    env.close()
    names = [path.stem.rpartition("-")[2] for path in (tmp_path / "films").iterdir()]
    assert sorted(names) == ["0", "1", "8"]
    filmed = [k for k in range(3001) if env.episode_trigger(k)]
    assert filmed == [*(k**3 for k in range(10)), 1000, 2000, 3000]


def test_what_is_missing_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"^recording videos needs imageio-ffmpeg: pip install 'ms-sl[^\n]*$"
    ):
        RecordVideo(Colours(), str(tmp_path / "films"))
