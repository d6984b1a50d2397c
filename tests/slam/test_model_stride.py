"""The thinned view that frames are tracked against, and the host's view of device arrays."""

from __future__ import annotations

import numpy as np
import pytest
from surfel_scenes import SMALL, build_map, device_poses

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import xtion
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.slam.surfel.device import HostDeviceBuffer
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.tracker import model_stride

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
    mirror = HostDeviceBuffer((2,), wp.mat44, "cpu")
    values = np.arange(32.0).reshape(2, 4, 4)
    mirror.write(values)
    np.testing.assert_array_equal(mirror.array.numpy(), values)
    read = mirror.read()
    mirror.write(np.zeros((2, 4, 4)))
    np.testing.assert_array_equal(read, values)
