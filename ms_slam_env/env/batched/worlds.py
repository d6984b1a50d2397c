"""The true worlds of B cameras: scenes, images, possible motions, surface mapped in its place."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float32, Float64
from ms_slam_env._runtime.warp import HostDeviceBuffer, RecordedLaunch, StructTable, wp
from ms_slam_env.env.batched import kernels
from ms_slam_env.env.coverage import STRIDE, VOXEL_M, VoxelGrid, Voxels
from ms_slam_env.env.env_config import EnvConfig
from ms_slam_env.env.observations import COLUMNS, DEPTH_CAP, DEPTH_SCALE_M, GREY_BINS, ROWS
from ms_slam_env.errors import InputError
from ms_slam_env.robot.action_primitives import NUM_ROTATIONS, TRANSLATION_DIRECTIONS
from ms_slam_env.robot.free_camera import CAMERA_RADIUS_M
from ms_slam_env.scenes.mesh_scene import MeshScene
from ms_slam_env.scenes.registry import SceneName
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor.camera_batch import CameraBatch
from ms_slam_env.sensor.noise import noise_config
from ms_slam_env.sensor.scene_cache import get_scene, get_sensor


class Worlds:
    """B free cameras, each in a scene; what they see stays on the device.

    Attributes:
        cameras: take the frames.
        scenes: (B) scene of each camera; None before the first.
        grey: (B, H, W) float32 on the device, grey values of the last frames.
        mapped_area: (B,) surface mapped in its true place so far, square metres.
        mapped_share: (B,) of the reachable surface.
    """

    def __init__(self, batch: int, config: EnvConfig, device: str) -> None:
        self._config, self.device = config, device
        self.scenes: list[Scene | None] = [None] * batch
        self.cameras = CameraBatch(batch, config.camera, noise_config(config.noise), device)
        self.mapped_area, self.mapped_share = np.zeros(batch), np.zeros(batch)
        self._places = StructTable(batch, kernels.Place, device)
        self._known: WeakKeyDictionary[Scene, kernels.Place] = WeakKeyDictionary()
        self._reachable = np.ones(batch)  # number of voxels
        rays = config.camera.rays()[::STRIDE, ::STRIDE]
        self._truth, self._estimate = (HostDeviceBuffer(batch, wp.mat44d, device) for _ in range(2))
        self._fused = HostDeviceBuffer(batch, wp.int32, device)
        self._counts = HostDeviceBuffer((batch, 2), wp.int32, device)
        self._mapped = wp.zeros((batch, 1), dtype=wp.uint32, device=device)
        self._free = HostDeviceBuffer((batch, len(TRANSLATION_DIRECTIONS)), wp.uint8, device)
        self._histogram = HostDeviceBuffer((batch, GREY_BINS), wp.int32, device)
        self._coarse = HostDeviceBuffer((batch, 2 * ROWS * COLUMNS), wp.float32, device)
        color, depth = self.cameras.color, self.cameras.depth
        self.grey = wp.zeros(depth.shape, dtype=wp.float32, device=device)
        ways: Any = wp.array(config.step_m * TRANSLATION_DIRECTIONS, dtype=wp.vec3d, device=device)
        radius = wp.float64(CAMERA_RADIUS_M)
        inputs = [self._places.array, self._truth.array, ways, radius, self._free.array]
        self._find_ways = RecordedLaunch(
            kernels.find_free_ways, self._free.array.shape, inputs, device
        )
        height = config.camera.height
        inputs = [color, 256 // GREY_BINS, self.grey, self._histogram.array]
        self._find_grey = RecordedLaunch(kernels.find_grey, (batch, height), inputs, device)
        inputs = [depth, ROWS, COLUMNS, DEPTH_SCALE_M, DEPTH_CAP, self._coarse.array]
        cells = batch, ROWS * COLUMNS
        self._find_coarse = RecordedLaunch(kernels.find_coarse_depth, cells, inputs, device)
        flat_rays: Any = wp.array(rays.ravel(), dtype=wp.float64, device=device)
        poses = [self._truth.array, self._estimate.array, self._fused.array]
        inputs = [self._places.array, depth, self.cameras.hits, STRIDE, flat_rays, *poses]
        inputs += [self._mapped, self._counts.array]
        points = batch, rays.shape[0] * rays.shape[1]
        self._mark = RecordedLaunch(kernels.mark_seen, points, inputs, device)

    def enter(self, camera: int, name: SceneName, seed: int) -> Scene:
        """Put a camera into a scene in which nothing is mapped.

        Raises:
            InputError: a scene whose free space is not a grid of distances.
        """
        scene = get_scene(name, seed)
        if not isinstance(scene, MeshScene):
            raise InputError(f"scene {scene.name} has no grid of free space: step it with gym.make")
        if self.scenes[camera] is not scene:
            self.scenes[camera] = scene
            own = self._config.camera, self._config.noise, self.device
            self.cameras.enter(camera, get_sensor(name, seed, *own))
            place = self._known.get(scene)
            if place is None:
                self._known[scene] = place = self._place(scene)
            self._places.put(camera, place)
            self._reachable[camera] = max(1, Voxels.of(scene, VOXEL_M).num_reachable)
            self._make_room(-(-place.reachable.shape[0] // 32))
        self._mapped[camera : camera + 1].zero_()
        counts = self._counts.read()
        counts[camera] = 0
        self._counts.write(counts)
        return scene

    def _place(self, scene: MeshScene) -> kernels.Place:
        """The grids of a scene on the device."""
        voxels, free, place = Voxels.of(scene, VOXEL_M), scene.free_space, kernels.Place()
        place.distance = wp.array(free.distance, dtype=wp.float32, device=self.device)
        place.low, place.edge_m = wp.vec3d(*free.origin), free.voxel_m
        grid = VoxelGrid()
        grid.origin, grid.shape = wp.vec3d(*voxels.origin), wp.vec3i(*voxels.shape)
        grid.voxel_m = VOXEL_M
        place.voxels = grid
        reachable = voxels.reachable.view(np.uint8)
        place.reachable = wp.array(reachable, dtype=wp.uint8, device=self.device)
        return place

    def _make_room(self, words: int) -> None:
        """Have at least so many words of voxels for each camera."""
        before = self._mapped
        if before.shape[1] >= words:
            return
        values = np.zeros((before.shape[0], words), dtype=np.uint32)
        values[:, : before.shape[1]] = before.numpy()
        self._mapped = wp.array(values, dtype=wp.uint32, device=self.device)
        self._mark.set_param("mapped", self._mapped)

    def capture(
        self, T_world_camera: Float64, seeds: NDArray[np.int64], index: NDArray[np.int64]
    ) -> None:
        """Take frames ``index`` (B,) from poses (B, 4, 4) under noise ``seeds`` (B,)."""
        self._truth.write(T_world_camera)
        self.cameras.capture(T_world_camera, seeds, index)
        self._histogram.zero()
        self._find_grey.launch()

    def action_masks(self) -> Bool:
        """(B, 49) which motions are possible from where the last frames were taken."""
        self._find_ways.launch()
        return np.repeat(self._free.look() != 0, NUM_ROTATIONS, axis=1)

    def cover(self, T_world_camera_estimate: Float64, fused: Bool) -> Float64:
        """Mark the surface in the frames that were ``fused`` (B,); return the new area (B,), m2."""
        before = self._counts.read()
        self._estimate.write(T_world_camera_estimate)
        self._fused.write(fused)
        self._mark.launch()
        counts = self._counts.look()
        self.mapped_area = counts[:, 0] * VOXEL_M**2
        self.mapped_share = counts[:, 1] / self._reachable
        area: Float64 = (counts[:, 0] - before[:, 0]) * VOXEL_M**2
        return area

    def image_features(self) -> list[Float32]:
        """Grey histograms (B, 16) and coarse depth (B, 96) of the last frames."""
        self._find_coarse.launch()
        pixels = np.float32(self.grey.shape[1] * self.grey.shape[2])
        return [self._histogram.look().astype(np.float32) / pixels, self._coarse.read()]
