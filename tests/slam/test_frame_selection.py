"""Frame management: which frames are processed, and what is said of the others."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from box_scene import BoxScene
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, intensity_image, xtion
from ms_slam_env.config import from_dict
from ms_slam_env.divergence import DivergenceConfig, depth_divergence, intensity_divergence
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, look_at, make_pose, se3_exp, se3_log, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.frame_selection import (
    BudgetConfig,
    DivergenceFilterConfig,
    FrameSelectionConfig,
    RegularConfig,
    SelectiveSlam,
    make_config,
)
from ms_slam_env.slam.frame_selection.budget import (
    HIGHEST_THRESHOLD,
    LOWEST_THRESHOLD,
    BudgetFilter,
)
from ms_slam_env.slam.frame_selection.filters import Change, ChangeConfig, RegularSkipping
from ms_slam_env.slam.slam_backend import Loop, SlamBackend, TrackResult, Views

CAMERA = xtion("80x60")
START = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])
STILL, STEP = np.eye(4), make_pose(so3_exp([0, np.radians(-2.0), 0]), [0.04, 0, 0.008])
MOTIONS = [STEP] * 4 + [STILL] * 6 + [STEP] * 4 + [STILL] * 4
FILTERS: dict[str, dict[str, Any]] = {
    "none": {},
    "regular": {"every": 2.5},
    "divergence": {"threshold": 0.02},
    "budget": {"share": 0.5},
}


@pytest.fixture(scope="module")
def frames(box_scene: BoxScene) -> list[RGBDFrame]:
    """Moving, resting, moving, resting; 30 a second."""
    sensor = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=0)
    poses = [START]
    for motion in MOTIONS:
        poses.append(poses[-1] @ motion)
    return [sensor.capture(pose, k, timestamp=k / 30) for k, pose in enumerate(poses)]


def _surfel() -> SlamBackend:
    backend = slam.make("surfel", CAMERA, max_surfels=30_000)
    backend.reset(START)
    return backend


def _black(time: float = 0.0) -> RGBDFrame:
    color = np.zeros((*CAMERA.shape, 3), dtype=np.uint8)
    return RGBDFrame(color, np.zeros(CAMERA.shape, dtype=np.float32), time)


_BLACK = _black()


class Recorder(SlamBackend):
    """Notes what it is shown; says what it is told to."""

    def __init__(self) -> None:
        self.intrinsics = CAMERA
        self.shown: list[RGBDFrame] = []
        self.fused: list[np.ndarray] = []
        self.guesses: list[Any] = []
        self.answers: list[TrackResult] = []
        self.pose = np.eye(4)

    def reset(self, T_world_camera: Any = None) -> None:
        self.pose = np.eye(4) if T_world_camera is None else np.array(T_world_camera)
        self.shown.clear()

    def track(self, frame: RGBDFrame, T_world_camera_guess: Any = None) -> TrackResult:
        self.shown.append(frame)
        self.guesses.append(T_world_camera_guess)
        if self.answers:
            return self.answers.pop(0)
        self.pose = self.pose @ STEP
        return TrackResult(self.pose, True)

    def fuse(self, frame: RGBDFrame, T_world_camera: Any) -> TrackResult:
        self.shown.append(frame)
        self.fused.append(T_world_camera)
        return TrackResult(np.array(T_world_camera), True)

    def predict(self, poses: Any, scale: float = 1.0) -> Views:
        raise NotImplementedError

    def surface_points(self) -> np.ndarray:
        return np.zeros((0, 3))

    def surface_colors(self) -> np.ndarray:
        return np.zeros((0, 3), dtype=np.uint8)

    def corrected_trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        kept = np.arange(0, len(self.shown), 2, dtype=np.int32)
        return kept, np.stack([make_pose(np.eye(3), [10.0 * k, 0, 0]) for k in kept])

    def get_state(self) -> dict[str, Any]:
        return {"pose": self.pose.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        self.pose = state["pose"].copy()


# -- Which frames --------------------------------------------------------------------------------


def test_without_management_nothing_changes(frames):
    bare = _surfel()
    assert make_config("none").manage(bare) is bare
    managed = SelectiveSlam(_surfel(), RegularSkipping(1))
    for frame in [*frames[:8], _black(), *frames[8:10]]:
        a, b = bare.track(frame), managed.track(frame)
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
        np.testing.assert_array_equal(a.covariance, b.covariance)
        assert (a.tracking_ok, a.residual_m, a.reason) == (b.tracking_ok, b.residual_m, b.reason)
        assert b.processed
    np.testing.assert_array_equal(bare.surface_points(), managed.surface_points())
    np.testing.assert_array_equal(bare.map_points(), managed.map_points())
    np.testing.assert_array_equal(
        bare.predict(START[None]).depth, managed.predict(START[None]).depth
    )
    for own, theirs in zip(
        bare.corrected_trajectory(), managed.corrected_trajectory(), strict=True
    ):
        np.testing.assert_array_equal(own, theirs)
    for name, values in bare.map_attributes().items():
        np.testing.assert_array_equal(values, managed.map_attributes()[name])


@pytest.mark.parametrize("every", [1.0, 2.0, 3.0, 2.5, 1.3])
def test_regular_skipping_keeps_the_share(every):
    backend = Recorder()
    managed = RegularConfig(every=every).manage(backend)
    processed = [managed.track(_black()).processed for _ in range(100)]
    # the frames that a clock ticking every ``every`` frames meets first
    due = {int(np.ceil(k * every - 1e-9)) for k in range(200)}
    assert [k for k in range(100) if processed[k]] == sorted(due & set(range(100)))
    assert len(backend.shown) == sum(processed)


def _slow_change(current: RGBDFrame, reference: RGBDFrame, weight: float) -> float:
    """The divergences of the frames' every second row and column, by the plain functions."""
    config = DivergenceConfig()
    intrinsics = CAMERA.every_nth(2)
    images, depths = [], []
    for frame in (current, reference):
        grey, depth = intensity_image(frame.color)[::2, ::2], frame.depth[::2, ::2]
        images.append(grey[depth > 0].reshape(1, -1))  # as the default configuration has it
        depths.append(depth)
    intensity = intensity_divergence(
        *images, bins=config.bins, pseudo_count=config.pseudo_count, smoothing=config.smoothing
    )
    depth = depth_divergence(
        *depths,
        intrinsics,
        inclinations=config.inclinations,
        alpha_deg=config.alpha_deg,
        pseudo_count=config.pseudo_count,
        normal_reach_deg=config.normal_reach_deg,
        edge_threshold=config.edge_threshold,
    )
    return intensity + weight * depth


