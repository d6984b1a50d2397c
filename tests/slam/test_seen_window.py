"""Drawing and fusing only the surfels last seen within a window of frames."""

from __future__ import annotations

import numpy as np
from surfel_scenes import SMALL, device_poses, fuse, live_frame

from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.surfels import any_time

POSES = np.tile(np.eye(4), (2, 1, 1))


def two_maps() -> SurfelMap:
    """Two equal maps of one frame, whose left halves were seen last in frame 3 and 7."""
    surfel_map = SurfelMap(2, SMALL, SurfelConfig(max_surfels=20_000))
    fuse(surfel_map, live_frame(POSES), POSES, 0)
    state = surfel_map.get_state()
    for surfels, time in zip(state["surfels"], (3, 7), strict=True):
        surfels["seen"][surfels["position"][:, 0] < 0] = time
    surfel_map.set_state(state)
    return surfel_map


def test_only_surfels_of_the_window_are_drawn_in_each_env() -> None:
    surfel_map = two_maps()
    everything = surfel_map.render_model(device_poses(POSES)).vertices.numpy()
    surfel_map.active.seen_from.assign([3, 8])
    view = surfel_map.render_model(device_poses(POSES)).vertices.numpy()
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
    renderer.cull(device_poses(POSES))
    view = renderer.splat().vertices.numpy()
    drawn = view[..., 2] > 0
    assert drawn.any()
    assert (view[drawn][:, 0] > -0.1).all()


def test_surfels_outside_the_window_take_no_part_in_fusion() -> None:
    surfel_map = two_maps()
    before = surfel_map.get_state()["surfels"]
    surfel_map.active.seen_from.assign([3, 8])
    fuse(surfel_map, live_frame(POSES), POSES, 9)
    after = surfel_map.get_state()["surfels"]
    old = len(before[0]["seen"])
    is_left = before[0]["position"][:, 0] < 0
    np.testing.assert_array_equal(after[0]["seen"][:old] == 9, is_left)
    np.testing.assert_array_equal(after[1]["confidence"][:old], before[1]["confidence"])
    assert len(after[1]["seen"]) == 2 * old  # all readings start new surfels
