"""The kinds of results that a report knows, one file each; the first that fits is taken."""

from __future__ import annotations

from typing import Any

from ms_slam_env.benchmark.report.kinds.base import Kind
from ms_slam_env.benchmark.report.kinds.generic import Generic

KINDS: tuple[Kind, ...] = (Generic(),)


def kind_of(content: dict[str, Any]) -> Kind:
    """The kind of JSON ``content``."""
    return next(kind for kind in KINDS if kind.fits(content))
