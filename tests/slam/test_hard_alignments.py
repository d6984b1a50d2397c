"""Acceptance where it is hard: depth bent by six standard deviations, right and wrong alignments.

On a clean pair of frames 99 % of the points are inliers, and rules and limits may be off by half
without a test noticing. Here right alignments have 75 to 81 %, wrong ones 55 to 79 %. The truth is
the scene's; the rules are those of the options.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env import slam as slam_backends
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.geometry import make_pose, orthonormal, relative_angle, se3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import HandheldPath, Sequence, open_sequence
from ms_slam_env.slam import SlamBackend
from ms_slam_env.slam.shared.alignment_check import TrackingStatus
from ms_slam_env.slam.shared.feature_poses import FeaturePose
from ms_slam_env.slam.surfel import localization
from ms_slam_env.slam.surfel.acceptance import (
    Alignment,
    acceptance_thresholds,
    at_usual_noise,
    fit_of_noise,
)
from ms_slam_env.slam.surfel.photometry import is_leap, same_exposure
from ms_slam_env.slam.surfel.pose_hypotheses import NUM_HYPOTHESES, tracking_hypotheses
from ms_slam_env.slam.surfel.preprocessing import Preprocessor
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.surfel_config import AcceptanceConfig, SurfelConfig
from ms_slam_env.slam.surfel.tracker import Tracker

CONFIG = SurfelConfig(depth_cutoff_m=5.0)
NOISE_M = CONFIG.depth_noise_m  # at 1 m, independent
BENDING_M = 6.0 * CONFIG.depth_noise_m  # at 1 m, amplitude of what is smooth
RIGHT = (2, 44, 46, 47, 58)  # seeds of motions that the tracker finds, and of others
WRONG = (10, 13, 30, 32, 57)


class _Frames:
    """Pairs of poses and of preprocessed frames, by seed."""

    def __init__(self) -> None:
        self.camera = xtion("160x120")
        self._scene = BoxScene()
        self._sensor = RGBDSensor(self._scene, self.camera, noise="none")

    def poses(self, seed: int) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
        rng = np.random.default_rng(seed)
        model = self._scene.sample_start(rng)
        twist = np.concatenate([rng.normal(0, 0.25, 3), rng.normal(0, 0.35, 3)])
        return model, model @ se3_exp(twist), rng

    def align(self, seed: int, config: SurfelConfig) -> tuple[Alignment, bool]:
        """The alignment of a noisy frame with the view from its model's pose; is it right?"""
        T_world_model, truth, rng = self.poses(seed)
        model, live = (
            self._sensor.capture(pose, k) for k, pose in enumerate((T_world_model, truth))
        )
        v, u = np.mgrid[: self.camera.height, : self.camera.width]
        error = BENDING_M * np.sin(u / 12 + seed) * np.cos(v / 11)
        error += rng.normal(0, NOISE_M, error.shape)
        noisy = (live.depth + error * live.depth**2).astype(np.float32)
        first, second = (Preprocessor(1, self.camera, config) for _ in range(2))
        view = first(model.color[None], model.depth[None])
        tracker = Tracker(1, NUM_HYPOTHESES, self.camera, config)
        tracker.set_frame(second(live.color[None], noisy[None]))
        thresholds = acceptance_thresholds(
            config.acceptance, np.zeros(1, dtype=bool), np.zeros(1, dtype=np.int32)
        )
        found = tracker.align(
            ModelView(view.vertices, view.normals, view.intensity, view.color),
            T_world_model[None],
            tracking_hypotheses(np.eye(4))[None],
            thresholds,
        )
        pose = found.T_world_live[0]
        is_near = np.linalg.norm(pose[:3, 3] - truth[:3, 3]) < 0.01
        return found, is_near and relative_angle(pose[:3, :3], truth[:3, :3]) < np.radians(0.5)


@cache
def _frames() -> _Frames:
    return _Frames()


