"""Blocks of surfels: what a camera sees is found as by looking at every surfel; boxes hold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surfel_scenes import SMALL, device_poses, fuse, live_frame

from ms_slam_env.geometry import invert, make_pose, so3_exp, transform_points
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.surfels import BLOCK_SIZE

CONFIG = SurfelConfig(max_surfels=3000, compaction_interval=2, unstable_window=3)
MAPS = SurfelMap(2, SMALL, CONFIG)
SHARED_MAPS = SurfelMap(2, SMALL, CONFIG, workers=7)  # as on a GPU
seeds = st.integers(0, 2**32 - 1)


def random_pose(rng: np.random.Generator, reach_m: float) -> np.ndarray:
    return make_pose(so3_exp(rng.normal(0, 1.5, 3)), rng.uniform(-reach_m, reach_m, 3))


def random_surfels(rng: np.random.Generator, count: int, extent_m: float) -> dict[str, np.ndarray]:
    """Places of neighbours, as blocks have them, and of strangers; some surfels are dead."""
    places = rng.uniform(-extent_m, extent_m, (count // 50 + 1, 3))
    spread = rng.choice([0.05, 1.0])
    position = np.repeat(places, 50, axis=0)[:count] + rng.normal(0, spread, (count, 3))
    normal = rng.normal(0, 1, (count, 3))
    return {
        "position": position.astype(np.float32),
        "normal": (normal / np.linalg.norm(normal, axis=1)[:, None]).astype(np.float32),
        "color": rng.uniform(0, 255, (count, 3)).astype(np.float32),
        "radius": rng.uniform(0.001, 0.02, count).astype(np.float32),
        "confidence": np.maximum(rng.uniform(-3, 20, count), 0).astype(np.float32),
        "created": np.zeros(count, dtype=np.int32),
        "seen": rng.integers(0, 9, count).astype(np.int32),
    }


def set_surfels(surfels: list[dict[str, np.ndarray]], maps: SurfelMap = MAPS) -> None:
    maps.set_state(
        {
            "counters": {
                "count": np.int32([len(s["seen"]) for s in surfels]),
                "dead": np.int32([(s["confidence"] == 0).sum() for s in surfels]),
                "dropped": np.zeros(2, dtype=np.int32),
            },
            "surfels": surfels,
        }
    )


def visible(
    poses: np.ndarray, first_env: int, margin_px: float, maps: SurfelMap = MAPS, **more: float
) -> list[dict[str, np.ndarray]]:
    """What is listed for each pose."""
    maps.kernels._model_renderer.cull(device_poses(poses), first_env, margin_px, **more)
    listed = maps.kernels._model_renderer.visible
    names = ("index", "position", "normal", "radius")
    return [
        {name: getattr(listed, name).numpy()[k, :count].copy() for name in names}
        for k, count in enumerate(listed.count.numpy())
    ]


def look_everywhere() -> None:
    """Boxes without end: every surfel is looked at."""
    MAPS._buffers.blocks.low.fill_((-1e6, -1e6, -1e6))
    MAPS._buffers.blocks.high.fill_((1e6, 1e6, 1e6))


@settings(max_examples=60, deadline=None)
@given(seeds, st.sampled_from([0.0, 1.0, 7.0]), st.sampled_from([1.0, 8.0, 300.0]))
def test_the_visible_surfels_are_those_of_the_loop_over_all(seed, margin_px, extent_m):
    rng = np.random.default_rng(seed)
    surfels = [random_surfels(rng, int(rng.integers(0, 2500)), extent_m) for _ in range(2)]
    set_surfels(surfels)
    window = np.sort(rng.integers(0, 9, 2))
    MAPS.active.seen_from.fill_(int(window[0]))
    MAPS.active.seen_to.fill_(int(window[1]))
    poses = np.stack([random_pose(rng, extent_m) for _ in range(2)])
    fast = visible(poses, 0, margin_px)
    looked_at = MAPS._buffers.blocks.num_listed.numpy() * BLOCK_SIZE
    look_everywhere()
    slow = visible(poses, 0, margin_px)
    for env in range(2):
        for name, values in slow[env].items():
            np.testing.assert_array_equal(fast[env][name], values, err_msg=name)
        expected, doubtful = visible_by_definition(surfels[env], poses[env], margin_px, window)
        assert set(fast[env]["index"]) <= set(expected) | set(doubtful)
        assert set(fast[env]["index"]) >= set(expected) - set(doubtful)
        assert (np.diff(fast[env]["index"]) > 0).all()  # the order of the map
        assert looked_at[env] >= len(expected) - len(doubtful)


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from([0.0, 7.0]), st.sampled_from([1.0, 8.0]), st.booleans())
def test_many_workers_make_the_same_list(seed, margin_px, extent_m, leaves_out):
    rng = np.random.default_rng(seed)
    surfels = [random_surfels(rng, int(rng.integers(0, 2900)), extent_m) for _ in range(2)]
    window = np.sort(rng.integers(0, 9, 2))
    layers = 2.0 if leaves_out else np.inf
    for maps in (MAPS, SHARED_MAPS):
        set_surfels(surfels, maps)
        maps.active.seen_from.fill_(int(window[0]))
        maps.active.seen_to.fill_(int(window[1]))
    for _ in range(2):  # the second looks from elsewhere, over what the first has left behind
        poses = np.stack([random_pose(rng, extent_m) for _ in range(2)])
        one, many = (
            visible(poses, 0, margin_px, maps, layers=layers) for maps in (MAPS, SHARED_MAPS)
        )
        for env in range(2):
            for name, values in one[env].items():
                np.testing.assert_array_equal(many[env][name], values, err_msg=name)
        blocks = [maps._buffers.blocks for maps in (MAPS, SHARED_MAPS)]
        counts = [block.num_listed.numpy().tolist() for block in blocks]
        assert counts[0] == counts[1]
        for env, count in enumerate(counts[0]):
            listed = [block.listed.numpy()[env, :count] for block in blocks]
            np.testing.assert_array_equal(*listed)
        # Drawing overwrites the memory that the counts were in.
        views = [maps.kernels._model_renderer.splat() for maps in (MAPS, SHARED_MAPS)]
        for name in ("vertices", "normals", "intensity", "color"):  # sums in another order
            images = [getattr(view, name).numpy() for view in views]
            np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-4, err_msg=name)


def test_of_many_discs_to_a_pixel_a_share_is_listed_by_their_slots():
    rng = np.random.default_rng(0)
    set_surfels([random_surfels(rng, 2500, 8.0) for _ in range(2)])
    MAPS.active.seen_from.fill_(0)
    MAPS.active.seen_to.fill_(9)
    poses = np.stack([random_pose(rng, 8.0) for _ in range(2)])
    focal = MAPS.kernels._model_renderer.intrinsics.fx
    left_out = 0
    for every, some in zip(visible(poses, 0, 0), visible(poses, 0, 0, layers=2.0), strict=True):
        likely = 2.0 * (every["radius"] * focal / every["position"][:, 2]) ** 2
        draw = ((every["index"].astype(np.uint32) * np.uint32(2654435769)) >> 8) / 2**24
        np.testing.assert_array_equal(some["index"], every["index"][draw < likely])
        left_out += len(every["index"]) - len(some["index"])
    assert left_out > 20


def visible_by_definition(
    surfels: dict[str, np.ndarray], pose: np.ndarray, margin_px: float, window: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Slots in view, and those so close to a limit that rounding decides."""
    renderer = MAPS.kernels._model_renderer
    camera, image = renderer.camera, renderer.intrinsics
    p = transform_points(invert(pose), surfels["position"].astype(float))
    facing = -np.sum(p * (surfels["normal"] @ pose[:3, :3]), axis=1)
    z = np.maximum(p[:, 2], 1e-9)
    u, v = image.fx * p[:, 0] / z + image.cx, image.fy * p[:, 1] / z + image.cy
    room = np.stack(
        [
            p[:, 2] - camera.z_near,
            camera.z_far - p[:, 2],
            u + 0.5 + margin_px,
            image.width - 0.5 + margin_px - u,
            v + 0.5 + margin_px,
            image.height - 0.5 + margin_px - v,
            facing,
        ]
    )
    living = (surfels["confidence"] > 0) & (surfels["seen"] >= window[0])
    living &= surfels["seen"] <= window[1]
    doubtful = np.abs(room).min(axis=0) < 1e-3 * (1 + np.abs(surfels["position"]).max(initial=0))
    return np.flatnonzero(living & (room > 0).all(axis=0)), np.flatnonzero(living & doubtful)


