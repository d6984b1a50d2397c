"""A few mutated inputs at every entry point; ``tests/fuzz/run.py`` tries many."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("optuna")
pytest.importorskip("plotly")

from entries import ENTRIES
from fuzzing import Entry, attempt
from mutations import mutated_bytes, mutated_tree, places

from ms_slam_env.errors import InputError

NEEDS = {"frames-sparse": "gtsam", "frames-volumetric": "open3d", "frames-kinectfusion": "open3d"}


@pytest.mark.parametrize("name", ENTRIES)
def test_every_input_is_refused_in_one_line_or_taken_as_it_should_be(name):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], exc_type=ImportError)
    entry = ENTRIES[name]
    outcomes = [attempt(entry, number) for number in range(entry.in_tests + 1)]
    assert outcomes[0].verdict == "taken", outcomes[0].fault
    assert [(one.number, one.fault) for one in outcomes if one.verdict == "fault"] == []


def raising(error):
    def call(value, folder):
        raise error

    return call


@pytest.mark.parametrize(
    ("call", "verdict"),
    [
        (lambda value, folder: None, "taken"),
        (raising(InputError("no such thing")), "refused"),
        (raising(InputError("")), "fault"),
        (raising(KeyError("x")), "fault"),
    ],
)
def test_what_counts_as_a_fault(call, verdict):
    entry = Entry("entry", lambda: b"valid", mutated_bytes, call)
    assert attempt(entry, 1).verdict == verdict


def test_the_same_number_is_the_same_input():
    seen = []
    entry = Entry("e", lambda: b"valid" * 9, mutated_bytes, lambda v, folder: seen.append(v))
    for number in (0, 1, 2, 1, 2):
        attempt(entry, number)
    assert seen[0] == b"valid" * 9
    assert seen[1:3] == seen[3:5]
    assert len(set(seen)) > 1
    attempt(replace(entry, name="another name"), 1)
    assert seen[5] != seen[1]


def test_mutations_leave_the_valid_input_as_it_is():
    valid = {"a": [1, 2.5, {"b": np.arange(3.0)}], "c": ("x", None)}
    text = repr(valid)
    changed = [mutated_tree(valid, np.random.default_rng(k)) for k in range(200)]
    assert repr(valid) == text
    assert sum(repr(one) != text for one in changed) > 150
    assert ("a", 2, "b") in set(places(valid))
