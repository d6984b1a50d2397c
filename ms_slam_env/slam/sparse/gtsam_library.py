"""Loads GTSAM, an optional library."""

from __future__ import annotations

from typing import Any

from ms_slam_env.errors import InputError


def load_gtsam() -> Any:
    """GTSAM's module.

    Raises:
        InputError: it is not installed.
    """
    try:
        import gtsam
    except (ImportError, OSError) as error:
        raise InputError(
            f"the sparse backend needs GTSAM (pip install 'ms-slam-env[gtsam]'): {error}"
        ) from error
    return gtsam
