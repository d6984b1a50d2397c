"""Reading and writing flat arrays without checks, for loops over pixels and surfels.

Warp's own indexing takes negative indices and any strides, which costs more than most of the
arithmetic here, and keeps the compiler from working on eight pixels at once. So does Warp's
``for ... in range``, whose step is a variable: inner loops that matter are ``while`` loops. On one
core of an AMD EPYC a loop over 19,200 pixels with five operations each took 43 microseconds with
indexing and ``for``, 32 with ``while``, 5 with ``while`` and these functions.

Arrays are one-dimensional and contiguous, such as ``array.flatten()``; indices are not checked.
"""

# ruff: noqa: F811
# mypy: disable-error-code="no-redef, empty-body"
# Warp tells overloads of a function apart by the types of their arguments.

from __future__ import annotations

from ms_slam_env._warp import wp


@wp.func_native("return values.data[i];")
def fetch(values: wp.array(dtype=wp.float32), i: int) -> wp.float32:
    """Value ``i``."""


@wp.func_native("return values.data[i];")
def fetch(values: wp.array(dtype=wp.int32), i: int) -> wp.int32:
    """Value ``i``."""


@wp.func_native("return values.data[i];")
def fetch(values: wp.array(dtype=wp.uint8), i: int) -> wp.uint8:
    """Value ``i``."""


@wp.func_native(
    "const float* p = (const float*)values.data + 3 * i; "
    "return wp::vec_t<3, float>(p[0], p[1], p[2]);"
)
def fetch(values: wp.array(dtype=wp.vec3), i: int) -> wp.vec3:
    """Value ``i``."""


@wp.func_native("return values.data[size_t(row) * values.shape[1] + i];")
def fetch(values: wp.array2d(dtype=wp.float32), row: int, i: int) -> wp.float32:
    """Value ``i`` of a row."""


@wp.func_native("return values.data[size_t(row) * values.shape[1] + i];")
def fetch(values: wp.array2d(dtype=wp.int32), row: int, i: int) -> wp.int32:
    """Value ``i`` of a row."""


@wp.func_native(
    "const float* p = (const float*)values.data + 3 * (size_t(row) * values.shape[1] + i); "
    "return wp::vec_t<3, float>(p[0], p[1], p[2]);"
)
def fetch(values: wp.array2d(dtype=wp.vec3), row: int, i: int) -> wp.vec3:
    """Value ``i`` of a row."""


@wp.func_native("values.data[i] = value;")
def put(values: wp.array(dtype=wp.float32), i: int, value: wp.float32):
    """Set value ``i``."""


@wp.func_native("values.data[i] = value;")
def put(values: wp.array(dtype=wp.int32), i: int, value: wp.int32):
    """Set value ``i``."""


@wp.func_native(
    "float* p = (float*)values.data + 3 * i; "
    "p[0] = value.c[0]; "
    "p[1] = value.c[1]; "
    "p[2] = value.c[2];"
)
def put(values: wp.array(dtype=wp.vec3), i: int, value: wp.vec3):
    """Set value ``i``."""


@wp.func_native("values.data[size_t(row) * values.shape[1] + i] = value;")
def put(values: wp.array2d(dtype=wp.float32), row: int, i: int, value: wp.float32):
    """Set value ``i`` of a row."""


@wp.func_native("values.data[size_t(row) * values.shape[1] + i] = value;")
def put(values: wp.array2d(dtype=wp.int32), row: int, i: int, value: wp.int32):
    """Set value ``i`` of a row."""


@wp.func_native(
    "float* p = (float*)values.data + 3 * (size_t(row) * values.shape[1] + i); "
    "p[0] = value.c[0]; "
    "p[1] = value.c[1]; "
    "p[2] = value.c[2];"
)
def put(values: wp.array2d(dtype=wp.vec3), row: int, i: int, value: wp.vec3):
    """Set value ``i`` of a row."""


@wp.func_native("wp::atomic_max(values.data + i, value);")
def raise_to(values: wp.array(dtype=wp.float32), i: int, value: wp.float32):
    """Make value ``i`` at least ``value``, also when other threads do so at the same time."""
