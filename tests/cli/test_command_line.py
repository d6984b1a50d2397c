"""Exit codes and messages of ``ms-slam``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ms_slam_env._runtime.command_line import exit_code
from ms_slam_env._runtime.extension import ExtensionPoint
from ms_slam_env._runtime.progress import Bar
from ms_slam_env.benchmark import rows as harness_rows
from ms_slam_env.benchmark.planners import DETAILS, HEADLINE
from ms_slam_env.cli import COMMANDS, main
from ms_slam_env.cli.train import TRAINERS
from ms_slam_env.errors import InputError
from ms_slam_env.report.records import Row
from ms_slam_env.sequences import associate


def one_line(text: str) -> str:
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    return lines[0]


def test_an_unreadable_mesh_is_refused_before_any_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junk = tmp_path / "junk.glb"
    junk.write_text("junk")
    out = tmp_path / "out"
    assert main(["benchmark", "--scenes", str(junk), "--out", str(out)]) == 2
    assert f"mesh file '{junk}' cannot be read" in one_line(capsys.readouterr().err)
    assert not out.exists()


@pytest.mark.parametrize("arguments", [["--help"], ["-h"], ["--version"]])
def test_help_is_code_0(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 0
    assert capsys.readouterr().out


@pytest.mark.parametrize("command", ["benchmark", "evaluate"])
def test_help_of_commands(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    assert "--out" in capsys.readouterr().out


def test_the_help_of_training_lists_every_trainer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line each, also of a trainer of somebody else's that cannot be loaded."""
    names, found = (*TRAINERS.names(), "other"), ExtensionPoint.names
    monkeypatch.setattr(
        ExtensionPoint, "names", lambda point: names if point is TRAINERS else found(point)
    )
    with pytest.raises(SystemExit) as stop:
        main(["train", "--help"])
    assert stop.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    listed = dict(line.split(maxsplit=1) for line in lines[2 : 2 + len(names)])
    assert {"sb3", "imitation", "ppo", "qrdqn", "rllib"} <= set(listed) == set(names)
    assert listed["qrdqn"] == "Masked QR-DQN, off-policy, with n-step returns."
    assert listed["other"].startswith("(unknown trainer 'other'")
    assert all(len(text) > 20 for text in listed.values())
    assert any("--total-timesteps" in line for line in lines)  # those of the default follow


def test_no_command_is_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    usage = capsys.readouterr().err
    assert all(name in usage for name in COMMANDS)


def test_failed_episodes_are_code_1_and_stay_in_the_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = dict.fromkeys((*HEADLINE, *DETAILS), 0.5)
    curve = {"looks_at_steps": [0, 5], "f_score_5cm_over_steps": [0.0, 0.5]}
    finished = {"result": {**result, "ate_over_steps": [0.0, 0.1], **curve}, "error": None}
    monkeypatch.setattr(harness_rows, "run_all", made_up_rows(failed(), finished))
    assert main([*TWO_EPISODES, "--out", str(tmp_path)]) == 1
    assert "1 failed, the first: planner random, scene table, seed 2000" in capsys.readouterr().err
    content = json.loads((tmp_path / "results.json").read_text())
    assert [row["error"] for row in content["episodes"]] == ["boom", None]


def test_where_every_episode_failed_the_old_report_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "table.md").write_text("good")
    monkeypatch.setattr(harness_rows, "run_all", made_up_rows(failed(), failed()))
    assert main([*TWO_EPISODES, "--out", str(tmp_path)]) == 1
    assert "all 2 failed, the first: planner random, scene tab" in one_line(capsys.readouterr().err)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("table.md", "good")]


TWO_EPISODES = ["benchmark", "--planners", "random", "--scenes", "table", "--episodes", "2"]


def failed() -> dict[str, Any]:
    return {"result": None, "error": "boom"}


