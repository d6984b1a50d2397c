"""An error of a user's is one line, whatever it quotes."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.errors import InputError, UnreachableError


@given(st.text())
def test_a_message_is_one_line(text):
    message = str(InputError(f"a {text} b"))
    assert len(message.splitlines()) == 1
    assert message.split() == f"a {text} b".split()


def test_errors_come_back_from_other_processes():
    error = pickle.loads(pickle.dumps(UnreachableError("too\nfar")))
    assert (type(error), str(error)) == (UnreachableError, "too far")


def test_an_action_that_is_a_column_is_refused_in_one_line():
    env = ActiveSlamEnv("free", scene="wall")
    env.reset(seed=0)
    with pytest.raises(InputError, match=r"^action array\(\[\[1\], \[2\]\]\) is not an integer"):
        env.step(np.array([[1], [2]]))
