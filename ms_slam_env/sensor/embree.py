"""Intel Embree's C interface, from the library shipped with embreex.

embreex itself casts one ray at a time. Packets of eight rays, which traverse the hierarchy
together, need the functions below. Names and constants are those of embree4/rtcore.h.

Embree divides by approximate reciprocals, whose last bits differ among processors, and in SLAM that
grows to millimetres. So Embree only finds the face that a ray hits; the position on it is computed
here.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.native import native_source
from ms_slam_env.sensor.native import VECTOR_FLAGS
from ms_slam_env.sensor.rays import Hits, Pinhole, pose_of_row

PACKET_FUNCTION = "rtcIntersect8"
DEVICE = b"threads=1,max_isa=avx2"
"""Embree's device options: the same kernels on every processor with AVX2, so that a ray at an edge
hits the same face (AVX-512 kernels cast packets of eight 6 % faster)."""
_VERSION_MAJOR = 4
_RTC_DEVICE_PROPERTY_VERSION_MAJOR = 1
_RTC_GEOMETRY_TYPE_TRIANGLE = 0
_RTC_BUFFER_TYPE_INDEX = 0
_RTC_BUFFER_TYPE_VERTEX = 1
_RTC_FORMAT_UINT3 = 0x5003
_RTC_FORMAT_FLOAT3 = 0x9003
_RTC_SCENE_FLAG_ROBUST = 1 << 2  # as in embreex: no ray passes between two adjacent triangles
_P, _I, _U, _N = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint, ctypes.c_size_t
_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "rtcNewDevice": (_P, [ctypes.c_char_p]),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, [_P, _I]),
    "rtcReleaseDevice": (None, [_P]),
    "rtcNewScene": (_P, [_P]),
    "rtcSetSceneFlags": (None, [_P, _I]),
    "rtcCommitScene": (None, [_P]),
    "rtcReleaseScene": (None, [_P]),
    "rtcNewGeometry": (_P, [_P, _I]),
    "rtcSetNewGeometryBuffer": (_P, [_P, _I, _U, _I, _N, _N]),
    "rtcCommitGeometry": (None, [_P]),
    "rtcAttachGeometry": (_U, [_P, _P]),
    "rtcReleaseGeometry": (None, [_P]),
}


@lru_cache(maxsize=1)
def embree_library() -> ctypes.CDLL | None:
    """Load Embree 4 with its function types declared; None if there is none, as on Linux on ARM.

    It opens the extension module instead of the library. On Linux and macOS the loader also
    searches a library's dependencies, and so finds Embree wherever the wheel installed it.
    """
    try:
        from embreex import rtcore_scene
    except ImportError:
        return None
    library = ctypes.CDLL(rtcore_scene.__file__)
    try:
        getattr(library, PACKET_FUNCTION)
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except AttributeError:
        return None
    device = library.rtcNewDevice(DEVICE)
    version = library.rtcGetDeviceProperty(device, _RTC_DEVICE_PROPERTY_VERSION_MAJOR)
    library.rtcReleaseDevice(device)
    return library if version == _VERSION_MAJOR else None


class PacketScene:
    """An Embree scene of triangles, built on one thread.

    Attributes:
        scene: address of the RTCScene.
        intersect: address of the function that casts eight rays.
        vertices: corners (V,) of the triangles, vec3.
        faces: their indices (F,), vec3i.
    """

    def __init__(
        self, library: ctypes.CDLL, vertices: NDArray[np.float32], faces: NDArray[np.int32]
    ) -> None:
        """Copy vertices (V, 3) and faces (F, 3) and build the hierarchy."""
        self._library = library
        self.vertices = wp.array(vertices, dtype=wp.vec3, device="cpu")
        self.faces = wp.array(faces, dtype=wp.vec3i, device="cpu")
        self._device = library.rtcNewDevice(DEVICE)
        self.scene: int = library.rtcNewScene(self._device)
        library.rtcSetSceneFlags(self.scene, _RTC_SCENE_FLAG_ROBUST)
        geometry = library.rtcNewGeometry(self._device, _RTC_GEOMETRY_TYPE_TRIANGLE)
        for kind, form, rows in (
            (_RTC_BUFFER_TYPE_VERTEX, _RTC_FORMAT_FLOAT3, vertices.astype(np.float32)),
            (_RTC_BUFFER_TYPE_INDEX, _RTC_FORMAT_UINT3, faces.astype(np.uint32)),
        ):
            values = np.ascontiguousarray(rows)
            room = library.rtcSetNewGeometryBuffer(geometry, kind, 0, form, 12, len(values))
            ctypes.memmove(room, values.ctypes.data, values.nbytes)
        library.rtcCommitGeometry(geometry)
        library.rtcAttachGeometry(self.scene, geometry)
        library.rtcReleaseGeometry(geometry)
        library.rtcCommitScene(self.scene)
        function = ctypes.cast(getattr(library, PACKET_FUNCTION), ctypes.c_void_p)
        self.intersect: int = function.value or 0

    def __del__(self) -> None:
        """Release the scene."""
        self._library.rtcReleaseScene(self.scene)
        self._library.rtcReleaseDevice(self._device)


wp.set_module_options(VECTOR_FLAGS)

TILE_WIDTH = 4
TILE_HEIGHT = 2


@wp.func_native(native_source("packet_casting", "cast_tile"))
def cast_tile(
    intersect: wp.uint64,
    scene: wp.uint64,
    vertices: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    T: wp.mat44,
    camera: Pinhole,
    image: int,
    tile_y: int,
    tile_x: int,
    hits: Hits,
) -> None:
    """Cast the eight rays of a tile."""


@wp.kernel
def cast_tiles(
    intersect: wp.uint64,  # address of rtcIntersect8
    scene: wp.uint64,  # address of the RTCScene
    vertices: wp.array[wp.vec3],  # (V,)
    faces: wp.array[wp.vec3i],  # (F,)
    T_world_camera: wp.array[wp.mat44],  # (B * poses an image,)
    camera: Pinhole,
    hits: Hits,  # of B * H * W rays
) -> None:
    """Find the first hit of each pixel's ray; face -1 if there is none; one thread per tile."""
    b, y, x = wp.tid()
    T = T_world_camera[pose_of_row(camera, b, 2 * y)]  # the rows of a tile share their pose
    cast_tile(intersect, scene, vertices, faces, T, camera, b, y, x, hits)
