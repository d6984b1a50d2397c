"""Stages of the environment's clock."""

import time

import pytest

from ms_slam_env._runtime.timings import Timings


def test_own_time_leaves_out_what_is_nested():
    timings = Timings()
    with timings.stage("outer"):
        time.sleep(0.02)
        for _ in range(2):
            with timings.stage("inner"), timings.stage("innermost"):
                time.sleep(0.01)
    assert timings.calls == {"outer": 1, "inner": 2, "innermost": 2}
    assert timings.total["inner"] >= timings.total["innermost"] >= 0.02
    assert timings.own["inner"] == pytest.approx(timings.total["inner"] - timings.own["innermost"])
    assert timings.own["outer"] == pytest.approx(timings.total["outer"] - timings.total["inner"])
    assert sum(timings.own.values()) == pytest.approx(timings.total["outer"])
    timings.clear()
    assert not timings.own
    assert not timings.total


def test_a_stage_that_fails_is_charged_and_closed():
    timings = Timings()
    with pytest.raises(KeyError), timings.stage("outer"), timings.stage("inner"):
        raise KeyError
    with timings.stage("outer"):
        pass
    assert timings.calls == {"outer": 2, "inner": 1}
    assert sum(timings.own.values()) == pytest.approx(timings.total["outer"])
