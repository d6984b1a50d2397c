"""The best trial for a divergence, and levels of adaptation, against what their words say."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.slam import adaptation, frame_selection
from ms_slam_env.slam.adaptation import AdaptiveSlam
from ms_slam_env.slam.configuration import SlamConfiguration, write_levels
from ms_slam_env.tuning.choices import Limit, as_options, for_divergence, levels_of
from ms_slam_env.tuning.front import Point, front_of

LIMIT = Limit("ate_m", 1.5)


def trial(number: int, error: float, ext: float, change: float, feasible: bool = True) -> Point:
    measured = {"ate_m": error, "ext_ms": ext, "largest_change": change, "M_I": change, "M_D": 1.0}
    return Point(number, {}, measured, (error, ext), feasible, False, number == 0)


TRIALS = st.lists(
    st.tuples(
        st.sampled_from([1.0, 1.2, 1.6, 2.0]), st.integers(1, 6), st.integers(1, 3), st.booleans()
    ),
    min_size=1,
    max_size=10,
).map(lambda rows: [trial(k, *row) for k, row in enumerate(rows)])


@settings(deadline=None)
@given(TRIALS)
def test_levels_are_what_none_beats_in_time_and_divergence(points):
    levels = levels_of(points, LIMIT)
    pairs = [(p.measured["ext_ms"], p.measured["largest_change"]) for p in levels]
    for slower, faster in itertools.pairwise(reversed(pairs)):
        assert slower[0] > faster[0]
        assert slower[1] > faster[1]
    good = [p for p in points if p.feasible and p.measured["ate_m"] <= 1.5]
    for asked in (1, 2, 3):  # for every divergence the first level that copes is the fastest there
        able = [p.measured["ext_ms"] for p in good if p.measured["largest_change"] >= asked]
        found = [ext for ext, change in pairs if change >= asked]
        assert found[:1] == ([min(able)] if able else [])


@settings(deadline=None)
@given(TRIALS, st.integers(1, 3))
def test_the_answer_for_a_divergence(points, asked):
    able = [p for p in points if p.feasible and p.measured["M_I"] >= asked]
    if not able:
        with pytest.raises(InputError, match=f"no feasible trial was measured at M_I >= {asked}"):
            for_divergence(points, asked, 1.0, LIMIT)
        return
    answer = for_divergence(points, asked, 1.0, LIMIT)
    assert answer in able
    good = [p.measured["ext_ms"] for p in able if p.measured["ate_m"] <= 1.5]
    if good:
        assert answer.measured["ext_ms"] == min(good)
        assert answer.measured["ate_m"] <= 1.5
    else:
        assert answer.measured["ate_m"] == min(p.measured["ate_m"] for p in able)


@settings(deadline=None)
@given(TRIALS)
def test_a_front_is_what_none_beats(points):
    front = front_of(points, ("ate_m", "ext_ms"))
    for p in points:
        beaten = any(
            all(a <= b for a, b in zip(q.values, p.values, strict=True)) and q.values != p.values
            for q in points
        )
        assert (p in front) == (not beaten)


def test_the_limit_is_a_multiple_of_the_defaults_error():
    points = [trial(0, 0.01, 5, 1), trial(1, 0.013, 3, 1)]
    assert Limit.of(points, ("ate_m", "ext_ms"), 1.2).value == pytest.approx(0.012)
    assert [Limit.of(points, ("ate_m",), t).holds(points[1]) for t in (1.2, 1.4)] == [False, True]
    assert Limit.of(points[1:], ("ate_m",), 1.2).holds(points[1])  # no default, no limit


@pytest.fixture
def levels_file(tmp_path):
    """What a study of two levels writes: one of 10 and one of 20 points a level, say."""
    points = [trial(0, 1.0, 5.0, 0.004), trial(1, 1.1, 3.0, 0.004), trial(2, 1.2, 6.0, 0.03)]
    levels = levels_of(points, LIMIT)
    assert [p.number for p in levels] == [1, 2]
    made = [
        SlamConfiguration(slam_config={"points_per_level": 1000 * k}, image_size="80x60")
        for k in (1, 2)
    ]
    write_levels(tmp_path / "levels.yaml", as_options(levels, made, points))
    return tmp_path / "levels.yaml"


def test_adaptation_takes_its_levels_from_a_study(levels_file):
    config = adaptation.make_config("divergence", levels=str(levels_file), dwell_frames=3)
    assert config.thresholds == (0.004,)
    assert config.costs == (3.0, 6.0)
    backend = config.adapt(slam.make("surfel", xtion("160x120"), max_surfels=20_000))
    assert isinstance(backend, AdaptiveSlam)
    assert [level.config.points_per_level for level in backend.levels] == [1000, 2000]
    assert [level.image_size for level in backend.levels] == [(80, 60)] * 2
    with pytest.raises(InputError, match="levels and configurations both say"):
        adaptation.make_config("divergence", levels=levels_file, configurations=["a.yaml"])


def test_frame_management_takes_its_threshold_from_a_study(levels_file):
    config = frame_selection.parse_frame_selection(f"divergence,levels={levels_file},max_skip=3")
    assert config.threshold == pytest.approx(0.026)  # what the last copes with, less one frame
    assert config.max_skip == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot read levels"),
        ("a: [", "not YAML"),
        ("adaptation: 3", "has no section 'adaptation'"),
        ("frame_management: {threshold: 1}", "has no section 'adaptation'"),
        ("adaptation: {configurations: [{}, {}], thresholds: [2, 1]}", "thresholds = "),
        ("adaptation: {configurations: 3}", "configurations = 3"),
    ],
)
def test_a_bad_file_of_levels_is_one_line(tmp_path, text, message):
    path = tmp_path / "levels.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        adaptation.make_config("divergence", levels=path)
    assert "\n" not in str(caught.value)


def test_one_level_is_none_to_switch_among():
    points = [trial(0, 1.0, 5.0, 0.004)]
    assert as_options(levels_of(points, LIMIT), [SlamConfiguration()], points) == {}
