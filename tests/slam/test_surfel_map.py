"""The surfel map: batches, capacity, windows of frames, the thinned view for tracking."""

from __future__ import annotations

import numpy as np
import pytest
from surfel_scenes import SMALL, build_map, device_poses, fuse, live_frame

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import xtion
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.slam.surfel.device import SavedBuffer
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.surfels import any_time
from ms_slam_env.slam.surfel.tracker import model_stride

CONFIG = SurfelConfig(max_surfels=6000, compaction_interval=3, unstable_window=4)


def path(env: int, frames: int = 7) -> np.ndarray:
    rng = np.random.default_rng(env)
    twists = rng.normal(0, 0.02, (frames, 6))
    return np.stack([make_pose(so3_exp(t[:3]), t[3:]) for t in twists])


def stack(frames: list[LiveFrame]) -> LiveFrame:
    """Frames of one env each as one frame of many envs."""
    arrays = {}
    for name in LiveFrame.__dataclass_fields__:
        parts = [getattr(frame, name) for frame in frames]
        data = np.concatenate([part.numpy() for part in parts])
        arrays[name] = type(parts[0])(data, dtype=parts[0].dtype)
    return LiveFrame(**arrays)


def assert_same_state(a: dict, b: dict, env_a: int = 0, env_b: int = 0) -> None:
    for name, values in a["surfels"][env_a].items():
        np.testing.assert_array_equal(values, b["surfels"][env_b][name], err_msg=name)
    for name, values in a["counters"].items():
        assert values[env_a] == b["counters"][name][env_b], name


def test_three_envs_at_once_are_bit_identical_to_three_alone() -> None:
    paths = [path(env) for env in range(3)]
    frames = [
        [
            live_frame(p[t][None], noise_m=0.004, rng=np.random.default_rng(100 * e + t))
            for t in range(7)
        ]
        for e, p in enumerate(paths)
    ]
    together = SurfelMap(3, SMALL, CONFIG)
    for t in range(7):
        fuse(together, stack([f[t] for f in frames]), np.stack([p[t] for p in paths]), t)
    last = np.stack([p[-1] for p in paths])
    view = together.render_model(device_poses(last))
    candidates = last[:, None] @ path(9, 4)[None]
    predicted = together.predict_device(candidates, 0.5)
    for env in range(3):
        alone = SurfelMap(1, SMALL, CONFIG)
        for t in range(7):
            fuse(alone, frames[env][t], paths[env][t][None], t)
        assert_same_state(together.get_state(), alone.get_state(), env_a=env)
        single = alone.render_model(device_poses(last[env][None]))
        for name in ("vertices", "normals", "intensity", "color"):
            np.testing.assert_array_equal(
                getattr(view, name).numpy()[env], getattr(single, name).numpy()[0]
            )
        own = together.predict(candidates[env], 0.5, env=env)
        np.testing.assert_array_equal(own.depth, alone.predict(candidates[env], 0.5).depth)
        shared = predicted.depth.numpy().reshape(3, 4, *own.intrinsics.shape)[env]
        # A shared reference view may be wider than one env needs alone.
        assert np.mean(np.abs(shared - own.depth) < 1e-3) > 0.95


def test_a_full_map_drops_surfels_and_recovers() -> None:
    config = SurfelConfig(max_surfels=1000, compaction_interval=5)
    surfel_map = SurfelMap(1, SMALL, config)
    fuse(surfel_map, live_frame(np.eye(4)[None]), np.eye(4)[None], 0)
    pixels = SMALL.width * SMALL.height
    assert surfel_map.surfels.dropped.numpy()[0] == pixels - 1000
    assert surfel_map.count() == 1000
    assert len(surfel_map.points(stable=False)) == 1000
    # Elsewhere the unstable surfels out of view make room at once.
    away = make_pose(so3_exp([0.0, 0.0, 0.0]), [5.0, 0.0, 0.0])
    for time in (1, 2):
        fuse(surfel_map, live_frame(away[None]), away[None], time)
    assert surfel_map.count() == 1000
    assert (surfel_map.points(stable=False)[:, 0] > 2.5).mean() > 0.99


def test_clear_forgets_one_env_or_all() -> None:
    surfel_map = SurfelMap(2, SMALL, CONFIG)
    poses = np.stack([np.eye(4)] * 2)
    fuse(surfel_map, live_frame(poses), poses, 0)
    surfel_map.clear(0)
    assert surfel_map.count(0) == 0
    assert surfel_map.count(1) > 0
    surfel_map.clear()
    assert surfel_map.count(1) == 0
    assert surfel_map.points(1, stable=False).shape == (0, 3)
    assert (surfel_map.render_model(device_poses(poses)).intensity.numpy() == 0).all()


def test_colors_belong_to_points() -> None:
    surfel_map = build_map(path(2, 3))
    points, colors = surfel_map.points(stable=False), surfel_map.colors(stable=False)
    assert colors.shape == points.shape
    assert colors.dtype == np.uint8
    surfels = surfel_map.get_state()["surfels"][0]
    alive = surfels["confidence"] > 0
    np.testing.assert_array_equal(points, surfels["position"][alive].astype(float))
    np.testing.assert_array_equal(colors, np.rint(surfels["color"][alive]).astype(np.uint8))


