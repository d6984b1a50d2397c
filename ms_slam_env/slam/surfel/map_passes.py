"""The passes over a surfel map that depend on the camera and the configuration.

One map may have several: a running SLAM that changes its parameters or the size of its images
works on the same surfels with other passes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.blocks import Blocks, bound_blocks, set_bounded
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.discs import Discs
from ms_slam_env.slam.surfel.fusion import add_surfels, radial_weights
from ms_slam_env.slam.surfel.fusion_update import FusionParameters, update_surfels
from ms_slam_env.slam.surfel.removal import Removal, expire, gather, list_survivors, put_back
from ms_slam_env.slam.surfel.splat_renderer import (
    Culler,
    SplatParameters,
    SplatRenderer,
    splat_camera,
)
from ms_slam_env.slam.surfel.surfel_arrays import SeenWindow, Surfels, VisibleList
from ms_slam_env.slam.surfel.types import LiveFrame, ModelView

_CHANGING = ("poses", "mask", "time", "weight", "live_depth", "live_normals", "live_color")


@dataclass(frozen=True)
class MapArrays:
    """Device arrays of B maps, shared by all passes.

    Attributes:
        batch: number of maps B.
        capacity: slots of each.
        workers: threads that share one map.
        device: of all arrays.
        surfels: the maps.
        spare: room for compaction.
        blocks: of the surfels.
        visible: working list.
        discs: working memory of the list.
        survivors: (B, capacity) working list of compaction.
        kept: (B,) surfels that a compaction keeps.
        expired: (B,) surfels that a removal takes.
        active: what ``fuse`` and ``render_model`` work on.
    """

    batch: int
    capacity: int
    workers: int
    device: str
    surfels: Surfels
    spare: Surfels
    blocks: Blocks
    visible: VisibleList
    discs: Discs
    survivors: wp.array
    kept: wp.array
    expired: wp.array
    active: SeenWindow


class MapPasses:
    """Recorded launches for frames of one size under one configuration."""

    def __init__(
        self, arrays: MapArrays, intrinsics: Intrinsics, config: SurfelConfig, model_stride: int
    ) -> None:
        """Prepare for frames of ``intrinsics``; see ``SurfelMap``."""
        self.config = config
        self._arrays = arrays
        self._intrinsics = intrinsics
        self._covered = wp.zeros(
            arrays.batch * intrinsics.width * intrinsics.height,
            dtype=wp.int32,
            device=arrays.device,
        )
        self._fusion = FusionParameters()
        self._fusion.distance_m = config.fusion_distance_m
        self._fusion.min_cosine = math.cos(math.radians(config.fusion_angle_deg))
        self._fusion.coverage_px = config.coverage_px
        self._fusion.radius_px = config.surfel_radius_px
        self._fusion.max_confidence = config.max_confidence
        self.splat_parameters = SplatParameters(tolerance_m=config.fusion_distance_m)
        self._camera = splat_camera(intrinsics, self.splat_parameters)
        self._cull = Culler(
            arrays.surfels,
            arrays.blocks,
            arrays.visible,
            arrays.batch,
            self._camera,
            arrays.workers,
            arrays.device,
            arrays.active,
        )
        self._model_renderer = self.model_renderer(model_stride, arrays.active)
        self._arguments: tuple[Any, ...] = (None,) * 5
        self._record_launches()

    def model_renderer(self, stride: int, window: SeenWindow) -> SplatRenderer:
        """Renders every ``stride``-th row and column of what was last seen within ``window``."""
        arrays, parameters = self._arrays, self.splat_parameters
        return SplatRenderer(
            arrays.surfels,
            arrays.blocks,
            arrays.visible,
            arrays.discs,
            arrays.batch,
            self._intrinsics.every_nth(stride),
            replace(
                parameters, min_px=parameters.min_px / stride, max_px=parameters.max_px / stride
            ),
            arrays.workers,
            arrays.device,
            window,
        )

    def render_model(self, poses: wp.array) -> ModelView:
        """Render every env's map from its pose; see ``SurfelMap.render_model``."""
        self._model_renderer.cull(poses)
        return self._model_renderer.splat()

    def fuse(
        self, live: LiveFrame, poses: wp.array, time: wp.array, weight: wp.array, mask: wp.array
    ) -> None:
        """Fuse one frame per env; see ``SurfelMap.fuse``."""
        self._cull(poses)
        self._covered.zero_()
        self._arrays.kept.zero_()
        self._arrays.expired.zero_()
        self._bind(live, poses, time, weight, mask)
        self._update.launch()
        self._add.launch()
        for launch in (*self._removal, *self._bound):
            launch.launch()

    def bound_blocks(self) -> None:
        """Look at the surfels of all blocks that are not bounded."""
        for launch in self._bound:
            launch.launch()

    def _bind(
        self, live: LiveFrame, poses: wp.array, time: wp.array, weight: wp.array, mask: wp.array
    ) -> None:
        """Make these the arguments of the recorded launches, if they are not already."""
        arguments = (live, poses, time, weight, mask)
        if all(new is old for new, old in zip(arguments, self._arguments, strict=True)):
            return
        self._arguments = arguments
        images = (live.depth.flatten(), live.normals.flatten(), live.color.flatten())
        for command in (self._update, self._add):
            for name, value in zip(_CHANGING, (poses, mask, time, weight, *images), strict=True):
                command.set_param_by_name(name, value)
        for command in self._removal[:2]:
            command.set_param_by_name("mask", mask)
            command.set_param_by_name("time", time)

    def _record_launches(self) -> None:
        """Record the launches of ``fuse``; what changes with the frame is set there."""
        config, arrays = self.config, self._arrays
        batch, workers, capacity = arrays.batch, arrays.workers, arrays.capacity
        device = arrays.device
        dim = (batch, workers)
        poses = wp.zeros(batch, dtype=wp.mat44, device=device)
        integers = wp.zeros(batch, dtype=wp.int32, device=device)
        floats = wp.zeros(batch, dtype=wp.float32, device=device)
        pixels = math.prod((batch, *self._intrinsics.shape))
        depth = wp.zeros(pixels, dtype=wp.float32, device=device)
        image = wp.zeros(pixels, dtype=wp.vec3, device=device)
        radial = radial_weights(*self._intrinsics.shape).ravel()
        frame = [poses, self._camera, integers, integers, floats, self._fusion, workers]
        frame += [depth, image, image, wp.array(radial, device=device), self._covered]

        def record(kernel: Any, inputs: list[Any]) -> Any:
            return wp.launch(kernel, dim=dim, inputs=inputs, device=device, record_cmd=True)

        self._update = record(update_surfels, [arrays.surfels, arrays.visible, *frame])
        self._add = record(add_surfels, [arrays.surfels, capacity, *frame])
        removal = Removal()
        removal.capacity = capacity
        removal.interval = config.compaction_interval
        removal.window = config.unstable_window
        removal.confidence_threshold = config.confidence_threshold
        surfels, spare, blocks = arrays.surfels, arrays.spare, arrays.blocks
        survivors, kept, expired = arrays.survivors, arrays.kept, arrays.expired
        due = [removal, integers, integers, workers, expired]
        self._removal = [
            record(expire, [surfels, blocks, *due]),
            record(list_survivors, [surfels, *due, survivors, kept]),
            record(gather, [surfels, spare, survivors, kept, workers]),
            record(put_back, [spare, surfels, blocks, survivors, expired, kept, capacity, workers]),
        ]
        threshold = config.confidence_threshold
        self._bound = [
            record(bound_blocks, [surfels, blocks, capacity, threshold, workers]),
            wp.launch(
                set_bounded, batch, [surfels, blocks, capacity], device=device, record_cmd=True
            ),
        ]
