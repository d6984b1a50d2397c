"""Configuration: what a field refuses, in one clear line."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError
from ms_slam_env.slam.surfel import SurfelConfig


@dataclass(frozen=True)
class Options(Checked):
    count: int = bounded(2, 0, 5)
    length_m: float = bounded(1.0, 0, 5)
    limit: int | None = bounded(None, 0, 5)
    kind: str = chosen("fast", "fast", "robust")


@pytest.mark.parametrize("value", [0, 5, np.int64(3)])
def test_an_integer_in_range_passes(value: Any) -> None:
    Options(count=value, length_m=value)


@pytest.mark.parametrize("value", [-1, 6, float("nan"), "2", None, True, [1]])
@pytest.mark.parametrize("name", ["count", "length_m"])
def test_what_is_no_number_in_range_is_refused(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=rf"Options.{name} = .* is outside \[0, 5\]"):
        Options(**{name: value})


def test_a_fraction_is_no_integer() -> None:
    Options(length_m=2.5)
    with pytest.raises(InputError, match=r"Options.count = 2.5 must be an integer"):
        Options(count=2.5)  # type: ignore[arg-type]


def test_only_a_field_that_may_be_none_takes_none() -> None:
    assert Options(limit=None).limit is None
    with pytest.raises(InputError, match=r"Options.limit = 6 is outside \[0, 5\]"):
        Options(limit=6)


def test_a_subclass_with_another_default_keeps_the_range() -> None:
    @dataclass(frozen=True)
    class More(Options):
        count: int = 4

    assert More().count == 4
    with pytest.raises(InputError, match=r"More.count = 6 is outside \[0, 5\]"):
        More(count=6)


def test_an_unknown_choice_is_refused_with_the_valid_ones() -> None:
    assert Options(kind="robust").kind == "robust"
    with pytest.raises(InputError, match=r"unknown Options.kind 'slow'; valid choices: fast, rob"):
        Options(kind="slow")


@pytest.mark.parametrize(
    ("owner", "options", "message"),
    [
        (DivergenceConfig, {"bins": 2.5}, "bins = 2.5 must be an integer"),
        (DivergenceConfig, {"windows": 3}, "windows = 3 must be two integers in [1, 16]"),
        (DivergenceConfig, {"windows": (2, 0)}, "windows = (2, 0) must be two integers"),
        (SurfelConfig, {"max_surfels": 5000.5}, "max_surfels = 5000.5 must be an integer"),
        (SurfelConfig, {"iterations": 3}, "iterations = 3 must be 1 to 5 integers"),
        (SurfelConfig, {"iterations": ()}, "iterations = () must be 1 to 5 integers"),
        (SurfelConfig, {"iterations": "444"}, "iterations = '444' must be 1 to 5 integers"),
    ],
)
def test_a_wrong_kind_of_value_is_named(owner: type, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        owner(**options)


def test_lists_become_tuples_as_configurations_are_compared_and_hashed() -> None:
    assert DivergenceConfig(windows=[2, 3]) == DivergenceConfig(windows=(2, 3))  # type: ignore[arg-type]
    assert SurfelConfig(iterations=[1, 2]) == SurfelConfig(iterations=(1, 2))  # type: ignore[arg-type]
