"""Options of a task: from its YAML file, before those of the command line."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from ms_slam_agents import (
    environments,
    imitation,
    options,
    ppo,
    qrdqn,
    resume,
    train_sb3,
    trainers,
)

from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.reward import RewardConfig
from ms_slam_env.errors import InputError
from ms_slam_env.tasks import OWN, env_id_of

TRAINERS = {
    "ppo": ppo.Args,
    "imitation": imitation.Args,
    "sb3": train_sb3.Args,
    "qrdqn": qrdqn.Args,
}
NAMES = sorted(path.stem for path in options.TASKS.glob("*.yaml"))


def parsed(words, trainer="ppo"):
    cls = TRAINERS[trainer]
    return resume.parse_options(cls, words, "ms-slam train", trainer, cls.algorithms)


def test_every_task_of_the_benchmark_has_a_file():
    assert set(OWN) <= set(NAMES)


@pytest.mark.parametrize("trainer", TRAINERS)
@pytest.mark.parametrize("task", NAMES)
def test_every_file_is_read_by_every_trainer_and_is_about_its_task(task, trainer):
    args = parsed(["--task", task], trainer)
    own = OWN[task.removesuffix("-kinematic")]()
    assert args.env_id == env_id_of(task.removesuffix("-kinematic"))
    assert args.scenes == own.scenes
    assert args.task == task
    if task in OWN:
        assert args.episode_steps == own.steps
    else:
        assert environments.problem_options(args, "train")["arm"] == {"frames_per_action": 1}


@pytest.mark.parametrize("task", NAMES)
def test_the_environment_of_every_file_can_be_made(task):
    environments.check_problem(parsed(["--task", task]))


def test_the_command_line_counts_more():
    args = parsed(["--task=home", "--gamma", "0.5", "--scenes", "table"])
    assert (args.gamma, args.scenes, args.memory) == (0.5, ("table",), 128)
    assert parsed([]).gamma == ppo.Args().gamma
    assert parsed(["--task", "home"], "sb3").gamma == 0.99


def test_a_file_of_ones_own(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("problem: {scenes: [table]}\nppo: {gamma: 0.7}\nsb3: {gamma: 0.6}\n")
    assert parsed(["--task", str(path)]).gamma == 0.7
    args = parsed(["--task", str(path)], "sb3")
    assert (args.gamma, args.scenes, args.hidden) == (0.6, ("table",), train_sb3.Args().hidden)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ppo: {gama: 0.7}", "unknown option of PpoArgs 'gama'; valid choices"),
        ("ppo: {gamma: 7}", "gamma"),
        ("ppo: {gamma: high}", "gamma"),
        ("problem: {scenes: 3}", "scenes"),
        ("problem: {without: 3}", "without = 3 must be a list of terms"),
        ("problem: {without: null}", "without = None must be a list of terms"),
        ("problem: {without: lost}", "without = 'lost' must be a list of terms"),
        ("pro: {gamma: 0.7}", "'pro' must be one of problem, sb3, imitation, ppo"),
        ("ppo: 3", "'ppo' must be one of"),
        ("- ppo", "must be one of"),
        ("{", "not YAML"),
    ],
)
def test_what_a_file_cannot_say_is_one_line_with_its_name(tmp_path, text, said, capsys):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=f"mine.yaml: .*{said}"):
        parsed(["--task", str(path)])
    assert ppo.main(["--task", str(path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_extra_that_is_missing_is_named_once_the_options_are_right(
    tmp_path, capsys, monkeypatch
):
    def missing(name):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr("ms_slam_env._runtime.extension.import_module", missing)
    words = ["--out", str(tmp_path / "out")]
    assert trainers.ppo([*words, "--typo"]) == 2
    assert "Unrecognized options: --typo" in capsys.readouterr().err
    assert trainers.ppo(words) == 2
    assert "No module named 'torch'; pip install 'ms-slam-env[train]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_file_may_name_files(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("ppo: {init: runs/first.safetensors, pull: 1, curriculum: stages.yaml}\n")
    args = parsed(["--task", str(path)])
    assert args.init == Path("runs/first.safetensors")
    assert args.curriculum == Path("stages.yaml")


def test_trainings_and_their_environments_meet_other_episodes():
    firsts = [environments.first_seed(seed, steps) for seed in range(40) for steps in (0, 1000)]
    assert np.diff(sorted(firsts)).min() > 1000  # environments at once
    assert max(firsts) < 2**30
    assert environments.first_seed(3) == environments.first_seed(3)


def test_an_environment_whose_process_has_ended_is_said_in_a_line():
    closed = []

    def close():
        closed.append(True)
        raise BrokenPipeError

    venv = SimpleNamespace(close=close)
    for error in (EOFError(), ConnectionResetError()):
        said = pytest.raises(RuntimeError, match="process of an environment")
        with said, environments.opened(venv):
            raise error
    with pytest.raises(KeyError), environments.opened(venv):
        raise KeyError
    assert len(closed) == 3


def test_an_unknown_task_lists_those_that_there_are():
    with pytest.raises(InputError, match=r"unknown task 'rooms'; valid choices: .*room"):
        parsed(["--task", "rooms"])


def test_frames_a_motion_are_the_arms_or_the_free_cameras():
    free = environments.problem_options(ppo.Args(frames_per_action=2), "train")
    assert free["frames_per_action"] == 2
    arm = ppo.Args(env_id="MSActiveSLAM-v0", frames_per_action=2)
    assert environments.problem_options(arm, "train")["arm"] == {"frames_per_action": 2}
    held = ppo.Args(embodiment="arm-kinematic", frames_per_action=3)
    env = gym.make(held.env_id, **environments.problem_options(held, "train"))
    assert env.unwrapped.config.arm.frames_per_action == 3
    assert math.isclose(env.unwrapped.config.step_m, 0.12)


def test_the_size_of_the_images_is_that_of_the_environments_and_no_part_of_the_policy():
    args = ppo.Args(image_size="64x48", scenes=("table",), scene_seeds=1)
    env = environments.make_env(args, "train", ())
    assert env.unwrapped.intrinsics.shape == (48, 64)
    assert "image_size" not in environments.env_options(args)
    assert environments.problem_options(ppo.Args(), "train").get("image_size") is None
    with pytest.raises(InputError, match="image size"):
        environments.check_problem(ppo.Args(image_size="64"))


def test_terms_of_the_reward_are_left_out_by_name():
    for reward in ("paper", "mapping", "default"):
        args = parsed(["--without", "intensity_divergence", "lost", "--reward", reward])
        whole = environments.make_env(replace(args, without=()), "train").unwrapped.config.reward
        weights = environments.make_env(args, "train").unwrapped.config.reward
        assert weights == replace(whole, intensity_divergence=0.0, lost=0.0)
    with pytest.raises(InputError, match=r"term of the reward 'los'.*lost_for_good"):
        parsed(["--without", "los"])


def test_a_run_keeps_the_terms_that_it_leaves_out(tmp_path):
    args = parsed(["--without", "lost"])
    resume.check_kept(tmp_path, {"without": ["lost"]}, args, ["without"])
    assert parsed(["--without", "lost", "blocked", "lost"]).without == ("blocked", "lost")
    with pytest.raises(InputError, match="trained with without"):
        resume.check_kept(tmp_path, {}, args, ["without"])


def test_the_parallel_environments_are_of_several_tasks_in_turn(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("problem: {scenes: [wall], episode_steps: 7}\nppo: {gamma: 0.5}\n")
    args = parsed(["--task", "room", "--also", "arm-kinematic", str(path), "--num-envs", "4"])
    worlds = [options.world_of(args, k) for k in range(4)]
    assert worlds[0] == worlds[3] == args
    arm = parsed(["--task", "arm-kinematic"])
    for name in options.WORLD:
        assert getattr(worlds[1], name) == getattr(arm, name)
    assert (worlds[1].observation, worlds[1].gamma) == (args.observation, args.gamma)
    assert (worlds[2].scenes, worlds[2].episode_steps, worlds[2].gamma) == (("wall",), 7, 0.98)
    held = environments.make_env(args, "train", environment=1).unwrapped
    assert held.simulation.embodiment_type is EMBODIMENTS["arm-kinematic"]
    assert held.config.arm.frames_per_action == 1
    # Validation is the problem itself, in whichever process.
    judged = environments.make_env(args, "validation", [1_000_000], environment=1).unwrapped
    assert judged.simulation.embodiment_type is EMBODIMENTS["free"]
    environments.check_problem(args)


def test_where_it_trains_is_said_and_the_further_tasks_can_be_left_out(capsys):
    environments.say_problem(parsed(["--task", "room"]))
    said = capsys.readouterr().out
    assert said == (
        "trains in MSActiveSLAM-Room-v0 (living_room, corridor, table, wall), reward mapping; and "
        "in MSActiveSLAM-Arm-v0 (window, table, wall, carpet), reward mapping, "
        "as --also arm-kinematic says\n"
    )
    alone = parsed(["--task", "room", "--num-envs", "1", "--also"])
    assert (alone.also, alone.num_envs) == ((), 1)
    environments.check_problem(alone)
    environments.say_problem(alone)
    assert capsys.readouterr().out.endswith("wall), reward mapping\n")


@pytest.mark.parametrize("words", [[], ["--reward", "paper"], ["--task", "room"]])
def test_the_reward_that_is_said_is_that_of_the_environment(words, capsys):
    args = parsed([*words, "--num-envs", "1", "--also"])
    environments.say_problem(args)
    name = capsys.readouterr().out.split("reward ")[1].strip()
    reward = environments.make_env(args, "train").unwrapped.config.reward
    assert reward == RewardConfig.named()[name]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["rooms"], "unknown task 'rooms'; valid choices: .*arm-kinematic"),
        (["other.yaml"], "task 'other.yaml' has other observations or actions"),
        (["unknown.yaml"], "unknown environment 'MSActiveSLAM-Nowhere-v0'"),
        (
            ["room", "arm", "arm-kinematic"],
            "4 tasks to train in, .*--num-envs 3 is too few",
        ),
    ],
)
def test_tasks_that_cannot_be_trained_in_together_are_refused(
    words, said, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("unknown.yaml").write_text("problem: {env_id: MSActiveSLAM-Nowhere-v0}\n")
    Path("other.yaml").write_text("problem: {env_id: MSActiveSLAM-FixedTranslation-v0}\n")
    args = ["--num-envs", "3", "--observation", "features", "--out", "out", "--also", *words]
    with pytest.raises(InputError, match=said):
        environments.check_problem(parsed(args))
    assert ppo.main(args) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not Path("out").exists()
