"""A planner that goes back to where tracking last held."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from ms_slam_env.env.planners import Planner, Recovering, make_planner, opposite
from ms_slam_env.errors import InputError
from ms_slam_env.robot.action_primitives import decompose

OK, LOST = {"tracking_ok": True}, {"tracking_ok": False}


class Counting(Planner):
    """Takes actions 1, 2, 3, ..."""

    def reset(self):
        self.last = 0
        self.losses = []
        self.seen = []

    def see(self, observation, info):
        self.seen.append(observation)

    def lost_by(self, action):
        self.losses.append(action)

    def act(self, observation, info):
        self.last += 1
        return self.last


def recovering(mask=None):
    mask = np.ones(49, bool) if mask is None else mask
    planner = Recovering(env := SimpleNamespace(action_masks=lambda: mask), Counting(env))
    planner.reset()
    return planner


@pytest.mark.parametrize("action", range(49))
def test_the_opposite_motion_leads_back(action):
    motions = decompose(0.12, np.radians(12))
    there_and_back = motions[action] @ motions[opposite(action)]
    np.testing.assert_allclose(there_and_back[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.norm(there_and_back[:3, 3]) <= 0.12 * np.radians(12) + 1e-9
    assert opposite(opposite(action)) == action


def test_rotations_alone_have_opposites_too():
    assert [opposite(n, 7) for n in range(7)] == [0, 2, 1, 4, 3, 6, 5]


def test_lost_motions_are_undone_newest_first_until_tracking_holds():
    planner = recovering()
    assert [planner.act(None, OK) for _ in range(3)] == [1, 2, 3]
    undone = [planner.act(None, LOST) for _ in range(2)]
    assert undone == [opposite(3), opposite(2)]
    assert planner.act(None, OK) == 4
    assert [planner.act(None, LOST) for _ in range(2)] == [opposite(4), opposite(1)]
    assert planner.act(None, LOST) == 5  # nothing left to undo


def test_a_planner_is_told_of_the_action_that_lost_tracking_and_of_no_other():
    planner = recovering()
    for info in (OK, OK, LOST, LOST, OK, LOST, LOST, LOST, LOST):
        planner.act(None, info)
    # 1 and 2 made, 2 lost, both undone; 3 made, lost, undone; 4, 5 and 6 made while lost.
    assert planner.planner.losses == [2, 3]


def test_a_planner_sees_the_way_back():
    planner = recovering()
    for name, info in zip("abcdefgh", (OK, OK, LOST, LOST, OK, LOST, LOST, LOST), strict=True):
        planner.act(name, info)
    assert planner.planner.seen == ["c", "d", "f", "h"]  # at "g" nothing was left to undo


def doubtful(sigma_m):
    return {"tracking_ok": True, "pose_covariance": np.diag([1e-6, sigma_m**2, 1e-6, 1, 1, 1.0])}


def test_a_pose_that_slam_doubts_is_left_the_way_it_was_reached():
    planner = recovering()
    assert [planner.act(None, doubtful(s)) for s in (0.001, 0.003)] == [1, 2]
    assert planner.act(None, doubtful(0.02)) == opposite(2)
    assert planner.act(None, doubtful(0.003)) == 3
    assert planner.planner.losses == [2]


def test_a_slam_that_gives_no_covariance_is_believed():
    planner = recovering()
    infinite = {"tracking_ok": True, "pose_covariance": np.diag(np.full(6, np.inf))}
    assert [planner.act(None, infinite) for _ in range(3)] == [1, 2, 3]


@pytest.mark.parametrize(
    ("made", "blocked", "done"),
    [
        (1, [2], 0),
        (7 * 5 + 1, [7 * 6 + 2], 2),  # forward and roll right: the roll alone
        (7 * 5 + 1, [7 * 6 + 2, 2], 7 * 6),  # nor that: backward alone
    ],
)
def test_of_what_is_blocked_the_possible_part_is_done(made, blocked, done):
    mask = np.ones(49, bool)
    mask[blocked] = False
    planner = recovering(mask)
    planner.planner.last = made - 1
    assert planner.act(None, OK) == made
    assert planner.act(None, LOST) == done


def test_an_episode_begins_without_a_past():
    planner = recovering()
    planner.act(None, OK)
    planner.reset()
    assert planner.act(None, LOST) == 1


def test_any_planner_takes_the_option_and_only_true_or_false():
    env = SimpleNamespace(action_masks=lambda: np.ones(49, bool))
    assert isinstance(make_planner("random,recovery=true", env), Recovering)
    assert not isinstance(make_planner("random", env), Recovering)
    assert not isinstance(make_planner("random,recovery=false", env), Recovering)
    with pytest.raises(InputError, match=r"recovery of planner random is true or false"):
        make_planner("random,recovery=7", env)
    with pytest.raises(InputError, match=r"unknown option of planner random.*recovery"):
        make_planner("random,recover=true", env)


def test_what_was_done_instead_is_what_is_undone():
    planner = recovering()
    assert planner.act(None, OK) == 1
    planner.instead(7)
    assert planner.act(None, OK) == 2
    assert planner.act(None, LOST) == opposite(2)
    planner.instead(21)  # so 2 was not undone, and 21 comes on top of it
    undone = [planner.act(None, LOST) for _ in range(3)]
    assert undone == [opposite(21), opposite(2), opposite(7)]


def test_planner_and_environment_draw_differently_from_one_seed():
    class Still(Planner):
        def act(self, observation, info):
            return 0

    planner = Still(None, 7)
    drawn = planner.rng.uniform(size=4)
    of_env, _ = gymnasium.utils.seeding.np_random(7)
    assert not np.isclose(drawn, of_env.uniform(size=4)).any()
    np.testing.assert_array_equal(Still(None, 7).rng.uniform(size=4), drawn)


def test_on_the_way_back_no_policy_within_has_a_choice():
    planner = recovering()
    planner.planner.choices = lambda: np.arange(49) < 3
    planner.act(None, OK)
    assert planner.choices().sum() == 3
    planner.act(None, LOST)
    assert planner.choices() is None
