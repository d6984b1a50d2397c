"""Tiny runs of every experiment give the numbers that are stored; see ``experiments.py``."""

from __future__ import annotations

import pytest

from experiments import RUNS, STORED, differences, measure, read


@pytest.mark.parametrize("name", RUNS)
def test_an_experiment_gives_its_numbers(name: str) -> None:
    assert differences(name, measure(name), read(STORED)[name]) == []


def test_no_numbers_are_left_of_experiments_that_are_gone() -> None:
    assert set(read(STORED)) == set(RUNS)
