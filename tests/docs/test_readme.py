"""The README's code prints what the README says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

README = (Path(__file__).resolve().parents[2] / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_code_of_the_readme_prints_what_it_says() -> None:
    episode, training = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    (said,) = re.findall(r"```text\n(.*?)```", README, re.DOTALL)
    short = training.replace("learn(1024)", "learn(256)").replace("range(100)", "range(2)")
    code = f"{episode}\n{short}\nprint(model.num_timesteps, env.action_space.contains(0), reward)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    mapped_and_error, after = done.stdout.strip().splitlines()
    assert mapped_and_error == said.strip()
    assert re.fullmatch(r"256 True -?\d+\.\d+.*", after)
