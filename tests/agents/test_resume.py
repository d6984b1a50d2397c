"""What the file of a run may say when it is resumed: a stranger may have written it."""

from __future__ import annotations

import json
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from learnable_fake import read_curve, words_of
from ms_slam_agents import imitation, learning_curve, ppo, qrdqn, resume, train_sb3
from ms_slam_agents.policy_file import read_policy
from policy_files import METADATA, as_bytes

from ms_slam_env.report.records import to_plain

TRAINERS = {
    "sb3": (train_sb3, "maskable_ppo"),
    "ppo": (ppo, "masked_ppo"),
    "qrdqn": (qrdqn, "qr_dqn"),
    "imitation": (imitation, "imitation"),
}
try:
    from ms_slam_agents import train_rllib

    TRAINERS["rllib"] = (train_rllib, "rllib_ppo")
except ImportError:
    pass

MODULE = "open('sprung', 'w').write('run')\n"
ALSO = "problem: {scenes: ['stranger:make'], env_id: 'stranger:Env-v0'}\n"
STAGES = "- {scenes: ['stranger:make']}\n"
SAID_BY_FILES = {
    "scenes": ["table", "stranger:make"],
    "env_id": "stranger:Env-v0",
    "embodiment": "stranger:Robot",
    "observation": "stranger:Seen",
    "reward": "stranger:reward",
    "task": "also.yaml",
    "also": ["arm-kinematic", "also.yaml"],
    "curriculum": "stages.yaml",
    "init": "other.safetensors",
    "through": "stranger:Planner",
    "teacher": "stranger:Planner",
    "address": "ray://stranger:10001",
    "image_size": "stranger:80x60",
    "without": ["stranger:lost"],
    "algorithm": "stranger:PPO",
}
MORE = {
    "scenes": ["scan.glb"],
    "through": "agent-home,path=other.safetensors",
    "teacher": "policy,path=other.safetensors",
    "also": ["../also.yaml"],
    "task": "/etc/passwd",
    "embodiment": {"name": "stranger:Robot"},
}


def write_run(trainer: str, **options: object) -> None:
    """A run in the folder ``run``, of a trainer's default options and others."""
    module, algorithm = TRAINERS[trainer]
    saved = to_plain(asdict(module.Args())) | options
    known = replace(METADATA, algorithm=algorithm, options=saved)
    Path("run").mkdir(exist_ok=True)
    Path("run/latest.safetensors").write_bytes(as_bytes(json.dumps(to_plain(known))))


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("stranger.py").write_text(MODULE)
    Path("also.yaml").write_text(ALSO)
    Path("stages.yaml").write_text(STAGES)
    Path("other.safetensors").write_bytes(as_bytes())


CASES = [
    (trainer, name, value)
    for trainer, (module, _) in TRAINERS.items()
    for said in (SAID_BY_FILES, MORE)
    for name, value in said.items()
    if name in {field.name for field in fields(module.Args)}
]


