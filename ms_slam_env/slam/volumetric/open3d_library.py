"""Loads Open3D, an optional library."""

from __future__ import annotations

from typing import Any

from ms_slam_env.errors import InputError


def load_open3d() -> Any:
    """Open3D, its messages below errors silenced.

    Raises:
        InputError: it, or a system library that it needs, is not installed.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            "the volumetric backend needs Open3D (pip install 'ms-slam-env[open3d]') and, on "
            f"Debian and Ubuntu, libgl1, libx11-6 and libgomp1 (apt-get install): {error}"
        ) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
