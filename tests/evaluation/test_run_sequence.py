"""The loop over a sequence: what it records, where it starts, how it is stopped and continued."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.evaluation.run_sequence import SequenceRun, run_sequence
from ms_slam_env.evaluation.run_to_folder import measure
from ms_slam_env.geometry import look_at
from ms_slam_env.metrics import CostMeter
from ms_slam_env.sequences import Sequence, render_sequence
from ms_slam_env.slam.slam_backend import SlamBackend, TrackResult


@pytest.fixture(scope="module")
def sequence(box_scene: BoxScene) -> Sequence:
    eye = box_scene.sample_start(np.random.default_rng(0))[:3, 3]
    middle = (box_scene.mesh.vertices.min(0) + box_scene.mesh.vertices.max(0)) / 2
    poses = [look_at(eye + 0.01 * k * np.eye(3)[0], middle) for k in range(6)]
    rendered = render_sequence(box_scene, np.stack(poses), xtion("80x60"))
    return Sequence(tuple(rendered.frames), rendered.poses, rendered.intrinsics, "box")


@pytest.fixture
def backend(sequence: Sequence) -> SlamBackend:
    return slam.make("surfel", sequence.intrinsics)


def test_records_what_a_loop_by_hand_gives(sequence: Sequence, backend: SlamBackend) -> None:
    by_hand = slam.make("surfel", sequence.intrinsics)
    by_hand.reset(sequence.poses[0])
    results = [by_hand.track(frame) for frame in sequence.frames]
    run = run_sequence(backend, sequence)
    np.testing.assert_array_equal(run.estimates, [r.T_world_camera for r in results])
    np.testing.assert_array_equal(run.true_poses, sequence.poses)
    np.testing.assert_array_equal(run.timestamps, sequence.timestamps)
    assert run.tracking_ok.all()
    assert run.processed.all()
    assert (run.lost_frames, run.lost) == (0, 0.0)
    assert (run.cpu_ms > 0).all()
    assert (run.wall_ms > 0).all()
    np.testing.assert_array_equal(run.backend.surface_points(), by_hand.surface_points())


def test_frames_whose_pose_is_doubted_are_counted_as_tracked_and_as_uncertain(
    sequence: Sequence, backend: SlamBackend
) -> None:
    doubted = [sequence.timestamps[k] for k in (1, 4)]

    def track(frame: RGBDFrame) -> TrackResult:
        return replace(backend.track(frame), uncertain=frame.timestamp in doubted)

    run = run_sequence(backend, sequence, track=track, meter=CostMeter())
    found = measure(run, sequence)
    assert (found["uncertain_frames"], found["lost_frames"], found["tracked_share"]) == (2, 0, 1.0)


def test_a_meter_made_before_slam_measures_every_frame(sequence: Sequence) -> None:
    meter = CostMeter()
    run = run_sequence(slam.make("surfel", sequence.intrinsics), sequence, meter=meter)
    assert run.costs is meter.frames
    assert len(run.costs) == len(sequence)


def test_stops_and_goes_on_where_it_was(sequence: Sequence, backend: SlamBackend) -> None:
    run = SequenceRun(backend, sequence)
    seen = []
    for step in run:
        seen.append(step.index)
        if step.index == 2:
            break
    assert len(run) == len(run.true_poses) == 3
    seen += [step.index for step in run]
    assert seen == [0, 1, 2, 3, 4, 5]
    whole = run_sequence(slam.make("surfel", sequence.intrinsics), sequence)
    np.testing.assert_array_equal(run.estimates, whole.estimates)


def test_the_start_is_the_true_pose_the_one_given_or_where_slam_is(
    sequence: Sequence, backend: SlamBackend
) -> None:
    frames = sequence.frames[:2]
    np.testing.assert_array_equal(run_sequence(backend, frames).estimates[0], np.eye(4))
    run = run_sequence(backend, frames, start=sequence.poses[0])
    np.testing.assert_array_equal(run.estimates[0], sequence.poses[0])
    assert np.isnan(run.true_poses).all()
    again = run_sequence(backend, frames[1:], reset=False)
    np.testing.assert_allclose(again.estimates[0], run.estimates[1], atol=1e-2)


def test_an_error_leaves_what_was_recorded(sequence: Sequence, backend: SlamBackend) -> None:
    def frames():
        yield from sequence.frames[:3]
        raise OSError("no more")

    run = SequenceRun(backend, frames(), start=sequence.poses[0])
    with pytest.raises(OSError, match="no more"):
        for _ in run:
            pass
    assert len(run.estimates) == len(run.costs) == 3


def test_slam_may_be_fed_in_another_way(sequence: Sequence, backend: SlamBackend) -> None:
    truth = iter(sequence.poses)

    def fuse(frame: RGBDFrame):
        return backend.fuse(frame, next(truth))

    indices: list[int] = []
    run = run_sequence(
        backend, sequence, track=fuse, on_step=lambda step: indices.append(step.index)
    )
    np.testing.assert_allclose(run.estimates, sequence.poses)
    assert indices == list(range(len(sequence)))
