# mypy: disable-error-code="no-redef, empty-body"
# ruff: noqa: F811
"""Arrays on the device: unchecked access in kernels, host-device buffers, recorded launches.

Warp's own indexing allows negative indices and any strides. That costs more than most of the
arithmetic here and keeps the compiler from vectorizing over eight pixels. Warp's
``for ... in range`` does, too, because its step is a variable; so inner loops that matter are
``while`` loops. On one core of an AMD EPYC, a loop over 19,200 pixels with five operations each
took 43 microseconds with indexing and ``for``, 32 with ``while``, and 5 with ``while``, ``fetch``
and ``put``. ``fetch`` and ``put`` take contiguous one-dimensional arrays, such as
``array.flatten()``, or rows. Only a checked build (``ms_slam_env.native``) checks their indices.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any

from ms_slam_env._runtime import warp as _warp
from ms_slam_env._runtime.warp import RecordedLaunch
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.native import native_source
from ms_slam_env.slam.shared.state import Stateful

Dim = int | Sequence[int]


class SavedBuffer(_warp.HostDeviceBuffer, Stateful):
    """A host-device buffer that is part of a saved state."""

    def get_state(self) -> dict[str, Any]:
        """The values."""
        return {"values": self.read()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Set the values."""
        self.write(state["values"])


class KernelLaunchCache:
    """Recorded launches by key, for kernels whose arguments are the same objects every time.

    Packing the arguments of a launch takes longer than a small kernel (24 microseconds against 4 on
    one core), and tracking repeats the same hundred launches every frame.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._commands: dict[Hashable, RecordedLaunch] = {}

    def clear(self) -> None:
        """Forget all launches; call it when the arguments have become other objects."""
        self._commands.clear()

    def launch(
        self, key: Hashable, kernel: Any, arguments: Callable[[], tuple[Dim, Sequence[Any]]]
    ) -> None:
        """Repeat the launch recorded under ``key``; if there is none, launch ``kernel`` and record.

        ``arguments`` returns the number of threads and the kernel's inputs.
        """
        command = self._commands.get(key)
        if command is None:
            dim, inputs = arguments()
            command = RecordedLaunch(kernel, dim, inputs, self._device)
            self._commands[key] = command
        command.launch()


def threads_per_row(width: int, device: str, gpu_columns: int = 1) -> tuple[int, int]:
    """Number of image columns per thread, and number of threads per row.

    The CPU runs threads one after another, so a thread takes a whole row. A GPU needs many threads.
    """
    columns = gpu_columns if wp.get_device(device).is_cuda else width
    return columns, -(-width // columns)


_dtype: Any
for _dtype in (wp.float32, wp.int32, wp.uint8, wp.vec3):
    _kind = "vec3" if _dtype is wp.vec3 else "number"

    @wp.func_native(native_source("arrays", f"fetch_{_kind}"))
    def fetch(values: wp.array[_dtype], i: int) -> _dtype:
        """Return value ``i``."""

    @wp.func_native(native_source("arrays", f"fetch_{_kind}_in_row"))
    def fetch(values: wp.array2d[_dtype], row: int, i: int) -> _dtype:
        """Return value ``i`` of a row."""

    @wp.func_native(native_source("arrays", f"put_{_kind}"))
    def put(values: wp.array[_dtype], i: int, value: _dtype) -> None:
        """Set value ``i``."""

    @wp.func_native(native_source("arrays", f"put_{_kind}_in_row"))
    def put(values: wp.array2d[_dtype], row: int, i: int, value: _dtype) -> None:
        """Set value ``i`` of a row."""


@wp.func_native(native_source("arrays", "raise_to"))
def raise_to(values: wp.array[wp.float32], i: int, value: wp.float32) -> None:
    """Atomically raise value ``i`` to at least ``value``."""