@cache
def _accepted(**rules: float) -> frozenset[int]:
    """Seeds whose alignments are accepted under the acceptance rules, the others as configured."""
    config = replace(CONFIG, acceptance=replace(CONFIG.acceptance, **rules))
    found = {seed: _frames().align(seed, config)[0] for seed in RIGHT + WRONG}
    return frozenset(seed for seed, one in found.items() if one.status[0] == TrackingStatus.OK)


@pytest.mark.parametrize("seed", RIGHT)
def test_right_alignments_are_accepted_though_many_points_do_not_fit(seed):
    found, is_right = _frames().align(seed, CONFIG)
    assert is_right
    assert found.status[0] == TrackingStatus.OK
    assert found.statistics["inlier_ratio"][0] < 0.9


@pytest.mark.parametrize("seed", WRONG)
def test_wrong_alignments_are_refused_though_many_points_fit(seed):
    found, is_right = _frames().align(seed, CONFIG)
    assert not is_right
    assert found.status[0] != TrackingStatus.OK
    assert found.statistics["inlier_ratio"][0] > 0.5


@pytest.mark.parametrize(
    ("rule", "factor"),
    [("inlier_sigmas", 0.5), ("inliers", 0.95 / 0.65), ("conflict_sigmas", 0.25), ("cost", 0.6)],
)
def test_a_stricter_rule_refuses_right_alignments(rule, factor):
    accepted = _accepted(**{rule: factor * getattr(CONFIG.acceptance, rule)})
    assert not accepted


def test_without_three_of_the_rules_a_wrong_alignment_is_accepted():
    assert not _accepted(inliers=0.3) & set(WRONG)
    assert _accepted(inliers=0.3, conflicts=0.3, cost=3.0) & set(WRONG)


def _thresholds(strict: bool, rules: AcceptanceConfig = CONFIG.acceptance, **usual: float):
    """What is demanded, as a dictionary, of a recording with this usual fit."""
    demanded = acceptance_thresholds(rules, np.full(1, strict), np.zeros(1, dtype=np.int32))
    fit = fit_of_noise(1)
    for name, value in usual.items():
        fit[name] = value
    relaxed = at_usual_noise(demanded, fit)[0]
    return dict(zip(relaxed.dtype.names, relaxed.tolist(), strict=True))


@pytest.mark.parametrize("strict", [False, True])
def test_the_noise_that_is_expected_relaxes_nothing(strict):
    rules, lost = CONFIG.acceptance, np.zeros(1, dtype=np.int32)
    demanded = acceptance_thresholds(rules, np.full(1, strict), lost)[0]
    assert tuple(_thresholds(strict).values()) == demanded.tolist()
    assert _thresholds(strict, cost=0.5) == _thresholds(strict)


def test_a_noisy_recording_is_judged_by_its_own_noise():
    usual = {"cost": 1.3, "inlier_ratio": 0.85, "photometric_inlier_ratio": 0.8}
    relaxed = _thresholds(False, **usual)
    assert relaxed["cost"] == pytest.approx(1.4 + 0.25)
    assert relaxed["inlier_ratio"] == pytest.approx(0.65 - 0.05)
    assert relaxed["photometric_inlier_ratio"] == pytest.approx(0.7 - 0.05)
    assert _thresholds(True, **usual)["cost"] == pytest.approx(1.3 + 0.25)
    conflicting = _thresholds(True, depth_conflict_ratio=0.06)["depth_conflict_ratio"]
    assert conflicting == pytest.approx(0.12 + 0.03)
    assert _thresholds(True, depth_conflict_ratio=0.9)["depth_conflict_ratio"] == 0.25
    hopeless = _thresholds(False, cost=5.0, inlier_ratio=0.0, photometric_inlier_ratio=0.0)
    assert hopeless["cost"] == 1.9
    assert hopeless["inlier_ratio"] == hopeless["photometric_inlier_ratio"] == 0.5