@pytest.mark.parametrize("reference", ["processed", "previous"])
@pytest.mark.parametrize("threshold", [0.0, 0.004, 0.02, 0.1])
def test_the_divergence_filter_is_the_obvious_one(frames, threshold, reference):
    change = ChangeConfig(width=40, depth_weight=0.5)
    config = DivergenceFilterConfig(threshold, reference, change, max_skip=7)
    managed = config.manage(Recorder())
    processed = [managed.track(frame).processed for frame in frames]
    expected, last = [], -1
    for k, frame in enumerate(frames):
        before = frames[last if reference == "processed" else k - 1]
        changed = last < 0 or _slow_change(frame, before, 0.5) >= threshold
        expected.append(bool(changed or k - last > 7))
        last = k if expected[-1] else last
    assert processed == expected
    assert threshold == 0 or not all(expected)


def test_a_camera_at_rest_is_left_alone_and_one_that_moves_is_followed(frames):
    managed = make_config("divergence", threshold=0.004).manage(_surfel())
    results = [managed.track(frame) for frame in frames]
    processed = np.array([result.processed for result in results])
    resting = np.array([False, *(np.array_equal(motion, STILL) for motion in MOTIONS)])
    assert processed[~resting].mean() > 0.8
    assert processed[resting].mean() < 0.3
    assert all(result.tracking_ok for result in results)


def test_lost_tracking_and_the_start_have_every_frame_processed(frames):
    managed = make_config("regular", every=5).manage(_surfel())
    assert [managed.track(_black()).processed for _ in range(3)] == [True] * 3  # nothing to map
    while managed.track(frames[0]).processed:
        pass
    while not (result := managed.track(_black())).processed:
        assert result.tracking_ok
    assert not result.tracking_ok
    for _ in range(3):
        result = managed.track(_black())
        assert result.processed
        assert not result.tracking_ok
    result = managed.track(frames[1])
    assert result.processed
    assert result.relocalised


def test_no_gap_is_longer_than_permitted(frames):
    managed = make_config("divergence", threshold=1e6, max_skip=3).manage(Recorder())
    processed = [managed.track(frame).processed for frame in frames]
    assert np.flatnonzero(processed).tolist() == list(range(0, len(frames), 4))
    managed = make_config("divergence", threshold=1e6, max_skip=0).manage(Recorder())
    assert all(managed.track(frame).processed for frame in frames)