@pytest.mark.parametrize(("trainer", "name", "value"), CASES)
def test_no_file_of_a_run_leads_to_a_module_a_file_or_an_address(
    trainer, name, value, stranger, capsys
):
    write_run(trainer, **{name: value})
    assert TRAINERS[trainer][0].main(["--out", "run", "--resume"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"option {name} = " in error
    assert f"give --{name.replace('_', '-')} again" in error
    assert not Path("sprung").exists()


def test_no_option_takes_text_from_a_file_unless_it_is_named_here():
    """A text option that is added later must be given again, until somebody says what it may be."""
    known = set(resume._NAMES) | {"out"}
    for module, _ in TRAINERS.values():
        for field in fields(module.Args):
            if field.name not in known:
                assert not resume._may_say(field.name, "text")
                assert not resume._may_say(field.name, ["text"])


@pytest.mark.parametrize("trainer", TRAINERS)
def test_numbers_and_installed_names_are_as_they_were(trainer, stranger):
    module, algorithm = TRAINERS[trainer]
    own = {"scenes": ["table"], "gamma": 0.5, "step_m": 0.2, "task": "room", "reward": "paper"}
    if trainer != "imitation":
        own |= {"also": ["arm-kinematic"], "num_envs": 3}
    write_run(trainer, **own)
    words = ["--out", "run", "--resume", "--gamma", "0.25", "--batch-size", "64"]
    args = resume.parse_options(module.Args, words, "train", trainer, [algorithm])
    assert (args.scenes, args.gamma, args.step_m) == (("table",), 0.25, 0.2)
    assert (args.task, args.reward, args.batch_size) == ("room", "paper", 64)
    assert to_plain(asdict(args)) == to_plain(asdict(module.Args())) | own | {
        **{"gamma": 0.25, "batch_size": 64, "out": "run", "resume": True}
    }


def test_what_the_command_line_says_again_is_used(stranger):
    write_run("ppo", init="other.safetensors", pull=1.0, also=["also.yaml"], num_envs=2)
    words = ["--out=run", "--resume", "--init", "other.safetensors", "--also"]
    args = resume.parse_options(ppo.Args, words, "train", "ppo", ["masked_ppo"])
    assert (args.init, args.also, args.pull) == (Path("other.safetensors"), (), 1.0)
    words[-1:] = ["--also", "room"]
    args = resume.parse_options(ppo.Args, words, "train", "ppo", ["masked_ppo"])
    assert args.also == ("room",)


def test_what_the_task_of_the_command_line_names_counts_as_said(stranger):
    Path("mine.yaml").write_text("ppo: {curriculum: stages.yaml}\n")
    write_run("ppo", task="mine.yaml", curriculum="stages.yaml", gamma=0.5)
    words = ["--out", "run", "--resume", "--task", "mine.yaml"]
    args = resume.parse_options(ppo.Args, words, "train", "ppo", ["masked_ppo"])
    assert (args.curriculum, args.gamma) == (Path("stages.yaml"), 0.5)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"step_m": -1}, "step_m = -1 is outside"),
        ({"hidden": 1e9}, "hidden"),
        ({"num_envs": "2"}, "num_envs"),
        ({"scenes": 3}, "scenes"),
        ({"nope": 1}, "unknown option of PpoArgs 'nope'"),
        ({"scenes": [["table"]]}, "scenes"),
    ],
)
def test_options_that_no_run_has_are_one_line_with_its_name(options, said, stranger, capsys):
    write_run("ppo", **options)
    assert ppo.main(["--out", "run", "--resume"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "run/latest.safetensors: " in error
    assert said in error


def test_a_run_of_another_trainer_is_refused(stranger, capsys):
    write_run("qrdqn")
    assert ppo.main(["--out", "run", "--resume"]) == 2
    assert "is of qr_dqn, not of masked_ppo" in capsys.readouterr().err


# -- A run that was killed ---------------------------------------------------------------------


class Killed(BaseException):
    """Ends a run as a kill does: nothing is written any more."""


def points(out):
    return [(p["timesteps"], p["return"]) for p in read_curve(out).points]


LEARNS = {
    "sb3": {"n_steps": 16, "n_epochs": 2},
    "ppo": {"n_steps": 16, "n_epochs": 2, "memory": 4},
    "qrdqn": {"save_every": 16, "learning_starts": 16, "train_every": 1},
}


def train(trainer, out):
    judged = {"total_timesteps": 64, "eval_every": 32, "eval_episodes": 3}
    more = words_of(out, ["--no-references"], **judged | LEARNS[trainer])
    return TRAINERS[trainer][0].main(more)


@pytest.fixture(scope="module", params=LEARNS)
def whole(request, tmp_path_factory):
    """A trainer, and the folder of a run of it that nothing interrupted."""
    out = tmp_path_factory.mktemp(request.param)
    assert train(request.param, out) == 0
    assert [steps for steps, _ in points(out)] == [0, 32, 64]
    return request.param, out


def test_two_runs_of_one_seed_are_one(whole, tmp_path):
    trainer, out = whole
    assert train(trainer, tmp_path) == 0
    assert points(tmp_path) == points(out)
    a, b = (read_policy(path / "latest.safetensors").tensors for path in (out, tmp_path))
    for name, value in a.items():
        np.testing.assert_array_equal(b[name], value, err_msg=name)


@pytest.mark.parametrize("at", [0, 1, 2])
def test_a_point_that_a_kill_prevented_is_made_up(whole, at, tmp_path, monkeypatch):
    """Killed between saving and evaluating: at first, in the midst, and at the end."""
    trainer, out = whole
    played = learning_curve.evaluate_policy
    with monkeypatch.context() as patched:
        left = [played] * at

        def play(*args):
            if not left:
                raise Killed
            return left.pop()(*args)

        patched.setattr(learning_curve, "evaluate_policy", play)
        with pytest.raises(Killed):
            train(trainer, tmp_path)
    again = ["--out", str(tmp_path), "--resume"]
    assert TRAINERS[trainer][0].main(again) == 0
    assert [steps for steps, _ in points(tmp_path)] == [0, 32, 64]
    assert points(tmp_path)[: at + 1] == points(out)[: at + 1]
    assert TRAINERS[trainer][0].main(again) == 2  # all is there


def test_a_round_that_is_judged_twice_has_one_point():
    curve = learning_curve.Curve(1)
    for steps in (10, 20, 20):
        curve.add(steps, 1.0, {"return": float(len(curve.points))})
    assert [(p["timesteps"], p["return"]) for p in curve.points] == [(10, 0.0), (20, 2.0)]
