"""The surfel maps of B envs: fuse frames, render the model, predict views, save and restore.

A removed surfel is dead: it keeps its slot, and nothing uses it. Compaction removes dead slots when
there are many. A crowded map forgets the surfels that were unseen for longest, enough to make room
for some frames. It does not forget everything out of view, which may be all that a camera mapped.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import RecordedLaunch
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.slam.shared.state import Stateful
from ms_slam_env.slam.shared.state_check import ArrayOf, Fields
from ms_slam_env.slam.slam_backend import Views
from ms_slam_env.slam.surfel.device import fetch, put
from ms_slam_env.slam.surfel.frustum_culling import (
    FrustumCuller,
    bound_blocks,
    num_blocks,
    set_bounded,
)
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.rendering import (
    ModelView,
    SplatParameters,
    SplatRenderer,
    splat_camera,
)
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_update import (
    FULL_WEIGHT_SIGMA_M,
    FusedFrame,
    FusionParameters,
    add_surfels,
    cull_and_update,
    radial_weights,
    update_surfels,
)
from ms_slam_env.slam.surfel.surfels import (
    ATTRIBUTES,
    BLOCK_SIZE,
    COUNTERS,
    NUM_AGES,
    Compaction,
    CullingBlocks,
    MapBuffers,
    SeenWindow,
    SurfelAges,
    Surfels,
)
from ms_slam_env.slam.surfel.view_prediction import DeviceViews, ViewPredictor

NEVER = wp.constant(2**31 - 1)
AGES = wp.constant(NUM_AGES)
FORGOTTEN = wp.constant(16)  # a sixteenth of a crowded map's slots at once


@wp.struct
class CullingRule:
    """When surfels are removed."""

    capacity: int  # slots of a map
    interval: int  # frames between two removals of unstable surfels
    window: int  # frames for which an unstable surfel may stay unseen
    confidence_threshold: float  # at which a surfel is stable


@wp.func
def is_crowded(slots: int, capacity: int) -> bool:
    """Whether nine tenths of a map's slots are taken."""
    return slots > capacity - capacity / 10


@wp.func
def age_span(rule: CullingRule, time: int) -> int:
    """Number of frames over which the ages of unstable surfels are counted."""
    return wp.max(wp.min(rule.window, time), 1)


@wp.kernel
def count_ages(
    surfels: Surfels, rule: CullingRule, frame: FusedFrame, workers: int, ages: SurfelAges
) -> None:
    """Count the unstable surfels of crowded maps by the frame that last saw them."""
    b, worker = wp.tid()
    time = frame.time[b]
    count = wp.min(surfels.count[b], rule.capacity)
    if frame.mask[b] == 0 or not is_crowded(count - surfels.dead[b], rule.capacity):
        return
    span = age_span(rule, time)
    i = int(worker)
    while i < count:
        confidence = fetch(surfels.confidence, b, i)
        seen = fetch(surfels.seen, b, i)
        if confidence > 0.0 and confidence < rule.confidence_threshold and seen < time:
            age = wp.max(seen - (time - span), 0) * AGES / span
            wp.atomic_add(ages.count, b, age, 1)
        i += workers


@wp.func
def oldest_that_stay(ages: SurfelAges, rule: CullingRule, b: int, time: int) -> int:
    """First frame such that unstable surfels seen since then stay in a crowded map.

    The surfels not seen since then are as many as must go, or all that are out of view.
    """
    gone = wp.int32(0)
    k = wp.int32(0)
    while k < AGES and gone < rule.capacity / FORGOTTEN:
        gone += ages.count[b, k]
        k += 1
    span = age_span(rule, time)
    return time - span + (k * span + AGES - 1) / AGES


