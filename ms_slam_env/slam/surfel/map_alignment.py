"""Frames of B cameras aligned with the views of their maps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.warp import wp
from ms_slam_env.slam.shared.alignment_check import TrackingStatus
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel.acceptance import (
    Alignment,
    acceptance_thresholds,
    geometric_thresholds,
)
from ms_slam_env.slam.surfel.camera_states import CameraStates
from ms_slam_env.slam.surfel.device import HostDeviceBuffer
from ms_slam_env.slam.surfel.free_space_mask import MotionMask
from ms_slam_env.slam.surfel.photometry import geometry_only
from ms_slam_env.slam.surfel.pipeline import Pipeline
from ms_slam_env.slam.surfel.pose_hypotheses import (
    NUM_FIRST,
    NUM_HYPOTHESES,
    relocalization_hypotheses,
    tracking_hypotheses,
)
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.surfel_map import SurfelMap


class MapAligner:
    """Aligns the frames of B envs with their maps, and keeps the view of the map that it used."""

    def __init__(
        self, states: CameraStates, surfel_map: SurfelMap, motion_mask: MotionMask
    ) -> None:
        self._states = states
        self._map = surfel_map
        self._motion_mask = motion_mask
        self._device_poses = HostDeviceBuffer(surfel_map.batch, wp.mat44, surfel_map.device)
        self._strict = np.ones(surfel_map.batch, dtype=bool)
        self._view: ModelView
        self._view_poses: Float64 | None = None  # of ``_view``; None: the maps have changed since

    def use(self, pipeline: Pipeline) -> None:
        """Look at frames in this way from now on."""
        self._tracker = pipeline.tracker
        self._config = pipeline.config
        self.forget_view()

    def forget_view(self) -> None:
        """Render anew next time: the maps have changed, or what of them takes part."""
        self._view_poses = None

    def render(self, poses: Float64) -> ModelView:
        """Render the maps from ``poses`` (B, 4, 4), unless that view is at hand."""
        if self._view_poses is None or not np.array_equal(self._view_poses, poses):
            self._device_poses.write(poses)
            self._view = self._map.render_model(self._device_poses.array)
            self._view_poses = poses.copy()
        return self._view

    def set_frame(self, live: LiveFrame) -> None:
        """Take the frames that ``align_from`` aligns next."""
        self._tracker.set_frame(live)

    def align_from(
        self, origins: Float64, hypotheses: Float64, thresholds: NDArray[Any]
    ) -> Alignment:
        """Align the current frames with the maps as seen from ``origins`` (B, 4, 4)."""
        return self._align(origins, hypotheses, thresholds, self._states.photometry)

    def align_strictly(self, origins: Float64, hypotheses: Float64) -> Alignment:
        """The same under strict thresholds, of alignments that a wide search leads to."""
        config, lost = self._config.acceptance, self._states.lost
        return self.align_from(
            origins, hypotheses, acceptance_thresholds(config, self._strict, lost)
        )

    def track(self, invalid: NDArray[np.bool_], guesses: Float64 | None) -> Alignment:
        """Align with the views from the last poses; a lost env searches wider at every frame."""
        states = self._states
        lost = states.lost > 0
        hypotheses = np.stack(
            [
                relocalization_hypotheses(int(frames_lost) - 1)
                if frames_lost
                else tracking_hypotheses(motion)
                for motion, frames_lost in zip(states.motions, states.lost, strict=True)
            ]
        )
        thresholds = acceptance_thresholds(self._config.acceptance, lost, states.lost)
        alignment = self._align(states.poses, hypotheses, thresholds, states.photometry, guesses)
        alignment = alignment.with_status(invalid, TrackingStatus.BLANK)
        return self._without_color(hypotheses, alignment)

    def refine(self, starts: Float64) -> Alignment:
        """Align with the views from the last poses at the finest level alone.

        ``starts`` (B, 4, 4) are T_model_live.
        """
        states = self._states
        thresholds = acceptance_thresholds(self._config.acceptance, states.lost > 0, states.lost)
        view = self._view_from(states.poses)
        return self._tracker.refine(view, states.poses, starts, thresholds, states.photometry)

    def _without_color(self, hypotheses: Float64, alignment: Alignment) -> Alignment:
        """Align the envs whose grey values do not fit by geometry alone, from the nearest poses.

        Lights are switched, cameras glare, and a recording's colour may not be registered with its
        depth. Geometry must then constrain the pose without help, near to where it is expected.
        """
        states = self._states
        failed = states.started & (alignment.status == TrackingStatus.PHOTOMETRIC_MISMATCH)
        if not failed.any():
            return alignment
        near = np.repeat(hypotheses[:, :1], NUM_HYPOTHESES, axis=1)
        near[:, :NUM_FIRST] = hypotheses[:, :NUM_FIRST]
        thresholds = geometric_thresholds(self._config.acceptance, states.lost)
        again = self._align(states.poses, near, thresholds, geometry_only(states.photometry))
        return alignment.replace(failed & again.tracked, again)

    def realign(self, live: LiveFrame, alignment: Alignment, where: NDArray[np.bool_]) -> Alignment:
        """Align the envs ``where`` (B,) again from where they were found, with other images."""
        self._tracker.set_frame(live)
        states = self._states
        starts = np.where(where[:, None, None], alignment.T_model_live, np.eye(4))
        hypotheses = np.repeat(starts[:, None], NUM_HYPOTHESES, axis=1)
        thresholds = acceptance_thresholds(self._config.acceptance, states.lost > 0, states.lost)
        again = self.align_from(states.poses, hypotheses, thresholds)
        return alignment.replace(where & again.tracked, again)

    def _align(
        self,
        origins: Float64,
        hypotheses: Float64,
        thresholds: NDArray[Any],
        photometry: NDArray[Any],
        guesses: Float64 | None = None,
    ) -> Alignment:
        view = self._view_from(origins)
        return self._tracker.align(view, origins, hypotheses, thresholds, guesses, photometry)

    def _view_from(self, origins: Float64) -> ModelView:
        """The maps from ``origins`` (B, 4, 4), but what moves."""
        view = self.render(origins)
        if self._motion_mask.hide(view, origins):
            self.forget_view()  # it is whole no more
        return view
