"""The surfel maps of B envs: fuse frames, render the model, predict views, save and restore."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.base import Views
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.frustum_culling import (
    CullingBlocks,
    FrustumCuller,
    allocate_culling_blocks,
    bound_blocks,
    set_bounded,
)
from ms_slam_env.slam.surfel.fusion import (
    FusionParameters,
    add_surfels,
    radial_weights,
    update_surfels,
)
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.rendering import (
    ModelView,
    SplatParameters,
    SplatRenderer,
    splat_camera,
)
from ms_slam_env.slam.surfel.splatting import SplatFootprints, allocate_footprints
from ms_slam_env.slam.surfel.surfel_culling import (
    SurfelCulling,
    cull_unstable,
    gather,
    list_survivors,
    put_back,
)
from ms_slam_env.slam.surfel.surfels import (
    ATTRIBUTES,
    COUNTERS,
    SeenWindow,
    Surfels,
    VisibleList,
    allocate_surfels,
    allocate_visible,
    any_time,
)
from ms_slam_env.slam.surfel.view_prediction import DeviceViews, ViewPredictor

_CHANGING = ("poses", "mask", "time", "weight", "live_depth", "live_normals", "live_color")


@dataclass(frozen=True)
class MapBuffers:
    """Device arrays of B maps, shared by all of its kernels.

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
    blocks: CullingBlocks
    visible: VisibleList
    discs: SplatFootprints
    survivors: wp.array
    kept: wp.array
    expired: wp.array
    active: SeenWindow


