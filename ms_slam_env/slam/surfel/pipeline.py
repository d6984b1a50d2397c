"""The parts of a surfel SLAM that depend on its configuration and frame size, but not on the map.

A running SLAM may switch to another pipeline and keep its surfels, poses and keyframes.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.slam.surfel.photometry import ExposureCorrection
from ms_slam_env.slam.surfel.pose_hypotheses import NUM_HYPOTHESES
from ms_slam_env.slam.surfel.preprocessing import Preprocessor
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import MapKernels, SurfelMap
from ms_slam_env.slam.surfel.tracker import Tracker, model_stride

FIXED = (
    *("max_surfels", "acceptance", "relocalisation", "loop_closure", "loops", "submaps"),
    *("motion_mask", "readout_s", "color_registration"),
)
"""Fields of ``SurfelConfig`` that a running SLAM cannot change: stored data or existing parts
depend on them."""
_KEPT = 8  # pipelines kept; each has its own image buffers


@dataclass(frozen=True)
class Pipeline:
    """Buffers and launches for frames of one size under one configuration."""

    intrinsics: Intrinsics  # of the frames
    config: SurfelConfig  # in force
    preprocess: Preprocessor  # of the frames
    tracker: Tracker  # of the frames against the map's views
    correct_exposure: ExposureCorrection  # of the frames before they are fused
    map_kernels: MapKernels  # over the map


class PipelineCache:
    """Pipelines of one map, made at the first request and kept for the next."""

    def __init__(self, surfel_map: SurfelMap) -> None:
        self._map = surfel_map
        self._made: OrderedDict[tuple[Intrinsics, SurfelConfig], Pipeline] = OrderedDict()

    def get(self, intrinsics: Intrinsics, config: SurfelConfig) -> Pipeline:
        """The pipeline for frames of ``intrinsics`` under ``config``."""
        key = (intrinsics, config)
        if key not in self._made:
            self._made[key] = self._make(intrinsics, config)
        self._made.move_to_end(key)
        if len(self._made) > _KEPT:
            self._made.popitem(last=False)
        return self._made[key]

    def _make(self, intrinsics: Intrinsics, config: SurfelConfig) -> Pipeline:
        batch, device = self._map.batch, self._map.device
        stride = model_stride(intrinsics, config)
        is_first = not self._made  # the map was made with these kernels
        return Pipeline(
            intrinsics=intrinsics,
            config=config,
            preprocess=Preprocessor(batch, intrinsics, config, device),
            tracker=Tracker(batch, NUM_HYPOTHESES, intrinsics, config, device, stride),
            correct_exposure=ExposureCorrection(batch, intrinsics, device),
            map_kernels=self._map.kernels
            if is_first
            else self._map.make_kernels(intrinsics, config, stride),
        )


def check_change(before: SurfelConfig, after: SurfelConfig, is_resized: bool) -> None:
    """Refuse a change that a running SLAM cannot make.

    Raises:
        InputError: a field of ``FIXED`` changes, or the image size with loop closure; names it.
    """
    for name in FIXED:
        old, new = getattr(before, name), getattr(after, name)
        if old != new:
            raise InputError(
                f"SurfelConfig.{name} = {new!r} differs from the running SLAM's {old!r}: these "
                f"stay as they are: {', '.join(FIXED)}"
            )
    if is_resized and before.loop_closure != "none":
        raise InputError(
            f"a running SLAM with loop_closure = {before.loop_closure!r} keeps its image size"
        )
