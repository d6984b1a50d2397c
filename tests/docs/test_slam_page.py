"""The live loop of the page on SLAM runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs/slam.md"


def test_the_live_loop_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    section = PAGE.read_text(encoding="utf-8").partition("## A live camera")[2]
    source = re.findall(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)[0]
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(source, "docs/slam.md", "exec"), names)
    said = capsys.readouterr().out.splitlines()
    assert sum("standard deviation" in line for line in said) == 39  # the first has none
    assert not any(line.startswith("lost") for line in said)
    assert said[-1] == "True"