def test_noise_does_not_undo_what_the_options_demand():
    strict = _thresholds(False, replace(CONFIG.acceptance, inliers=1.0, cost=0.7))
    assert (strict["inlier_ratio"], strict["cost"]) == (1.0, 0.7)
    lax = replace(CONFIG.acceptance, inliers=0.3, cost=2.5)
    for noise in ({}, {"cost": 1.8, "inlier_ratio": 0.5}):
        kept = _thresholds(False, lax, **noise)
        assert (kept["inlier_ratio"], kept["cost"]) == (0.3, 2.5)


def test_what_is_usual_follows_accepted_frames_only():
    found, _ = _frames().align(RIGHT[0], CONFIG)
    states = localization.CameraStates(1)
    cost = float(found.statistics["cost"][0])
    here = np.ones(1, dtype=bool)
    states.accept(here, found, 1.0)
    assert states.usual["cost"][0] == pytest.approx(1 + 0.1 * (cost - 1))
    for _ in range(100):
        states.accept(here, found, 1.0)
    assert states.usual["cost"][0] == pytest.approx(cost, rel=1e-3)
    assert states.usual["surprise"][0] < 1e-3  # the same motion again and again
    before = states.usual.copy()
    in_doubt = found.with_status(here, TrackingStatus.UNCERTAIN)
    states.accept(here, in_doubt, 1.0)
    assert states.usual == before
    states.reset(np.array([0]), np.eye(4)[None])
    assert states.usual == fit_of_noise(1)


def test_features_deny_what_is_farther_away_than_both_err():
    found, _ = _frames().align(RIGHT[0], CONFIG)
    pose, covariance = found.T_world_live[0], np.diag([1e-4] * 6)  # 1 cm along each axis
    for step_m, is_denied in ((0.1, False), (0.3, True)):
        # Three times what they say, so that 0.1 m are 3.3 standard deviations.
        elsewhere = pose @ make_pose(np.eye(3), [step_m, 0.0, 0.0])
        features = FeaturePose(elsewhere, 100, covariance)
        assert localization._is_denied(found, 0, elsewhere, features) == is_denied


def test_another_light_leaves_the_scale_of_the_noise():
    states = localization.CameraStates(1)
    photometry = same_exposure(1)
    photometry["reference"], photometry["gain"] = 3.0, 1.5
    states.set_state(states.get_state() | {"photometry": photometry})
    states.forget_exposure(0)
    assert states.photometry["reference"][0] == 3.0
    assert states.photometry["gain"][0] == 1.0


STEP = 6  # frames of 1.5 cm and 0.7 degrees that are skipped


@pytest.fixture(scope="module")
def carpet() -> Sequence:
    path = HandheldPath(240, speed_m_s=0.4, turn_deg_s=20.0)
    return open_sequence("carpet:1003", path=path).picked(STEP * np.arange(6))


def _errors(sequence: Sequence, frames: list[RGBDFrame], check_slips: bool) -> np.ndarray:
    system = slam.make("surfel", sequence.intrinsics, check_slips=check_slips)
    system.reset(sequence.poses[0])
    estimate = np.stack([system.track(frame).T_world_camera for frame in frames])
    return np.linalg.norm(estimate[:, :3, 3] - sequence.poses[:, :3, 3], axis=1)


def test_frames_that_slip_over_a_carpet_are_put_right(carpet):
    frames = list(carpet.frames)
    slipped, checked = (_errors(carpet, frames, check) for check in (False, True))
    assert slipped.max() > 0.05
    assert checked.max() < 0.005


FACING_THE_WALL = make_pose(
    [[0.9785, -0.0311, 0.2038], [-0.206, -0.1891, 0.9601], [0.0087, -0.9815, -0.1914]],
    [1.6529, 2.3378, 1.2981],
)


