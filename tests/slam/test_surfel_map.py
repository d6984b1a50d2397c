"""Batches, states and capacity of the surfel map."""

from __future__ import annotations

import numpy as np
from surfel_scenes import SMALL, build_map, device_poses, fuse, live_frame

from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap

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


def test_a_restored_state_goes_on_bit_exactly() -> None:
    poses = path(1, 10)
    original = build_map(poses[:5], noise_m=0.003, compaction_interval=3)
    saved = original.get_state()
    restored = SurfelMap(1, SMALL, original.config)
    restored.set_state(saved)
    assert_same_state(saved, restored.get_state())
    for t in range(5, 10):
        live = live_frame(poses[t][None], noise_m=0.003, rng=np.random.default_rng(t))
        fuse(original, live, poses[t][None], t)
        fuse(restored, live, poses[t][None], t)
    assert_same_state(original.get_state(), restored.get_state())
    assert original.count() != len(saved["surfels"][0]["radius"])  # time did go on


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
