"""Learning from a planner, end to end on a small fake environment whose answer a planner knows."""

import shutil

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from learnable_fake import ENV_ID, NUM_ACTIONS, RECALL_ID, read_curve, words_of
from ms_slam_agents import demonstrations, imitation, student, train_sb3
from ms_slam_agents.demonstrations import Demonstration, Task, play
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import read_policy
from ms_slam_agents.policy_planner import TrainedPolicy

from ms_slam_env.env import Planner
from ms_slam_env.errors import InputError

TEACHER = f"{__name__}:Knowing"


class Undecided(Planner):
    """Finds the action before the right one a third as good, where that is possible."""

    def act(self, observation, info):
        self.label = self.robot._env.right
        return self.label

    def preferences(self):
        before = (self.label - 1) % NUM_ACTIONS
        other = before if self.robot._env.mask[before] else self.label
        return 0.75 * np.eye(NUM_ACTIONS)[self.label] + 0.25 * np.eye(NUM_ACTIONS)[other]


class Knowing(Planner):
    """Knows the right action, and hears what was done instead."""

    instead_of: list = []  # noqa: RUF012 -- the tests look at it

    def act(self, observation, info):
        self.label = self.robot._env.right
        return self.label

    def instead(self, action):
        self.instead_of.append((self.label, action))


class Through(TrainedPolicy):
    """The policy, but every third motion is the first that is possible."""

    taken: list = []  # noqa: RUF012 -- the tests look at it
    instead_of: list = []  # noqa: RUF012

    def act(self, observation, info):
        action = super().act(observation, info)
        first = int(np.flatnonzero(self.robot._env.mask)[0])
        self.taken.append(first if len(self.taken) % 3 == 2 else action)
        return self.taken[-1]

    def instead(self, action):
        self.instead_of.append(action)


class Sometimes(Undecided):
    """Weighs the motions where the first is not the right one."""

    def preferences(self):
        return super().preferences() if self.label else None


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    """All episodes are played where the fake is known."""
    monkeypatch.setattr(imitation, "open_pool", InThisProcess)


class InThisProcess:
    def __init__(self, run, workers, environment):
        self.run, self.busy, self.done = run, 0, []

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        pass

    @property
    def idle(self):
        return 1 - len(self.done)

    def give(self, key, spec):
        from ms_slam_env._runtime.parallel import attempt

        self.done.append(attempt(self.run, key, spec))

    def take(self):
        done, self.done = self.done, []
        return done


def arguments(out, *more, rounds=2):
    taught = {"teacher": TEACHER, "episodes": 12, "rounds": rounds, "epochs": 30}
    return words_of(out, more, eval_episodes=4, learning_rate=0.01, **taught)


