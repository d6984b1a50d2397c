"""NVIDIA Warp, initialised once: quiet, forward kernels only; launches and arrays used again."""

import atexit
import ctypes
import errno
import math
import mmap
import os
import shutil
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
    """Warp where kernels are written: its 32-bit numbers are no types of Python's."""
else:
    kernel_wp = wp

wp.config.log_level = wp.LOG_ERROR
wp.config.enable_backward = False


def _init_quietly() -> OSError | None:
    """Initialise; without a GPU the native library warns on file descriptor 2, at every start."""
    saved = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            return _init()
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def _check_home() -> None:
    """Refuse a user without a home folder: Warp would make one that is called ``~``.

    Raises:
        FileNotFoundError: saying so.
    """
    told = os.environ.get("WARP_CACHE_PATH") or os.environ.get("XDG_CACHE_HOME")
    if not told and os.path.expanduser("~") == "~":
        raise FileNotFoundError(errno.ENOENT, "this user has no home folder", "~")


def _init() -> OSError | None:
    """Initialise; where no kernels can be kept they go into a passing folder. Return why not."""
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


def roomy_zeros(shape: int | tuple[int, ...], dtype: Any, device: str) -> Any:
    """Zeros of a Warp type, of which a CPU gives memory to what is written alone.

    For arrays that have room for far more than they will hold. Warp writes all of its zeros: for
    the four million surfels of a home's map 703 MB in 0.5 s, here 3 MB in 4 ms. The memory is
    asked of the system: ``np.zeros`` may take it from what the process freed, and then writes it.
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
        memory.madvise(mmap.MADV_HUGEPAGE)  # as NumPy does for what is large
    values = np.frombuffer(memory, scalar, count).reshape(full)
    return wp.array(values, dtype=dtype, device=device, copy=False)


class HostDeviceBuffer:
    """A device array; on a CPU the host works on its memory.

    There ``assign`` and ``numpy`` of a small array cost 5 to 15 microseconds a call, most of it
    for finding out what the array is; here that is done once.

    Attributes:
        array: the device array, zeros at first.
    """

    def __init__(self, shape: int | tuple[int, ...], dtype: Any, device: str) -> None:
        self.array = wp.zeros(shape, dtype=dtype, device=device)
        self._values: NDArray[Any] = self.array.numpy()  # on a CPU its memory, else a copy
        self._is_shared = wp.get_device(device).is_cpu

    def write(self, values: ArrayLike) -> None:
        """Set all values; on every device they are broadcast to the shape of the array.

        Raises:
            ValueError: values that cannot be broadcast to it.
        """
        np.copyto(self._values, values)
        if not self._is_shared:
            # Given fewer values, `assign` would fill the beginning of the array, and say nothing.
            self.array.assign(self._values)

    def zero(self) -> None:
        """Set all values to zero."""
        if self._is_shared:
            self._values.fill(0)
        else:
            self.array.zero_()

    def look(self) -> NDArray[Any]:
        """The values until they change; not to be written to."""
        return self._values if self._is_shared else self.array.numpy()

    def read(self) -> NDArray[Any]:
        """A copy of the values."""
        return self.look().copy()


class RecordedLaunch:
    """A launch to be repeated, whose arguments are packed once.

    Warp's own recorded launch writes them into a structure anew each time: 2.9 microseconds on one
    core of an AMD EPYC for seven arguments, where the call of the kernel takes 0.15. Only structs
    are written anew here too, because their fields may have been set since. On a GPU it is Warp's.
    """

    def __init__(
        self, kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], device: str
    ) -> None:
        """Record; nothing is launched yet."""
        self._command = wp.launch(kernel, dim=dim, inputs=inputs, device=device, record_cmd=True)
        self._inputs = list(inputs)
        self._names = [argument.label for argument in kernel.adj.args]
        self._is_on_cpu = wp.get_device(device).is_cpu
        self._packed: Any = None
        self._structs: dict[str, ctypes.Structure] = {}

    def launch(self) -> None:
        """Launch."""
        if not self._is_on_cpu:
            self._command.launch()
            return
        if self._packed is None:
            self._pack()
        for name, struct in self._structs.items():
            setattr(self._packed, name, struct)
        self._call(*self._pointers)

    def takes(self, name: str) -> bool:
        """Whether the kernel has an argument of that name."""
        return name in self._names

    def set_param(self, name: str, value: Any) -> None:
        """Launch with another argument from now on."""
        index = self._names.index(name)
        if self._inputs[index] is value:
            return
        self._inputs[index] = value  # which keeps arrays alive
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


__all__ = ["HostDeviceBuffer", "RecordedLaunch", "kernel_wp", "roomy_zeros", "wp"]
