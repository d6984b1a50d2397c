"""The training script end to end on a small fake environment that can be learnt."""

import os
import signal
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("sb3_contrib")

from learnable_fake import ENV_ID, LearnableFake, arguments, read_curve
from ms_slam_agents import environments, evaluation, learning_curve, supervisor, train_sb3
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import read_policy, write_policy
from ms_slam_agents.sb3_state import tensors_of, whole_batches
from scipy.stats import sem
from stable_baselines3.common.vec_env import DummyVecEnv

from ms_slam_env.report.results import read_results


@pytest.fixture(scope="module", params=["maskable_ppo", "ppo"])
def run(request, tmp_path_factory):
    out = tmp_path_factory.mktemp(request.param)
    LearnableFake.log.clear()
    assert train_sb3.main(arguments(out, algorithm=request.param)) == 0
    log = [permitted for split, permitted in LearnableFake.log if split == "train"]
    return SimpleNamespace(out=out, algorithm=request.param, train_log=log)


def test_trains_for_the_steps_asked(run):
    metadata = read_policy(run.out / "latest.safetensors").metadata
    assert metadata.timesteps == 64 == len(run.train_log)
    assert metadata.epochs == 4  # two updates of two passes
    assert (metadata.algorithm, metadata.observation) == (run.algorithm, "features")
    assert metadata.provenance["command"]
    assert list((run.out / "tensorboard").rglob("events*"))
    assert not list(run.out.glob("*.partial*"))


def test_only_the_masked_variant_never_tries_a_blocked_action(run):
    assert all(run.train_log) == (run.algorithm == "maskable_ppo")


