"""Configuration: what a field refuses, in one clear line."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from ms_slam_env import slam
from ms_slam_env.config import (
    Checked,
    bounded,
    chosen,
    from_dict,
    load_yaml,
    nested_options,
    parse_named,
    parse_value,
)
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError
from ms_slam_env.sensor.noise import NOISE_MODELS
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


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("(4,5,5,10)", [4, 5, 5, 10]),
        ("[4,5,5,10]", [4, 5, 5, 10]),
        (" ( 4, 5 ,10 ) ", [4, 5, 10]),
        ("(4,)", [4]),
        ("room (2).ply", "room (2).ply"),
        ("off", "off"),
        ("no", "no"),
        ("true", True),
        ("1:30", "1:30"),
        ("010", 10),
        ("0x10", 16),
        ("1_000_000", 1_000_000),
        ("1e-3", 0.001),
        ("-.5", -0.5),
        ("null", None),
    ],
)
def test_a_value_means_what_its_text_says(text: str, value: Any) -> None:
    found = parse_value(text, "option")
    assert (type(found), found) == (type(value), value)
    if "(" not in text:
        assert load_yaml(f"key: {text}") == {"key": value}


def test_both_spellings_of_a_list_reach_a_configuration() -> None:
    for text in ("iterations=(4,5,5,10)", "iterations=[4, 5, 5, 10]"):
        assert SurfelConfig(**nested_options([text])).iterations == (4, 5, 5, 10)
        assert parse_named(f"surfel,{text},submaps=off", "backend") == (
            "surfel",
            {"iterations": [4, 5, 5, 10], "submaps": "off"},
        )
    for text in ("4,5,10", "()", "[[4]]", "true", "[true]", "[1.5]", "[1,1,1,1,1,1]"):
        with pytest.raises(
            InputError, match=r"1 to 5 integers in \[0, 100\], such as \[4, 5, 10\]"
        ):
            SurfelConfig(**nested_options([f"iterations={text}"]))


@pytest.mark.parametrize("text", ["{1: a, 1.0: b}", "{1: a, true: b}", "{a: 1, 'a': 2}"])
def test_keys_that_are_one_in_a_mapping_are_given_twice(text: str) -> None:
    with pytest.raises(ValueError, match="is given twice"):
        load_yaml(text)


def test_dotted_names_are_those_of_nested_options() -> None:
    made = from_dict(SurfelConfig, {"acceptance.inliers": 0.4, "acceptance": {"texture": 9.0}})
    assert (made.acceptance.inliers, made.acceptance.texture) == (0.4, 9.0)
    assert parse_named("surfel,acceptance.inliers=0.4", "backend")[1] == {"acceptance.inliers": 0.4}
    for values in (
        {"acceptance": {"inliers": 0.3}, "acceptance.inliers": 0.4},
        {"acceptance.inliers": 0.4, "acceptance": 3},
    ):
        with pytest.raises(InputError, match=r"acceptance already has a value"):
            from_dict(SurfelConfig, values)
    with pytest.raises(InputError, match=r"'acceptance.inlier'; valid choices: "):
        from_dict(SurfelConfig, {"acceptance.inlier": 0.4})


def test_every_backend_looks_as_far_as_a_sensor_reads() -> None:
    farthest = max(one.max_range_m for name, one in NOISE_MODELS.items() if name != "none")
    for name in slam.BACKENDS:
        slam.check_parameters(name, {"depth_cutoff_m": farthest})
