"""Loops closed in rendered rooms whose drift is known, and places that only look alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ms_slam_env import scenes
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.geometry import invert, look_at, make_pose, relative_angle, se3_exp
from ms_slam_env.sequences import render_sequence
from ms_slam_env.slam.shared.alignment_check import TrackingStatus
from ms_slam_env.slam.shared.ferns import Candidate
from ms_slam_env.slam.surfel import SurfelConfig
from ms_slam_env.slam.surfel.acceptance import Alignment
from ms_slam_env.slam.surfel.map_deformation import (
    Deformation,
    creation_times,
    identity,
    pack,
    sample_graph,
    unpack,
)
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam
from ms_slam_env.slam.surfel.surfel_config import LoopConfig

CAMERA = xtion("160x120")
TURN = 60  # frames for a whole turn
KNOWN = 48  # of them given with their drifted poses; then the rest is tracked
DRIFT = np.array([0.02, -0.01, 0.02, *np.radians([0.5, 1.8, -0.7])])  # 3 cm, 2 degrees
CONFIG = SurfelConfig(
    max_surfels=300_000, loop_closure="deformation", loops=LoopConfig(window=20, interval=2)
)


@pytest.fixture(scope="module")
def turn() -> tuple[list[RGBDFrame], np.ndarray]:
    """Frames of a camera that turns once in a room and goes on, and their true poses."""
    scene = scenes.make("living_room", 1)
    rng = np.random.default_rng(0)
    starts = np.stack([scene.sample_start(rng)[:3, 3] for _ in range(32)])
    centre = starts[scene.clearance(starts).argmax()]
    angles = 2 * np.pi * np.arange(TURN + 10) / TURN
    gaze = np.stack([np.cos(angles), np.sin(angles), -0.2 + 0 * angles], axis=1)
    eyes = centre + 0.2 * gaze
    poses = np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, gaze, strict=True)])
    return list(render_sequence(scene, poses, CAMERA, noise="none").frames), poses


def drifted(poses: np.ndarray) -> np.ndarray:
    """Poses whose error grows evenly to DRIFT about the middle of the turn, and stays."""
    middle = make_pose(np.eye(3), poses[:TURN, :3, 3].mean(axis=0))
    shares = np.minimum(np.arange(len(poses)) / KNOWN, 1.0)
    errors = [middle @ se3_exp(DRIFT * share) @ invert(middle) for share in shares]
    return np.stack(errors) @ poses


def images(frames: list[RGBDFrame], k: int, batch: int = 1) -> tuple[np.ndarray, np.ndarray]:
    return np.stack([frames[k].color] * batch), np.stack([frames[k].depth] * batch)


def map_with_drift(
    frames: list[RGBDFrame], poses: np.ndarray, config: SurfelConfig = CONFIG, batch: int = 1
) -> BatchedSurfelSlam:
    system = BatchedSurfelSlam(batch, CAMERA, config)
    for k, pose in enumerate(drifted(poses)[:KNOWN]):
        system.fuse(*images(frames, k, batch), np.stack([pose] * batch))
    return system


def errors(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(estimate[..., :3, 3] - truth[..., :3, 3], axis=-1)


def test_a_drifted_turn_is_closed(turn: tuple[list[RGBDFrame], np.ndarray]) -> None:
    frames, poses = turn
    system = map_with_drift(frames, poses)
    last, closed = KNOWN, False
    while not closed:
        result = system.track(*images(frames, last))[0]
        assert result.tracking_ok
        closed = result.loop_closed
        last += 1
    estimate = result.T_world_camera
    loop = result.loop
    assert loop is not None
    assert loop.bent
    assert loop.reference < last - CONFIG.loops.window
    stated = poses[loop.reference] @ loop.T_reference_camera
    assert errors(stated, poses[last - 1]) < 0.005
    assert errors(drifted(poses)[last - 1], poses[last - 1]) > 0.02
    assert errors(estimate, poses[last - 1]) < 0.005
    assert relative_angle(estimate[:3, :3], poses[last - 1][:3, :3]) < np.radians(0.3)
    # The way in between follows: its drift is spread over it, though not just as it came about.
    indices, past = system.loops.trajectory(0)
    np.testing.assert_array_equal(indices, np.arange(last))
    before = errors(drifted(poses)[:last], poses[:last])
    assert np.sqrt(np.mean(errors(past, poses[:last]) ** 2)) < 0.7 * np.sqrt(np.mean(before**2))
    # The place is one surface now: the next frames see old and new as one, and close nothing.
    for k in range(last, TURN + 10):
        assert not system.track(*images(frames, k))[0].loop_closed


def test_what_is_in_place_is_taken_back_without_a_jump(
    turn: tuple[list[RGBDFrame], np.ndarray],
) -> None:
    frames, poses = turn
    loose = replace(CONFIG, loops=replace(CONFIG.loops, smallest_m=0.01))
    system = BatchedSurfelSlam(1, CAMERA, loose)
    for k in range(KNOWN):
        system.fuse(*images(frames, k), poses[k][None])
    results = [system.track(*images(frames, k))[0] for k in range(KNOWN, TURN + 10)]
    assert not any(result.loop_closed for result in results)
    stated = [(k, result.loop) for k, result in enumerate(results, KNOWN) if result.loop]
    assert stated
    for k, loop in stated:
        assert not loop.bent
        assert errors(poses[loop.reference] @ loop.T_reference_camera, poses[k]) < 0.005
    unclosed = BatchedSurfelSlam(
        1, CAMERA, replace(CONFIG, loops=LoopConfig(window=20, coverage=1))
    )
    for k in range(KNOWN):
        unclosed.fuse(*images(frames, k), poses[k][None])
    for k in range(KNOWN, TURN + 10):
        unclosed.track(*images(frames, k))
    assert system.map.count() < 0.95 * unclosed.map.count()  # nothing is mapped twice


def test_a_keyframe_closes_a_loop_that_is_out_of_sight(
    turn: tuple[list[RGBDFrame], np.ndarray],
) -> None:
    frames, poses = turn
    blind = replace(CONFIG, loops=replace(CONFIG.loops, largest_m=0.001, global_interval=2))
    system = map_with_drift(frames, poses, blind)
    results = [system.track(*images(frames, k))[0] for k in range(KNOWN, TURN + 6)]
    assert any(result.loop_closed for result in results)
    assert errors(results[-1].T_world_camera, poses[TURN + 5]) < 0.005


@pytest.mark.parametrize("by", ["drift", "status"])
def test_a_keyframe_too_far_for_the_way_or_a_refused_alignment_closes_nothing(
    turn: tuple[list[RGBDFrame], np.ndarray], by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, poses = turn
    loops = replace(CONFIG.loops, largest_m=0.001, global_interval=2)
    if by == "drift":
        loops = replace(loops, drift_share=0.001)
    system = map_with_drift(frames, poses, replace(CONFIG, loops=loops))
    if by == "status":
        align, refused = system.loops._aligner.from_keyframes, TrackingStatus.IMPLAUSIBLE_MOTION

        def all_refused(starts: np.ndarray) -> Alignment | None:
            found = align(starts)
            return None if found is None else found.with_status(np.ones(1, dtype=bool), refused)

        monkeypatch.setattr(system.loops._aligner, "from_keyframes", all_refused)
    for k in range(KNOWN, TURN + 6):
        assert not system.track(*images(frames, k))[0].loop_closed


def test_places_that_only_look_alike_are_refused() -> None:
    """On the self-similar carpet every place resembles every other."""
    scene = scenes.make("carpet", 1)
    start = scene.sample_start(np.random.default_rng(3))
    floor_m = 0.9
    straight_down = look_at([*start[:2, 3], floor_m], [*start[:2, 3], 0.0], up=(0.0, 1.0, 0.0))
    steps = np.array([0.02 * k for k in range(60)])
    poses = np.stack([straight_down @ make_pose(np.eye(3), [-x, 0, 0]) for x in steps])
    frames = list(render_sequence(scene, poses, CAMERA, noise="none").frames)
    system = BatchedSurfelSlam(
        1, CAMERA, replace(CONFIG, loops=replace(CONFIG.loops, global_interval=2, drift_share=10.0))
    )
    for k in range(len(frames)):
        system.fuse(*images(frames, k), poses[k][None])
    color, depth = images(frames, -1)
    live = system.preprocess(color, depth)
    before = system.map.get_state()
    wrong = [Candidate(poses[k], 0.1, k, k) for k in range(0, 25, 5)]
    closed = system.loops.close(
        live, system.poses, np.array([60], np.int32), np.array([True]), lambda env, limit: wrong
    )
    assert not closed
    np.testing.assert_array_equal(
        system.map.get_state()["surfels"][0]["position"], before["surfels"][0]["position"]
    )


def test_states_go_on_bit_exactly_and_envs_do_not_meddle(
    turn: tuple[list[RGBDFrame], np.ndarray],
) -> None:
    frames, poses = turn
    alone = map_with_drift(frames, poses)
    pair = BatchedSurfelSlam(2, CAMERA, CONFIG)
    truth = np.stack([drifted(poses), poses], axis=1)
    for k in range(KNOWN):
        pair.fuse(*images(frames, k, 2), truth[k])
    restored = BatchedSurfelSlam(1, CAMERA, CONFIG)
    closed = False
    for k in range(KNOWN, TURN + 10):
        if k == KNOWN + 3:
            restored.set_state(alone.get_state())
        one = alone.track(*images(frames, k))[0]
        both = pair.track(*images(frames, k, 2))
        np.testing.assert_array_equal(one.T_world_camera, both[0].T_world_camera)
        if k >= KNOWN + 3:
            again = restored.track(*images(frames, k))[0]
            np.testing.assert_array_equal(one.T_world_camera, again.T_world_camera)
            assert one.loop_closed == again.loop_closed == both[0].loop_closed
        closed |= one.loop_closed
    assert closed
    final = [system.map.get_state()["surfels"][0] for system in (alone, restored, pair)]
    for name, values in final[0].items():
        np.testing.assert_array_equal(values, final[1][name])
        np.testing.assert_array_equal(values, final[2][name])


def test_surfels_move_as_the_deformation_says(turn: tuple[list[RGBDFrame], np.ndarray]) -> None:
    frames, poses = turn
    system = map_with_drift(frames[:4], poses[:4])
    surfels = system.map.get_state()["surfels"][0]
    times = surfels["created"] + np.linspace(0, 0.5, len(surfels["created"]))
    times = np.sort(times)
    graph = sample_graph(surfels["position"], times, 30)
    rng = np.random.default_rng(0)
    motion = unpack(graph, pack(identity(graph)) + rng.normal(0, 0.05, 12 * len(graph)))
    system.loops._deformer._move_surfels(0, motion, times)
    moved = system.map.get_state()["surfels"][0]
    np.testing.assert_allclose(
        moved["position"], motion.points(surfels["position"], times), atol=2e-5
    )
    turned = Deformation(graph, motion.R, np.zeros_like(motion.t))
    turned = replace(turned, graph=replace(graph, positions=graph.positions))
    nodes, weights = turned.graph.influence(surfels["position"], times)
    normals = np.einsum("nk,nkij,nj->ni", weights, motion.R[nodes], surfels["normal"])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(moved["normal"], normals, atol=1e-4)


def test_creation_times_spread_the_surfels_of_a_frame_over_it() -> None:
    order, times = creation_times(np.array([3, 0, 0, 7, 3, 3, 0, 0], dtype=np.int32))
    np.testing.assert_array_equal(order, [1, 2, 6, 7, 0, 4, 5, 3])
    np.testing.assert_allclose(times, [0, 0.25, 0.5, 0.75, 3, 3 + 1 / 3, 3 + 2 / 3, 7])
