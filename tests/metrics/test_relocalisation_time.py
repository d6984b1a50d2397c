"""Relocalisation time against runs of black frames of known length."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.metrics import mean_relocalisation_time, relocalisation, relocalisation_times

RUN = st.tuples(st.integers(1, 6), st.integers(0, 5), st.integers(1, 4))


@given(st.lists(RUN, min_size=1, max_size=6), st.integers(1, 5), st.floats(0.01, 2.0))
def test_every_run_takes_as_long_as_its_lost_frames(runs, head, period_s):
    # Per run: black frames, frames lost after them, frames tracked.
    black, tracked = [False] * head, [True] * head
    for dark, lost, good in runs:
        black += [True] * dark + [False] * (lost + good)
        tracked += [False] * (dark + lost) + [True] * good
    times = 5.0 + period_s * np.arange(len(black))
    expected = [period_s * lost for _, lost, _ in runs]
    np.testing.assert_allclose(relocalisation_times(times, black, tracked), expected, atol=1e-9)
    mean = mean_relocalisation_time(times, black, tracked)
    assert mean == pytest.approx(sum(expected) / len(runs), abs=1e-9)


def test_a_pose_claimed_in_the_dark_is_no_relocalisation():
    black = [False, True, True, False, False, False]
    tracked = [True, True, True, False, False, True]
    assert relocalisation_times(np.arange(6) / 10, black, tracked) == pytest.approx([0.2])


def test_never_found_again_is_infinite():
    times = np.arange(7.0)
    black = [False, True, False, False, True, False, False]
    tracked = [True, False, False, False, False, False, True]
    np.testing.assert_array_equal(relocalisation_times(times, black, tracked), [np.inf, 1.0])
    assert mean_relocalisation_time(times, black, tracked) == np.inf


def test_never_is_counted_apart_from_the_times():
    times = np.arange(13.0)
    black = np.array([0, 1, 0, 0, 1, 0, 0, 0, 1, 1, 0, 0, 0], dtype=bool)
    tracked = np.array([1, 0, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1], dtype=bool)
    found = relocalisation(times, black, tracked)
    assert (found.mean_s, found.found, found.never) == (1.5, 2, 1)
    lost = relocalisation(times, black, np.zeros(13, dtype=bool))
    assert np.isnan(lost.mean_s)
    assert (lost.found, lost.never) == (0, 3)


def test_without_a_chance_there_is_no_time():
    assert len(relocalisation_times([0.0, 1.0], [False, True], [True, False])) == 0
    assert len(relocalisation_times([0.0, 1.0], [False, False], [True, True])) == 0
    assert np.isnan(mean_relocalisation_time([0.0, 1.0], [False, False], [True, True]))


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="one length"):
        relocalisation_times([0.0, 1.0], [True], [True, False])
    with pytest.raises(InputError, match="one length"):
        relocalisation_times([], [], [])
    for times in ([1.0, 0.0], [0.0, np.nan]):
        with pytest.raises(InputError, match="ascending"):
            relocalisation_times(times, [True, False], [True, False])
