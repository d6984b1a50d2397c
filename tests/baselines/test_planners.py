"""Planners against a small fake environment whose right answers a slow loop knows."""

from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium.spaces import Discrete, MultiDiscrete
from hypothesis import given, settings
from hypothesis import strategies as st
from ms_slam_baselines import GreedyDivergence, MaxInformation, RandomWalk, Stationary

from ms_slam_env.env.env_config import TargetConfig
from ms_slam_env.errors import InputError

NUM_ACTIONS = 49
PLANNERS = (GreedyDivergence, MaxInformation, RandomWalk, Stationary)


class FakeEnv:
    """Answers a planner's questions from tables."""

    def __init__(self, seed=0, blocked=0.3, targets=None):
        rng = np.random.default_rng(seed)
        self.config = SimpleNamespace(targets=targets or TargetConfig())
        self.divergences = rng.exponential(0.01, (NUM_ACTIONS, 2))
        self.depth = rng.choice([0.0, 1.5], (NUM_ACTIONS, 3, 4)).astype(np.float32)
        self.mask = rng.random(NUM_ACTIONS) >= blocked
        self.mask[0] = True  # standing still is always possible
        self.action_space = Discrete(NUM_ACTIONS)

    def action_masks(self):
        return self.mask.copy()

    def lookahead(self):
        return self.divergences.copy()

    def predict_candidates(self):
        return SimpleNamespace(depth=self.depth)


def act(planner, times=1):
    planner.reset()
    return [planner.act(None, {}) for _ in range(times)]


@pytest.mark.parametrize("planner", PLANNERS)
def test_only_unmasked_actions_are_taken(planner):
    for seed in range(20):
        env = FakeEnv(seed, blocked=0.9)
        actions = act(planner(env, seed), times=20)
        assert all(type(action) is int and env.mask[action] for action in actions)


@pytest.mark.parametrize("planner", PLANNERS)
def test_same_seed_same_actions(planner):
    assert act(planner(FakeEnv(), 7), 30) == act(planner(FakeEnv(), 7), 30)


def test_random_walk_takes_every_unmasked_action_equally_often():
    env = FakeEnv()
    counts = np.bincount(act(RandomWalk(env, 3), 20_000), minlength=NUM_ACTIONS)
    expected = 20_000 / env.mask.sum()
    chi_squared = float((((counts - expected) ** 2) / expected)[env.mask].sum())
    degrees = env.mask.sum() - 1
    assert chi_squared < degrees + 5 * np.sqrt(2 * degrees)  # 5 standard deviations
    assert act(RandomWalk(env, 3), 30) != act(RandomWalk(env, 4), 30)


def test_random_walk_draws_each_number_of_an_action_from_its_own_choices():
    env = FakeEnv()
    env.mask = np.concatenate([env.mask, [True, False, True]])
    env.action_space = MultiDiscrete([NUM_ACTIONS, 3])
    motions, configurations = np.transpose(act(RandomWalk(env, 3), 2000))
    assert set(motions) == set(np.flatnonzero(env.mask[:NUM_ACTIONS]))
    assert set(configurations) == {0, 2}


def test_stationary_stays():
    assert act(Stationary(FakeEnv()), 5) == [0] * 5


def slow_algorithm_1(env, rho_I, rho_D, depth_weight):
    """Lines 1 to 11 as a loop."""
    best, smallest = -1, np.inf
    for i in range(NUM_ACTIONS):
        if not env.mask[i]:
            continue
        distance = abs(env.divergences[i, 0] - rho_I * env.config.targets.M_I)
        distance += depth_weight * abs(env.divergences[i, 1] - rho_D * env.config.targets.M_D)
        if distance < smallest:
            best, smallest = i, distance
    return best


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    rho_I=st.floats(0, 1),
    rho_D=st.floats(0, 1),
    depth_weight=st.floats(0, 10),
    M_I=st.floats(1e-3, 1),
)
def test_greedy_is_algorithm_1(seed, rho_I, rho_D, depth_weight, M_I):
    env = FakeEnv(seed, targets=TargetConfig(M_I=M_I))
    options = {"rho_I": rho_I, "rho_D": rho_D, "depth_weight": depth_weight}
    expected = slow_algorithm_1(env, **options)
    assert act(GreedyDivergence(env, **options)) == [expected]
    as_text = {name: str(value) for name, value in options.items()}
    assert act(GreedyDivergence(env, **as_text)) == [expected]


def test_greedy_takes_its_targets_from_the_environment():
    for seed in range(20):
        targets = TargetConfig(rho_I=0.9, rho_D=0.1, depth_weight=3.0)
        env = FakeEnv(seed, targets=targets)
        assert act(GreedyDivergence(env)) == [slow_algorithm_1(env, 0.9, 0.1, 3.0)]


def test_greedy_breaks_ties_by_the_lowest_action():
    env = FakeEnv()
    env.divergences[:] = 0.01
    env.mask[:] = False
    env.mask[[11, 5, 40]] = True
    assert act(GreedyDivergence(env)) == [5]


def test_a_calibrated_greedy_chooses_by_what_is_met():
    targets = TargetConfig(rho_I=1, rho_D=1)
    env, met = FakeEnv(3, targets=targets), FakeEnv(3, targets=targets)
    factors = np.array([2.5, 0.5])
    env.divergences *= 20
    met.divergences *= 20 * factors
    right = GreedyDivergence(met).act(None, {})
    planner = GreedyDivergence(env, calibration=0.3)
    action, info = planner.act(None, {}), {"tracking_ok": True}
    assert action == GreedyDivergence(env).act(None, {}) != right
    for _ in range(40):
        action = planner.act(None, info | {"divergence": met.divergences[action]})
    assert action == right
    planner.instead(5)  # what comes is of another motion: nothing is learnt from it
    learnt = planner.log_factor.copy()
    planner.act(None, info | {"divergence": np.array([9.0, 9.0])})
    planner.act(None, {"tracking_ok": False, "divergence": np.array([9.0, 9.0])})
    np.testing.assert_array_equal(planner.log_factor, learnt)
    planner.reset()
    assert planner.act(None, {}) == GreedyDivergence(env).act(None, {})


@pytest.mark.parametrize(
    "options", [{"rho_I": 1.5}, {"rho_D": "much"}, {"depth_weight": -1}, {"calibration": 2}]
)
def test_greedy_refuses_bad_options(options):
    (name,) = options
    with pytest.raises(InputError, match=name):
        GreedyDivergence(FakeEnv(), **options)


def test_max_information_takes_the_emptiest_view():
    for seed in range(20):
        env = FakeEnv(seed)
        empty = [
            sum(env.depth[i, y, x] == 0 for y in range(3) for x in range(4)) if env.mask[i] else -1
            for i in range(NUM_ACTIONS)
        ]
        chosen = set(act(MaxInformation(env, seed), 50))
        assert chosen <= {i for i in range(NUM_ACTIONS) if empty[i] == max(empty)}


def test_max_information_draws_ties_at_random():
    env = FakeEnv(blocked=0)
    env.depth[:] = 1.0
    env.depth[[3, 17, 30]] = 0.0
    assert set(act(MaxInformation(env), 60)) == {3, 17, 30}