def test_many_workers_do_what_one_does() -> None:
    """The threads of a GPU share the surfels of an env; here they run one after the other."""
    poses = path(4, 6)
    maps = [SurfelMap(1, SMALL, CONFIG, workers=workers) for workers in (1, 7)]
    for t in range(6):
        live = live_frame(poses[t][None], noise_m=0.004, rng=np.random.default_rng(t))
        for surfel_map in maps:
            fuse(surfel_map, live, poses[t][None], t)
    one, seven = (m.get_state() for m in maps)
    assert one["counters"]["count"] == seven["counters"]["count"]
    order = [np.lexsort(s["surfels"][0]["position"].T) for s in (one, seven)]
    assert not np.array_equal(*order)
    for name, values in one["surfels"][0].items():
        other = seven["surfels"][0][name]
        np.testing.assert_array_equal(values[order[0]], other[order[1]], err_msg=name)
    views = [m.render_model(device_poses(poses[:1])) for m in maps]
    depth = [view.vertices.numpy()[..., 2] for view in views]
    np.testing.assert_allclose(depth[0], depth[1], atol=1e-5)  # sums in another order


AT_REST = np.tile(np.eye(4), (2, 1, 1))


def two_maps() -> SurfelMap:
    """Two equal maps of one frame, whose left halves were seen last in frame 3 and 7."""
    surfel_map = SurfelMap(2, SMALL, SurfelConfig(max_surfels=20_000))
    fuse(surfel_map, live_frame(AT_REST), AT_REST, 0)
    state = surfel_map.get_state()
    for surfels, time in zip(state["surfels"], (3, 7), strict=True):
        surfels["seen"][surfels["position"][:, 0] < 0] = time
    surfel_map.set_state(state)
    return surfel_map


def test_only_surfels_of_the_window_are_drawn_in_each_env() -> None:
    surfel_map = two_maps()
    everything = surfel_map.render_model(device_poses(AT_REST)).vertices.numpy()
    surfel_map.active.seen_from.assign([3, 8])
    view = surfel_map.render_model(device_poses(AT_REST)).vertices.numpy()
    left = (everything[..., 2] > 0) & (everything[..., 0] < -0.1)
    right = (everything[..., 2] > 0) & (everything[..., 0] > 0.1)
    np.testing.assert_array_equal(view[0][left[0]], everything[0][left[0]])
    assert (view[0][right[0]] == 0).all()
    assert (view[1] == 0).all()


def test_another_renderer_draws_another_window() -> None:
    surfel_map = two_maps()
    old = any_time(2, "cpu")
    old.seen_to.assign([2, 2])
    renderer = surfel_map.model_renderer(1, old)
    renderer.cull(device_poses(AT_REST))
    view = renderer.splat().vertices.numpy()
    drawn = view[..., 2] > 0
    assert drawn.any()
    assert (view[drawn][:, 0] > -0.1).all()


def test_surfels_outside_the_window_take_no_part_in_fusion() -> None:
    surfel_map = two_maps()
    before = surfel_map.get_state()["surfels"]
    surfel_map.active.seen_from.assign([3, 8])
    fuse(surfel_map, live_frame(AT_REST), AT_REST, 9)
    after = surfel_map.get_state()["surfels"]
    old = len(before[0]["seen"])
    is_left = before[0]["position"][:, 0] < 0
    np.testing.assert_array_equal(after[0]["seen"][:old] == 9, is_left)
    np.testing.assert_array_equal(after[1]["confidence"][:old], before[1]["confidence"])
    assert len(after[1]["seen"]) == 2 * old  # all readings start new surfels


POSES = np.stack(
    [make_pose(so3_exp([0.01 * k, -0.02 * k, 0.0]), [0.02 * k, 0.0, 0.01 * k]) for k in range(4)]
)


@pytest.mark.parametrize("stride", [2, 4])
def test_a_thinned_view_has_the_pixels_of_the_whole_one(stride):
    whole_map = build_map(POSES[:3], noise_m=0.003)
    thin_map = SurfelMap(1, SMALL, whole_map.config, model_stride=stride)
    thin_map.set_state(whole_map.get_state())
    whole = whole_map.render_model(device_poses(POSES[3:]))
    thin = thin_map.render_model(device_poses(POSES[3:]))
    for name, tolerance in (("vertices", 1e-4), ("normals", 1e-3), ("color", 0.05)):
        expected = getattr(whole, name).numpy()[:, ::stride, ::stride]
        found = getattr(thin, name).numpy()
        assert found.shape == expected.shape
        # A pixel on the very rim of a disc may fall to either side of it.
        same = (np.abs(found - expected) < tolerance).all(axis=-1)
        assert same.mean() > 0.99
    assert (thin.vertices.numpy()[..., 2] > 0).mean() > 0.5


@pytest.mark.parametrize(("size", "stride"), [("80x60", 1), ("160x120", 2), ("320x240", 4)])
def test_the_view_is_as_thin_as_the_last_iteration_allows(size, stride):
    assert model_stride(xtion(size), SurfelConfig()) == stride
    assert model_stride(xtion(size), SurfelConfig(points_per_level=1_000_000)) == 1


def test_a_mirror_writes_and_reads_the_device_array():
    mirror = SavedBuffer((2,), wp.mat44, "cpu")
    values = np.arange(32.0).reshape(2, 4, 4)
    mirror.write(values)
    np.testing.assert_array_equal(mirror.array.numpy(), values)
    read = mirror.read()
    mirror.write(np.zeros((2, 4, 4)))
    np.testing.assert_array_equal(read, values)