class MapKernels:
    """Recorded launches for frames of one size under one configuration."""

    def __init__(
        self, arrays: MapBuffers, intrinsics: Intrinsics, config: SurfelConfig, model_stride: int
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
        self._cull = FrustumCuller(
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
        removal = SurfelCulling()
        removal.capacity = capacity
        removal.interval = config.compaction_interval
        removal.window = config.unstable_window
        removal.confidence_threshold = config.confidence_threshold
        surfels, spare, blocks = arrays.surfels, arrays.spare, arrays.blocks
        survivors, kept, expired = arrays.survivors, arrays.kept, arrays.expired
        due = [removal, integers, integers, workers, expired]
        self._removal = [
            record(cull_unstable, [surfels, blocks, *due]),
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


Float64 = NDArray[np.float64]
GPU_THREADS = 1 << 20  # of a launch, about
GPU_WORKERS = (256, 8192)  # fewest and most that share one env's surfels


class SurfelMap:
    """Dense maps of ``batch`` envs (Keller et al., 3DV 2013; Whelan et al., IJRR 2016).

    Args:
        batch: number of envs B.
        intrinsics: of the live camera.
        config: parameters of fusion and removal.
        device: Warp device, ``"cpu"`` or ``"cuda"``.
        model_stride: ``render_model`` draws every so many-th row and column of the image.
        workers: threads that share one env's surfels; None: 1 on the CPU, where they run one after
            the other and the results keep the order of the map, many on a GPU.

    Attributes:
        surfels: the maps on the device.
        active: ``fuse`` and ``render_model`` work on the surfels last seen within this window; all
            unless its times are set.
        kernels: how ``fuse`` and ``render_model`` do that.
    """

    def __init__(
        self,
        batch: int,
        intrinsics: Intrinsics,
        config: SurfelConfig,
        device: str = "cpu",
        model_stride: int = 1,
        workers: int | None = None,
    ) -> None:
        self.batch = batch
        self.intrinsics = intrinsics
        self.device = device
        self._workers = default_workers(batch, device) if workers is None else workers
        capacity = config.capacity(intrinsics.width)
        self.surfels = allocate_surfels(batch, capacity, device)
        self._blocks = allocate_culling_blocks(batch, capacity, device)
        self._discs = allocate_footprints(batch, capacity, device)
        self.active = any_time(batch, device)
        self._arrays = MapBuffers(
            batch=batch,
            capacity=capacity,
            workers=self._workers,
            device=device,
            surfels=self.surfels,
            spare=allocate_surfels(batch, capacity, device),
            blocks=self._blocks,
            visible=allocate_visible(batch, capacity, device),
            discs=self._discs,
            survivors=wp.zeros((batch, capacity), dtype=wp.int32, device=device),
            kept=wp.zeros(batch, dtype=wp.int32, device=device),
            expired=wp.zeros(batch, dtype=wp.int32, device=device),
            active=self.active,
        )
        self.kernels = self.make_kernels(intrinsics, config, model_stride)
        self._predictor = ViewPredictor(
            self.surfels,
            self._blocks,
            self._arrays.visible,
            self._discs,
            intrinsics,
            self.kernels.splat_parameters,
            self._workers,
            device,
        )

    @property
    def config(self) -> SurfelConfig:
        """The parameters in force."""
        return self.kernels.config

    def make_kernels(
        self, intrinsics: Intrinsics, config: SurfelConfig, model_stride: int
    ) -> MapKernels:
        """Passes for frames of another size or with other parameters; ``use`` puts them in force.

        The capacity of the map stays what it is.
        """
        return MapKernels(self._arrays, intrinsics, config, model_stride)

    def use(self, kernels: MapKernels) -> None:
        """Go on with other kernels; views are predicted at the sizes of before."""
        before, after = self.config, kernels.config
        self.kernels = kernels
        if before.confidence_threshold != after.confidence_threshold:
            self.surfels_moved()  # which surfels may expire is a matter of the threshold

    def model_renderer(self, stride: int, window: SeenWindow) -> SplatRenderer:
        """Renders every ``stride``-th row and column of what was last seen within ``window``."""
        return self.kernels.model_renderer(stride, window)

    def clear(self, env: int | None = None) -> None:
        """Forget the map of one env, or of all."""
        counters = [getattr(self.surfels, name) for name in COUNTERS]
        for counter in (*counters, self._blocks.bounded):
            if env is None:
                counter.zero_()
            else:
                counter[env : env + 1].zero_()

    def fuse(
        self,
        live: LiveFrame,
        poses: wp.array,
        time: wp.array,
        weight: wp.array,
        mask: wp.array,
    ) -> None:
        """Fuse one frame per env.

        Args:
            live: the frames.
            poses: (B,) mat44 T_world_camera.
            time: (B,) int32 number of the frame in its episode.
            weight: (B,) float32 in (0, 1], lower for a fast camera (Whelan et al., section 3).
            mask: (B,) int32, 0 leaves an env's map as it is.
        """
        self.kernels.fuse(live, poses, time, weight, mask)

    def surfels_moved(self) -> None:
        """Look at all surfels anew: something else than ``fuse`` has changed them."""
        self._blocks.bounded.zero_()
        self._blocks.num_listed.zero_()
        self.kernels.bound_blocks()

    def render_model(self, poses: wp.array) -> ModelView:
        """Render every env's map from its pose (B,) mat44 T_world_camera.

        With every ``model_stride``-th row and column, from the first on. The images are
        overwritten by the next call.
        """
        return self.kernels.render_model(poses)

    def predict_device(
        self, poses: ArrayLike, scale: float = 1.0, first_env: int = 0
    ) -> DeviceViews:
        """Predict views of the maps, left on the device.

        Args:
            poses: (E, N, 4, 4) T_world_camera of N views for each of E envs.
            scale: of the predicted images relative to the live ones.
            first_env: the E envs are those from this one on.

        Returns:
            Images (E * N, h, w), overwritten by the next call.
        """
        return self._predictor.predict(np.asarray(poses, dtype=np.float64), scale, first_env)

    def predict(self, poses: ArrayLike, scale: float = 1.0, env: int = 0) -> Views:
        """Predict views (N) of one env's map from ``poses`` (N, 4, 4) T_world_camera."""
        stack = np.asarray(poses, dtype=np.float64).reshape(1, -1, 4, 4)
        views = self.predict_device(stack, scale, env)
        return Views(
            intensity=views.intensity.numpy().copy(),
            depth=views.depth.numpy().copy(),
            normals=views.normals.numpy().copy(),
            intrinsics=views.intrinsics,
        )

    def count(self, env: int = 0) -> int:
        """Living surfels of one env."""
        return int(self.surfels.count.numpy()[env] - self.surfels.dead.numpy()[env])

    def dropped(self, env: int = 0) -> int:
        """Surfels that found no room in one env's map since it was cleared."""
        return int(self.surfels.dropped.numpy()[env])

    def points(self, env: int = 0, stable: bool = True) -> Float64:
        """Positions (M, 3) of the living surfels, world frame; only stable ones if asked."""
        return self.attribute("position", env, stable).astype(np.float64)

    def colors(self, env: int = 0, stable: bool = True) -> NDArray[np.uint8]:
        """Colours (M, 3) RGB of ``points``, in the same order."""
        return np.clip(np.rint(self.attribute("color", env, stable)), 0, 255).astype(np.uint8)

    def attribute(self, name: str, env: int = 0, stable: bool = True) -> NDArray[np.float32]:
        """Array ``name`` of the living surfels, in the order of ``points``."""
        used = int(self.surfels.count.numpy()[env])
        confidence = self.surfels.confidence[env, :used].numpy()
        keep = confidence > 0
        if stable:
            keep &= confidence >= self.config.confidence_threshold
        return getattr(self.surfels, name)[env, :used].numpy()[keep]

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly: per env, the used part of every array."""
        counters = {name: getattr(self.surfels, name).numpy().copy() for name in COUNTERS}
        used = counters["count"]
        return {
            "counters": counters,
            "surfels": [
                {
                    name: getattr(self.surfels, name)[env, : int(used[env])].numpy().copy()
                    for name in ATTRIBUTES
                }
                for env in range(self.batch)
            ],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` of a map of this size returned."""
        for name in COUNTERS:
            getattr(self.surfels, name).assign(state["counters"][name])
        for env, arrays in enumerate(state["surfels"]):
            for name in ATTRIBUTES:
                used = len(arrays[name])
                if used:
                    getattr(self.surfels, name)[env, :used].assign(arrays[name])
        self.surfels_moved()


def default_workers(batch: int, device: str) -> int:
    """Threads that share one env's surfels."""
    if wp.get_device(device).is_cpu:
        return 1
    fewest, most = GPU_WORKERS
    return min(most, max(fewest, GPU_THREADS // batch))