@wp.kernel
def cull_unstable(
    surfels: Surfels,
    blocks: CullingBlocks,
    rule: CullingRule,
    frame: FusedFrame,
    workers: int,
    compaction: Compaction,
    ages: SurfelAges,
) -> None:
    """Remove unstable surfels that were unseen for long, every ``interval`` frames.

    If living surfels take nine tenths of the slots, remove those unseen for longest at once,
    whatever their age: a sixteenth of the slots, or all that are out of view if they are fewer.
    Only blocks that hold such surfels are visited.
    """
    b, worker = wp.tid()
    count = wp.min(surfels.count[b], rule.capacity)
    time = frame.time[b]
    crowded = is_crowded(count - surfels.dead[b], rule.capacity)
    if frame.mask[b] == 0 or (time % rule.interval != 0 and not crowded):
        return
    oldest = time - rule.window
    if crowded:
        oldest = oldest_that_stay(ages, rule, b, time)
    block = int(worker)
    while block < num_blocks(count):
        if blocks.expiry[b, block] < oldest:
            i = block * BLOCK_SIZE
            end = wp.min(i + BLOCK_SIZE, count)
            expiry = int(NEVER)
            while i < end:
                confidence = fetch(surfels.confidence, b, i)
                seen = fetch(surfels.seen, b, i)
                if confidence > 0.0 and confidence < rule.confidence_threshold:
                    if seen < oldest:
                        put(surfels.confidence, b, i, 0.0)
                        wp.atomic_add(compaction.expired, b, 1)
                    else:
                        expiry = wp.min(expiry, seen)
                i += 1
            blocks.expiry[b, block] = expiry
        block += workers


@wp.kernel
def list_survivors(
    surfels: Surfels, rule: CullingRule, frame: FusedFrame, workers: int, compaction: Compaction
) -> None:
    """List the slots to keep of every env whose compaction is due; ``kept`` -1: not due.

    It is due when more than an eighth of the slots are dead; in a crowded map, when more than a
    sixty-fourth are and the dead outnumber the free. So its cost is proportional to the deaths.
    """
    b, worker = wp.tid()
    count = wp.min(surfels.count[b], rule.capacity)
    dead = surfels.dead[b] + compaction.expired[b]
    many = 8 * dead > count and frame.time[b] % rule.interval == 0
    crowded = is_crowded(count, rule.capacity)
    needed = crowded and 64 * dead > count and dead > rule.capacity - count
    if frame.mask[b] == 0 or not (many or needed):
        compaction.kept[b] = -1
        return
    i = int(worker)
    while i < count:
        if fetch(surfels.confidence, b, i) > 0.0:
            put(compaction.survivors, b, wp.atomic_add(compaction.kept, b, 1), i)
        i += workers


@wp.func
def copy_surfel(source: Surfels, target: Surfels, b: int, i: int, j: int) -> None:
    """Copy slot i of one map to slot j of the other."""
    put(target.position, b, j, fetch(source.position, b, i))
    put(target.normal, b, j, fetch(source.normal, b, i))
    put(target.color, b, j, fetch(source.color, b, i))
    put(target.radius, b, j, fetch(source.radius, b, i))
    put(target.confidence, b, j, fetch(source.confidence, b, i))
    put(target.created, b, j, fetch(source.created, b, i))
    put(target.seen, b, j, fetch(source.seen, b, i))


@wp.kernel
def gather(source: Surfels, target: Surfels, compaction: Compaction, workers: int) -> None:
    """Copy the survivors that must move to their new slots in ``target``."""
    b, worker = wp.tid()
    count = compaction.kept[b]
    j = int(worker)
    while j < count:
        i = fetch(compaction.survivors, b, j)
        if i != j:
            copy_surfel(source, target, b, i, j)
        j += workers


