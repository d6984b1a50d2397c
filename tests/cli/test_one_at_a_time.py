"""Two processes with one folder of results: the second one says so at once, and changes nothing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ms_slam_env.cli import main

HOLD = """
import sys
from pathlib import Path
from ms_slam_env._runtime.result_folders import alone_in, lock_beside
out = Path(sys.argv[1])
with alone_in(out), alone_in(out, lock_beside(out)):
    print("held", flush=True)
    sys.stdin.read()
"""
SIZE = ["--image-size", "80x60"]
COMMANDS = {
    "run": ["run", "living_room:1000", *SIZE],
    "divergence": ["divergence", "living_room:1000", *SIZE],
    "generate": ["generate", "--scene", "table", "--path.frames", "2", *SIZE],
    "benchmark": ["benchmark", "--planners", "stationary", "--scenes", "table"],
    "compare": ["compare", "--sequences", "living_room:1000"],
    "experiment": ["experiment", "step_size"],
    "explore": ["explore", "--sequences", "table:1", "--trials", "1"],
    "train sb3": ["train", "sb3"],
    "train ppo": ["train", "ppo"],
    "train imitation": ["train", "imitation"],
}


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, int]]:
    """A folder, and the number of the process that has it to itself."""
    out = tmp_path_factory.mktemp("held") / "out"
    words = [sys.executable, "-c", HOLD, str(out)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **pipes) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield out, process.pid
        process.kill()


@pytest.mark.parametrize("name", COMMANDS)
def test_the_second_is_refused(
    held: tuple[Path, int], capsys: pytest.CaptureFixture[str], name: str
) -> None:
    if name.startswith("train"):
        pytest.importorskip("stable_baselines3", reason="needs the extra train")
    out, number = held
    files = sorted(out.parent.rglob("*"))
    assert main([*COMMANDS[name], "--out", str(out)]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert f"error: {out} is in use by process {number}: " in last
    assert sorted(out.parent.rglob("*")) == files


def test_a_dataset_is_recorded_once(
    held: tuple[Path, int], capsys: pytest.CaptureFixture[str]
) -> None:
    """Its folder of datasets is shared with others of other names."""
    pytest.importorskip("pyarrow", reason="needs the extra record")
    out, _ = held
    words = ["record", "--format", "lerobot", "--out", str(out.parent), "--planner", "stationary"]
    name = f"{out.name}-v0"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(out.with_name(name))],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as other:  # fmt: skip
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        assert main([*words, "--name", name]) == 2
        other.kill()
    assert f"{name} is in use by process {other.pid}: " in capsys.readouterr().err
