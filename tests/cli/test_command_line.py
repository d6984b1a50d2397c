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
from ms_slam_env._runtime.progress import Bar
from ms_slam_env.benchmark import rows as harness_rows
from ms_slam_env.benchmark.planners import DETAILS, HEADLINE
from ms_slam_env.cli import COMMANDS, main
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.report.records import Row
from ms_slam_env.sequences import associate, write_trajectory


def one_line(text: str) -> str:
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    return lines[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "unknown command 'fly'; valid choices: benchmark, "),
        (["benchmark", "--planners", "nonsense"], "unknown planner 'nonsense'; valid choices:"),
        (["benchmark", "--scenes", "mars"], "unknown scene 'mars'; valid choices: living_room"),
        (["benchmark", "--scenes", "missing.glb"], "mesh file 'missing.glb' does not exist"),
        (["benchmark", "--options", "slam=orb"], "unknown SLAM backend 'orb'; valid choices:"),
        (["benchmark", "--options", "foo=1"], "unknown option of the environment 'foo'"),
        (["benchmark", "--options", "slam_config.foo=1"], "SurfelConfig 'slam_config.foo'; valid"),
        (["benchmark", "--planners", "policy,path=none.zip"], "no policy file 'none.zip'"),
        (["benchmark", "--planners", "greedy,rho_I=x"], "rho_I = 'x' is outside"),
        (["benchmark", "--planners", "greedy,foo=1"], "'foo'; valid choices: preset, rho_I"),
        (["benchmark", "--planners", ":Greedy"], "planner ':Greedy' cannot be loaded"),
        (["benchmark", "--planners", "greedy,rho_I=["], "'[' is not a YAML value"),
        (["benchmark", "--options", "steps=["], "'[' is not a YAML value"),
        (["benchmark", "--stps", "3"], "Unrecognized options: --stps"),
        (["benchmark", "--planner", "greedy"], "perhaps you meant --planners"),
        (["benchmark", "--steps", "0"], "error: steps = 0 is outside"),
        (["benchmark", "--step-m", "-1"], "error: step_m = -1.0 is outside"),
        (["benchmark", "--steps", "three"], "--steps"),
        (["benchmark", "--seeds", "exam"], "valid choices: train, validation, test"),
        (["benchmark", "--env-id", "CartPole-v1"], "unknown env_id 'CartPole-v1'; valid"),
        (
            ["benchmark", "--env-id", "MSActiveSLAM-Adaptive-v0"],
            "chooses motions only, MSActiveSLAM-Adaptive-v0 asks for a SLAM configuration too",
        ),
        (["benchmark", "--workers", "0", "--planners", "random"], "workers = 0"),
        (["evaluate"], "Missing"),
        (["evaluate", "missing.txt", "missing.txt"], "cannot read trajectory missing.txt"),
        (["train", "nonsense"], "unknown trainer 'nonsense'; valid choices: imitation, ppo"),
    ],
)
def test_bad_input_is_one_line_and_code_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    if arguments[0] == "benchmark":
        arguments = [*arguments, "--out", str(tmp_path)]
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in one_line(captured.err)
    assert not list(tmp_path.iterdir())


def test_an_unreadable_mesh_is_refused_before_any_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junk = tmp_path / "junk.glb"
    junk.write_text("junk")
    out = tmp_path / "out"
    assert main(["benchmark", "--scenes", str(junk), "--out", str(out)]) == 2
    assert f"mesh file '{junk}' cannot be read" in one_line(capsys.readouterr().err)
    assert not out.exists()


def test_a_folder_that_cannot_be_made_is_one_line_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    out = ["--out", str(tmp_path / "file" / "below")]
    estimate, truth = write_pair(tmp_path)
    for command in (TWO_EPISODES, ["evaluate", str(estimate), str(truth)]):
        assert main([*command, *out]) == 2
        assert "file is a file; a folder is needed" in one_line(capsys.readouterr().err)


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


def test_no_command_is_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    usage = capsys.readouterr().err
    assert all(name in usage for name in COMMANDS)


def test_the_installed_command_says_one_line(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-c",
        "import sys; from ms_slam_env.cli import main; sys.exit(main())",
    ]
    done = subprocess.run(
        [*command, "benchmark", "--planners", "nonsense"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "unknown planner" in one_line(done.stderr)


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


def write_pair(folder: Path, shift_s: float = 0.0) -> tuple[Path, Path]:
    """A wavy trajectory, and the same moved rigidly with one position off by 3 cm."""
    t = np.linspace(0, 3, 31)
    truth = np.stack([make_pose(so3_exp([0, 0, 0.3 * x]), [x, np.sin(x), 0.1 * x**2]) for x in t])
    moved = make_pose(so3_exp([0.1, 0.2, 0.3]), [1, 2, 3]) @ truth
    moved[10, :3, 3] += [0.03, 0, 0]
    estimate, groundtruth = folder / "estimate.txt", folder / "truth.txt"
    write_trajectory(estimate, t + shift_s, moved)
    write_trajectory(groundtruth, t, truth)
    return estimate, groundtruth


def test_evaluate_agrees_with_evo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core import sync
    from evo.tools import file_interface

    estimate, truth = write_pair(tmp_path, shift_s=0.004)
    assert main(["evaluate", str(estimate), str(truth), "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "evaluation.json").read_text())
    assert result["poses"] == 31
    assert f"{result['ate_m']:.6f}" in capsys.readouterr().out

    reference, other = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(str(truth)),
        file_interface.read_tum_trajectory_file(str(estimate)),
        max_diff=0.02,
    )
    rpe = metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames)
    rpe.process_data((reference, other))
    other.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, other))
    for name in ("rmse", "mean", "median", "max"):
        statistic = metrics.StatisticsType(name)
        infix = "" if name == "rmse" else f"_{name}"
        assert result[f"ate{infix}_m"] == pytest.approx(ape.get_statistic(statistic), abs=1e-9)
        assert result[f"rpe{infix}_m"] == pytest.approx(rpe.get_statistic(statistic), abs=1e-9)


def test_evaluate_refuses_trajectories_of_other_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate, truth = write_pair(tmp_path, shift_s=100)
    assert main(["evaluate", str(estimate), str(truth)]) == 2
    assert "0 timestamps in common" in one_line(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("option", "value"), [("--align", "affine"), ("--delta", "0"), ("--max-difference-s", "-1")]
)
def test_evaluate_refuses_bad_options(
    tmp_path: Path, option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate, truth = write_pair(tmp_path)
    assert main(["evaluate", str(estimate), str(truth), option, value]) == 2
    one_line(capsys.readouterr().err)


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