@wp.kernel
def put_back(
    source: Surfels,
    target: Surfels,
    blocks: CullingBlocks,
    compaction: Compaction,
    capacity: int,
    workers: int,
) -> None:
    """Copy the gathered survivors back and set the counters."""
    b, worker = wp.tid()
    count = compaction.kept[b]
    j = int(worker)
    while j < count:
        if fetch(compaction.survivors, b, j) != j:
            copy_surfel(source, target, b, j, j)
        j += workers
    if worker == 0:
        target.count[b] = wp.min(target.count[b], capacity)
        target.dead[b] = target.dead[b] + compaction.expired[b]
        if count >= 0:
            target.count[b] = count
            target.dead[b] = 0
            blocks.bounded[b] = 0


@wp.kernel
def forget_surfels(envs: wp.array[wp.int32], surfels: Surfels, blocks: CullingBlocks) -> None:
    """Empty the maps of some envs: what lies in the slots is never looked at."""
    b = envs[wp.tid()]
    surfels.count[b] = 0
    surfels.dead[b] = 0
    surfels.dropped[b] = 0
    blocks.bounded[b] = 0


class MapKernels:
    """Recorded launches for frames of one size under one configuration.

    One map may have several: a running SLAM that changes its parameters or image size works on the
    same surfels with other kernels.
    """

    def __init__(
        self, buffers: MapBuffers, intrinsics: Intrinsics, config: SurfelConfig, model_stride: int
    ) -> None:
        self.config = config
        self.splat_parameters = SplatParameters(tolerance_m=config.fusion_distance_m)
        self._buffers = buffers
        self._intrinsics = intrinsics
        self._camera = splat_camera(intrinsics, self.splat_parameters)
        self._cull = FrustumCuller(buffers, buffers.batch, self._camera, buffers.active)
        self._model_renderer = self.model_renderer(model_stride, buffers.active)
        self._arguments: tuple[Any, ...] = (None,) * 5
        self._frame = FusedFrame()
        self._frame.covered = wp.zeros(
            math.prod((buffers.batch, *intrinsics.shape)), dtype=wp.int32, device=buffers.device
        )
        radial = radial_weights(*intrinsics.shape).ravel()
        self._frame.radial = wp.array(radial, device=buffers.device)
        self._fusion = self._record_fusion()
        self._culling = self._record_culling()
        inputs = [buffers.surfels, buffers.blocks, buffers.capacity]
        threshold = config.confidence_threshold
        self._bound = [
            self._record(bound_blocks, [*inputs, threshold, buffers.workers]),
            RecordedLaunch(set_bounded, buffers.batch, inputs, buffers.device),
        ]

    def _record(self, kernel: Any, inputs: list[Any]) -> RecordedLaunch:
        dim = (self._buffers.batch, self._buffers.workers)
        return RecordedLaunch(kernel, dim, inputs, self._buffers.device)

    def _record_fusion(self) -> list[RecordedLaunch]:
        config, buffers = self.config, self._buffers
        rule = FusionParameters()
        rule.distance_m = config.fusion_distance_m
        rule.min_cosine = math.cos(math.radians(config.fusion_angle_deg))
        rule.coverage_px = config.coverage_px
        rule.radius_px = config.surfel_radius_px
        rule.max_confidence = config.max_confidence
        rule.full_m = math.sqrt(FULL_WEIGHT_SIGMA_M / config.depth_noise_m)
        shared = [self._camera, rule, self._frame, buffers.workers]
        inputs = [buffers.surfels, buffers.visible, *shared]
        update = self._record(update_surfels, inputs)
        if buffers.workers == 1:
            culled = [buffers.surfels, buffers.blocks, buffers.active, buffers.visible]
            update = RecordedLaunch(
                cull_and_update, buffers.batch, [*culled, *shared[:3]], buffers.device
            )
        return [
            update,
            self._record(add_surfels, [buffers.surfels, buffers.capacity, *shared]),
        ]

    def _record_culling(self) -> list[RecordedLaunch]:
        config, buffers = self.config, self._buffers
        rule = CullingRule()
        rule.capacity = buffers.capacity
        rule.interval = config.compaction_interval
        rule.window = config.unstable_window
        rule.confidence_threshold = config.confidence_threshold
        surfels, spare, blocks = buffers.surfels, buffers.spare, buffers.blocks
        workers, compaction = buffers.workers, buffers.compaction
        due = [rule, self._frame, workers, compaction]
        returned = [spare, surfels, blocks, compaction, rule.capacity, workers]
        ages = buffers.ages
        return [
            self._record(count_ages, [surfels, *due[:3], ages]),
            self._record(cull_unstable, [surfels, blocks, *due, ages]),
            self._record(list_survivors, [surfels, *due]),
            self._record(gather, [surfels, spare, compaction, workers]),
            self._record(put_back, returned),
        ]

    def model_renderer(self, stride: int, window: SeenWindow) -> SplatRenderer:
        """A renderer of every ``stride``-th row and column, for surfels last seen in ``window``."""
        drawn = self.splat_parameters
        drawn = replace(drawn, min_px=drawn.min_px / stride, max_px=drawn.max_px / stride)
        intrinsics = self._intrinsics.every_nth(stride)
        return SplatRenderer(self._buffers, self._buffers.batch, intrinsics, drawn, window)

    def render_model(self, poses: wp.array) -> ModelView:
        """Render every env's map from its pose; see ``SurfelMap.render_model``."""
        self._model_renderer.cull(poses)
        return self._model_renderer.splat()

    def fuse(
        self, live: LiveFrame, poses: wp.array, time: wp.array, weight: wp.array, mask: wp.array
    ) -> None:
        """Fuse one frame per env; see ``SurfelMap.fuse``."""
        if self._buffers.workers == 1:
            self._cull.list_blocks(poses)
        else:
            self._cull(poses)
        self._frame.covered.zero_()
        self._buffers.compaction.kept.zero_()
        self._buffers.compaction.expired.zero_()
        self._buffers.ages.count.zero_()
        self._bind(live, poses, time, weight, mask)
        for launch in (*self._fusion, *self._culling, *self._bound):
            launch.launch()

    def bound_blocks(self) -> None:
        """Compute the bounding boxes of all blocks without a valid one."""
        for launch in self._bound:
            launch.launch()

    def _bind(
        self, live: LiveFrame, poses: wp.array, time: wp.array, weight: wp.array, mask: wp.array
    ) -> None:
        """Set the arguments of the recorded launches, if they have changed."""
        arguments = (live, poses, time, weight, mask)
        if all(new is old for new, old in zip(arguments, self._arguments, strict=True)):
            return
        self._arguments, frame = arguments, self._frame
        frame.poses, frame.time, frame.weight, frame.mask = poses, time, weight, mask
        frame.depth, frame.normals = live.depth.flatten(), live.normals.flatten()
        frame.color, frame.moving = live.color.flatten(), live.moving.flatten()
        for launch in (*self._fusion, *self._culling[:3]):
            launch.set_param("frame", frame)


