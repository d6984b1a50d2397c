"""What states are compared with: every part of ours is described, and what does not fit named."""

import numpy as np
import pytest

from ms_slam_env import slam
from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.slam.shared.state_check import (
    ArrayOf,
    Depending,
    Fields,
    ListOf,
    OrNone,
    Real,
    WholeNumber,
    check_like,
    is_open,
)

NEEDS = {"sparse": "gtsam", "volumetric": "open3d", "kinectfusion": "open3d"}
VARIANTS = [
    *((name, {}) for name in sorted(slam.BACKENDS)),
    ("surfel", {"loop_closure": "deformation", "submaps": "atlas", "relocalisation": "features"}),
    ("surfel", {"color_registration": "estimated", "motion_mask": "geometric", "readout_s": 0.02}),
]


@pytest.mark.parametrize(("name", "options"), VARIANTS)
def test_nothing_in_a_state_of_ours_is_left_undescribed(name, options):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], exc_type=ImportError)
    backend = slam.make(name, xtion("80x60"), **options)
    assert not is_open(backend.state_like())
    check_like(backend.get_state(), backend.state_like(), "slam")


ROWS, IDS = ArrayOf(np.float64, ("rows", 3)), ArrayOf(np.int64, ("ids",), 0, index_of="rows")
PAIRS = ListOf({"a": ArrayOf(np.int8, ("n",)), "b": ArrayOf(np.int8, ("n",))}, "pairs")


@pytest.mark.parametrize(
    ("value", "like", "message"),
    [
        ({"x": np.zeros((4, 3)), "y": np.zeros((5, 3))}, {"x": ROWS, "y": ROWS}, "y has length 5"),
        ({"i": np.array([3]), "x": np.zeros((3, 3))}, {"i": IDS, "x": ROWS}, r"outside \[0, 2\]"),
        ({"i": np.array([0]), "x": np.zeros((0, 3))}, {"i": IDS, "x": ROWS}, r"outside \[0, -1\]"),
        ([{"a": np.zeros(2, np.int8), "b": np.zeros(3, np.int8)}], PAIRS, r"\[0\].b has length 3"),
        ({"p": [], "n": 1}, {"p": PAIRS, "n": WholeNumber(most="pairs")}, "n counts to 1"),
        ([np.zeros((2, 2)), np.zeros((3, 2))], ListOf(ArrayOf(float, ("h", 2))), "has length 3"),
        ([np.eye(4), np.eye(4, dtype="f4")], ListOf(np.eye(4)), "several shapes or types"),
        ([{"t": 1}, {"t": 1}], ListOf({"t": 0}, rising="t"), "not in the order of t"),
        ([0, 0, 0], ListOf(0, 2), "has 3 elements"),
        ("x", OrNone(0), "is a str"),
        (2**30 + 1, 0, "counts to"),
        (True, WholeNumber(), "is a bool"),
        (np.nan, Real(), "no number"),
        (-0.5, Real(0, 1), r"no number in \[0, 1\]"),
        ({"a": 1}, Fields({"a": 0}, lambda value: "is odd" if value["a"] % 2 else ""), "is odd"),
        ({"k": 1}, Depending(lambda value: {"k": WholeNumber(most=value["k"] - 1)}), "counts to 1"),
        (np.full(3, 3e38, "f4"), ArrayOf("f4", ("n",)), "not finite"),
        (np.full(3, 300.0), ArrayOf(float, ("n",), 0, 255), r"outside \[0, 255\]"),
        (np.full((1, 4), 0.3), ArrayOf(float, (1, 4), 0, is_distribution=True), "distributions"),
    ],
)
def test_a_value_that_does_not_fit_its_description_is_refused_by_its_place(value, like, message):
    with pytest.raises(InputError, match=message):
        check_like(value, like, "x")


def test_what_fits_is_taken():
    like = {"i": IDS, "x": ROWS, "pairs": PAIRS, "one": OrNone(WholeNumber(index_of="pairs"))}
    pairs = [{"a": np.zeros(n, np.int8), "b": np.zeros(n, np.int8)} for n in (2, 5)]
    value = {"i": np.array([0, 2]), "x": np.zeros((3, 3)), "pairs": pairs, "one": 1}
    check_like(value, like, "x")
    check_like({**value, "one": None, "pairs": []}, like, "x")
    check_like({"frames": 5}, {"frames": WholeNumber(most="all")}, "x", {"all": 5})
    check_like(np.inf, Real(0), "x")
