"""SLAM backends by name; each is imported only when it is made.

Loading kernels takes a while, and an optional dependency may be missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from ms_slam_env._runtime.extension import ExtensionPoint, check_options
from ms_slam_env.camera import Intrinsics, check_camera
from ms_slam_env.config import from_dict, is_options
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.slam.slam_backend import SlamBackend


@dataclass(frozen=True)
class BackendEntry:
    """Where to import a backend from."""

    module: str  # its module below ``ms_slam_env.slam``
    backend: str  # name of its class, constructed from intrinsics and configuration
    config: str  # name of its parameter dataclass
    has_devices: bool = False  # whether it also takes a device

    def load(self, name: str) -> Any:
        """Import the class ``name`` from its module."""
        return getattr(import_module(f"ms_slam_env.slam.{self.module}"), name)


_OWN = {
    "surfel": BackendEntry("surfel", "SurfelSlam", "SurfelConfig", has_devices=True),
    "odometry": BackendEntry("odometry", "OdometrySlam", "OdometryConfig"),
    "volumetric": BackendEntry("volumetric", "VolumetricSlam", "VolumetricConfig"),
    "kinectfusion": BackendEntry("volumetric", "KinectFusionSlam", "KinectFusionConfig"),
    "sparse": BackendEntry("sparse", "SparseSlam", "SparseConfig"),
}

BACKENDS: tuple[str, ...] = tuple(_OWN)
"""Names of the built-in backends."""

POINT = ExtensionPoint("SLAM backend", "ms_slam_env.slam", SlamBackend, own=_OWN)
"""Finds backends; a user's class is constructed with intrinsics and its options as keywords."""


def make_backend(name: object, intrinsics: Intrinsics, params: Mapping[str, Any]) -> SlamBackend:
    """Make the backend ``name`` for a camera; see ``ms_slam_env.slam.make``.

    Raises:
        InputError: unknown backend, unknown parameter or value out of range.
    """
    check_camera(intrinsics)
    config = check_parameters(name, params)
    entry = POINT.find(name)
    if not isinstance(entry, BackendEntry):
        own: SlamBackend = entry(intrinsics, **params)
        return own
    device = [params.get("device", "cpu")] if entry.has_devices else []
    made: SlamBackend = entry.load(entry.backend)(intrinsics, config, *device)
    return made


def backend_name(cls_name: object) -> str:
    """Name of the built-in backend with this class name.

    Raises:
        InputError: no built-in backend has it.
    """
    names = {entry.backend: name for name, entry in _OWN.items()}
    if not isinstance(cls_name, str) or cls_name not in names:
        raise unknown("SLAM backend", cls_name, names)
    return names[cls_name]


def check_parameters(name: object, params: object) -> Any:
    """Check a backend's options without making it; refuses whatever ``make_backend`` would.

    Returns:
        the parameters as the backend's dataclass; for a user's class, ``params`` as a dictionary.

    Raises:
        InputError: unknown backend, unknown parameter or value out of range.
    """
    entry = POINT.find(name)
    if not is_options(params):
        raise InputError(f"slam_config = {params!r} must be a mapping of options")
    options = dict(params)
    if not isinstance(entry, BackendEntry):
        check_options(f"SLAM backend {name}", entry, options, ("intrinsics",))
        return options
    if entry.has_devices:
        _check_device(options.pop("device", "cpu"))
    return from_dict(entry.load(entry.config), options, "slam_config")


def _check_device(device: object) -> None:
    from ms_slam_env._runtime.warp import wp

    devices = [found.alias for found in wp.get_devices()]
    if device not in (*devices, "cuda") or (device == "cuda" and not wp.is_cuda_available()):
        raise unknown("device", device, devices)
