"""Frames too similar to the last processed one are dropped: section V-A of the paper."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.config import Checked, bounded
from ms_slam_env.divergence import DivergenceConfig, Histograms, make_divergence
from ms_slam_env.slam.frame_selection.config import DroppingConfig
from ms_slam_env.slam.frame_selection.selective_slam import FrameFilter
from ms_slam_env.slam.state import Saved, Stateful


@dataclass(frozen=True)
class ChangeConfig(Checked):
    """How the change between two frames is measured.

    The change is delta_I + depth_weight delta_D, nats, of equations (5) and (10): the sum that the
    paper's Algorithm 1 forms with its lambda.

    Attributes:
        width: pixels are left out so that about so many columns remain; a frame must be cheap to
            judge.
        depth_weight: lambda. On hand-held sequences of validation seeds the sum with 1 followed the
            size of the motion at least as well as either divergence alone.
        divergence: of the two kinds.
    """

    width: int = bounded(80, 8, 10_000)
    depth_weight: float = bounded(1.0, 0, 1e6)
    divergence: DivergenceConfig = field(default_factory=DivergenceConfig)


class Change(Stateful):
    """Measures the change of each frame from a reference frame."""

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
        """Change of ``frame`` from the reference, nats; infinite without one."""
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


@dataclass(frozen=True)
class DivergenceFilterConfig(DroppingConfig):
    """A frame is dropped if its divergence from the last processed frame is below a threshold.

    The paper compares with the previous frame, under which a slow motion would never be seen: each
    frame is like the one before it. Changes add up against the last frame that SLAM has seen.

    Attributes:
        threshold: of the change, nats; 0 drops nothing.
        change: how it is measured.
    """

    name: str = field(default="divergence", init=False)
    threshold: float = bounded(0.01, 0, 1e6)
    change: ChangeConfig = field(default_factory=ChangeConfig)

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter for frames of ``intrinsics``."""
        return DivergenceFilter(self.threshold, Change(self.change, intrinsics))


class DivergenceFilter(Saved, FrameFilter):
    """Admits a frame that differs enough from the last processed one."""

    saved = ("_change",)

    def __init__(self, threshold: float, change: Change) -> None:
        self._threshold = threshold
        self._change = change

    def reset(self) -> None:
        """Forget the last processed frame."""
        self._change.reset()

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether its change reaches the threshold."""
        admitted = self._change.measure(frame) >= self._threshold
        if admitted or forced:
            self._change.keep()
        return admitted
