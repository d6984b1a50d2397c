"""Images of a batch on the device: looked at, fetched and kept as those on the host are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ms_slam_env._runtime.warp import HostDeviceBuffer, wp
from ms_slam_env.errors import InputError
from ms_slam_env.slam.shared.images import Images, ImageStore, Surveyor, images_of

SHAPE = (3, 13, 18)  # sizes that are no multiples of anything


@pytest.fixture
def images() -> Images:
    rng = np.random.default_rng(0)
    color = rng.normal(rng.uniform(0, 255, (3, 1, 1, 3)), 4, (*SHAPE, 3))
    depth = rng.uniform(0, 5, SHAPE).astype(np.float32)
    return Images(np.clip(color, 0, 255).astype(np.uint8), depth)


def on_device(images: Images) -> Images:
    color = wp.array(images.color, dtype=wp.uint8, device="cpu")
    return Images(color, wp.array(images.depth, dtype=wp.float32, device="cpu"))


@pytest.mark.parametrize("every", [1, 4])
def test_a_survey_finds_what_opencv_finds(images, every):
    images.color[1] = 77
    images.depth[2, 5, 6] = np.nan
    survey = Surveyor(every)
    for _ in range(2):  # sums start anew
        mean, deviation, is_bad = survey(on_device(images))
        for env, color in enumerate(images.color):
            expected = cv2.meanStdDev(np.ascontiguousarray(color[::every, ::every]))
            np.testing.assert_array_equal(mean[env], expected[0][:, 0])
            np.testing.assert_array_equal(deviation[env], expected[1][:, 0])
        assert is_bad.tolist() == [False, False, True]


@pytest.mark.parametrize("bad", [np.inf, -np.inf, -1e-6, np.nan])
def test_bad_depth_is_found(images, bad):
    images.depth[0, -1, -1] = bad
    assert Surveyor(4)(on_device(images))[2].tolist() == [True, False, False]


def test_one_env_is_fetched_as_it_was(images):
    there = on_device(images)
    color, depth = there.of(1)
    there.depth.zero_()
    assert there.of(1) == (color, depth)  # not fetched again
    np.testing.assert_array_equal(color, images.color[1])
    np.testing.assert_array_equal(depth, images.depth[1])
    assert (there.of(0)[1] == 0).all()


def test_tensors_of_pytorch_are_taken_without_a_copy(images):
    torch = pytest.importorskip("torch")
    color, depth = torch.from_numpy(images.color), torch.from_numpy(images.depth)
    found = images_of(color, depth, "cpu")
    assert found.on_device
    assert (found.color.ptr, found.depth.ptr) == (color.data_ptr(), depth.data_ptr())
    np.testing.assert_array_equal(found.of(2)[0], images.color[2])
    turned = images_of(color.flip(2), depth.transpose(1, 2).transpose(1, 2), "cpu")
    np.testing.assert_array_equal(turned.of(0)[0], images.color[0, :, ::-1])
    halves = torch.zeros(SHAPE, dtype=torch.float16)
    with pytest.raises(InputError, match="float16, not float32"):
        images_of(color, halves, "cpu")


def test_a_store_keeps_what_it_is_given_wherever_that_lies(images):
    rng, expected = np.random.default_rng(1), images.depth * 0
    store = ImageStore(*SHAPE[:1], SHAPE[1:])
    for step in range(12):
        where = rng.random(3) < (1 if step == 5 else 0.5)
        new = Images(np.roll(images.color, step, 0), images.depth + np.float32(step))
        store.replace(on_device(new) if step % 4 < 2 else new, where)
        expected[where] = new.depth[where]
        np.testing.assert_array_equal(store.images.on_host().depth, expected)
        for env in np.flatnonzero(where):
            np.testing.assert_array_equal(store.images.of(env)[0], new.color[env])


def test_a_buffer_takes_an_array_of_the_device():
    buffer = HostDeviceBuffer((2, 3), wp.float32, "cpu")
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    buffer.write(wp.array(values, device="cpu"))
    np.testing.assert_array_equal(buffer.read(), values)
    for other in (values[:1], values.astype(np.float64), values.ravel()):
        with pytest.raises(ValueError, match="in place of"):
            buffer.write(wp.array(other, device="cpu"))


def test_a_buffer_takes_and_shows_one_row():
    buffer = HostDeviceBuffer((3, 4), wp.int32, "cpu")
    buffer.write_row(1, [1, 2, 3, 4])
    buffer.write_row(2, 7)
    np.testing.assert_array_equal(buffer.array.numpy(), [[0] * 4, [1, 2, 3, 4], [7] * 4])
    np.testing.assert_array_equal(buffer.look_row(1), [1, 2, 3, 4])
