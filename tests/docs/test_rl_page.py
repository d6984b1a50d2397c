"""The examples of the page on RL code run, one after the other."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = re.findall(
    r"^```(\w*)\n(.*?)^```", (ROOT / "docs/rl.md").read_text(), re.MULTILINE | re.DOTALL
)
SMALL = f"OPTIONS = {dict(scene='table', scene_seed=0, image_size='80x60', observation='features')}"


def test_the_examples_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("torch", "sb3_contrib", "stable_baselines3", "imageio_ffmpeg"):
        pytest.importorskip(name)
    monkeypatch.chdir(tmp_path)
    assert {language for language, _ in BLOCKS} == {"python", "sh"}  # no other spelling of Python
    sources = [source for language, source in BLOCKS if language == "python"]
    assert len(sources) == 14
    names: dict[str, Any] = {}
    for source in sources:
        small = re.sub(r"^OPTIONS = .*$", SMALL, source, flags=re.MULTILINE)
        exec(compile(small, "docs/rl.md", "exec"), names)
    assert len(names["best"]) == 4
    assert 0 <= names["free"].unwrapped.simulation.travelled <= 1
    assert [path.name for path in Path("films").iterdir()] == ["rl-video-episode-0.mp4"]
    names["model"].save(tmp_path / "model.zip")
    env = names["gym"].make(names["ID"], **names["OPTIONS"])
    observation, info = env.reset(seed=0)
    planner = names["MySb3"](env.unwrapped, path=str(tmp_path / "model.zip"))
    assert info["action_mask"][planner.act(observation, info)]