def test_one_env_of_several_is_culled_by_its_own_boxes():
    rng = np.random.default_rng(3)
    surfels = [random_surfels(rng, 900, 4.0), random_surfels(rng, 1300, 4.0)]
    set_surfels(surfels)
    MAPS.active.seen_from.fill_(0)
    MAPS.active.seen_to.fill_(9)
    pose = make_pose(np.eye(3), [0, 0, -6])[None]
    both = visible(np.tile(pose, (2, 1, 1)), 0, 1.0)
    assert 0 < len(both[1]["index"]) < 1300
    look = MAPS.model_renderer(1, MAPS.active)
    look.cull(device_poses(np.tile(pose, (2, 1, 1))), 0)
    predicted = MAPS.predict(pose, 1.0, env=1).depth
    set_surfels(surfels[::-1])
    np.testing.assert_array_equal(MAPS.predict(pose, 1.0, env=0).depth, predicted)


def assert_boxes_hold(surfel_map: SurfelMap) -> None:
    """Every living surfel lies in its block's box; no unstable one is due before its block."""
    blocks, surfels = surfel_map._buffers.blocks, surfel_map.surfels
    low, high, expiry = blocks.low.numpy(), blocks.high.numpy(), blocks.expiry.numpy()
    counts = surfels.count.numpy()
    np.testing.assert_array_equal(blocks.bounded.numpy(), counts)
    for env, count in enumerate(counts):
        block = np.arange(count) // BLOCK_SIZE
        position = surfels.position.numpy()[env, :count]
        confidence = surfels.confidence.numpy()[env, :count]
        alive = confidence > 0
        assert (position >= low[env][block])[alive].all()
        assert (position <= high[env][block])[alive].all()
        unstable = alive & (confidence < surfel_map.config.confidence_threshold)
        seen = surfels.seen.numpy()[env, :count]
        assert (seen >= expiry[env][block])[unstable].all()
        assert surfels.dead.numpy()[env] == (~alive).sum()


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_boxes_hold_whatever_happens_to_the_maps(seed):
    rng = np.random.default_rng(seed)
    surfel_map = MAPS
    surfel_map.active.seen_from.fill_(0)
    surfel_map.active.seen_to.fill_(2**31 - 1)
    surfel_map.clear()
    saved = surfel_map.get_state()
    for time in range(14):
        what = rng.choice(["fuse", "fuse", "fuse", "fuse", "clear", "save", "restore", "move"])
        if what == "fuse":
            poses = np.stack(
                [make_pose(so3_exp(rng.normal(0, 0.1, 3)), rng.normal(0, 0.3, 3)) for _ in "ab"]
            )
            live = live_frame(poses, noise_m=0.01, rng=rng)
            # At the same pose the readings differ by noise; elsewhere they contradict the map.
            fuse(surfel_map, live, poses, time, mask=rng.integers(0, 2, 2))
        elif what == "clear":
            surfel_map.clear(int(rng.integers(0, 2)))
        elif what == "save":
            saved = surfel_map.get_state()
        elif what == "restore":
            surfel_map.set_state(saved)
        elif what == "move":
            surfel_map.surfels.position.assign(surfel_map.surfels.position.numpy() + 0.5)
            surfel_map.surfels_moved()
        if what != "clear":
            assert_boxes_hold(surfel_map)


