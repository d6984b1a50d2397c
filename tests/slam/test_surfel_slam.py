"""The whole surfel SLAM on a rendered room: accuracy, loss, recovery, batches, state."""

from __future__ import annotations

import numpy as np
import pytest
from arc import CAMERA, START, arc, black_frame
from scipy.spatial import cKDTree

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.surfel import BatchedSurfelSlam, SurfelConfig
from ms_slam_env.slam.surfel.pose_hypotheses import motion_weight

CONFIG = SurfelConfig(max_surfels=60_000, depth_cutoff_m=4.0)


@pytest.fixture(scope="module")
def frames(arc_frames: list[RGBDFrame]) -> list[RGBDFrame]:
    return arc_frames[:16]


def _new() -> slam.SlamBackend:
    backend = slam.make("surfel", CAMERA, max_surfels=60_000, depth_cutoff_m=4.0)
    backend.reset(START)
    return backend


def test_a_noisy_path_is_tracked_to_millimetres(frames, box_scene):
    backend = _new()
    for frame, truth in zip(frames, arc(16), strict=True):
        result = backend.track(frame)
        assert result.tracking_ok, result.reason
        assert np.linalg.norm(result.T_world_camera[:3, 3] - truth[:3, 3]) < 0.008
    assert result.inlier_fraction > 0.8
    assert 0 < result.residual_m < 0.01
    points, _ = box_scene.surface_points(0.02)
    estimated = backend.surface_points()
    assert backend.surface_colors().shape == estimated.shape
    distance, _ = cKDTree(points).query(estimated)
    assert np.median(distance) < 0.02


def test_lost_frames_hold_the_pose_and_the_map_until_relocalised(frames):
    backend = _new()
    for frame in frames[:5]:
        held = backend.track(frame)
    count = backend.map.count()
    rng = np.random.default_rng(0)
    garbage = RGBDFrame(
        rng.integers(0, 256, (*CAMERA.shape, 3), dtype=np.uint8),
        rng.uniform(0.5, 3, CAMERA.shape).astype(np.float32),
    )
    for bad in (black_frame(), garbage, black_frame()):
        result = backend.track(bad)
        assert not result.tracking_ok
        assert result.reason
        np.testing.assert_array_equal(result.T_world_camera, held.T_world_camera)
    assert backend.map.count() == count
    result = backend.track(frames[8])
    assert result.tracking_ok
    assert result.relocalised
    assert np.linalg.norm(result.T_world_camera[:3, 3] - arc(9)[8, :3, 3]) < 0.01
    assert not backend.track(frames[9]).relocalised


def test_relocalises_after_a_jump(frames, box_scene):
    backend = _new()
    for frame in frames[:6]:
        backend.track(frame)
    jump = START @ make_pose(so3_exp([np.radians(5), np.radians(14), 0]), [0.1, 0.0, 0.05])
    frame = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=1).capture(jump, 0)
    results = [backend.track(frame) for _ in range(12)]
    good = [result for result in results if result.tracking_ok]
    assert good
    for result in good:
        assert np.linalg.norm(result.T_world_camera[:3, 3] - jump[:3, 3]) < 0.02


def test_a_frame_from_elsewhere_is_not_called_tracked(frames, box_scene):
    backend = _new()
    for frame in frames[:4]:
        backend.track(frame)
    elsewhere = look_at([-0.5, 0.5, 1.2], [-1.5, -1.5, 0.6])
    frame = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=1).capture(elsewhere, 0)
    assert not any(backend.track(frame).tracking_ok for _ in range(5))


def test_first_frame_needs_depth(frames):
    backend = _new()
    result = backend.track(black_frame())
    assert not result.tracking_ok
    assert "first frame" in result.reason
    result = backend.track(frames[0])
    assert result.tracking_ok
    np.testing.assert_array_equal(result.T_world_camera, START)


def test_reset_forgets_everything(frames):
    backend = _new()
    first = [backend.track(frame) for frame in frames[:4]]
    backend.track(black_frame())
    backend.reset(START)
    assert backend.map.count() == 0
    assert len(backend.surface_points()) == 0
    second = [backend.track(frame) for frame in frames[:4]]
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)


