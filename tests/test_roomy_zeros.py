"""Arrays with room for more than they hold: what Warp makes, without the memory."""

import numpy as np
import pytest

from ms_slam_env._runtime.warp import roomy_zeros, wp
from ms_slam_env.metrics.cost.meter import forget_peak_memory, resident_mb


@wp.kernel
def count(values: wp.array2d(dtype=wp.vec3)):
    """Number of the place, three times."""
    row, i = wp.tid()
    values[row, i] = values[row, i] + wp.vec3(float(row * values.shape[1] + i))


@pytest.mark.parametrize("dtype", [wp.float32, wp.int32, wp.int64, wp.uint8, wp.vec3, wp.mat44])
@pytest.mark.parametrize("shape", [7, (5,), (2, 3)])
def test_they_are_zeros_as_of_warp(dtype, shape):
    ours, theirs = roomy_zeros(shape, dtype, "cpu"), wp.zeros(shape, dtype=dtype, device="cpu")
    assert (ours.shape, ours.strides, ours.dtype) == (theirs.shape, theirs.strides, theirs.dtype)
    assert ours.ptr % 64 == 0
    assert ours.is_contiguous
    np.testing.assert_array_equal(ours.numpy(), theirs.numpy())


def test_kernels_write_to_them():
    values = roomy_zeros((2, 100), wp.vec3, "cpu")
    wp.launch(count, dim=values.shape, inputs=[values], device="cpu")
    expected = np.arange(200.0).reshape(2, 100, 1).repeat(3, axis=2)
    np.testing.assert_array_equal(values.numpy(), expected)


def holes_in_the_heap() -> list[bytes]:
    """Free 600 MB below something kept: the process has the addresses, the system the memory."""
    np.ones(31_000_000, np.uint8)  # once this is freed, blocks of its size come from the heap
    blocks = [np.ones(20_000_000, np.uint8) for _ in range(30)]
    kept = [bytes(100_000) for _ in range(5)]
    blocks.clear()
    forget_peak_memory()  # hands back what was freed
    return kept


@pytest.mark.parametrize("holes", [False, True])
def test_what_is_not_written_takes_no_memory(holes):
    kept = holes_in_the_heap() if holes else []
    before = resident_mb()
    if before is None:
        pytest.skip("this system does not tell the memory in use")
    values = roomy_zeros((2, 50_000_000), wp.float32, "cpu")  # 400 MB
    assert resident_mb() < before + 40
    values.numpy()[1, :1000] = 1
    assert values.numpy().sum(dtype=float, axis=1).tolist() == [0, 1000]
    kept.clear()
