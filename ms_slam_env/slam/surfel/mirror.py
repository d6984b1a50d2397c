"""Small device arrays that the host writes or reads every frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._warp import wp


class Mirror:
    """A device array; on a CPU the host works on its memory.

    There ``assign`` and ``numpy`` of a small array cost 5 to 15 microseconds a call, most of it
    for finding out what the array is; here that is done once.

    Attributes:
        array: the device array, zeros at first.
    """

    def __init__(self, shape: int | tuple[int, ...], dtype: Any, device: str) -> None:
        """Allocate an array."""
        self.array = wp.zeros(shape, dtype=dtype, device=device)
        self._memory: NDArray[Any] | None = None
        if wp.get_device(device).is_cpu:
            self._memory = self.array.numpy()

    def write(self, values: ArrayLike) -> None:
        """Set all values."""
        if self._memory is None:
            self.array.assign(values)
        else:
            np.copyto(self._memory, values)

    def read(self) -> NDArray[Any]:
        """A copy of the values."""
        return (self.array.numpy() if self._memory is None else self._memory).copy()