def test_a_batch_is_bit_identical_to_its_envs_alone(frames):
    orders = [[0, 1, 2, 3, 4], [10, 9, 8, 7, 6], [0, 1, 15, 0, 1]]
    poses = arc(16)
    together = BatchedSurfelSlam(3, CAMERA, CONFIG)
    alone = [BatchedSurfelSlam(1, CAMERA, CONFIG) for _ in orders]
    for env, order in enumerate(orders):
        together.reset(poses[order[0]], env)
        alone[env].reset(poses[order[0]])
    black = black_frame()
    for step in range(5):
        # The last env loses its third frame, so that envs differ in what they do.
        batch = [
            black if (env, step) == (2, 2) else frames[order[step]]
            for env, order in enumerate(orders)
        ]
        results = together.track(
            np.stack([f.color for f in batch]), np.stack([f.depth for f in batch])
        )
        for env, frame in enumerate(batch):
            single = alone[env].track(frame.color[None], frame.depth[None])[0]
            assert single.tracking_ok == results[env].tracking_ok
            np.testing.assert_array_equal(single.T_world_camera, results[env].T_world_camera)
            assert alone[env].map.count() == together.map.count(env)


def test_state_goes_on_bit_exactly(frames):
    backend = _new()
    for frame in frames[:6]:
        backend.track(frame)
    backend.track(black_frame())  # saved while lost
    state = backend.get_state()
    expected = [backend.track(frame) for frame in frames[6:10]]
    for other in (backend, _new()):
        other.set_state(state)
        for frame, result in zip(frames[6:10], expected, strict=True):
            again = other.track(frame)
            np.testing.assert_array_equal(again.T_world_camera, result.T_world_camera)
            assert again.tracking_ok == result.tracking_ok
        np.testing.assert_array_equal(other.surface_points(), backend.surface_points())


def test_predicted_view_resembles_the_frame(frames):
    backend = _new()
    for frame in frames[:6]:
        pose = backend.track(frame).T_world_camera
    views = backend.predict(np.stack([pose, START]), scale=0.5)
    assert views.depth.shape == (2, 60, 80)
    truth = frames[5].depth[::2, ::2]
    both = (truth > 0) & (truth < 4) & (views.depth[0] > 0)
    assert both.mean() > 0.8
    assert np.median(np.abs(views.depth[0] - truth)[both]) < 0.02


def test_motion_weight_falls_from_one_to_a_half():
    motions = np.stack(
        [np.eye(4), make_pose(np.eye(3), [0.05, 0, 0]), make_pose(so3_exp([0, 0.5, 0]), [0, 0, 0])]
    )
    np.testing.assert_allclose(motion_weight(motions), [1.0, 0.75, 0.5])


def test_bad_input_is_refused(frames):
    backend = _new()
    small = RGBDFrame(np.zeros((60, 80, 3), dtype=np.uint8), np.zeros((60, 80), dtype=np.float32))
    with pytest.raises(InputError, match="80x60"):
        backend.track(small)
    batched = BatchedSurfelSlam(1, CAMERA, CONFIG)
    color, depth = frames[0].color[None], frames[0].depth[None]
    for bad in (np.nan, np.inf, -1.0):
        with pytest.raises(InputError, match="depth holds"):
            batched.track(color, np.where(depth == depth.max(), np.float32(bad), depth))
    for images in ((color[:, 1:], depth[:, 1:]), (color, depth[:, 1:]), (color[0], depth[0])):
        with pytest.raises(InputError, match=r"must be \(1, 120, 160, 3\)"):
            batched.track(*images)
    with pytest.raises(InputError, match="T_world_camera"):
        backend.reset(np.full((4, 4), np.nan))
    with pytest.raises(InputError, match="poses"):
        backend.predict(np.eye(4))
    with pytest.raises(InputError, match="scale"):
        backend.predict(np.eye(4)[None], scale=2.0)
    with pytest.raises(InputError, match="surfel"):
        slam.make("orb", CAMERA)
    with pytest.raises(InputError, match="icp_rgb_weight"):
        slam.make("surfel", CAMERA, icp_rgb_wieght=0.1)
    with pytest.raises(InputError, match="icp_rgb_weight"):
        slam.make("surfel", CAMERA, icp_rgb_weight=1.5)
    with pytest.raises(InputError, match="iterations"):
        slam.make("surfel", CAMERA, iterations=(1, -1))


@pytest.mark.parametrize(("columns", "capacity"), [(80, 500_000), (160, 500_000), (320, 1_000_000)])
def test_room_in_the_map_grows_with_the_image(columns: int, capacity: int) -> None:
    assert SurfelConfig().capacity(columns) == capacity
    assert SurfelConfig(max_surfels=5000).capacity(columns) == 5000
