"""Launches that are recorded do what a launch with the same arguments does."""

import numpy as np
import pytest

from ms_slam_env._runtime.warp import HostDeviceBuffer, RecordedLaunch, wp


@wp.struct
class Line:
    """y = slope x + offset."""

    slope: wp.float32
    offset: wp.array(dtype=wp.float32)


@wp.kernel
def on_line(
    x: wp.array(dtype=wp.float32), line: Line, shift: wp.float32, y: wp.array(dtype=wp.float32)
):
    """Values on a line."""
    i = wp.tid()
    y[i] = line.slope * x[i] + line.offset[i] + shift


@pytest.fixture
def recorded():
    x, y, offset = (wp.array(np.arange(5.0) * scale, dtype=wp.float32) for scale in (1, 0, 10))
    line = Line()
    line.slope, line.offset = 2.0, offset
    return RecordedLaunch(on_line, 5, [x, line, 0.5, y], "cpu"), x, line, y


def test_it_launches_only_when_told_and_as_often(recorded):
    launch, _, _, y = recorded
    assert not y.numpy().any()
    for _ in range(2):
        y.zero_()
        launch.launch()
        np.testing.assert_array_equal(y.numpy(), np.arange(5) * 12 + 0.5)


@pytest.mark.parametrize("is_packed", [False, True])
def test_arguments_may_change(recorded, is_packed):
    launch, _, _, y = recorded
    if is_packed:
        launch.launch()
    launch.set_param("shift", -1.0)
    launch.set_param("x", wp.array(np.ones(5), dtype=wp.float32))
    launch.launch()
    np.testing.assert_array_equal(y.numpy(), 2 + np.arange(5) * 10 - 1)
    other = Line()
    other.slope, other.offset = 0.0, wp.zeros(5, dtype=wp.float32)
    launch.set_param("line", other)
    launch.launch()
    np.testing.assert_array_equal(y.numpy(), np.full(5, -1.0))
    assert launch.takes("line")
    assert not launch.takes("z")


def test_fields_of_a_struct_may_be_set_later(recorded):
    launch, _, line, y = recorded
    launch.launch()
    line.slope, line.offset = 1.0, wp.zeros(5, dtype=wp.float32)
    launch.launch()
    np.testing.assert_array_equal(y.numpy(), np.arange(5) + 0.5)


def test_a_buffer_is_the_arrays_own_memory():
    buffer = HostDeviceBuffer((2, 3), wp.float32, "cpu")
    buffer.write(np.arange(6, dtype=np.uint8).reshape(2, 3))
    np.testing.assert_array_equal(buffer.array.numpy(), [[0, 1, 2], [3, 4, 5]])
    kept = buffer.read()
    buffer.zero()
    assert kept.any()
    assert not buffer.array.numpy().any()
    assert not buffer.look().any()


@pytest.mark.parametrize("dtype", [wp.float32, wp.int32, wp.vec3, wp.mat44])
@pytest.mark.parametrize("device", wp.get_devices(), ids=str)
@pytest.mark.parametrize("by_assigning", [False, True])
def test_fewer_values_are_broadcast_on_every_device(dtype, device, by_assigning) -> None:
    buffer = HostDeviceBuffer((4, 3), dtype, str(device))
    if by_assigning:  # as on any device that is not the CPU
        buffer._values, buffer._is_shared = buffer.read(), False
    shape = buffer.read().shape
    values = np.arange(4).reshape(4, *[1] * (len(shape) - 1))
    buffer.write(values)
    assert np.array_equal(buffer.read(), np.broadcast_to(values, shape))
    assert np.array_equal(buffer.array.numpy(), np.broadcast_to(values, shape))
    with pytest.raises(ValueError, match="broadcast"):
        buffer.write(np.zeros((5, *shape[1:]), dtype=int))
