"""Run-time adaptation: which configuration is in force when, and that the SLAM is the same one."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from box_scene import BoxScene
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.config import from_dict
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.adaptation import (
    AdaptationConfig,
    AdaptiveSlam,
    DivergenceAdaptationConfig,
    default_configurations,
    make_config,
)
from ms_slam_env.slam.adaptation.controllers import DivergenceController
from ms_slam_env.slam.configuration import SlamConfiguration, write_configuration

CAMERA = xtion("160x120")
START = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])
FAST = {"slam_config": {"iterations": [1, 1], "points_per_level": 1000}, "image_size": "80x60"}
PLAIN: dict[str, object] = {}
PARAMS = {"max_surfels": 60_000}
QUIET = make_pose(so3_exp([0, np.radians(-0.2), 0]), [0.003, 0, 0])
WILD = make_pose(so3_exp([0, np.radians(-4), 0]), [0.03, 0, 0])


@pytest.fixture(scope="module")
def frames(box_scene: BoxScene) -> list[RGBDFrame]:
    """Eight quiet ones, four wild ones, eight quiet ones."""
    sensor = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=0)
    poses = [START]
    for index in range(1, 20):
        poses.append(poses[-1] @ (WILD if 8 <= index < 12 else QUIET))
    return [sensor.capture(pose, i, i / 30) for i, pose in enumerate(poses)]


def adapted(name="divergence", configurations=(FAST, PLAIN), drops_frames=True, **options):
    config = make_config(name, configurations=configurations, **options)
    backend = config.adapt(slam.make("surfel", CAMERA, **PARAMS), drops_frames)
    backend.reset(START)
    return backend


def test_before_any_frame_the_level_is_the_first(frames):
    backend = adapted(thresholds=[0.02], dwell_frames=3)
    assert backend.level == 1
    state = backend.get_state()
    for frame in frames[:5]:
        backend.track(frame)
    assert backend.level == 0
    backend.reset(START)
    assert backend.level == 1
    backend.set_state(state)
    assert backend.level == 1


def test_violent_frames_are_processed_robustly_and_calm_ones_fast(frames):
    backend = adapted(thresholds=[0.02], dwell_frames=3)
    levels = []
    for frame in frames:
        assert backend.track(frame).tracking_ok
        levels.append(backend.level)
    # Starts robust; three calm frames lead down; the first wild frame up; three calm ones down.
    assert levels == [1, 1, 1] + [0] * 5 + [1] * 6 + [0] * 6
    assert backend.backend.image_size == (80, 60)


def test_one_configuration_is_the_plain_backend_to_the_bit(frames):
    plain = slam.make("surfel", CAMERA, **PARAMS)
    plain.reset(START)
    both = adapted(configurations=(PLAIN, PLAIN), thresholds=[0.01], dwell_frames=1)
    for frame in frames[:12]:
        np.testing.assert_array_equal(
            both.track(frame).T_world_camera, plain.track(frame).T_world_camera
        )
    np.testing.assert_array_equal(both.surface_points(), plain.surface_points())


def test_none_is_the_backend_itself():
    backend = slam.make("surfel", CAMERA)
    assert make_config("none").adapt(backend) is backend


def test_an_agent_is_obeyed_from_the_next_frame_on(frames):
    backend = adapted("agent", start=0)
    for frame, index in zip(frames, (0, 1, 1, 0, 1, 0), strict=False):
        backend.use(index)
        backend.track(frame)
        assert backend.level == index
    backend.reset(START)
    backend.track(frames[0])
    assert backend.level == 0
    for index in (-1, 2):
        with pytest.raises(InputError, match=r"outside \[0, 1\]"):
            backend.use(index)
    with pytest.raises(InputError, match="under adaptation 'agent' only"):
        adapted(thresholds=[0.01]).use(0)


def test_frames_are_dropped_by_the_configuration_in_force_if_at_all(frames):
    sparse = {**FAST, "keep_every": 3}
    options = {"configurations": (sparse, PLAIN), "thresholds": [0.02], "dwell_frames": 2}
    backend, all_frames = adapted(**options), adapted(drops_frames=False, **options)
    processed = [backend.track(frame).processed for frame in frames]
    levels = []
    for frame in frames:
        assert all_frames.track(frame).processed
        levels.append(all_frames.level)
    expected, dropped = [], 0
    for level in levels:
        keeps = level == 1 or dropped == 2 or not expected
        expected.append(keeps)
        dropped = 0 if keeps else dropped + 1
    assert processed == expected
    assert 0 < sum(processed) < len(frames)


def test_lost_tracking_calls_for_the_most_robust(frames):
    backend = adapted(thresholds=[0.5], dwell_frames=1, start=0)
    backend.track(frames[0])
    backend.track(frames[1])
    assert backend.level == 0
    dark = RGBDFrame(np.zeros_like(frames[0].color), np.zeros_like(frames[0].depth), 1.0)
    assert not backend.track(dark).tracking_ok
    assert backend.track(frames[2]).tracking_ok
    assert backend.level == 1


@pytest.mark.parametrize("name", ["divergence", "agent"])
def test_a_saved_state_goes_on_to_the_bit(frames, name):
    sparse = {**FAST, "keep_every": 2}
    options = {"thresholds": [0.02], "dwell_frames": 3} if name == "divergence" else {"start": 0}
    one, other = (adapted(name, (sparse, PLAIN), **options) for _ in range(2))
    for frame in frames[:7]:
        one.track(frame)
    other.track(frames[5])
    other.set_state(copy.deepcopy(one.get_state()))
    assert other.level == one.level
    for index, frame in enumerate(frames[7:]):
        if name == "agent" and index in (2, 5):
            one.use(index % 2)
            other.use(index % 2)
        a, b = one.track(frame), other.track(frame)
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
        assert (a.processed, one.level) == (b.processed, other.level)
    np.testing.assert_array_equal(one.surface_points(), other.surface_points())


def test_configurations_are_files_mappings_or_objects(tmp_path, frames):
    path = tmp_path / "fast.yaml"
    write_configuration(path, from_dict(SlamConfiguration, FAST))
    made = [
        adapted("agent", configurations=(first, PLAIN)).levels
        for first in (FAST, str(path), path, from_dict(SlamConfiguration, FAST))
    ]
    assert made[0] == made[1] == made[2] == made[3]
    fast, plain = made[0]
    assert fast.image_size == (80, 60)
    assert fast.config.iterations == (1, 1)
    assert plain.config.max_surfels == fast.config.max_surfels == 60_000  # as it was made


@pytest.mark.parametrize("size", ["160x120", "320x240", "640x480"])
def test_the_default_configurations_suit_the_camera(size):
    camera = xtion(size)
    backend = make_config("agent").adapt(slam.make("surfel", camera, **PARAMS))
    assert isinstance(backend, AdaptiveSlam)
    assert len(backend.levels) == 3
    costs = [one.about["cost"] for one in default_configurations(camera)]
    assert costs == sorted(costs)
    assert make_config("agent").costs_of(camera) == tuple(costs)


class _Changes(DivergenceController):
    """A controller that is told the changes."""

    def __init__(self, config, changes):
        super().__init__(config, CAMERA)
        self.told = iter(changes)

    def _observe(self, frame):
        self._time_s, self.change = 0.0, next(self.told)


@settings(max_examples=60, deadline=None)
@given(
    changes=st.lists(st.floats(0, 4), min_size=1, max_size=60),
    dwell=st.integers(1, 5),
    share=st.sampled_from([0.5, 1.0]),
)
def test_the_ladder_against_a_slow_obvious_one(changes, dwell, share):
    """Up at once; down to what the largest change of a whole window permits."""
    config = DivergenceAdaptationConfig(
        configurations=({}, {}, {}), thresholds=(1, 2), dwell_frames=dwell, release_share=share
    )
    controller = _Changes(config, changes)
    frame = RGBDFrame(np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32))
    index = 2
    for place, change in enumerate(changes):
        got = controller.choose(frame, False)
        if place > 0:  # the first frame has none before it
            for level in (1, 2):
                if change >= level and index < level:
                    index = level
            window = changes[max(1, place + 1 - dwell) : place + 1]
            while len(window) == dwell and index and max(window) < share * index:
                index -= 1
        assert got == index


def test_the_change_may_be_counted_per_second(frames):
    config = DivergenceAdaptationConfig(configurations=({}, {}), thresholds=(0.01,), per="second")
    seconds = config.make_controller(CAMERA)
    nats = replace(config, per="frame").make_controller(CAMERA)
    for frame in frames[:3]:
        seconds.choose(frame, False)
        nats.choose(frame, False)
    assert seconds.change == pytest.approx(30 * nats.change)
    with pytest.raises(InputError, match="time stamps that increase"):
        seconds.choose(frames[0], False)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "magic"}, "unknown adaptation.name 'magic'; valid choices: none, divergence"),
        ({"name": "agent", "speed": 1}, "unknown option of AgentConfig 'adaptation.speed'"),
        ({"name": "agent", "configurations": "fast.yaml"}, "must be a list of files"),
        ({"name": "agent", "configurations": ["no.yaml", {}]}, "cannot read configuration no.yaml"),
        ({"name": "agent", "configurations": [{}]}, "must be at least two"),
        ({"name": "agent", "configurations": [{}] * 9}, "has 9 entries, more than 8"),
        ({"name": "agent", "configurations": [1, 2]}, r"configurations\[0\] = 1 must be"),
        ({"name": "agent", "start": 3}, r"start = 3 is outside \[0, 2\]"),
        ({"name": "agent", "costs": [1, 1, 2]}, "must be 3 increasing positive numbers"),
        ({"name": "divergence", "thresholds": [0.1]}, "must be 2 increasing positive numbers"),
        ({"name": "divergence", "thresholds": [0.2, 0.1]}, "must be 2 increasing positive"),
        ({"name": "divergence", "release_share": 0}, "release_share = 0 is outside"),
        ({"name": "divergence", "per": "metre"}, "valid choices: frame, second"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InputError, match=message) as caught:
        from_dict(AdaptationConfig, options, "adaptation")  # type: ignore[type-abstract]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ({"slam": "odometry"}, "slam = 'odometry' must be 'surfel'"),
        ({"image_size": "320x240"}, "cannot be reduced to 320x240"),
        ({"slam_config": {"max_surfels": 5000}}, "SurfelConfig.max_surfels = 5000 differs"),
    ],
)
def test_what_a_running_slam_cannot_become(second, message):
    with pytest.raises(InputError, match=rf"^configurations\[1\]: .*{message}"):
        adapted("agent", configurations=({}, second))
    with pytest.raises(InputError, match="only the SLAM backend 'surfel'"):
        make_config("agent").adapt(slam.make("odometry", CAMERA))
