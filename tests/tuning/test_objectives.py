"""Constraints, and what failed evaluations count as."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.tuning import Constraint, ExplorationSettings, parse_constraint
from ms_slam_env.tuning.objectives import METRICS, objective_values

REFERENCE = {"ate_m": 0.03, "ext_ms": 20.0}
NUMBERS = st.none() | st.floats(0, 1e6) | st.just(math.nan) | st.just(math.inf)


def test_a_constraint_is_read():
    assert parse_constraint("ate_m<0.01") == Constraint("ate_m", 0.01)
    assert parse_constraint(" ext_ms <= 5 ") == Constraint("ext_ms", 5.0)
    assert parse_constraint("M_I<0.02") == Constraint("M_I", 0.02)
    assert parse_constraint("M_D >= 0.02") == Constraint("M_D", 0.02, at_least=True)
    assert str(Constraint("ate_m", 0.01)) == "ate_m<0.01"
    assert str(Constraint("ext_ms", 5.0)) == "ext_ms<5"


@given(name=st.sampled_from(sorted(METRICS)), limit=st.floats(1e-9, 1e9), at_least=st.booleans())
def test_a_constraint_is_read_back_from_its_text(name, limit, at_least):
    constraint = Constraint(name, limit, at_least and name in ("M_I", "M_D"))
    assert parse_constraint(str(constraint)) == constraint


def test_a_divergence_is_an_axis_on_which_more_is_better():
    assert Constraint("M_I", 0.02, at_least=True).violation({"M_I": 0.01}) == pytest.approx(0.5)
    assert Constraint("M_I", 0.02, at_least=True).violation({"M_I": 0.03}) <= 0
    assert Constraint("M_I", 0.02, at_least=True).violation({}) > 0
    assert Constraint("M_I", 0.02).violation({"M_I": 0.03}) == pytest.approx(0.5)
    reference = {"M_I": METRICS["M_I"].told(0.001)}
    easy, hard, none = (
        objective_values({"M_I": M_I}, ("M_I",), reference)[0] for M_I in (0.01, 0.02, None)
    )
    assert hard < easy < none == reference["M_I"] == pytest.approx(1000)
    lost = {"M_I": 0.02, "failure": "lost"}
    assert objective_values(lost, ("M_I",), reference)[0] == none  # it did not cope with that


@settings(deadline=None)  # a busy machine is no failure
@given(value=NUMBERS, limit=st.floats(0.001, 100))
def test_a_constraint_is_violated_above_its_limit(value, limit):
    violation = Constraint("ate_m", limit).violation({"ate_m": value})
    known = value is not None and math.isfinite(value)
    assert math.isfinite(violation)
    assert (violation <= 0) == ((value if known else 1.0) <= limit)


@settings(deadline=None)  # a busy machine is no failure
@given(ate=NUMBERS, ext=NUMBERS, failed=st.booleans())
def test_values_are_finite_and_never_above_the_reference(ate, ext, failed):
    measured = {"ate_m": ate, "ext_ms": ext, "failure": "lost" if failed else ""}
    values = objective_values(measured, ("ate_m", "ext_ms"), REFERENCE)
    assert all(math.isfinite(value) for value in values)
    assert values[0] <= REFERENCE["ate_m"]
    assert values[1] <= REFERENCE["ext_ms"]
    if failed:
        assert values[0] == REFERENCE["ate_m"]
    elif ate is not None and ate < REFERENCE["ate_m"]:
        assert values[0] == ate


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objectives": ("ate",)}, "unknown objective 'ate'; valid choices: ate_m"),
        ({"objectives": ("ate_m",)}, "must be two or more"),
        ({"objectives": ("ate_m", "ate_m")}, "each once"),
        ({"sampler": "grid"}, "valid choices: random, nsga2, tpe, gp"),
        ({"constraints": ("ate_m>1",)}, "'ate_m>1' is not metric<limit"),
        ({"constraints": ("speed<1",)}, "unknown metric of a constraint 'speed'"),
        ({"constraints": ("ate_m<small",)}, "'small' is not a number"),
        ({"constraints": ("M_I>0",)}, "'0' is not a positive number"),
        ({"constraints": ("ate_m<0.1<0.2",)}, "'0.1<0.2' is not a number"),
        ({"constraints": ("ate_m<nan",)}, "'nan' is not a number"),
        ({"population": 1}, "population = 1 is outside"),
    ],
)
def test_bad_settings_are_one_line(options, message):
    with pytest.raises(InputError) as caught:
        ExplorationSettings(**options)
    assert message in str(caught.value)
