"""A curriculum: which stage it is, what its episodes are made of, and that trainers follow it."""

import gymnasium as gym
import numpy as np
import pytest
from learnable_fake import LearnableFake, arguments

pytest.importorskip("sb3_contrib")

from ms_slam_agents import environments, ppo, qrdqn, train_sb3
from ms_slam_agents.curriculum import Stage, Staged, read_curriculum, stage_now
from ms_slam_agents.options import Training

from ms_slam_env.errors import InputError

ENV_ID = "LearnableStaged-v0"


class Made(LearnableFake):
    """Remembers the training environments that were made, and how many episodes each began."""

    made: list = []  # noqa: RUF012 -- the tests look at it

    def __init__(self, noise=None, **options):
        super().__init__(**options)
        self.perturbed = []
        self.own = {"scene_seeds": options["num_scene_seeds"], "noise": noise, "episodes": 0}
        if options["split"] == "train":
            self.made.append(self.own)

    def reset(self, **options):
        self.own["episodes"] += 1
        return super().reset(**options)

    def perturb(self, perturbation):
        self.perturbed.append(perturbation)


gym.register(ENV_ID, Made)


def points(*pairs):
    return [{"timesteps": steps, "return": score} for steps, score in pairs]


def test_a_stage_ends_by_its_share_of_the_steps_or_by_the_return_on_validation():
    stages = (Stage(until=0.2), Stage(until=0.6, above=5.0), Stage(above=7.0), Stage())
    assert [stage_now(stages, k, [], 100) for k in (0, 19, 20, 59, 60, 100)] == [0, 0, 1, 1, 2, 2]
    assert stage_now(stages, 30, points((0, 9.0), (25, 4.0)), 100) == 1
    assert stage_now(stages, 30, points((0, 9.0), (25, 6.0)), 100) == 2
    assert stage_now(stages, 30, points((25, 9.0)), 100) == 2  # one a validation
    assert stage_now(stages, 30, points((25, 9.0), (30, 9.0), (30, 9.0)), 100) == 3  # the last
    assert stage_now(stages, 10, points((10, 9.0)), 100) == 0  # its return ends not the first


def test_what_is_drawn_lies_between_the_numbers_and_depends_on_the_seed():
    stage = Stage(noise=(0.5, 1.5), perturbations={"illumination": {"dim": [0.1, 0.4], "lamp": 0}})
    drawn = [stage.draw(np.random.default_rng(seed).uniform) for seed in range(200)]
    strengths = np.array([options["noise"]["strength"] for options, _ in drawn])
    dims = np.array([made[0][1]["dim"] for _, made in drawn])
    for values, low, high in ((strengths, 0.5, 1.5), (dims, 0.1, 0.4)):
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high
    assert drawn[7] == stage.draw(np.random.default_rng(7).uniform)
    assert drawn[0][1][0] == ("illumination", {"dim": dims[0], "lamp": 0})


def test_episodes_are_of_the_stage_and_of_what_was_drawn(tmp_path):
    path = tmp_path / "stages.yaml"
    path.write_text("- {until: 0.5, scene_seeds: 2, episode_steps: 3}\n- {noise: [0.5, 1.5]}\n")
    args = Training(env_id=ENV_ID, curriculum=path, scene_seeds=4, episode_steps=10)
    env = environments.make_env(args, "train", ())
    assert isinstance(env, Staged)

    def length():
        env.reset()
        for steps in range(1, 20):
            if env.step(env.unwrapped.right)[3]:
                return steps

    assert (length(), env.unwrapped.own["scene_seeds"], env.unwrapped.own["noise"]) == (3, 2, None)
    same = env.unwrapped
    assert (length(), env.unwrapped) == (3, same)
    env.enter_stage(1)
    strengths = []
    for _ in range(4):
        assert (length(), env.unwrapped.own["scene_seeds"]) == (10, 4)
        strengths.append(env.unwrapped.own["noise"]["strength"])
    assert len(set(strengths)) == 4
    observations = [env.reset(seed=5)[0] for _ in range(2)]
    np.testing.assert_array_equal(*observations)
    assert environments.make_env(args, "validation", ()).unwrapped.own["noise"] is None


def played():
    """Scene seeds and episodes of the environments that something was played in."""
    return [(one["scene_seeds"], one["episodes"]) for one in Made.made if one["episodes"]]


@pytest.mark.parametrize("trainer", [ppo, qrdqn, train_sb3])
def test_trainers_go_from_stage_to_stage_and_are_validated_on_the_problem(tmp_path, trainer):
    path = tmp_path / "stages.yaml"
    path.write_text("- {until: 0.5, scene_seeds: 2}\n- {scene_seeds: 3}\n")
    words = arguments(tmp_path / "run", "--no-references", "--curriculum", str(path), steps=128)
    words[words.index("LearnableFake-v0")] = ENV_ID
    if trainer is not train_sb3:
        del words[words.index("--algorithm") : words.index("--algorithm") + 2]
    if trainer is qrdqn:
        for name in ("--n-steps", "--n-epochs"):
            del words[words.index(name) : words.index(name) + 2]
        words += ["--learning-starts", "16", "--save-every", "32"]
    Made.made.clear()
    assert trainer.main(words) == 0
    assert [seeds for seeds, _ in played()] == [2, 3]
    assert all(4 <= episodes <= 9 for _, episodes in played())  # of ten steps each
    Made.made.clear()
    longer = {"64": "160", "128": "160"}
    assert trainer.main([*(longer.get(word, word) for word in words), "--resume"]) == 0
    assert [seeds for seeds, _ in played()] == [3]  # not one episode of the first stage


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{until: 0.5}", "a list of stages is wanted"),
        ("- {untill: 0.5}", "stage 1: .*must be a mapping of above"),
        ("- {until: 2}", "until = 2"),
        ("- {until: 0.5}\n- {until: 0.2}", "one before the one before it"),
        ("- {noise: [2, 1]}", "the lower first"),
        ("- {perturbations: {fog: {}}}", "unknown perturbation 'fog'"),
        ("- {step_m: fast}", "step_m"),
        ("- {above: high}", "above"),
        ("- {perturbations: {illumination: {dim: [0.2, 1.3]}}}", "dim = 1.3"),
        ("- {perturbations: {illumination: {dim: [-0.1, 0.3]}}}", "dim = -0.1"),
        ("- {perturbations: {illumination: {dim: [0, .inf]}}}", "dim = inf"),
        ("- {until: 0.5}\n- {}\n- {}", "stage 2 has neither until nor above"),
    ],
)
def test_what_is_no_curriculum_is_refused_in_one_line(tmp_path, text, said, capsys):
    path = tmp_path / "stages.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=f"stages.yaml: .*{said}"):
        read_curriculum(path)
    assert ppo.main(["--curriculum", str(path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()