@pytest.fixture(params=[(0.0, 0.12, 0.0), (0.0, -0.12, 0.0)])
def step_along_a_wall(request, monkeypatch):
    """Two poses and frames; the grey values' leap is not looked at."""
    monkeypatch.setattr(localization, "is_leap", lambda before, *_: np.zeros(len(before), bool))
    T = orthonormal(FACING_THE_WALL)
    sensor = RGBDSensor(get_scene("wall", 1006), xtion("160x120"))
    poses = np.stack([T, T @ make_pose(np.eye(3), request.param)])
    return poses, [sensor.capture(pose, k, k / 30, seed=1) for k, pose in enumerate(poses)]


def _tracked_step(poses: np.ndarray, frames: list[RGBDFrame], **options: bool) -> tuple:
    """What is said of the second frame, and by how much it errs."""
    system = slam.make("surfel", xtion("160x120"), **options)
    system.reset(poses[0])
    _, found = (system.track(frame) for frame in frames)
    return found, np.linalg.norm((found.T_world_camera - poses[1])[:3, 3])


def test_what_a_wall_leaves_open_is_found_by_features(step_along_a_wall):
    assert _tracked_step(*step_along_a_wall, check_slips=False)[1] > 0.1
    assert _tracked_step(*step_along_a_wall)[1] < 0.01


def test_what_stays_open_can_be_refused(step_along_a_wall, monkeypatch):
    monkeypatch.setattr(localization.Localizer, "_feature_pose", lambda *_: None)
    taken, error = _tracked_step(*step_along_a_wall)
    assert taken.tracking_ok
    assert error > 0.1
    refused, error = _tracked_step(*step_along_a_wall, refuse_open=True)
    assert not refused.tracking_ok or error < 0.01


def test_a_leap_is_a_sudden_misfit_of_grey_values_that_were_trusted():
    before, after = same_exposure(5), same_exposure(5)
    before["reference"][3], before["trust"][4] = 3.0, 0.01
    after["scale"] = [0.9, 1.0, 0.7, 1.0, 0.7]
    after["trust"][[2, 4]] = 0.0
    np.testing.assert_array_equal(is_leap(before, after, 1.0), [False, True, True, False, False])


def frames_with_a_jump() -> tuple[np.ndarray, list[RGBDFrame]]:
    """The same view four times, then one from the other side of the room."""
    scene = BoxScene()
    sensor = RGBDSensor(scene, xtion("80x60"), noise="none")
    start = scene.sample_start(np.random.default_rng(0))
    back = start.copy()
    back[:3, :3] = start[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    poses = [start] * 4 + [back]
    return start, [sensor.capture(pose, index=k) for k, pose in enumerate(poses)]


def run(refuse: bool) -> tuple[list[bool], SlamBackend]:
    start, frames = frames_with_a_jump()
    slam = slam_backends.make("surfel", xtion("80x60"), refuse_bad_fits=refuse, motion_mask="none")
    slam.reset(start)
    return [slam.track(frame).tracking_ok for frame in frames], slam


def test_a_frame_from_elsewhere_is_refused_or_fused() -> None:
    ok, careful = run(refuse=True)
    assert ok == [True] * 4 + [False]
    ok, careless = run(refuse=False)
    assert ok == [True] * 5
    assert np.isfinite(careless.map_points()).all()
    assert len(careless.map_points()) > 1.1 * len(careful.map_points())


@pytest.mark.parametrize(("inliers", "fused"), [(0.65, [True] * 4), (1.0, [True] + [False] * 3)])
def test_the_share_of_inliers_that_is_demanded_is_an_option(inliers: float, fused: list) -> None:
    scene = BoxScene()
    sensor = RGBDSensor(scene, xtion("80x60"), noise="kinect")
    start = scene.sample_start(np.random.default_rng(0))
    rules = {"inliers": inliers, "doubted": {"inliers": inliers}}
    slam = slam_backends.make("surfel", xtion("80x60"), acceptance=rules)
    slam.reset(start)
    frames = [sensor.capture(start, index=k) for k in range(4)]
    assert [slam.track(frame).fused for frame in frames] == fused