def made_up_rows(first: dict[str, Any], last: dict[str, Any]) -> Callable[..., list[Row]]:
    """A ``run_all`` that runs nothing."""

    def run_all(specs: list[Any], *_: object, **__: object) -> list[Row]:
        outcomes = [*[first] * (len(specs) - 1), last]
        return [
            {"key": f"k{i}", "spec": vars(spec), "commit": "c", **outcome}
            for i, (spec, outcome) in enumerate(zip(specs, outcomes, strict=True))
        ]

    return run_all


def test_association_is_mutual_and_within_the_limit() -> None:
    first, second = associate(
        np.array([0.0, 1.0, 1.01, 2.0, 5.0]), np.array([0.015, 1.004, 2.5]), 0.02
    )
    np.testing.assert_array_equal(first, [0, 1])
    np.testing.assert_array_equal(second, [0, 1])


def test_association_of_single_timestamps() -> None:
    first, second = associate(np.array([1.0]), np.array([1.0]), 0.0)
    assert (list(first), list(second)) == ([0], [0])


def test_the_message_stands_below_the_bars_that_an_error_left_open(capsys):
    bars = []

    def run():
        bars.append(Bar(total=9, desc="frames"))
        raise InputError("no")

    assert exit_code(run) == 2
    bars[0].close()
    assert capsys.readouterr().err.splitlines()[-1] == "ms-slam: error: no"


SLOW_WRITER = """
import sys
from ms_slam_env._runtime.command_line import exit_code
def run():
    for _ in range(100_000):
        print("a line", file=getattr(sys, sys.argv[1]), flush=True)
    return 0
sys.exit(exit_code(run))
"""


@pytest.mark.skipif(os.name != "posix", reason="needs a shell")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    ("line", "codes", "said"),
    [
        ("ms-slam --help | head -1", "", "usage: ms-slam COMMAND"),
        ("ms-slam run --help | true", "141 0", ""),
        ("ms-slam run --help 2>&1 | true", "141 0", ""),
        ('python -c "$WRITER" stdout | head -1', "141 0", "a line"),
        ('python -c "$WRITER" stderr 2>&1 >/dev/null | head -1', "141 0", "a line"),
        ("ms-slam run x --nope 2>&1 | true", "2 0", ""),
        ("ms-slam --help >&-", "0", ""),
        ("ms-slam run --help >&-", "0", ""),
        ("ms-slam run --help 2>&- <&- | cat", "0 0", "usage: ms-slam run"),
        ("ms-slam run x --nope >&- 2>&- <&-", "2", ""),
    ],
)
def test_an_output_that_is_closed_ends_a_command_quietly(
    line, codes, said, unbuffered, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    line = line.replace("ms-slam ", 'python -c "$MAIN" ', 1)
    places = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    code = "import sys; from ms_slam_env.cli import main; sys.exit(main())"
    done = subprocess.run(
        ["bash", "-c", f"{{ {line}; echo \"${{PIPESTATUS[@]}}\" >&3; }} 3>codes 2>errors"],
        capture_output=True,
        text=True,
        env={**os.environ, **places, "PYTHONUNBUFFERED": unbuffered, "MAIN": code,
             "WRITER": SLOW_WRITER},
    )  # fmt: skip
    # All of a short text may be in the pipe before its reader goes.
    assert Path("codes").read_text().strip() in ([codes] if codes else ["0 0", "141 0"])
    assert Path("errors").read_text() == ""
    assert said in done.stdout


def test_files_do_not_take_the_place_of_closed_streams(tmp_path) -> None:
    code = (
        "import os, sys; from ms_slam_env._runtime.command_line import exit_code;"
        "sys.exit(exit_code(lambda: 0 if open(sys.argv[1], 'w').fileno() > 2 else 1))"
    )
    line = f'exec {sys.executable} -c "$0" {tmp_path}/file >&- 2>&- <&-'
    assert subprocess.run(["bash", "-c", line, code]).returncode == 0
