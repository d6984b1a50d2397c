"""Algorithm 1, lines 3 to 8: predict every candidate's view from the map and its divergence."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.divergence import DivergenceConfig, Histograms, make_divergence
from ms_slam_env.env.env_config import LookaheadConfig
from ms_slam_env.slam.slam_backend import Views


class PredictsViews(Protocol):
    """A map that can be rendered: SLAM, or a robot's view of it."""

    def predict(self, poses: Float64, scale: float = 1.0) -> Views:
        """Views from poses (N, 4, 4) at ``scale`` times the camera's size."""

    def project(self, poses: Float64, scale: float = 1.0) -> Views:
        """As ``predict``, each view rendered from the map itself."""


class Lookahead:
    """Predicts the candidates' views, and their divergence from the current view.

    Args:
        config: reference, scale and projection.
        divergence: how divergence is measured.
        intrinsics: intrinsics of the live camera.
    """

    def __init__(
        self, config: LookaheadConfig, divergence: DivergenceConfig, intrinsics: Intrinsics
    ) -> None:
        self.config = config
        self.intrinsics = intrinsics.scaled(config.scale)
        self.measure = make_divergence(divergence, self.intrinsics)

    def predict(self, slam: PredictsViews, poses: Float64) -> Views:
        """Views of the map from ``poses`` (n, 4, 4), line 5."""
        project = slam.project if self.config.projection == "exact" else slam.predict
        return project(poses, self.config.scale)

    def divergences(
        self, slam: PredictsViews, poses: Float64, current_pose: Float64, live: RGBDFrame
    ) -> Float64:
        """Predicted divergences (n, 2) of the candidates at ``poses`` (n, 4, 4), lines 6 and 7."""
        if self.config.reference == "predicted":
            views = self.predict(slam, np.concatenate([poses, current_pose[None]]))
            both = self.measure.histograms(views.intensity, views.depth, views.normals)
            candidates = Histograms(both.intensity[:-1], both.normals[:-1])
            current = Histograms(both.intensity[-1:], both.normals[-1:])
            return self.measure.divergence(candidates, current)
        views = self.predict(slam, poses)
        histograms = self.measure.histograms(views.intensity, views.depth)
        return self.measure.divergence(histograms, self._live_histograms(live))

    def _live_histograms(self, live: RGBDFrame) -> Histograms:
        size = (self.intrinsics.width, self.intrinsics.height)
        intensity = cv2.resize(intensity_image(live.color), size, interpolation=cv2.INTER_AREA)
        depth = cv2.resize(live.depth, size, interpolation=cv2.INTER_NEAREST)
        return self.measure.histograms(intensity[None].astype(np.float32), depth[None])
