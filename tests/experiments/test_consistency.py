"""The rule for duplicated objects against copies made by known offsets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ms_slam_experiments.shared.duplicate_objects import (
    ConsistencyRule,
    LabelledView,
    MapConsistency,
    SightingRule,
    count_votes,
    distinct_placements,
    judge_consistency,
)

from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, look_at, make_pose, so3_exp, transform_points

CAMERA = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)
GREY = np.full((*CAMERA.shape, 3), 128, dtype=np.uint8)


def square(side_m: float, spacing_m: float = 0.01) -> np.ndarray:
    """Points at the centres of the cells of a horizontal square, one corner at the origin."""
    line = np.arange(spacing_m / 2, side_m, spacing_m)
    x, y = np.meshgrid(line, line, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def box(size_m: float) -> np.ndarray:
    """Points on the surface of a cube."""
    face = square(size_m)
    sides = []
    for axis in range(3):
        turned = np.roll(face, axis, axis=1)
        moved = turned.copy()
        moved[:, (2 + axis) % 3] = size_m
        sides += [turned, moved]
    return np.concatenate(sides)


def judge(
    copies: list[np.ndarray], surface: np.ndarray, rule: ConsistencyRule, **options: Any
) -> MapConsistency:
    points = np.concatenate(copies)
    votes = np.ones((len(points), 1), dtype=int)
    return judge_consistency(points, votes, surface, np.zeros(len(surface), int), rule, **options)


def test_clean_map_succeeds() -> None:
    surface = box(0.3)
    rng = np.random.default_rng(0)
    noisy = surface + rng.normal(0, 0.005, surface.shape)
    verdict = judge([noisy], surface, ConsistencyRule())
    assert verdict.success
    assert verdict.duplicated == ()
    assert not verdict.apart.any()
    assert verdict.objects[0].points == len(surface)


@pytest.mark.parametrize(("offset_m", "twice"), [(0.03, False), (0.06, True), (0.2, True)])
def test_copy_above_a_plane(offset_m: float, twice: bool) -> None:
    surface = square(0.5)
    verdict = judge(
        [surface, surface + np.array([0, 0, offset_m])], surface, ConsistencyRule(apart_m=0.04)
    )
    assert verdict.success is not twice
    assert verdict.objects[0].apart_share == (0.5 if twice else 0.0)
    assert verdict.apart.sum() == (len(surface) if twice else 0)


@pytest.mark.parametrize("offset_m", [0.06, 0.1, 0.2])
def test_copy_slid_within_its_plane_shows_by_its_overhang(offset_m: float) -> None:
    side, apart = 0.4, 0.0401  # beyond the rounding of a distance of four cells
    surface = square(side)
    verdict = judge(
        [surface, surface + np.array([offset_m, 0, 0])],
        surface,
        ConsistencyRule(apart_m=apart, share=0.05),
    )
    overhang = (offset_m - 0.04) / side
    assert verdict.objects[0].apart_share == pytest.approx(overhang / 2, abs=1e-9)
    assert verdict.success is not (overhang / 2 > 0.05)


def test_slid_floor_shows_by_what_stands_on_it() -> None:
    floor, thing = square(2.0, 0.02), box(0.1) + np.array([1.0, 1.0, 0.0])
    slid = np.array([0.15, 0.0, 0.0])
    points = np.concatenate([floor, floor + slid, thing, thing + slid])
    label = np.repeat([0, 0, 1, 1], [len(floor), len(floor), len(thing), len(thing)])
    surface = np.concatenate([floor, thing])
    owner = np.repeat([0, 1], [len(floor), len(thing)])
    verdict = judge_consistency(points, np.eye(2, dtype=int)[label], surface, owner)
    assert [item.label for item in verdict.duplicated] == [1]


def test_object_shown_once_but_shifted_is_no_duplicate() -> None:
    surface = box(0.3)
    shift = make_pose(so3_exp(np.array([0.0, 0.1, 0.2])), np.array([0.3, -0.2, 0.1]))
    moved = transform_points(shift, surface)
    rule = ConsistencyRule()
    assert not judge([moved], surface, rule).success
    verdict = judge([moved], surface, rule, placements=np.stack([np.eye(4), invert(shift)]))
    assert verdict.success
    assert verdict.objects[0].misplaced_share > 0.8
    assert verdict.objects[0].apart_share == 0.0


def test_no_placement_reconciles_two_copies() -> None:
    surface = box(0.3)
    shift = make_pose(np.eye(3), np.array([0.25, 0.0, 0.05]))
    placements = np.stack([np.eye(4), invert(shift)])
    copies = [surface, transform_points(shift, surface)]
    verdict = judge(copies, surface, ConsistencyRule(), placements=placements)
    assert not verdict.success
    assert verdict.objects[0].apart_share > 0.3


def test_points_of_few_votes_do_not_count() -> None:
    surface = square(0.5)
    points = np.concatenate([surface, surface + np.array([0, 0, 0.3])])
    votes = np.zeros((len(points), 2), dtype=int)
    votes[: len(surface), 0] = 10
    votes[len(surface) :] = [2, 8]  # a fifth of the views took them for object 0
    owner = np.zeros(len(surface), dtype=int)
    assert judge_consistency(points, votes, surface, owner, ConsistencyRule(support=0.3)).success
    strict = judge_consistency(points, votes, surface, owner, ConsistencyRule(support=0.1))
    assert not strict.success


def test_small_objects_are_not_judged() -> None:
    surface = square(0.05)
    copies = [surface, surface + np.array([0, 0, 0.3])]
    assert judge(copies, surface, ConsistencyRule(min_points=51)).objects == ()
    assert not judge(copies, surface, ConsistencyRule(min_points=50)).success


@settings(max_examples=20, deadline=None)
@given(
    offset=st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3),
    second_share=st.floats(0, 1),
    thresholds=st.lists(st.floats(0.005, 0.2), min_size=2, max_size=2),
    shares=st.lists(st.floats(0, 1), min_size=2, max_size=2),
)
def test_looser_thresholds_never_find_more(
    offset: list[float], second_share: float, thresholds: list[float], shares: list[float]
) -> None:
    surface = box(0.08)
    second = surface[: int(second_share * len(surface))] + offset
    near, far = sorted(thresholds)
    small, large = sorted(shares)

    def verdict(apart_m: float, share: float) -> MapConsistency:
        return judge([surface, second], surface, ConsistencyRule(apart_m=apart_m, share=share))

    assert verdict(near, 0.1).apart.sum() >= verdict(far, 0.1).apart.sum()
    assert verdict(near, large).success or not verdict(near, small).success
    assert verdict(far, small).success or not verdict(near, small).success
    if len(second):
        exact = np.linalg.norm(second[:, None] - surface[None], axis=2).min(axis=1)
        found = verdict(near, 0.1).apart.sum()
        assert np.sum(exact > near + 1e-9) <= found <= np.sum(exact > near - 1e-9)


def view_of_wall(
    T_world_camera: np.ndarray, T_estimate: np.ndarray, distance_m: float
) -> LabelledView:
    """A view whose every pixel has one depth; the left half shows object 0, the right half 1."""
    labels = np.zeros(CAMERA.shape, dtype=int)
    labels[:, 32:] = 1
    depth = np.full(CAMERA.shape, distance_m, dtype=np.float32)
    return LabelledView(T_world_camera, T_estimate, GREY, depth, labels)


def test_votes_equal_the_slow_obvious_count() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-1, -1, 0.5], [1, 1, 2.5], (300, 3))
    views = []
    for _ in range(5):
        pose = make_pose(so3_exp(rng.normal(0, 0.1, 3)), rng.normal(0, 0.1, 3))
        labels = rng.integers(-1, 4, CAMERA.shape)
        depth = rng.uniform(0.8, 2.4, CAMERA.shape).astype(np.float32)
        depth[rng.uniform(size=CAMERA.shape) < 0.1] = 0
        color = rng.integers(0, 255, (*CAMERA.shape, 3)).astype(np.uint8)
        views.append(LabelledView(np.eye(4), pose, color, depth, labels))
    colors = rng.integers(0, 255, (300, 3))
    rule = SightingRule(depth_slack_m=0.1, range_m=2.0, color_slack=90)
    by_depth, by_color = np.zeros((300, 4), dtype=int), np.zeros((300, 4), dtype=int)
    for view in views:
        for index, point in enumerate(points):
            x, y, z = transform_points(invert(view.T_world_camera_estimate), point)
            u, v = round(50 * x / z + 31.5), round(50 * y / z + 23.5)
            if not (0 < z <= 2.0 and 0 <= u < 64 and 0 <= v < 48):
                continue
            there = float(view.depth[v, u])
            label = int(view.labels[v, u])
            if there > 0 and label >= 0 and abs(there - z) <= 0.1 * max(1, z) ** 2:
                by_depth[index, label] += 1
                difference = view.color[v, u].astype(int) - colors[index]
                by_color[index, label] += max(abs(difference)) <= 90
    expected = [
        color if any(color) else depth for color, depth in zip(by_color, by_depth, strict=True)
    ]
    assert np.sum(by_depth) > np.sum(by_color) > 10
    assert np.array_equal(count_votes(points, colors, views, CAMERA, 4, rule), expected)


def test_a_point_is_seen_where_the_estimate_puts_it() -> None:
    estimate = make_pose(np.eye(3), np.array([0.0, 0.0, 0.5]))
    view = view_of_wall(np.eye(4), estimate, 1.0)
    where_the_map_has_it, where_it_truly_is = [0.2, 0.0, 1.5], [0.2, 0.0, 1.0]
    points = [where_the_map_has_it, where_it_truly_is]
    votes = count_votes(points, np.full((2, 3), 128), [view], CAMERA, 2)
    assert votes.tolist() == [[0, 1], [0, 0]]
    assert np.allclose(view.T_true_map @ [0.2, 0, 1.5, 1], [0.2, 0, 1.0, 1])


def test_only_different_placements_are_kept() -> None:
    points = box(0.5)
    true = look_at([0, 0, 1], [1, 1, 0])
    near = make_pose(np.eye(3), np.array([0.0, 0.0, 0.01])) @ true
    far = make_pose(so3_exp(np.array([0, 0, 0.2])), np.zeros(3)) @ true
    views = [view_of_wall(true, estimate, 1.0) for estimate in (true, near, far, far)]
    placements = distinct_placements(views, points, 0.02)
    assert len(placements) == 2
    assert np.allclose(placements[0], np.eye(4))
    assert np.allclose(placements[1] @ far, true)


@pytest.mark.parametrize(
    "values",
    [
        {"apart_m": 0},
        {"apart_m": float("nan")},
        {"share": 1.1},
        {"share": -0.1},
        {"min_points": 0},
        {"min_points": 2.5},
        {"support": 2},
    ],
)
def test_bad_rules_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        ConsistencyRule(**values)


@pytest.mark.parametrize("values", [{"depth_slack_m": 0}, {"color_slack": 256}, {"range_m": -1}])
def test_bad_sighting_rules_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        SightingRule(**values)


def test_arrays_that_do_not_fit_are_refused() -> None:
    points, votes = square(0.1), np.ones((100, 1), dtype=int)
    owner = np.zeros(100, dtype=int)
    with pytest.raises(InputError, match="votes"):
        judge_consistency(points, votes[:50], points, owner)
    with pytest.raises(InputError, match="surface_labels"):
        judge_consistency(points, votes, points, owner[:50])
    with pytest.raises(InputError, match="empty"):
        judge_consistency(np.zeros((0, 3)), votes, points, owner)
    with pytest.raises(InputError, match="placement"):
        judge_consistency(points, votes, points, owner, placements=[2 * np.eye(4)])
    view = view_of_wall(np.eye(4), np.eye(4), 1.0)
    with pytest.raises(InputError, match="label 1"):
        count_votes(points, points, [view], CAMERA, 1)
    with pytest.raises(InputError, match="color of a view"):
        count_votes(points, points, [view], CAMERA.scaled(0.5), 2)
    with pytest.raises(InputError, match="colors must be"):
        count_votes(points, points[:5], [view], CAMERA, 2)
