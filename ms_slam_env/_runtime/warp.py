"""NVIDIA Warp, initialised once (quiet, forward kernels only); reusable launches and arrays."""

import atexit
import ctypes
import errno
import math
import mmap
import multiprocessing
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError, InputWarning

if TYPE_CHECKING:
    kernel_wp: Any
    """Warp as used in kernels, typed as Any, since its 32-bit numbers are not Python types."""
else:
    kernel_wp = wp

wp.config.log_level = wp.LOG_ERROR
wp.config.enable_backward = False


def _init_quietly() -> OSError | None:
    """Initialise without the warning that the native library prints if there is no GPU."""
    saved = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            return _init()
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def _check_home() -> None:
    """Refuse a user without a home folder, since Warp would create one called ``~``.

    Raises:
        FileNotFoundError: there is no home folder.
    """
    told = os.environ.get("WARP_CACHE_PATH") or os.environ.get("XDG_CACHE_HOME")
    if not told and os.path.expanduser("~") == "~":
        raise FileNotFoundError(errno.ENOENT, "this user has no home folder", "~")


def _init() -> OSError | None:
    """Initialise; if the kernel cache cannot be used, use a temporary one and return the error."""
    try:
        _check_home()
        wp.init()
    except OSError as error:
        try:
            passing = tempfile.mkdtemp(prefix="ms_slam_env-")
        except OSError as none:
            raise InputError(f"no place for compiled kernels: {none.strerror}") from None
        atexit.register(shutil.rmtree, passing, ignore_errors=True)
        wp.config.kernel_cache_dir = passing
        wp.init()
        return error
    return None


_refused = _init_quietly()
if _refused is not None:
    warnings.warn(
        f"compiled kernels cannot be kept: {_refused.filename}: {_refused.strerror}; they are "
        "compiled anew each time unless WARP_CACHE_PATH names a folder to write to",
        InputWarning,
        stacklevel=2,
    )
elif multiprocessing.parent_process() is None and not os.listdir(wp.config.kernel_cache_dir):
    print("ms_slam_env compiles its kernels once, which takes a minute or two", file=sys.stderr)


def roomy_zeros(shape: int | tuple[int, ...], dtype: Any, device: str) -> Any:
    """Zeros of a Warp type for which a CPU allocates memory only where it is written.

    For arrays with far more room than they will use. Warp writes all of its zeros: 703 MB in 0.5 s
    for the four million surfels of a home's map, compared with 3 MB in 4 ms here. The memory comes
    directly from the system, because ``np.zeros`` may reuse freed memory and then write zeros.
    """
    if not wp.get_device(device).is_cpu:
        return wp.zeros(shape, dtype=dtype, device=device)
    inner = getattr(dtype, "_shape_", ())
    scalar = np.dtype(wp.dtype_to_numpy(getattr(dtype, "_wp_scalar_type_", dtype)))
    full = (*np.atleast_1d(shape).tolist(), *inner)
    count = math.prod(full)
    private = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    memory = mmap.mmap(-1, max(count * scalar.itemsize, 1), flags=private)
    if hasattr(mmap, "MADV_HUGEPAGE"):
        memory.madvise(mmap.MADV_HUGEPAGE)  # as NumPy does for large arrays
    values = np.frombuffer(memory, scalar, count).reshape(full)
    return wp.array(values, dtype=dtype, device=device, copy=False)


