"""Frames of B envs as sensed, on the host or left on the device that SLAM works on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float32, UInt8
from ms_slam_env._runtime.warp import HostDeviceBuffer
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.errors import InputError

_GPU_THREADS = 1024  # that copy one env's image


@dataclass(frozen=True)
class Images:
    """Colour (B, H, W, 3) uint8 and depth (B, H, W) float32 metres, 0 = no reading.

    NumPy arrays, or Warp's on the device: from there ``of`` fetches only what it is asked for.
    """

    color: Any
    depth: Any
    _fetched: dict[int, tuple[UInt8, Float32]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def on_device(self) -> bool:
        """Whether the images were left on the device."""
        return isinstance(self.depth, wp.array)

    def of(self, env: int) -> tuple[UInt8, Float32]:
        """Colour (H, W, 3) and depth (H, W) of one env on the host; do not write to them.

        Of images on the device a copy, as they are when it is first asked for.
        """
        if not self.on_device:
            return self.color[env], self.depth[env]
        env = int(env)  # Warp takes no NumPy numbers
        if env not in self._fetched:
            self._fetched[env] = self.color[env].numpy().copy(), self.depth[env].numpy().copy()
        return self._fetched[env]

    def on_host(self) -> Images:
        """The same on the host."""
        return Images(self.color.numpy(), self.depth.numpy()) if self.on_device else self


def images_of(color: Any, depth: Any, device: str) -> Images:
    """Images from NumPy arrays, or from arrays of a device, which stay where they are.

    Those are Warp's, or whatever tells of its memory by DLPack or ``__cuda_array_interface__``,
    such as a tensor of PyTorch. Both images must be of one kind.

    Raises:
        InputError: one image on the host and one on the device, or another type of value.
    """
    if isinstance(color, np.ndarray) and isinstance(depth, np.ndarray):
        return Images(color, depth)
    if isinstance(color, np.ndarray) or isinstance(depth, np.ndarray):
        raise InputError("colour and depth must both be NumPy arrays or both lie on a device")
    return Images(_left_there(color, wp.uint8, device), _left_there(depth, wp.float32, device))


def _left_there(image: Any, dtype: Any, device: str) -> wp.array:
    """An image as a contiguous Warp array of ``device``; copied only if it must be."""
    if isinstance(image, wp.array):
        array = image
    elif hasattr(image, "__dlpack__"):
        array = wp.from_dlpack(image)
    elif hasattr(image, "__cuda_array_interface__"):
        array = wp.array(image, device=device, copy=False)
    else:
        raise InputError(
            "images must be NumPy arrays, Warp arrays, or have __dlpack__ or "
            f"__cuda_array_interface__, got {type(image).__name__}"
        )
    if array.dtype != dtype:
        name, wanted = (getattr(one, "__name__", one) for one in (array.dtype, dtype))
        raise InputError(f"an image on the device has values of {name}, not {wanted}")
    return array.to(device).contiguous()


@wp.kernel
def _survey(
    color: wp.array[wp.uint8],
    depth: wp.array[wp.float32],
    height: wp.int32,
    width: wp.int32,
    every: wp.int32,  # row and column of the colours that are summed
    sums: wp.array2d[wp.int64],  # (B, 7) of a colour's values and their squares; bad readings
) -> None:
    """Sum colours and count readings that are none, a row a thread."""
    row = wp.tid()
    b = row / height
    bad = wp.int32(0)
    for u in range(width):
        z = depth[row * width + u]
        if not (z >= 0.0 and z < wp.inf):
            bad += 1
    if bad > 0:
        wp.atomic_add(sums, b, 6, wp.int64(bad))
    if row % height % every == 0:
        for channel in range(3):
            total = wp.int64(0)
            squared = wp.int64(0)
            u = wp.int32(0)
            while u < width:
                value = wp.int64(color[3 * (row * width + u) + channel])
                total += value
                squared += value * value
                u += every
            wp.atomic_add(sums, b, channel, total)
            wp.atomic_add(sums, b, channel + 3, squared)


class Surveyor:
    """Looks on the device at all images of a batch, so that none need come to the host."""

    def __init__(self, every: int) -> None:
        """Look at the colour of every so many-th row and column."""
        self._every = every
        self._sums: HostDeviceBuffer | None = None

    def __call__(self, images: Images) -> tuple[NDArray[np.float64], NDArray[np.float64], Bool]:
        """Mean and standard deviation (B, 3) of the colours; which depth (B,) holds bad values.

        As ``cv2.meanStdDev`` of ``color[:, ::every, ::every]`` finds them, bit for bit. Bad are
        NaN, infinite and negative values.
        """
        batch, height, width = images.depth.shape
        device = images.depth.device
        if self._sums is None or self._sums.array.shape[0] != batch:
            self._sums = HostDeviceBuffer((batch, 7), wp.int64, device)
        self._sums.zero()
        flat = [images.color.flatten(), images.depth.flatten()]
        inputs = [*flat, height, width, self._every, self._sums.array]
        wp.launch(_survey, batch * height, inputs, device=device)
        sums = self._sums.look()
        per_pixel = 1.0 / (-(-height // self._every) * -(-width // self._every))
        mean = sums[:, :3] * per_pixel
        variance = sums[:, 3:6] * per_pixel - mean * mean
        return mean, np.sqrt(np.maximum(variance, 0.0)), sums[:, 6] > 0


@wp.kernel
def _keep(
    kept: wp.array[wp.int32],  # (B,)
    threads: wp.int32,  # that share a row
    source: wp.array2d[Any],  # (B, values)
    target: wp.array2d[Any],
) -> None:
    """Copy the rows that are kept."""
    b, thread = wp.tid()
    i = wp.int32(thread)
    while i < source.shape[1] and kept[b] != 0:
        target[b, i] = source[b, i]
        i += threads


for _dtype in (wp.uint8, wp.float32):
    wp.overload(_keep, {"source": wp.array2d[_dtype], "target": wp.array2d[_dtype]})


class ImageStore:
    """Images of B envs that are replaced env by env, kept where they come from."""

    def __init__(self, batch: int, shape: tuple[int, int]) -> None:
        """Black images without depth, on the host."""
        size = (batch, *shape)
        self.images = Images(np.zeros((*size, 3), dtype=np.uint8), np.zeros(size, dtype=np.float32))

    def replace(self, images: Images, where: Bool) -> None:
        """Copy the images of the envs ``where`` (B,)."""
        if images.on_device:
            self._replace_on_device(images, where)
            return
        self.images = own = self.images.on_host()
        if where.all():
            np.copyto(own.color, images.color)
            np.copyto(own.depth, images.depth)
            return
        for env in np.flatnonzero(where):
            own.color[env], own.depth[env] = images.color[env], images.depth[env]

    def _replace_on_device(self, images: Images, where: Bool) -> None:
        device, batch = images.depth.device, len(where)
        if not self.images.on_device:
            color = wp.array(self.images.color, dtype=wp.uint8, device=device)
            depth = wp.array(self.images.depth, dtype=wp.float32, device=device)
            self.images = Images(color, depth)
        else:
            self.images = Images(self.images.color, self.images.depth)  # nothing fetched yet
        kept = wp.array(where.astype(np.int32), dtype=wp.int32, device=device)
        for own, new in zip(
            (self.images.color, self.images.depth), (images.color, images.depth), strict=True
        ):
            source, target = new.reshape((batch, -1)), own.reshape((batch, -1))
            threads = 1 if device.is_cpu else _GPU_THREADS
            wp.launch(_keep, (batch, threads), [kept, threads, source, target], device=device)