def test_learning_curve_is_well_formed(run):
    curve = read_curve(run.out)
    assert [point["timesteps"] for point in curve.points] == [0, 32, 64]
    assert (run.out / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    references = curve.references
    assert references["greedy"]["return"] == 10  # the fake's lookahead gives the answer away
    assert 0 < references["random walk"]["return"] < 10
    for point in curve.points:
        gain = point["return"] - references["random walk"]["return"]
        assert point["return_gain"] == pytest.approx(gain)
        assert point["steps"] == 10
        assert point["terminated"] == point["lost_steps_share"] == 0


def test_the_curve_is_a_result_like_all_others(run):
    results = read_results(run.out / "results.json")
    assert results.kind == "train"
    assert (run.out / "table.md").read_text() == results.as_markdown()
    policy, references = results.tables
    assert [row["timesteps"] for row in policy.rows] == [0, 32, 64]
    assert [row["planner"] for row in references.rows] == ["random walk", "stationary", "greedy"]


def test_paired_gain_against_scipy():
    returns, reference = np.random.default_rng(0).normal(size=(2, 9))
    gain = evaluation.paired_gain(list(returns), list(reference))
    assert gain["return_gain"] == pytest.approx(np.mean(returns - reference))
    assert gain["return_gain_sem"] == pytest.approx(sem(returns - reference))


def played(num_envs, choose, seeds=(5, 6, 7, 8, 9)):
    """Returns of episodes dealt out to so many environments."""
    args = train_sb3.Args(env_id=ENV_ID, episode_steps=10, num_envs=1)
    shares = [list(seeds)[rank::num_envs] for rank in range(num_envs)]
    makers = [
        lambda share=share: environments.make_env(args, "validation", share) for share in shares
    ]
    return evaluation.evaluate(DummyVecEnv(makers), len(seeds), choose)["returns"]


@pytest.mark.parametrize("num_envs", [1, 2, 3])
def test_returns_come_in_the_order_of_the_seeds(num_envs):
    """However the episodes are dealt out: standing still, against playing one by one."""
    expected = []
    for seed in (5, 6, 7, 8, 9):
        env = LearnableFake()
        env.reset(seed=seed)
        expected.append(sum(env.step(0)[1] for _ in range(10)))
    assert played(num_envs, lambda _, masks, *__: np.zeros(len(masks), dtype=np.int64)) == expected


def test_what_an_episode_draws_depends_on_its_seed_alone():
    def random(_, masks, rngs, __):
        return evaluation.sample(masks / masks.sum(axis=1, keepdims=True), rngs)

    first = played(1, random)
    assert len(set(first)) > 1
    assert played(2, random) == played(3, random) == first
    assert played(2, random, (9, 7, 5)) == [first[4], first[2], first[0]]


def copy_of(run, out):
    for name in ("latest.safetensors", "results.json"):
        (out / name).write_bytes((run.out / name).read_bytes())
    return out


def test_resume_continues_the_count_and_the_curve(run, tmp_path):
    more = arguments(copy_of(run, tmp_path), "--resume", steps=128, algorithm=run.algorithm)
    assert train_sb3.main(more) == 0
    file = read_policy(tmp_path / "latest.safetensors")
    assert (file.metadata.timesteps, file.metadata.epochs) == (128, 8)
    assert file.tensors["observation.count"] == pytest.approx(128, abs=4)  # two resets
    assert file.tensors["optimizer.step"] == 16  # of 16 samples each
    before, after = read_curve(run.out), read_curve(tmp_path)
    assert after.points[:3] == before.points
    assert [point["timesteps"] for point in after.points] == [0, 32, 64, 96, 128]
    minutes = [point["training_min"] for point in after.points]
    assert minutes == sorted(minutes)


def test_a_resumed_run_keeps_the_options_that_are_not_given(run, tmp_path, capsys):
    words = ("--out", str(copy_of(run, tmp_path)), "--resume", "--total-timesteps", "96")
    assert train_sb3.main([*words, "--n-steps", "16"]) == 0
    said = capsys.readouterr().out
    assert "n_steps is 16 from now on, 32 so far" in said
    assert "total_timesteps is 96 from now on, 64 so far" in said
    assert "batch_size" not in said
    metadata = read_policy(tmp_path / "latest.safetensors").metadata
    assert (metadata.timesteps, metadata.epochs) == (96, 8)  # two updates more
    assert (metadata.options["n_steps"], metadata.options["batch_size"]) == (16, 16)
    assert metadata.options["env_id"] == ENV_ID


def test_the_return_rises_above_random_walk(tmp_path):
    more = ("--learning-rate", "0.003", "--n-epochs", "8", "--eval-every", "0")
    assert train_sb3.main([*arguments(tmp_path, steps=768), *more]) == 0
    curve = read_curve(tmp_path)
    first, last = curve.points
    assert last["return"] > 1.5 * curve.references["random walk"]["return"]
    assert last["return"] > first["return"]
    assert read_policy(tmp_path / "best.safetensors").metadata.timesteps == 768


def test_interrupt_saves_and_says_so(tmp_path, monkeypatch, capsys):
    number = signal.SIGTERM
    step = LearnableFake.step

    def step_and_interrupt(self, action):
        if self.split == "train" and len(steps_seen) == 40:
            os.kill(os.getpid(), number)
        if self.split == "train":
            steps_seen.append(action)
        return step(self, action)

    steps_seen = []
    monkeypatch.setattr(LearnableFake, "step", step_and_interrupt)
    before = signal.getsignal(number)
    assert train_sb3.main(arguments(tmp_path, steps=1000)) == 128 + number
    assert signal.getsignal(number) is before
    metadata = read_policy(tmp_path / "latest.safetensors").metadata
    assert (metadata.timesteps, metadata.epochs) == (41, 2)
    assert "the last 8 steps, less than a batch, are not in it" in capsys.readouterr().out


def end_after(steps, monkeypatch):
    """Let the clock of ``--minutes 1`` be over after so many steps."""
    monkeypatch.setattr(
        supervisor.Supervisor, "minutes", property(lambda self: float(self.num_timesteps >= steps))
    )


def test_time_that_ends_in_a_rollout_lets_the_network_learn_from_it(tmp_path, monkeypatch, capsys):
    """Bit-equal to a run whose rollout ends there."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert train_sb3.main([*arguments(whole, steps=19), "--n-steps", "19"]) == 0
    end_after(20, monkeypatch)  # the step at which the clock is read is lost
    assert train_sb3.main([*arguments(cut, steps=10**6), "--minutes", "1"]) == 0
    assert "time is up: 20 steps" in capsys.readouterr().out
    expected, found = (read_policy(out / "latest.safetensors") for out in (whole, cut))
    assert found.metadata.epochs == 2
    assert found.part("policy").keys() == expected.part("policy").keys()
    for name, value in expected.part("policy").items():
        np.testing.assert_array_equal(found.part("policy")[name], value)
    assert [point["timesteps"] for point in read_curve(cut).points] == [0, 20]
    assert read_policy(cut / "best.safetensors").metadata.timesteps == 20


def test_a_run_without_an_update_fails_and_leaves_no_best_policy(tmp_path, monkeypatch, capsys):
    end_after(10, monkeypatch)
    assert train_sb3.main([*arguments(tmp_path, steps=10**6), "--minutes", "1"]) == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "nothing was learnt: 9 steps are less than a batch of 16; give more --minutes" in error
    assert not (tmp_path / "best.safetensors").exists()
    assert read_policy(tmp_path / "latest.safetensors").metadata.epochs == 0
    monkeypatch.undo()
    assert train_sb3.main([*arguments(tmp_path, "--resume", steps=42)]) == 0
    assert read_policy(tmp_path / "latest.safetensors").metadata.timesteps == 42


@pytest.mark.parametrize("algorithm", ["maskable_ppo", "ppo"])
def test_a_rollout_of_one_sample_more_than_a_batch_leaves_numbers(tmp_path, monkeypatch, algorithm):
    """sb3-contrib divides by the spread of a batch, which one sample has not."""
    end_after(18, monkeypatch)
    words = arguments(tmp_path, "--no-references", steps=10**6, algorithm=algorithm)
    assert train_sb3.main([*words, "--minutes", "1"]) == 0
    assert read_policy(tmp_path / "latest.safetensors").metadata.epochs == 2
    monkeypatch.undo()
    assert train_sb3.main([*words, "--total-timesteps", "35", "--resume"]) == 0


@pytest.mark.parametrize("batch_size", [2, 3, 16, 200])
def test_no_batch_is_a_single_sample(batch_size):
    for samples in range(2, 150):
        found = whole_batches(samples, batch_size)
        assert min(batch_size, samples) <= found <= samples
        assert samples % found != 1


def test_a_budget_below_a_rollout_shrinks_it(tmp_path):
    assert train_sb3.main(arguments(tmp_path, steps=12)) == 0
    metadata = read_policy(tmp_path / "latest.safetensors").metadata
    assert (metadata.timesteps, metadata.epochs) == (12, 2)


def test_evaluations_are_no_training_time(tmp_path, monkeypatch):
    late = [0.0]

    def slow(*arguments):
        late[0] += 3600.0
        return evaluation.evaluate_policy(*arguments)

    monkeypatch.setattr(learning_curve, "evaluate_policy", slow)
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + late[0])
    monkeypatch.setattr(supervisor, "time", clock)
    assert train_sb3.main([*arguments(tmp_path), "--minutes", "20"]) == 0
    assert late[0] == 3 * 3600
    assert 0 < read_policy(tmp_path / "latest.safetensors").metadata.minutes < 20
    assert read_curve(tmp_path).points[-1]["training_min"] < 20


def test_references_can_be_left_out(tmp_path, capsys):
    assert train_sb3.main(arguments(tmp_path, "--no-references", steps=32)) == 0
    captured = capsys.readouterr()
    assert "reference" not in captured.err
    assert "validation return" in captured.out + captured.err
    curve = read_curve(tmp_path)
    assert curve.references == {}
    assert "return_gain" not in curve.points[0]
    assert "random walk" not in (tmp_path / "table.md").read_text()


@pytest.mark.parametrize(
    ("more", "ends"), [((), "training: 64 of 64"), (("--minutes", "0.02"), "training: 1 of 1")]
)
def test_bars_count_reference_episodes_then_steps_or_seconds(tmp_path, capsys, more, ends):
    steps = 10**6 if more else 64
    assert train_sb3.main([*arguments(tmp_path, steps=steps), *more]) == 0
    shown = capsys.readouterr().err
    episodes = read_curve(tmp_path).episodes
    assert f"{3 * episodes} of {3 * episodes}" in shown
    assert "reference: greedy" in shown
    assert ends in shown.splitlines()[-1]


DQN = ("--learning-starts", "64", "--train-every", "1", "--target-every", "50", "--save-every", "9")


def test_dqn_learns_and_goes_on_where_it_was(tmp_path):
    words = [*arguments(tmp_path, steps=1200, algorithm="dqn"), *DQN, "--learning-rate", "0.003"]
    assert train_sb3.main([*words, "--eval-every", "400"]) == 0
    curve, half = read_curve(tmp_path), read_policy(tmp_path / "latest.safetensors")
    assert [point["timesteps"] for point in curve.points] == [0, 400, 800, 1200]
    assert curve.points[-1]["return"] > 1.5 * curve.references["random walk"]["return"]
    updates = half.tensors["optimizer.step"]
    assert half.metadata.epochs == np.ceil(updates * half.metadata.options["batch_size"] / 1200)
    assert train_sb3.main([*words, "--total-timesteps", "1300", "--resume"]) == 0
    file = read_policy(tmp_path / "latest.safetensors")
    assert file.metadata.timesteps == 1300
    assert updates < file.tensors["optimizer.step"] <= updates + 100 - 64  # the replay filled first


def test_dqn_that_has_not_begun_to_learn_says_so(tmp_path, capsys):
    words = [*arguments(tmp_path, steps=60, algorithm="dqn"), *DQN]
    assert train_sb3.main(words) == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "nothing was learnt: 60 steps are not more than --learning-starts 64" in error


def test_a_policy_file_of_dqn_holds_the_model(tmp_path):
    """The same choices in NumPy as Stable-Baselines3 makes, and all of it is restored."""
    words = [*arguments(tmp_path, steps=300, algorithm="dqn"), *DQN, "--no-references"]
    assert train_sb3.main(words) == 0
    file = read_policy(tmp_path / "latest.safetensors")
    args = train_sb3.Args(
        out=tmp_path, algorithm="dqn", env_id=ENV_ID, hidden=file.metadata.hidden[0], num_envs=1
    )
    model = train_sb3.make_model(args, environments.make_venv(args, "train"), file)
    restored = tensors_of(model)
    assert restored.keys() == file.tensors.keys()
    assert any(name.startswith("target.") for name in restored)
    for name, value in file.tensors.items():
        np.testing.assert_array_equal(restored[name], value, err_msg=name)
    seen = (10 * np.eye(7) + np.random.default_rng(0).normal(size=(7, 7))).astype(np.float32)
    scaled = model.get_vec_normalize_env().normalize_obs(seen)
    expected = model.predict(scaled, deterministic=True)[0]
    found = Policy(file).probabilities(seen, np.ones((7, 7), bool))
    np.testing.assert_array_equal(found.argmax(axis=1), expected)
    with torch.no_grad():
        best = model.q_net(torch.as_tensor(scaled)).numpy().argmax(axis=1)
    np.testing.assert_array_equal(best, expected)
    assert len(set(expected.tolist())) > 1


def test_dqn_takes_one_number(tmp_path, capsys):
    words = ["--algorithm", "dqn", "--env-id", "MSActiveSLAM-Adaptive-v0", "--num-envs", "1"]
    assert train_sb3.main([*words, "--out", str(tmp_path / "run")]) == 2
    assert "has actions of several numbers: use PPO" in capsys.readouterr().err


def test_a_run_is_not_overwritten(run, capsys):
    assert train_sb3.main(arguments(run.out, algorithm=run.algorithm)) == 2
    assert "--resume" in capsys.readouterr().err


def test_resume_needs_a_run_with_the_same_options(run, tmp_path, capsys):
    assert train_sb3.main(arguments(tmp_path, "--resume")) == 2
    assert "no policy file" in capsys.readouterr().err
    more = arguments(run.out, "--resume", "--observation", "lookahead", algorithm=run.algorithm)
    assert train_sb3.main(more) == 2
    assert "'features', not 'lookahead'" in capsys.readouterr().err
    finished = arguments(run.out, "--resume", algorithm=run.algorithm)
    assert train_sb3.main(finished) == 2
    assert "is trained for 64 steps already" in capsys.readouterr().err
    other = arguments(
        run.out, "--resume", "--eval-episodes", "5", steps=128, algorithm=run.algorithm
    )
    assert train_sb3.main(other) == 2
    assert "judged with eval_episodes 3, not 5" in capsys.readouterr().err
    assert train_sb3.main([*other[:-2], "--episode-steps", "5"]) == 2
    assert "judged with episode_steps 10, not 5" in capsys.readouterr().err


def test_a_run_that_began_with_a_policy_is_resumed(run, tmp_path, capsys):
    init = ("--init", str(run.out / "latest.safetensors"))
    assert train_sb3.main(arguments(tmp_path, *init, algorithm=run.algorithm)) == 0
    more = arguments(tmp_path, "--resume", steps=96, algorithm=run.algorithm)
    assert train_sb3.main(more) == 2  # no file is opened because a run's file names it
    assert "give --init again" in capsys.readouterr().err
    assert train_sb3.main([*more, *init]) == 0
    assert read_policy(tmp_path / "latest.safetensors").metadata.timesteps == 96


def test_a_policy_of_another_task_is_begun_with(run, tmp_path):
    own = read_policy(run.out / "latest.safetensors")
    elsewhere = replace(own, metadata=replace(own.metadata, env_id="MSActiveSLAM-Home-v0"))
    write_policy(tmp_path / "home.safetensors", elsewhere)
    init = ("--init", str(tmp_path / "home.safetensors"))
    assert train_sb3.main(arguments(tmp_path / "on", *init, algorithm=run.algorithm)) == 0
    begun = read_policy(tmp_path / "on" / "latest.safetensors").metadata
    assert begun.env_id != "MSActiveSLAM-Home-v0"


def test_a_policy_of_other_actions_is_not_begun_with(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(LearnableFake, "inputs", 9)
    init = ("--init", str(run.out / "latest.safetensors"))
    assert train_sb3.main(arguments(tmp_path, *init, algorithm=run.algorithm)) == 2
    assert "is for 7 numbers and 7 actions, not for 9 and 7" in capsys.readouterr().err
