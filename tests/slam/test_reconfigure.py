"""A running surfel SLAM that changes its parameters and the size of its images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arc import CAMERA, START, arc

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.camera.frame import reduce_color, reduce_depth
from ms_slam_env.errors import InputError
from ms_slam_env.slam.surfel import SurfelConfig, SurfelSlam

SMALL = (80, 60)
POSES = arc(14)
STILL = {"motion_mask": "none"}  # the mask starts anew with another size
BASE = SurfelConfig(max_surfels=60_000, unstable_window=4, compaction_interval=2, **STILL)
OTHERS = {
    "weight": replace(BASE, icp_rgb_weight=0.5),
    "iterations": replace(BASE, iterations=(1, 2)),
    "points": replace(BASE, points_per_level=1000),
    "cutoff": replace(BASE, depth_cutoff_m=2.2),
    "threshold": replace(BASE, confidence_threshold=2.0),
    "fusion": replace(BASE, fusion_distance_m=0.01, surfel_radius_px=1.2),
}
FAST = replace(BASE, iterations=(1, 1), points_per_level=1000, confidence_threshold=2.0)


@pytest.fixture(scope="module")
def frames(arc_frames: list[RGBDFrame]) -> list[RGBDFrame]:
    return arc_frames[:14]


def new(config: SurfelConfig = BASE) -> SurfelSlam:
    slam = SurfelSlam(CAMERA, config)
    slam.reset(START)
    return slam


def assert_same(one: object, other: object) -> None:
    """The same values, bit for bit, at any depth."""
    if isinstance(one, dict):
        assert isinstance(other, dict)
        assert one.keys() == other.keys()
        for name in one:
            assert_same(one[name], other[name])
    elif isinstance(one, (list, tuple)):
        assert isinstance(other, (list, tuple))
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    else:
        np.testing.assert_array_equal(one, other)


def assert_same_but_ferns(one: SurfelSlam, other: SurfelSlam, changed: str) -> None:
    """The same state; ferns keep the depths that they ask for, which follow the first cutoff."""
    left_out = ("relocalization",) if changed == "cutoff" else ()
    states = [slam.get_state() for slam in (one, other)]
    for state in states:
        for name in left_out:
            del state[name]
    assert_same(*states)


def test_going_elsewhere_and_back_between_frames_changes_no_bit(frames):
    plain, restless = new(), new()
    for frame in frames[:8]:
        restless.reconfigure(FAST, SMALL)
        restless.reconfigure(OTHERS["fusion"])
        restless.reconfigure(BASE)
        plain.track(frame)
        restless.track(frame)
    assert_same(restless.get_state(), plain.get_state())


@pytest.mark.parametrize("name", OTHERS)
def test_reconfigured_before_the_first_frame_it_is_a_slam_made_so(frames, name):
    changed, made = new(), new(OTHERS[name])
    changed.reconfigure(OTHERS[name])
    assert changed.config == OTHERS[name]
    for frame in frames[:6]:
        changed.track(frame)
        made.track(frame)
    assert_same_but_ferns(changed, made, name)
    assert_same(changed.surface_points(), made.surface_points())
    if name != "fusion":  # ``predict`` draws as the SLAM was made
        assert_same(vars(changed.predict(POSES[:2])), vars(made.predict(POSES[:2])))


@pytest.mark.parametrize("name", OTHERS)
def test_a_change_half_way_is_that_of_a_new_slam_with_the_old_state(frames, name):
    changed, made = new(), new(OTHERS[name])
    for frame in frames[:5]:
        changed.track(frame)
    made.set_state(changed.get_state())
    changed.reconfigure(OTHERS[name])
    for frame in frames[5:10]:
        changed.track(frame)
        made.track(frame)
    assert_same_but_ferns(changed, made, name)


def test_smaller_images_are_those_of_a_smaller_camera(frames):
    reduced = new()
    reduced.reconfigure(BASE, SMALL)
    assert reduced.image_size == SMALL
    small = SurfelSlam(CAMERA.scaled(0.5), BASE)
    small.reset(START)
    for frame in frames[:6]:
        image = RGBDFrame(reduce_color(frame.color, SMALL), reduce_depth(frame.depth, SMALL))
        small.track(image)
        reduced.track(frame)
    assert_same(reduced.get_state(), small.get_state())
    assert reduced.predict(POSES[:1]).depth.shape == (1, *CAMERA.shape)


def test_the_map_lives_on_when_the_images_change_size(frames):
    slam = new()
    for index, frame in enumerate(frames):
        before = slam.map.count()
        slam.reconfigure(FAST if index // 3 % 2 else BASE, SMALL if index // 3 % 2 else None)
        result = slam.track(frame)
        assert result.tracking_ok
        assert np.linalg.norm((result.T_world_camera - POSES[index])[:3, 3]) < 0.01
        assert slam.map.count() > 0.9 * before


def test_a_lost_frame_is_found_at_another_size(frames):
    slam = new()
    for frame in frames[:5]:
        slam.track(frame)
    dark = RGBDFrame(np.zeros_like(frame.color), np.zeros_like(frame.depth))
    slam.reconfigure(FAST, SMALL)
    assert not slam.track(dark).tracking_ok
    slam.reconfigure(BASE)
    result = slam.track(frames[5])
    assert result.tracking_ok
    assert result.relocalised


def test_a_saved_state_goes_on_where_its_configuration_is_in_force(frames):
    one, other = new(), new()
    for frame in frames[:4]:
        one.track(frame)
    one.reconfigure(FAST, SMALL)
    one.track(frames[4])
    saved = one.get_state()
    other.reconfigure(FAST, SMALL)
    other.set_state(saved)
    for index in (5, 6, 7):
        if index == 7:
            one.reconfigure(BASE)
            other.reconfigure(BASE)
        one.track(frames[index])
        other.track(frames[index])
    assert_same(one.get_state(), other.get_state())


def test_what_a_running_slam_must_keep():
    slam = new()
    for change in ({"max_surfels": 50_000}, {"motion_mask": "geometric"}):
        name = next(iter(change))
        with pytest.raises(InputError, match=rf"^SurfelConfig.{name} = .* stay as they are"):
            slam.reconfigure(replace(BASE, **change))
    for size in ((320, 240), (80, 80), (0, 0)):
        with pytest.raises(InputError, match=r"^frames of 160x120 cannot be reduced to"):
            slam.reconfigure(BASE, size)
    with pytest.raises(InputError, match=r"^frames of 20x15 have other ferns"):
        slam.reconfigure(BASE, (20, 15))
    assert slam.config == BASE
    assert slam.image_size == (160, 120)
    closing = replace(BASE, loop_closure="deformation")
    loops = SurfelSlam(CAMERA, closing)
    with pytest.raises(InputError, match="keeps its image size"):
        loops.reconfigure(closing, SMALL)
