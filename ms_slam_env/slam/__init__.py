"""SLAM backends, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import from_dict
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.slam.base import SlamBackend, TrackResult, Views
from ms_slam_env.slam.configuration import (
    SlamConfiguration,
    is_file_name,
    merged,
    read_configuration,
    write_configuration,
)

# Backends are imported where they are made: loading kernels takes a while, and an extra may be
# missing.


def _surfel_config(device: str = "cpu", **params: Any) -> Any:
    from ms_slam_env._warp import wp
    from ms_slam_env.slam.surfel import SurfelConfig

    devices = [found.alias for found in wp.get_devices()]
    if device not in (*devices, "cuda") or (device == "cuda" and not wp.is_cuda_available()):
        raise unknown("device", device, devices)
    return from_dict(SurfelConfig, params, "slam_config")


def _surfel(intrinsics: Intrinsics, device: str = "cpu", **params: Any) -> SlamBackend:
    from ms_slam_env.slam.surfel import SurfelSlam

    return SurfelSlam(intrinsics, _surfel_config(device, **params), device)


def _odometry_config(**params: Any) -> Any:
    from ms_slam_env.slam.odometry import OdometryConfig

    return from_dict(OdometryConfig, params, "slam_config")


def _odometry(intrinsics: Intrinsics, **params: Any) -> SlamBackend:
    from ms_slam_env.slam.odometry import OdometrySlam

    return OdometrySlam(intrinsics, _odometry_config(**params))


def _volumetric_config(**params: Any) -> Any:
    from ms_slam_env.slam.volumetric import VolumetricConfig

    return from_dict(VolumetricConfig, params, "slam_config")


def _volumetric(intrinsics: Intrinsics, **params: Any) -> SlamBackend:
    from ms_slam_env.slam.volumetric import VolumetricSlam

    return VolumetricSlam(intrinsics, _volumetric_config(**params))


def _sparse_config(**params: Any) -> Any:
    from ms_slam_env.slam.sparse import SparseConfig

    return from_dict(SparseConfig, params, "slam_config")


def _sparse(intrinsics: Intrinsics, **params: Any) -> SlamBackend:
    from ms_slam_env.slam.sparse import SparseSlam

    return SparseSlam(intrinsics, _sparse_config(**params))


BACKENDS: dict[str, Callable[..., SlamBackend]] = {
    "surfel": _surfel,
    "odometry": _odometry,
    "volumetric": _volumetric,
    "sparse": _sparse,
}
"""Name to maker; a maker takes the intrinsics and the backend's parameters."""

_CONFIGS: dict[str, Callable[..., Any]] = {
    "surfel": _surfel_config,
    "odometry": _odometry_config,
    "volumetric": _volumetric_config,
    "sparse": _sparse_config,
}


def make(name: str | Path, intrinsics: Intrinsics, **params: Any) -> SlamBackend:
    """Make the SLAM backend ``name`` for a camera.

    Args:
        name: one of ``BACKENDS``, or a configuration file (YAML) that names one with parameters;
            the frames' size is that of ``intrinsics`` all the same.
        intrinsics: of every frame.
        params: of the backend, such as the fields of ``SurfelConfig``; ``device`` = "cpu" or
            "cuda" where the backend has a choice. They take precedence over those of a file.

    Raises:
        InputError: unknown backend, unknown parameter or value out of range, or a bad file.
    """
    if is_file_name(name):
        configuration = read_configuration(name)
        name, params = configuration.slam, merged(configuration.slam_config, params)
    if not isinstance(name, str) or name not in BACKENDS:
        raise unknown("SLAM backend", name, BACKENDS)
    return BACKENDS[name](intrinsics, **params)


def check_parameters(name: object, params: object) -> Any:
    """Refuse what ``make`` would refuse, without making a backend.

    Returns:
        the backend's parameters as its dataclass.

    Raises:
        InputError: unknown backend, unknown parameter or value out of range.
    """
    if not isinstance(name, str) or name not in BACKENDS:
        raise unknown("SLAM backend", name, BACKENDS)
    if not isinstance(params, Mapping) or not all(isinstance(key, str) for key in params):
        raise InputError(f"slam_config = {params!r} must be a mapping of options")
    return _CONFIGS[name](**params)


__all__ = [
    "BACKENDS",
    "SlamBackend",
    "SlamConfiguration",
    "TrackResult",
    "Views",
    "check_parameters",
    "is_file_name",
    "make",
    "read_configuration",
    "write_configuration",
]