class SurfelMap(Stateful):
    """Dense maps of ``batch`` envs (Keller et al., 3DV 2013; Whelan et al., IJRR 2016).

    ``fuse`` and ``render_model`` work on the surfels last seen within ``active``: all, unless its
    times are set. ``render_model`` draws every ``model_stride``-th row and column of the image.
    ``workers`` threads share one env's surfels; None: many on a GPU, and 1 on the CPU, where
    threads run in turn and a single one keeps results in the order of the map.
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
        capacity = config.capacity(intrinsics.width)
        self._buffers = MapBuffers(batch, capacity, device, workers)
        self.surfels, self.active = self._buffers.surfels, self._buffers.active
        self.kernels = self.make_kernels(intrinsics, config, model_stride)
        drawn = self.kernels.splat_parameters
        self._predictor = ViewPredictor(self._buffers, intrinsics, drawn)

    @property
    def config(self) -> SurfelConfig:
        """The parameters in force."""
        return self.kernels.config

    def make_kernels(
        self, intrinsics: Intrinsics, config: SurfelConfig, model_stride: int
    ) -> MapKernels:
        """Kernels for frames of another size or for other parameters; ``use`` activates them.

        The capacity of the map does not change.
        """
        return MapKernels(self._buffers, intrinsics, config, model_stride)

    def use(self, kernels: MapKernels) -> None:
        """Continue with other kernels; predicted views keep their size."""
        before, after = self.config, kernels.config
        self.kernels = kernels
        if before.confidence_threshold != after.confidence_threshold:
            self.surfels_moved()  # the threshold decides which surfels may expire

    def model_renderer(self, stride: int, window: SeenWindow) -> SplatRenderer:
        """A renderer of every ``stride``-th row and column, for surfels last seen in ``window``."""
        return self.kernels.model_renderer(stride, window)

    def clear(self, envs: ArrayLike | None = None) -> None:
        """Forget the map of one env or of several (N,), or all."""
        which = np.arange(self.batch) if envs is None else np.atleast_1d(envs)
        cleared = wp.array(which.astype(np.int32), dtype=wp.int32, device=self.device)
        inputs = [cleared, self.surfels, self._buffers.blocks]
        wp.launch(forget_surfels, len(which), inputs, device=self.device)

    def fuse(
        self, live: LiveFrame, poses: wp.array, time: wp.array, weight: wp.array, mask: wp.array
    ) -> None:
        """Fuse one frame per env.

        Args:
            live: the frames.
            poses: (B,) mat44 T_world_camera.
            time: (B,) int32 index of the frame in its episode.
            weight: (B,) float32 in (0, 1], lower for a fast camera (Whelan et al., section 3).
            mask: (B,) int32, 0 leaves an env's map as it is.
        """
        self.kernels.fuse(live, poses, time, weight, mask)

    def surfels_moved(self) -> None:
        """Recompute the culling blocks; call it when anything but ``fuse`` has changed surfels."""
        self._buffers.blocks.bounded.zero_()
        self._buffers.blocks.num_listed.zero_()
        self.kernels.bound_blocks()

    def render_model(self, poses: wp.array) -> ModelView:
        """Render every env's map from its pose (B,) mat44 T_world_camera.

        The view holds every ``model_stride``-th row and column, from the first on. The next call
        overwrites its images.
        """
        return self.kernels.render_model(poses)

    def predict_device(
        self, poses: ArrayLike, scale: float = 1.0, first_env: int = 0, singly: bool = False
    ) -> DeviceViews:
        """Predict views of the maps, left on the device.

        Args:
            poses: (E, N, 4, 4) T_world_camera of N views for each of E envs.
            scale: size of the predicted images relative to the live ones.
            first_env: index of the first of the E envs.
            singly: whether to splat the map into every view instead of warping one.

        Returns:
            Images (E * N, h, w), overwritten by the next call.
        """
        stack = np.asarray(poses, dtype=np.float64)
        return self._predictor.predict(stack, scale, first_env, singly)

    def predict(
        self, poses: ArrayLike, scale: float = 1.0, env: int = 0, singly: bool = False
    ) -> Views:
        """Predict views (N) of one env's map from ``poses`` (N, 4, 4) T_world_camera."""
        stack = np.asarray(poses, dtype=np.float64).reshape(1, -1, 4, 4)
        views = self.predict_device(stack, scale, env, singly)
        return Views(
            intensity=views.intensity.numpy().copy(),
            depth=views.depth.numpy().copy(),
            normals=views.normals.numpy().copy(),
            intrinsics=views.intrinsics,
        )

    def count(self, env: int = 0) -> int:
        """Number of living surfels of one env."""
        return int(self.surfels.count.numpy()[env] - self.surfels.dead.numpy()[env])

    def points(self, env: int = 0, stable: bool = True) -> Float64:
        """Positions (M, 3) of the living surfels, world frame; only stable ones if ``stable``."""
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
        """Everything needed to continue bit-exactly: per env, the used part of every array."""
        counters = {name: getattr(self.surfels, name).numpy().copy() for name in COUNTERS}
        return {
            "counters": counters,
            "surfels": [self.get_surfels(env) for env in range(self.batch)],
        }

    def state_like(self) -> Any:
        """See ``Stateful``."""
        like = self.get_state() | {"surfels": [self.surfels_like() for _ in range(self.batch)]}
        return Fields(like, self._why_wrong)

    def surfels_like(self) -> dict[str, ArrayOf]:
        """Description of what ``get_surfels`` returns; see ``Stateful.state_like``."""
        return {
            name: ArrayOf(values.dtype, ("surfels", *values.shape[1:]), *_RANGES.get(name, _FREE))
            for name, values in self.get_surfels(0).items()
        }

    def get_surfels(self, env: int) -> dict[str, NDArray[Any]]:
        """The used part of every array of one env, dead surfels included."""
        used = int(self.surfels.count.numpy()[env])
        return {name: getattr(self.surfels, name)[env, :used].numpy().copy() for name in ATTRIBUTES}

    def set_surfels(self, env: int, arrays: dict[str, NDArray[Any]]) -> None:
        """Replace the surfels of one env; those beyond the map's capacity are dropped."""
        capacity = self._buffers.capacity
        total = len(arrays["confidence"])
        used = min(total, capacity)
        confidence = arrays["confidence"][:used]
        counts = used, int((confidence == 0).sum()), total - used
        for name, count in zip(COUNTERS, counts, strict=True):
            getattr(self.surfels, name)[env : env + 1].assign(np.array([count], dtype=np.int32))
        self._assign(env, {name: values[:used] for name, values in arrays.items()})
        self.surfels_moved()

    def _assign(self, env: int, arrays: dict[str, NDArray[Any]]) -> None:
        for name in ATTRIBUTES:
            _write(getattr(self.surfels, name), env, arrays[name])

    def check_fits(self, state: dict[str, Any]) -> None:
        """Refuse a state with more surfels than the map's capacity.

        Raises:
            InputError: naming both numbers.
        """
        why = self._why_too_large(state)
        if why:
            raise InputError(f"the map {why}")

    def _why_too_large(self, state: dict[str, Any]) -> str:
        most, room = max(len(one["radius"]) for one in state["surfels"]), self._buffers.capacity
        return f"has {most} surfels; there is room for {room}" if most > room else ""

    def _why_wrong(self, state: dict[str, Any]) -> str:
        """Error message if the counters of a state do not fit its surfels or the capacity."""
        used = [len(one["confidence"]) for one in state["surfels"]]
        dead = [np.count_nonzero(one["confidence"] == 0) for one in state["surfels"]]
        counters = state["counters"]
        if (counters["count"] != used).any() or (counters["dead"] != dead).any():
            return self._why_too_large(state) or f"has counters of others than its {used} surfels"
        return self._why_too_large(state)

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state that ``get_state`` of a map of this size returned."""
        for name in COUNTERS:
            getattr(self.surfels, name).assign(state["counters"][name])
        for env, arrays in enumerate(state["surfels"]):
            self._assign(env, arrays)
        self.surfels_moved()


_FREE: tuple[float | None, float] = None, math.inf
_RANGES: dict[str, tuple[float | None, float]] = {
    "color": (-1e4, 1e4),  # at the first exposure; colours of later ones may leave [0, 255]
    **dict.fromkeys(("radius", "confidence"), (0.0, math.inf)),
    **dict.fromkeys(("created", "seen"), (0, math.inf)),
}


def _write(array: wp.array, env: int, values: NDArray[Any]) -> None:
    """Write the first ``len(values)`` elements of one env's row."""
    if wp.get_device(array.device).is_cpu:  # write through a view; ``assign`` costs 5 times more
        array.numpy()[env, : len(values)] = values
    elif len(values):
        array[env, : len(values)].assign(values)