@pytest.fixture(scope="module")
def taught(tmp_path_factory):
    """A run of one round."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(imitation, "open_pool", InThisProcess)
        out = tmp_path_factory.mktemp("taught")
        assert imitation.main(arguments(out, rounds=1)) == 0
    return out


@pytest.fixture
def copied(taught, tmp_path):
    """A copy of it."""
    return shutil.copytree(taught, tmp_path / "copied")


def test_the_policy_does_as_its_teacher(tmp_path, capsys):
    tmp_path = tmp_path / "lr=1,h=2 #a: b"  # folders may have any name
    assert imitation.main(arguments(tmp_path)) == 0
    curve = read_curve(tmp_path)
    assert [point["timesteps"] for point in curve.points] == [120, 240]
    assert curve.points[-1]["return"] > 9  # of 10; random walk gets some 2.5
    policy = Policy.load(tmp_path / "latest.safetensors")
    assert policy.metadata.algorithm == "imitation"
    assert policy.metadata.timesteps == 240
    for right in range(NUM_ACTIONS):
        seen = (10 * np.eye(NUM_ACTIONS)[right] + 3).astype(np.float32)
        assert policy.act(seen, np.ones(NUM_ACTIONS, bool)) == right
    assert "round 1: 240 steps" in capsys.readouterr().out


def test_the_policy_weighs_actions_as_its_teacher(tmp_path):
    words = arguments(tmp_path, "--teacher", f"{__name__}:Undecided", rounds=1)
    assert imitation.main(words) == 0
    policy = Policy.load(tmp_path / "latest.safetensors")
    seen = (10 * np.eye(NUM_ACTIONS) + 3).astype(np.float32)
    both = (np.eye(NUM_ACTIONS) + np.roll(np.eye(NUM_ACTIONS), -1, axis=1)).astype(bool)
    found = policy.probabilities(seen, both)
    assert abs(np.diag(found).mean() - 0.75) < 0.05
    np.testing.assert_allclose(np.diag(found), 0.75, atol=0.15)


def test_only_a_memory_learns_what_needs_one(tmp_path):
    for memory, more in ((0, ()), (32, ("--batch-size", "40", "--hidden", "32"))):
        own = ("--env-id", RECALL_ID, "--memory", str(memory), "--episodes", "150", *more)
        assert imitation.main(arguments(tmp_path / str(memory), *own, rounds=1)) == 0
    assert read_curve(tmp_path / "0").points[-1]["return"] < 4  # three of ten need none
    assert read_curve(tmp_path / "32").points[-1]["return"] > 9
    policy = Policy.load(tmp_path / "32" / "latest.safetensors")
    assert policy.metadata.memory == 32
    named = [3, 5, 1, 6, 0]
    seen = [(10 * np.eye(NUM_ACTIONS)[one] + 3).astype(np.float32) for one in named]
    done = [policy.act(one, np.ones(NUM_ACTIONS, bool)) for one in seen]
    assert done[2:] == named[:3]


def test_episodes_of_different_lengths_are_fitted_to_whole():
    rng = np.random.default_rng(0)
    lengths = (3, 7, 1, 5)

    def demonstration(k, length):
        named = 100 * k + np.arange(length)
        preferences = np.tile(named[:, None], 2).astype(np.float16)
        masks, none = np.ones((length, 2), bool), np.zeros(length, np.float32)
        return Demonstration(named[:, None], masks, preferences, none, none > 1)

    given = [demonstration(k, length) for k, length in enumerate(lengths)]
    batches = student.Batches(given, imitation.Args(memory=1, batch_size=14, epochs=2), rng)
    assert len(batches) == len(list(batches)) == 4
    for seen, _, is_step, preferences, returns in batches:
        columns = seen[..., 0].T.astype(int)
        for column, used in zip(columns, is_step.reshape(seen.shape[:2]).T, strict=True):
            k, length = column[0] // 100, int(used.sum())
            assert length == lengths[k]
            assert column[:length].tolist() == [100 * k + t for t in range(length)]
        np.testing.assert_array_equal(seen.reshape(-1)[is_step], preferences[:, 0])
        assert len(returns) == is_step.sum()


@pytest.mark.parametrize("more", [("--dropout", "0.3"), ("--memory", "4")])
def test_a_run_that_goes_on_is_the_run_that_never_stopped(tmp_path, more):
    imitation.main(arguments(tmp_path / "whole", *more))
    imitation.main(arguments(tmp_path / "parts", *more, rounds=1))
    assert imitation.main(arguments(tmp_path / "parts", *more, "--resume")) == 0
    whole, parts = (read_policy(tmp_path / p / "latest.safetensors") for p in ("whole", "parts"))
    for name, value in whole.tensors.items():
        np.testing.assert_array_equal(parts.tensors[name], value, err_msg=name)


def test_weights_of_the_reward_are_an_option_of_an_episode(tmp_path, monkeypatch):
    given = []
    make = demonstrations.gym.make
    monkeypatch.setattr(
        demonstrations.gym,
        "make",
        lambda env_id, reward, **options: given.append(reward) or make(env_id, **options),
    )
    weights = {"new_surface": 0.25}
    options = (("max_episode_steps", 3), ("reward", weights))
    for seed in range(2):
        task = Task(tmp_path / f"{seed}.npz", ENV_ID, options, seed, TEACHER)
        assert len(Demonstration.read(play(task)).rewards) == 3
    assert given == [weights]  # one environment for both


def test_later_rounds_are_played_by_the_policy_and_labelled_by_the_teacher(taught, tmp_path):
    Knowing.instead_of.clear()
    task = Task(
        path=tmp_path / "one.npz",
        env_id=ENV_ID,
        options=(("max_episode_steps", 30),),
        seed=3,
        teacher=TEACHER,
        policy=taught / "latest.safetensors",
    )
    one = Demonstration.read(play(task))
    labels = one.preferences.argmax(axis=1)
    assert (one.preferences.sum(axis=1) == 1).all()
    assert all(labels == one.observations.argmax(axis=1))
    wrong = np.flatnonzero(one.rewards == 0)
    assert [right for right, _ in Knowing.instead_of] == labels[wrong].tolist()
    assert all(right != done for right, done in Knowing.instead_of)


def test_the_policy_acts_through_a_planner_and_only_weighed_decisions_count(taught, tmp_path):
    Through.taken.clear(), Through.instead_of.clear()
    task = Task(
        path=tmp_path / "one.npz",
        env_id=ENV_ID,
        options=(("max_episode_steps", 60),),
        seed=3,
        teacher=f"{__name__}:Sometimes",
        policy=taught / "latest.safetensors",
        share=0.5,
        through=f"{__name__}:Through",
    )
    one = Demonstration.read(play(task))
    assert len(Through.taken) == 60
    right = one.observations.argmax(axis=1)
    done = np.array(Through.taken)
    wrong = done != right
    assert 0 < len(Through.instead_of) < wrong.sum()  # the teacher's share of them
    assert one.rewards.sum() == 60 - wrong.sum() + len(Through.instead_of)
    np.testing.assert_array_equal(one.preferences.sum(axis=1), right > 0)


def test_a_teacher_that_weighs_nothing_teaches_no_policy_under_a_planner(tmp_path, capsys):
    words = ["--teacher", f"{__name__}:Knowing", "--through", f"{__name__}:Through"]
    assert imitation.main(arguments(tmp_path, *words)) == 2
    assert "Knowing weighs no decision of a policy that acts through" in capsys.readouterr().err


def test_it_begins_with_a_policy_that_there_is(taught, tmp_path, capsys):
    init = taught / "latest.safetensors"
    words = ["--init", str(init), "--epochs", "1", "--learning-rate", "0"]
    assert imitation.main(arguments(tmp_path / "second", *words, rounds=1)) == 0
    first, second = (read_policy(path) for path in (init, tmp_path / "second/latest.safetensors"))
    for name, value in first.tensors.items():
        np.testing.assert_array_equal(second.tensors[name], value, err_msg=name)
    assert (first.metadata.epochs, second.metadata.epochs) == (30, 1)
    assert imitation.main(arguments(tmp_path / "second", *words, "--resume")) == 0
    assert imitation.main(arguments(tmp_path / "other", *words, "--hidden", "8")) == 2
    assert "give --hidden that" in capsys.readouterr().err


def test_returns_are_those_of_a_loop(tmp_path):
    rng = np.random.default_rng(0)
    rewards = rng.normal(size=20).astype(np.float32)
    one = Demonstration(np.zeros((20, 3), np.float16), np.ones((20, 7), bool), *[rewards] * 3)
    slow = [sum(0.9**i * r for i, r in enumerate(rewards[t:])) for t in range(20)]
    np.testing.assert_allclose(one.returns(0.9), slow, rtol=1e-6)


def test_ppo_goes_on_from_what_was_imitated(tmp_path):
    assert imitation.main(arguments(tmp_path / "imitated")) == 0
    words = ["--env-id", ENV_ID, "--out", str(tmp_path / "ppo"), "--hidden", "16"]
    words += ["--num-envs", "1", "--episode-steps", "10", "--eval-episodes", "4"]
    words += ["--total-timesteps", "32", "--n-steps", "32", "--no-references"]
    init = str(tmp_path / "imitated/latest.safetensors")
    assert train_sb3.main([*words, "--init", init]) == 0
    points = read_curve(tmp_path / "ppo").points
    assert points[0]["return"] == read_curve(tmp_path / "imitated").points[-1]["return"]
    assert points[-1]["return"] > 8
    words[words.index("16")] = "8"
    words[words.index(str(tmp_path / "ppo"))] = str(tmp_path / "other")
    assert train_sb3.main([*words, "--init", init]) == 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda out: (out / "latest.safetensors").write_bytes(b"no"), "is not a policy"),
        (lambda out: next((out / "episodes").iterdir()).write_bytes(b"PK"), "not a demonstration"),
    ],
)
def test_damaged_runs_are_one_line(copied, capsys, change, said):
    change(copied)
    assert imitation.main(arguments(copied, "--resume")) == 2
    assert said in capsys.readouterr().err


def test_runs_that_are_not_to_be_gone_on_with_are_refused(copied, tmp_path, capsys):
    def resumed(*more, rounds=2):
        return arguments(copied, "--resume", *more, rounds=rounds)

    for words, said in (
        (arguments(copied), "holds a training run already"),
        (resumed(rounds=1), "has 1 rounds already"),
        (resumed("--hidden", "32"), "trained with hidden 16, not 32"),
        (resumed("--memory", "8"), "trained with memory 0, not 8"),
        (resumed("--through", "policy"), "through None, not 'policy'"),
        (
            arguments(tmp_path / "new", "--through", "agent-home"),
            "observation of the policy under agent-home 'features'",
        ),
        (resumed("--reward", "paper"), "reward 'default', not 'paper'"),
        (resumed("--step-m", "0.06"), "step_m None, not 0.06"),
        (resumed("--eval-episodes", "9"), "eval_episodes 4, not 9"),
        (arguments(tmp_path / "new", "--teacher", "nobody"), "unknown planner 'nobody'"),
        (arguments(tmp_path / "new", "--observation", "x:Y"), "unknown observation 'x:Y'"),
    ):
        assert imitation.main(words) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    assert not list((copied / "episodes").glob("001*"))


def test_an_interrupted_first_round_is_gone_on_with_as_what_it_was(tmp_path, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(imitation, "Student", interrupt)
        assert imitation.main(arguments(tmp_path, rounds=1)) == 130
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "episodes",
        "results.json",
        "table.md",
    ]
    other = arguments(tmp_path, "--resume", "--hidden", "32", rounds=1)
    assert imitation.main(other) == 2
    assert "trained with hidden 16, not 32" in capsys.readouterr().err
    assert imitation.main(arguments(tmp_path, "--resume", rounds=1)) == 0


def test_what_is_no_demonstration_is_refused(tmp_path):
    path = tmp_path / "x.npz"
    for arrays in ({"labels": np.zeros(3)}, {"observations": np.array([{}], dtype=object)}):
        np.savez(path, **arrays)
        with pytest.raises(InputError, match="not a demonstration"):
            Demonstration.read(path)