# -- The budget ----------------------------------------------------------------------------------


class _Changes(Change):
    """Changes as given, whatever the frames are."""

    def __init__(self, changes: list[float]) -> None:
        self._given = iter(changes)

    def reset(self) -> None:
        pass

    def measure(self, frame: RGBDFrame) -> float:
        return next(self._given)

    def keep(self) -> None:
        pass


def _tick(time: float) -> RGBDFrame:
    """A frame of which only the time stamp is looked at."""
    frame = object.__new__(RGBDFrame)  # the images are checked once
    frame.__dict__.update(vars(_BLACK), timestamp=time)
    return frame


def _processed(config: BudgetConfig, changes: list[float], seconds: float = 1 / 30) -> np.ndarray:
    budget = BudgetFilter(config, _Changes(changes))
    found, dropped = [], 0
    for k in range(len(changes)):
        forced = k == 0 or dropped >= config.max_skip
        found.append(budget.admits(_tick(k * seconds), dropped, forced) or forced)
        dropped = 0 if found[-1] else dropped + 1
    return np.array(found)


@settings(deadline=None, max_examples=30)
@given(
    levels=st.lists(st.floats(-3, 0), min_size=1, max_size=8),
    share=st.floats(0.1, 1.0),
    gain=st.floats(0.02, 1.0),
)
def test_the_budget_converges_to_its_share(levels, share, gain):
    config = BudgetConfig(share=share, gain=gain, max_skip=10)
    changes = [10.0**level for level in levels for _ in range(800 // len(levels))]
    processed = _processed(config, changes)
    # What is owed stays between ln(lowest / start) / gain and ln(highest / start) / gain; the
    # forced frames of a long gap come on top of a debt that is paid back.
    bound = np.log(HIGHEST_THRESHOLD / LOWEST_THRESHOLD) / gain + config.max_skip
    assert abs(processed.sum() - share * len(changes)) <= bound


def test_a_budget_saves_in_quiet_stretches_for_violent_ones():
    changes = ([0.002] * 60 + [0.5] * 30) * 6
    processed = _processed(BudgetConfig(share=0.4, gain=0.02), changes)
    violent = np.array(changes) > 0.1
    second_half = np.arange(len(changes)) >= len(changes) // 2
    assert processed[violent & second_half].mean() > 0.9
    assert processed[~violent & second_half].mean() < 0.25
    assert abs(processed[second_half].mean() - 0.4) < 0.06


def test_a_budget_a_second_is_kept_in_its_own_unit():
    config = BudgetConfig(
        budget_per_s=4.0, cost_per_frame=0.5, cost_per_look=0.02, gain=0.1, max_skip=30
    )  # 30 looks a second cost 0.6, so 6.8 frames a second can be processed
    changes = list(np.random.default_rng(0).lognormal(-4, 1, 3000))
    processed = _processed(config, changes)
    assert abs(processed[600:].sum() / 80 - 6.8) < 0.3
    slower = _processed(config, changes, seconds=1 / 15)  # 15 looks cost 0.3: 7.4 frames
    assert abs(slower[600:].sum() / 160 - 7.4) < 0.3


def test_what_lies_below_the_lowest_threshold_is_dropped_however_rich_one_is():
    config = BudgetConfig(share=0.9, max_skip=1000)
    assert _processed(config, [LOWEST_THRESHOLD / 2] * 300).sum() == 1


def test_measured_costs_are_kept_too(monkeypatch):
    """A backend that takes 20 ms a frame and a budget of 0.2 s a second: 10 frames a second."""
    clock = [0.0]
    module = "ms_slam_env.slam.frame_selection.selective_slam.time.process_time"
    monkeypatch.setattr(module, lambda: clock[0])

    class Slow(Recorder):
        def track(self, frame: RGBDFrame, T_world_camera_guess: Any = None) -> TrackResult:
            clock[0] += 0.02
            return super().track(frame, T_world_camera_guess)

    config = BudgetConfig(budget_per_s=0.2, measured=True, gain=0.1, max_skip=30)
    assert config.uses_clock
    changes = _Changes(list(np.random.default_rng(1).lognormal(-4, 1, 1500)))
    managed = SelectiveSlam(Slow(), BudgetFilter(config, changes), config.max_skip)
    for k in range(1500):
        managed.track(_tick(k / 30))
    assert abs(clock[0] / 50 - 0.2) < 0.01


# -- What is said of dropped frames --------------------------------------------------------------


def test_a_dropped_frame_moves_on_as_far_as_the_last_motion():
    backend = Recorder()
    poses = [np.eye(4), STEP @ STEP, make_pose(np.eye(3), [5.0, 0, 0])]
    backend.answers = [
        TrackResult(poses[0], True, inlier_fraction=0.7, covariance=np.eye(6)),
        TrackResult(poses[1], True, inlier_fraction=0.8, covariance=np.eye(6), loop_closed=False),
        TrackResult(poses[2], True, loop_closed=True),
    ]
    managed = make_config("regular", every=2).manage(backend)
    first, dropped, _, moving = (managed.track(_black()) for _ in range(4))
    assert first.covariance is not None
    assert dropped.covariance is None
    assert dropped.inlier_fraction == 0.7
    assert dropped.tracking_ok
    assert not dropped.processed
    np.testing.assert_array_equal(dropped.T_world_camera, np.eye(4))  # nothing is known yet
    half = se3_exp(0.5 * se3_log(poses[1]))
    np.testing.assert_allclose(moving.T_world_camera, poses[1] @ half, atol=1e-12)
    managed.track(_black())
    after_loop = managed.track(_black())  # the jump of a closed loop is no motion
    assert not after_loop.loop_closed
    np.testing.assert_array_equal(after_loop.T_world_camera, poses[2])


def test_a_loop_is_stated_by_the_numbers_of_all_frames():
    backend = Recorder()
    first, loop = TrackResult(np.eye(4), True), Loop(1, np.eye(4))
    backend.answers = [first, first, TrackResult(np.eye(4), True, loop=loop)]
    managed = make_config("regular", every=2).manage(backend)
    results = [managed.track(_black()) for _ in range(6)]
    stated = [(k, result.loop) for k, result in enumerate(results) if result.loop]
    assert stated == [(4, replace(loop, reference=2))]  # frames 0, 2 and 4 are processed


def test_a_stopped_camera_is_not_carried_on(frames):
    backend = Recorder()
    managed = SelectiveSlam(
        backend, make_config("regular", every=9).make_filter(CAMERA), max_skip=8
    )
    managed.track(_black())
    for _ in range(8):
        managed.track(_black())
    results = [managed.track(_black()) for _ in range(9)]
    far = [float(np.linalg.norm((invert(backend.pose) @ r.T_world_camera)[:3, 3])) for r in results]
    assert results[0].processed
    assert np.all(np.diff(far) > 0)
    assert far[-1] < np.linalg.norm(STEP[:3, 3])
    resting = make_config("divergence", threshold=1e6, max_skip=20).manage(Recorder())
    resting.track(frames[0])
    assert len({resting.track(frames[1]).T_world_camera.tobytes() for _ in range(15)}) == 1


def test_known_and_guessed_poses_are_those_of_dropped_frames():
    backend = Recorder()
    managed = make_config("regular", every=2).manage(backend)
    managed.track(_black(), START)
    result = managed.track(_black(), START @ STEP)
    np.testing.assert_array_equal(result.T_world_camera, START @ STEP)
    assert not result.processed
    managed.fuse(_black(), START)
    result = managed.fuse(_black(), START @ STEP)
    np.testing.assert_array_equal(result.T_world_camera, START @ STEP)
    assert not result.processed
    assert len(backend.fused) == 1
    np.testing.assert_array_equal(backend.guesses[0], START)


def test_the_frame_after_a_gap_is_also_tracked_from_its_predicted_pose():
    backend = Recorder()
    managed = make_config("divergence", threshold=1e6, max_skip=2).manage(backend)
    for _ in range(6):
        managed.track(_black())  # 0 and 3 are processed; nothing was known of a motion before 3
    assert backend.guesses == [None, None]
    managed.track(_black())
    np.testing.assert_allclose(backend.guesses[2], STEP @ STEP @ STEP, atol=1e-12)
    always = make_config("divergence", threshold=0.0).manage(Recorder())
    for _ in range(4):
        always.track(_black())  # no gap, no guess
    assert always.backend.guesses == [None] * 4


def test_the_last_pose_can_be_held():
    backend = Recorder()
    managed = make_config("regular", every=3, pose="last").manage(backend)
    for _ in range(4):
        held = managed.track(_black()).T_world_camera
        for _ in range(2):
            np.testing.assert_array_equal(managed.track(_black()).T_world_camera, held)


def test_corrected_frames_are_counted_with_the_dropped_ones():
    backend = Recorder()
    managed = make_config("regular", every=3).manage(backend)
    results = [managed.track(_black()) for _ in range(11)]  # 0, 3, 6, 9 are processed
    frames, poses = managed.corrected_trajectory()
    # the backend corrects its frames 0 and 2: ours 0 and 6; 1, 2 and 7, 8 move with them
    assert frames.tolist() == [0, 1, 2, 6, 7, 8]
    assert frames.dtype == np.int32
    np.testing.assert_array_equal(poses[3], make_pose(np.eye(3), [20.0, 0, 0]))
    for k, anchor in ((1, 0), (2, 0), (4, 6), (5, 6)):
        moved = invert(results[anchor].T_world_camera) @ results[frames[k]].T_world_camera
        corrected = poses[frames.tolist().index(anchor)]
        np.testing.assert_allclose(poses[k], corrected @ moved, atol=1e-12)


@pytest.mark.parametrize("name", sorted(FILTERS))
def test_a_state_goes_on_bit_exactly(name, frames):
    config = make_config(name, **FILTERS[name])
    managed = config.manage(_surfel())
    for frame in frames[:7]:
        managed.track(frame)
    saved = pickle.dumps(managed.get_state())
    expected = [managed.track(frame) for frame in frames[7:]]
    fresh = config.manage(_surfel())
    for other in (managed, fresh):
        other.set_state(pickle.loads(saved))
        for frame, result in zip(frames[7:], expected, strict=True):
            again = other.track(frame)
            np.testing.assert_array_equal(again.T_world_camera, result.T_world_camera)
            assert again.processed == result.processed
        np.testing.assert_array_equal(other.surface_points(), managed.surface_points())
    assert name == "none" or not all(result.processed for result in expected)
    managed.reset(START)
    twin = config.manage(_surfel())
    for frame in frames[:6]:
        a, b = managed.track(frame), twin.track(frame)
        assert a.processed == b.processed
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)


# -- Bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "sometimes"}, "'sometimes'; valid choices: none, regular, divergence, budget"),
        ({}, "valid choices: none, regular, divergence, budget"),
        ({"name": "none", "every": 2}, "every"),
        ({"name": "regular", "every": 0.5}, r"RegularConfig.every = 0.5 is outside \[1, "),
        ({"name": "regular", "every": 12}, "drops 11 frames in a row, more than max_skip = 10"),
        ({"name": "divergence", "threshold": -1}, "threshold = -1 is outside"),
        ({"name": "divergence", "pose": "guess"}, "valid choices: last, constant-velocity"),
        ({"name": "divergence", "change": {"widht": 3}}, r"change.widht.*valid choices: width"),
        ({"name": "divergence", "change": 3}, "must be a mapping of options: width"),
        ({"name": "budget", "share": 0.05}, "max_skip = 10 has 1 of 11 frames processed"),
        ({"name": "budget", "measured": True}, "of use with budget_per_s only"),
        ({"name": "budget", "cost_per_frame": 3.0}, "of use with budget_per_s only"),
        ({"name": "budget", "threshold": 1e-5}, "threshold = 1e-05 is outside"),
        ({"name": "budget", "threshold": 20.0}, "threshold = 20.0 is outside"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(InputError, match=message):
        from_dict(FrameSelectionConfig, options)


def test_every_variant_has_its_name_and_comes_back_from_its_mapping():
    for name in FrameSelectionConfig.variants():
        assert make_config(name).name == name
    config = make_config("budget", share=0.3, change={"width": 40})
    assert config == BudgetConfig(share=0.3, change=ChangeConfig(width=40))


@pytest.mark.parametrize("name", sorted(FILTERS))
def test_bad_frames_and_poses_are_refused_also_where_they_would_be_dropped(name):
    managed = make_config(name, **FILTERS[name]).manage(_surfel())
    managed.track(_black())
    small = RGBDFrame(np.zeros((30, 40, 3), dtype=np.uint8), np.zeros((30, 40), dtype=np.float32))
    for _ in range(3):
        with pytest.raises(InputError, match="40x30"):
            managed.track(small)
        with pytest.raises(InputError, match="40x30"):
            managed.fuse(small, START)
        with pytest.raises(InputError, match="T_world_camera_guess"):
            managed.track(_black(), np.zeros((4, 4)))
        with pytest.raises(InputError, match="T_world_camera"):
            managed.fuse(_black(), np.full((4, 4), np.nan))


def test_a_budget_a_second_needs_time_stamps():
    managed = BudgetConfig(budget_per_s=10.0).manage(Recorder())
    managed.track(_black(1.0))
    with pytest.raises(InputError, match="time stamps that increase; 1 s follows 1 s"):
        managed.track(_black(1.0))