class HostDeviceBuffer:
    """A device array; on a CPU, the host accesses its memory directly.

    On a CPU, ``assign`` and ``numpy`` of a small array take 5 to 15 microseconds per call, mostly
    to inspect the array; here that is done once.

    Attributes:
        array: the device array, initially zeros.
    """

    def __init__(self, shape: int | tuple[int, ...], dtype: Any, device: str) -> None:
        self.array = wp.zeros(shape, dtype=dtype, device=device)
        self._values: NDArray[Any] = self.array.numpy()  # its memory on a CPU, otherwise a copy
        self._is_shared = wp.get_device(device).is_cpu

    def write(self, values: ArrayLike | wp.array) -> None:
        """Set all values, broadcast to the shape of the array.

        Those of a Warp array are copied on the device; it must have the same shape and type.

        Raises:
            ValueError: values that cannot be broadcast to it.
        """
        if isinstance(values, wp.array):
            if (values.shape, values.dtype) != (self.array.shape, self.array.dtype):
                raise ValueError(f"shape {values.shape} in place of {self.array.shape}")
            wp.copy(self.array, values)
            return
        np.copyto(self._values, values)
        if not self._is_shared:
            # With fewer values, `assign` would silently fill only the beginning of the array.
            self.array.assign(self._values)

    def write_row(self, row: int, values: ArrayLike) -> None:
        """Set the values of one row, broadcast to its shape."""
        np.copyto(self._values[row], values)
        if not self._is_shared:
            self.array[row].assign(self._values[row])

    def look_row(self, row: int) -> NDArray[Any]:
        """The values of one row, valid until they change; do not write to them."""
        return self._values[row] if self._is_shared else self.array[row].numpy()

    def zero(self) -> None:
        """Set all values to zero."""
        if self._is_shared:
            self._values.fill(0)
        else:
            self.array.zero_()

    def look(self) -> NDArray[Any]:
        """The values, valid until they change; do not write to them."""
        return self._values if self._is_shared else self.array.numpy()

    def read(self) -> NDArray[Any]:
        """A copy of the values."""
        return self.look().copy()


class StructTable:
    """Structs of one type on a device, replaced one at a time.

    Attributes:
        array: the structs, initially zero.
    """

    def __init__(self, count: int, dtype: Any, device: str) -> None:
        self.array = wp.zeros(count, dtype=dtype, device=device)
        self._kept: list[tuple[Any, ...]] = [()] * count

    def put(self, index: int, struct: Any, *kept: Any) -> None:
        """Replace a struct; its arrays, and what else it refers to (``kept``), stay alive."""
        one: Any = wp.array([struct], dtype=self.array.dtype, device=self.array.device)
        wp.copy(self.array, one, dest_offset=index, count=1)
        self._kept[index] = (struct, *kept)


class RecordedLaunch:
    """A repeatable kernel launch whose arguments are packed once.

    Warp's own recorded launch repacks the arguments each time: 2.9 microseconds for seven arguments
    on one core of an AMD EPYC, compared with 0.15 for the kernel call. Here only structs are
    repacked, because their fields may have changed. On a GPU, Warp's recorded launch is used.
    """

    def __init__(
        self, kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], device: str
    ) -> None:
        """Record the launch without running it."""
        self._command = wp.launch(kernel, dim=dim, inputs=inputs, device=device, record_cmd=True)
        self._inputs = list(inputs)
        self._names = [argument.label for argument in kernel.adj.args]
        self._is_on_cpu = wp.get_device(device).is_cpu
        self._packed: Any = None
        self._structs: dict[str, ctypes.Structure] = {}

    def launch(self) -> None:
        """Launch the kernel."""
        if not self._is_on_cpu:
            self._command.launch()
            return
        if self._packed is None:
            self._pack()
        for name, struct in self._structs.items():
            setattr(self._packed, name, struct)
        self._call(*self._pointers)

    def takes(self, name: str) -> bool:
        """Whether the kernel has an argument called ``name``."""
        return name in self._names

    def set_param(self, name: str, value: Any) -> None:
        """Change an argument for all later launches."""
        index = self._names.index(name)
        if self._inputs[index] is value:
            return
        self._inputs[index] = value  # keeps arrays alive
        self._command.set_param_at_index(index, value)
        if name in self._structs:
            self._structs[name] = self._command.params[1 + index]
        elif self._packed is not None:
            setattr(self._packed, name, self._command.params[1 + index])

    def _pack(self) -> None:
        bounds, *values = self._command.params
        fields = list(zip(self._names, map(type, values), strict=True))
        self._packed = type("Arguments", (ctypes.Structure,), {"_fields_": fields})(*values)
        self._structs = {
            name: value
            for name, value, given in zip(self._names, values, self._inputs, strict=True)
            if isinstance(value, ctypes.Structure) and not isinstance(given, wp.array)
        }
        self._call = self._command.hooks.forward
        self._pointers = ctypes.byref(bounds), ctypes.byref(self._packed)


__all__ = ["HostDeviceBuffer", "RecordedLaunch", "StructTable", "kernel_wp", "roomy_zeros", "wp"]
