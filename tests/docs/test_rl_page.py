"""The examples of the page on RL code run, one after the other."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from ms_slam_env.env.wrappers import RecordVideo
from ms_slam_env.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = re.findall(
    r"^## (.*?)$|^```python\n(.*?)^```", (ROOT / "docs/rl.md").read_text(), re.MULTILINE | re.DOTALL
)
SMALL = f"OPTIONS = {dict(scene='table', scene_seed=0, image_size='80x60', observation='features')}"


def test_the_examples_run(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("torch", "sb3_contrib", "stable_baselines3"):
        pytest.importorskip(name)
    monkeypatch.chdir(ROOT)
    sources = [source for _, source in BLOCKS if source]
    assert len(sources) == 8
    names: dict[str, Any] = {}
    for source in sources:
        small = re.sub(r"^OPTIONS = .*$", SMALL, source, flags=re.MULTILINE)
        exec(compile(small, "docs/rl.md", "exec"), names)
    assert len(names["best"]) == 4


def test_a_film_without_moviepy_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    env = gym.make("MSActiveSLAM-FreeCamera-v0", render_mode="rgb_array")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"^recording videos needs MoviePy: pip install 'ms-sl[^\n]*$"
    ):
        RecordVideo(env, "films")
