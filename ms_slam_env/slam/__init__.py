"""SLAM backends, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import from_dict
from ms_slam_env.errors import unknown
from ms_slam_env.slam.base import SlamBackend, TrackResult, Views


def _surfel(intrinsics: Intrinsics, device: str = "cpu", **params: Any) -> SlamBackend:
    # Imported here: loading the kernels takes a while, and a backend's extra may be missing.
    from ms_slam_env._warp import wp
    from ms_slam_env.slam.surfel import SurfelConfig, SurfelSlam

    devices = [found.alias for found in wp.get_devices()]
    if device not in (*devices, "cuda") or (device == "cuda" and not wp.is_cuda_available()):
        raise unknown("device", device, devices)
    return SurfelSlam(intrinsics, from_dict(SurfelConfig, params, "slam_config"), device)


def _odometry(intrinsics: Intrinsics, **params: Any) -> SlamBackend:
    from ms_slam_env.slam.odometry import OdometryConfig, OdometrySlam

    return OdometrySlam(intrinsics, from_dict(OdometryConfig, params, "slam_config"))


def _volumetric(intrinsics: Intrinsics, **params: Any) -> SlamBackend:
    from ms_slam_env.slam.volumetric import VolumetricConfig, VolumetricSlam

    return VolumetricSlam(intrinsics, from_dict(VolumetricConfig, params, "slam_config"))


def _sparse(intrinsics: Intrinsics, **params: Any) -> SlamBackend:
    from ms_slam_env.slam.sparse import SparseConfig, SparseSlam

    return SparseSlam(intrinsics, from_dict(SparseConfig, params, "slam_config"))


BACKENDS: dict[str, Callable[..., SlamBackend]] = {
    "surfel": _surfel,
    "odometry": _odometry,
    "volumetric": _volumetric,
    "sparse": _sparse,
}
"""Name to maker; a maker takes the intrinsics and the backend's parameters."""


def make(name: str, intrinsics: Intrinsics, **params: Any) -> SlamBackend:
    """Make the SLAM backend ``name`` for a camera.

    Args:
        name: one of ``BACKENDS``.
        intrinsics: of every frame.
        params: of the backend, such as the fields of ``SurfelConfig``; ``device`` = "cpu" or
            "cuda" where the backend has a choice.

    Raises:
        InputError: unknown backend, unknown parameter or value out of range.
    """
    if not isinstance(name, str) or name not in BACKENDS:
        raise unknown("SLAM backend", name, BACKENDS)
    return BACKENDS[name](intrinsics, **params)


__all__ = ["BACKENDS", "SlamBackend", "TrackResult", "Views", "make"]
