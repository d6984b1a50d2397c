"""What of a surfel SLAM depends on its configuration and the size of its frames, but not the map.

A running SLAM may change to another pipeline: it goes on with the same surfels, poses and
keyframes.
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
"""Fields of ``SurfelConfig`` that a running SLAM keeps: they shape what it has stored, or what its
parts were made with."""
_KEPT = 8  # pipelines: each has the buffers of its images


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
    """Pipelines of one map, made when they are first asked for and kept for the next time."""

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
    """Refuse a change of what a running SLAM must keep.

    Raises:
        InputError: naming it.
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
