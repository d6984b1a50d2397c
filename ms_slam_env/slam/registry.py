"""SLAM backends by name; each is imported only when it is made.

Loading kernels takes a while, and an optional dependency may be missing.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from ms_slam_env._runtime.extension import ExtensionPoint, check_call, check_options
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

_PEERS = {
    "open3d": BackendEntry("volumetric", "Open3DSlam", "Open3DConfig"),
    "small_gicp": BackendEntry("odometry.cloud_odometry", "SmallGicpSlam", "SmallGicpConfig"),
    "kiss_icp": BackendEntry("odometry.cloud_odometry", "KissIcpSlam", "KissIcpConfig"),
}

BACKENDS: tuple[str, ...] = tuple(_OWN)
"""Names of the built-in backends that can do all that ``SlamBackend`` describes."""

PEERS: tuple[str, ...] = tuple(_PEERS)
"""Names of other libraries' systems, to compare with; their runs may not repeat bit-exactly."""

POINT = ExtensionPoint(
    "SLAM backend",
    "ms_slam_env.slam",
    SlamBackend,
    own=_OWN | _PEERS,
    elsewhere={
        "([^=,:]+=)?command:": "an external program is run by ms-slam compare alone, as in "
        "ms-slam compare --backends 'NAME=command:PROGRAM --in {sequence} --out {trajectory}'"
    },
)
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
        own.options = dict(params)
        return own
    device = [params.get("device", "cpu")] if entry.has_devices else []
    made: SlamBackend = entry.load(entry.backend)(intrinsics, config, *device)
    return made


def backend_name(cls_name: object, module: object = None) -> str | None:
    """Name of the built-in backend with this class name and ``module``; None if there is none."""
    names = {entry.backend: name for name, entry in _OWN.items()}
    is_ours = module is None or str(module).startswith("ms_slam_env.")
    return names.get(cls_name) if is_ours and isinstance(cls_name, str) else None


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
        check_call(f"SLAM backend {name}", entry, ("intrinsics",), options)
        return options
    if entry.has_devices:
        _check_device(options.pop("device", "cpu"))
    return from_dict(entry.load(entry.config), options, "slam_config")


def given_or_default(name: object, params: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a user's backend class: ``params``, and what its constructor has by default."""
    options = inspect.signature(POINT.find(name)).parameters.values()
    return {p.name: p.default for p in options if p.default is not p.empty} | dict(params)


def _check_device(device: object) -> None:
    from ms_slam_env._runtime.warp import wp

    devices = [found.alias for found in wp.get_devices()]
    if device not in (*devices, "cuda") or (device == "cuda" and not wp.is_cuda_available()):
        raise unknown("device", device, devices)
