"""Learning within a planner: what it leaves open, and that the rest teaches nothing."""

import numpy as np
import pytest
import torch
from ms_slam_agents import ppo
from ms_slam_agents.environments import VALIDATION_SEED, make_venv
from ms_slam_agents.home_agent import HomePolicy
from ms_slam_agents.network import Network
from ms_slam_agents.through_planner import ThroughPlanner
from small_env import ROOM, small_env

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError

AGENT = "agent-home"


def make_env(observation="held"):
    return small_env(ROOM, observation=observation)


def play(env, choose, steps=30):
    """Actions in an episode, and the possible ones that each was one of."""
    observation, info = env.reset(seed=3)
    actions, masks = [], []
    for _ in range(steps):
        masks.append(np.array(info["action_mask"]))
        actions.append(choose(observation, info))
        observation, *_, info = env.step(actions[-1])
    return actions, masks


def test_a_learner_that_is_the_policy_makes_the_agents_motions(monkeypatch):
    seeds = []

    def noted(text, env, seed):
        seeds.append(seed)
        return make_planner(text, env, seed)

    monkeypatch.setattr("ms_slam_agents.through_planner.make_planner", noted)
    env = ThroughPlanner(make_env(), AGENT)
    policy = HomePolicy(env.unwrapped).policy

    def choose(observation, info):
        assert np.array_equal(info["action_mask"], env.action_masks())
        return policy.act(observation, info["action_mask"])

    actions, masks = play(env, choose)
    forced = [mask.sum() == 1 for mask in masks]
    assert 3 < sum(forced) < 27

    alone = make_env()
    alone.reset(seed=3)
    agent = make_planner(AGENT, alone.unwrapped, seeds[-1])
    agent.reset()
    assert play(alone, agent.act)[0] == actions


def test_an_episode_is_that_of_its_seed():
    def play_at_random(env):
        rng = np.random.default_rng(5)
        return play(env, lambda _, info: int(rng.choice(np.flatnonzero(info["action_mask"]))))

    env = ThroughPlanner(make_env(), AGENT)
    first, again = play_at_random(env), play_at_random(env)
    assert first[0] == again[0]
    assert np.array_equal(first[1], again[1])


def test_the_planner_is_told_of_what_was_done_in_its_place():
    env = ThroughPlanner(make_env(), AGENT)
    env.reset(seed=3)
    told, tell = [], env._planner.instead
    env._planner.instead = lambda action: told.append(action) or tell(action)
    env.step(env._wanted)
    assert told == []
    other = (env._wanted + 1) % 49
    env.step(other)
    assert told == [other]


def test_training_and_validation_are_through_the_planner():
    args = ppo.Args(
        env_id="MSActiveSLAM-Room-v0",
        scenes=("table",),
        observation="held",
        image_size="80x60",
        through="agent-home,enough_m3=1000",
        num_envs=1,
    )
    for split, seeds in (("train", ()), ("validation", (VALIDATION_SEED,))):
        venv = make_venv(args, split, seeds)
        venv.reset()
        assert venv.env_method("action_masks")[0].sum() == 1  # all ways lead to goals
        venv.close()


def test_what_had_no_choice_teaches_the_policy_nothing():
    torch.manual_seed(0)
    network, rng = Network(5, 8, 7), np.random.default_rng(0)
    steps, environments = 16, 2
    actions = torch.as_tensor(rng.integers(7, size=(steps, environments)))
    seen = torch.as_tensor(rng.normal(size=(steps, environments, 5)), dtype=torch.float32)
    masks = torch.nn.functional.one_hot(actions, 7).bool()
    nothing = torch.zeros(steps, environments)
    rewards = torch.as_tensor(rng.normal(size=(steps, environments)), dtype=torch.float32)
    empty = torch.zeros(steps, environments, 0)
    rollout = ppo.Rollout(seen, masks, nothing, empty, actions, nothing, nothing, rewards, empty)
    args = ppo.Args(batch_size=8, value_weight=0.0, ent_coef=0.1, n_epochs=2)
    rollout.find_advantages(torch.zeros(environments), torch.zeros(environments), args)
    before = [parameter.clone() for parameter in network.parameters()]
    optimizer = torch.optim.SGD(network.parameters(), 1.0)
    ppo.update(network, optimizer, rollout, args, 0.0, rng)
    for was, parameter in zip(before, network.parameters(), strict=True):
        torch.testing.assert_close(parameter, was, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("planner", "observation", "said"),
    [
        ("nbv", "features", "planner 'nbv' has no policy within, as agent-home has"),
        ("agent-home", "features", "the policy within 'agent-home' sees 'held', not 'features'"),
        ("agent-home,overlap=2", "held", "overlap"),
        ("agent-hom", "held", "unknown planner 'agent-hom'"),
    ],
)
def test_what_no_policy_can_act_through_is_one_line(planner, observation, said, tmp_path, capsys):
    with pytest.raises(InputError, match=said):
        ThroughPlanner(make_env(observation), planner)
    words = ["--through", planner, "--observation", observation, "--out", str(tmp_path / "out")]
    assert ppo.main([*words, "--env-id", "MSActiveSLAM-Room-v0", "--scenes", "table"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