def test_far_blocks_are_not_looked_at():
    rng = np.random.default_rng(0)
    near = random_surfels(rng, 500, 0.2)
    far = {name: np.tile(values, (4,) + (1,) * (values.ndim - 1)) for name, values in near.items()}
    far["position"] = far["position"] + np.float32([50, 0, 0])
    set_surfels([{name: np.concatenate([far[name], near[name]]) for name in near}] * 2)
    poses = np.tile(make_pose(np.eye(3), [0, 0, -3]), (2, 1, 1))
    visible(poses, 0, 1.0)
    assert (MAPS._buffers.blocks.num_listed.numpy() <= 500 / BLOCK_SIZE + 2).all()


def test_unstable_surfels_expire_at_the_interval_and_gaps_close_when_many():
    config = SurfelConfig(
        max_surfels=5000, compaction_interval=4, unstable_window=6, confidence_threshold=10
    )
    surfel_map = SurfelMap(1, SMALL, config)
    rng = np.random.default_rng(1)
    surfels = random_surfels(rng, 2000, 3.0)
    surfels["position"][:, 2] -= 100  # behind the camera: fusion leaves them alone
    surfels["confidence"] = np.float32(rng.uniform(1, 30, 2000))
    surfels["seen"] = np.int32(np.arange(2000) // 100)
    counters = {"count": np.int32([2000]), "dead": np.int32([0]), "dropped": np.int32([0])}
    surfel_map.set_state({"counters": counters, "surfels": [surfels]})
    nothing = live_frame(np.eye(4)[None])
    nothing.depth.zero_()
    nothing.normals.zero_()
    expected = np.ones(2000, dtype=bool)
    slots = []
    for time in range(30):
        fuse(surfel_map, nothing, np.eye(4)[None], time)
        if time % 4 == 0:
            old_and_unstable = (surfels["confidence"] < 10) & (surfels["seen"] < time - 6)
            expected &= ~old_and_unstable
            used = -(-int(surfel_map.surfels.count.numpy()[0]) // BLOCK_SIZE)
            # No block is looked at again for what is gone already.
            assert (surfel_map._buffers.blocks.expiry.numpy()[0, :used] >= time - 6).all()
        state = surfel_map.get_state()
        for name, values in surfels.items():
            found = surfel_map.attribute(name, stable=False)
            np.testing.assert_array_equal(found, values[expected], err_msg=name)
        assert surfel_map.count() == expected.sum()
        dead = int(state["counters"]["dead"][0])
        slots.append(int(state["counters"]["count"][0]))
        assert slots[-1] == expected.sum() + dead
        assert 8 * dead <= slots[-1] or time % 4
        assert_boxes_hold(surfel_map)
    assert 0.5 < expected.mean() < 0.9
    assert 2 <= len(set(slots)) < 5  # few compactions for many removals


def test_a_full_map_closes_its_gaps_now_and_then():
    config = SurfelConfig(max_surfels=3000, compaction_interval=1000)
    surfel_map = SurfelMap(1, SMALL, config)
    rng = np.random.default_rng(2)
    surfels = random_surfels(rng, 2990, 3.0)
    surfels["position"][:, 2] -= 100  # behind the camera
    surfels["confidence"] = np.full(2990, 20, dtype=np.float32)
    surfels["confidence"][:100] = 1  # unstable: at once to go, seen in the frames 1, 2, 3, ...
    surfels["seen"] = np.int32(np.arange(2990) // 10 + 1)
    counters = {"count": np.int32([2990]), "dead": np.int32([0]), "dropped": np.int32([0])}
    surfel_map.set_state({"counters": counters, "surfels": [surfels]})
    nothing = live_frame(np.eye(4)[None])
    nothing.depth.zero_()
    nothing.normals.zero_()
    slots = []
    for time in range(1, 12):
        fuse(surfel_map, nothing, np.eye(4)[None], time)
        assert surfel_map.count() == 2990 - 10 * (time - 1)
        slots.append(int(surfel_map.surfels.count.numpy()[0]))
        assert_boxes_hold(surfel_map)
    # First when a sixty-fourth is dead, again only when as many are dead as are free.
    assert slots == [2990] * 5 + [2940] * 6


@pytest.mark.parametrize("frames", [50, 200])
def test_a_crowded_map_forgets_the_oldest_first_and_few_at_once(frames):
    config = SurfelConfig(max_surfels=4000, compaction_interval=1000, unstable_window=60)
    surfel_map = SurfelMap(2, SMALL, config)
    rng = np.random.default_rng(3)
    maps = []
    for count in (3700, 3500):  # the second is not crowded
        surfels = random_surfels(rng, count, 3.0)
        surfels["position"][:, 2] -= 100  # behind the camera
        surfels["confidence"] = np.where(rng.random(count) < 0.2, 20, 1).astype(np.float32)
        surfels["seen"] = rng.integers(max(0, frames - 60), frames, count).astype(np.int32)
        maps.append(surfels)
    counts = np.int32([3700, 3500])
    counters = {"count": counts, "dead": 0 * counts, "dropped": 0 * counts}
    surfel_map.set_state({"counters": counters, "surfels": maps})
    poses = np.tile(np.eye(4), (2, 1, 1))
    nothing = live_frame(poses)
    nothing.depth.zero_()
    nothing.normals.zero_()
    fuse(surfel_map, nothing, poses, frames - 1)
    left = surfel_map.get_state()["surfels"]
    assert surfel_map.count(1) == 3500
    alive = left[0]["confidence"] > 0
    stable = maps[0]["confidence"] == 20
    assert alive[stable].all()
    went = 3700 - surfel_map.count(0)
    seen = np.sort(maps[0]["seen"][~stable])
    kept = np.sort(left[0]["seen"][alive & (left[0]["confidence"] < 20)])
    np.testing.assert_array_equal(kept, seen[went:])  # the oldest went, nothing else
    assert 250 <= went <= 250 + 2 * (3700 / 50)  # a sixteenth of the slots, and a frame's more
