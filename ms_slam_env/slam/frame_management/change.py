"""How much a frame differs from the last processed one: their divergence, cheaply."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.config import check_range
from ms_slam_env.divergence import DivergenceConfig, Histograms, make_divergence


@dataclass(frozen=True)
class ChangeConfig:
    """How the change between two frames is measured.

    The change is delta_I + depth_weight delta_D, nats, of equations (5) and (10): the sum that the
    paper's Algorithm 1 forms with its lambda.

    Attributes:
        width: pixels are left out so that about so many columns remain; a frame must be cheap to
            judge.
        depth_weight: lambda. On hand-held sequences of validation seeds the sum with 1 followed the
            size of the motion at least as well as either divergence alone.
        divergence: of the two kinds.

    Raises:
        InputError: a value out of range.
    """

    width: int = 80
    depth_weight: float = 1.0
    divergence: DivergenceConfig = field(default_factory=DivergenceConfig)

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "width", 8, 10_000)
        check_range(self, "depth_weight", 0, 1e6)


class Change:
    """Measures the change of each frame from a reference frame.

    Args:
        config: how it is measured.
        intrinsics: of the frames.
    """

    def __init__(self, config: ChangeConfig, intrinsics: Intrinsics) -> None:
        self._intrinsics = intrinsics
        self._stride = max(1, intrinsics.width // config.width)
        self._measure = make_divergence(config.divergence, intrinsics.every_nth(self._stride))
        self._weights = np.array([1.0, config.depth_weight])
        self._reference: Histograms | None = None
        self._current: Histograms | None = None

    def reset(self) -> None:
        """Forget the reference."""
        self._reference = self._current = None

    def measure(self, frame: RGBDFrame) -> float:
        """Change of ``frame`` from the reference, nats; infinite without one.

        Raises:
            InputError: the frame's size is not that of the intrinsics.
        """
        self._intrinsics.check_image(frame.depth, "frame")
        s = self._stride
        grey = intensity_image(np.ascontiguousarray(frame.color[::s, ::s])).astype(np.float32)
        depth = frame.depth[::s, ::s].astype(np.float32)
        self._current = self._measure.histograms(grey[None], depth[None])
        if self._reference is None:
            return np.inf
        return float(self._measure.divergence(self._current, self._reference)[0] @ self._weights)

    def keep(self) -> None:
        """Make the frame that was measured last the reference."""
        self._reference = self._current

    def get_state(self) -> dict[str, Any]:
        """The reference's histograms."""
        kept = self._reference
        if kept is None:
            return {"intensity": None, "normals": None}
        return {"intensity": kept.intensity.copy(), "normals": kept.normals.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with the reference of a state."""
        self._current = None
        if state["intensity"] is None:
            self._reference = None
        else:
            self._reference = Histograms(state["intensity"].copy(), state["normals"].copy())
