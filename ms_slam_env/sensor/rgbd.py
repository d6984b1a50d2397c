"""The RGB-D sensor: poses in, noisy frames or noise-free views out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.scenes.base import Scene, TexturedMesh
from ms_slam_env.sensor.casters import Hits, RayCaster, make_caster
from ms_slam_env.sensor.depth_noise import make_depth_noise, measure_depth, projector_shadow
from ms_slam_env.sensor.noise import NoiseConfig, noise_config
from ms_slam_env.sensor.random_numbers import frame_key, normal_table
from ms_slam_env.sensor.rays import generate_rays, make_pinhole
from ms_slam_env.sensor.shading import Surfaces, shade, true_geometry
from ms_slam_env.sensor.textures import (
    decode_table,
    encode_table,
    face_planes,
    pack_textures,
    texel_density,
)

FRAME_RATE_HZ = 30.0
"""Rate of the simulated sensor; gives a frame its time stamp when the caller does not."""


@dataclass(frozen=True)
class TrueView:
    """What an ideal sensor sees from one pose.

    Attributes:
        color: (H, W, 3) uint8 without noise.
        depth: (H, W) float32 metres along the optical axis; 0 = no surface.
        normals: (H, W, 3) float32 unit vectors in the camera frame, towards the camera; 0 = none.
        labels: (H, W) int32 index into the mesh's labels; -1 = no surface.
        points: (H, W, 3) float32 in the world frame; 0 = no surface.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    labels: NDArray[np.int32]
    points: NDArray[np.float32]


class _Buffers:
    """Arrays for ``batch`` images, kept between frames."""

    def __init__(self, batch: int, pixels: int, device: str) -> None:
        count = batch * pixels
        self.poses = wp.zeros(batch, dtype=wp.mat44, device=device)
        self.keys = wp.zeros((batch, 2), dtype=wp.uint32, device=device)
        self.origins = wp.zeros(count, dtype=wp.vec3, device=device)
        self.directions = wp.zeros(count, dtype=wp.vec3, device=device)
        self.hits = Hits(count, device)
        self.shadow = wp.zeros(count, dtype=wp.uint8, device=device)
        self.color = wp.zeros((count, 3), dtype=wp.uint8, device=device)
        self.depth = wp.zeros(count, dtype=wp.float32, device=device)


def _upload_surfaces(mesh: TexturedMesh, device: str) -> Surfaces:
    textures = pack_textures(mesh.textures)
    normals, planes = face_planes(mesh)
    surfaces = Surfaces()
    surfaces.uv = wp.array(mesh.uv, dtype=wp.vec2, device=device)
    surfaces.irradiance = wp.array(mesh.irradiance, dtype=wp.vec3, device=device)
    surfaces.normal = wp.array(normals, dtype=wp.vec3, device=device)
    surfaces.plane = wp.array(planes, dtype=wp.float32, device=device)
    surfaces.density = wp.array(texel_density(mesh), dtype=wp.float32, device=device)
    surfaces.texture = wp.array(mesh.face_texture, dtype=wp.int32, device=device)
    surfaces.label = wp.array(mesh.face_label, dtype=wp.int32, device=device)
    surfaces.texels = wp.array(textures.texels, dtype=wp.uint32, device=device)
    surfaces.offsets = wp.array(textures.offsets, dtype=wp.int32, device=device)
    surfaces.sizes = wp.array(textures.sizes, dtype=wp.vec3i, device=device)
    return surfaces


class RGBDSensor:
    """A colour and depth camera in a scene.

    The noise of a frame is a function of (seed, index, pixel) alone: the order of the calls and
    the batch in which a frame is rendered do not matter.
    """

    def __init__(
        self,
        scene: Scene,
        intrinsics: Intrinsics,
        noise: str | NoiseConfig = "kinect",
        seed: int = 0,
        device: str = "cpu",
        caster: RayCaster | None = None,
    ) -> None:
        """Prepare to render ``scene``.

        Args:
            scene: the world; its mesh is copied to the device once.
            intrinsics: of both images, which are registered.
            noise: "kinect", "none" or a NoiseConfig.
            seed: of the noise.
            device: Warp device, such as "cpu" or "cuda:0".
            caster: what finds the ray hits; by default the fastest of the device.

        Raises:
            InputError: unknown noise model, or a seed that is not an integer >= 0.
        """
        self.scene = scene
        self.intrinsics = intrinsics
        self.noise = noise_config(noise)
        self.seed = seed
        frame_key(seed, 0)
        self.device = device
        self._caster = caster or make_caster(scene.mesh, device)
        self._camera = make_pinhole(intrinsics)
        self._depth_noise = make_depth_noise(self.noise, intrinsics)
        self._surfaces = _upload_surfaces(scene.mesh, device)
        self._normals: wp.array = wp.array(normal_table(), dtype=wp.float32, device=device)
        self._decode: wp.array = wp.array(decode_table(), dtype=wp.float32, device=device)
        self._encode: wp.array = wp.array(encode_table(), dtype=wp.float32, device=device)
        self._buffers: dict[int, _Buffers] = {}

    def capture(
        self,
        T_world_camera: ArrayLike,
        index: int,
        timestamp: float | None = None,
        seed: int | None = None,
    ) -> RGBDFrame:
        """Take frame ``index`` from pose ``T_world_camera`` (4, 4).

        Args:
            T_world_camera: pose of the camera.
            index: counter of the noise: the same index and seed give the same noise.
            timestamp: seconds; index / 30 Hz by default.
            seed: of the noise, in place of the sensor's own.

        Raises:
            InputError: a pose that is not a finite rigid motion, or a bad index or seed.
        """
        poses = np.asarray(T_world_camera, dtype=np.float64)[None]
        frame = self.capture_batch(poses, [index], seed)[0]
        if timestamp is None:
            return frame
        return RGBDFrame(frame.color, frame.depth, float(timestamp))

    def capture_batch(
        self,
        T_world_camera: ArrayLike,
        indices: Sequence[int] | NDArray[np.integer],
        seed: int | None = None,
    ) -> list[RGBDFrame]:
        """Take frames ``indices`` (B,) from poses (B, 4, 4) at once.

        Raises:
            InputError: a pose that is not a finite rigid motion, or indices that do not fit.
        """
        poses = np.asarray(T_world_camera, dtype=np.float64)
        if len(poses) != len(indices) or len(poses) == 0:
            raise InputError(f"{len(indices)} frame indices for poses of shape {poses.shape}")
        buffers = self._cast(poses)
        noise_seed = self.seed if seed is None else seed
        keys = np.stack([frame_key(noise_seed, index) for index in indices])
        buffers.keys.assign(keys)
        self._shade(buffers, len(poses), self.noise.shot, self.noise.read)
        self._measure(buffers, len(poses))
        height, width = self.intrinsics.shape
        colors = buffers.color.numpy().reshape(-1, height, width, 3)
        depths = buffers.depth.numpy().reshape(-1, height, width)
        return [
            RGBDFrame(colors[b].copy(), depths[b].copy(), float(index) / FRAME_RATE_HZ)
            for b, index in enumerate(indices)
        ]

    def last_true_depth(self) -> NDArray[np.float32]:
        """True depth (H, W) of the frame that ``capture`` took last, metres; 0 = no surface.

        Costs no second ray cast. Other users of the same sensor overwrite it.

        Raises:
            InputError: nothing was captured yet.
        """
        if 1 not in self._buffers:
            raise InputError("the sensor has captured no frame yet")
        hits = self._buffers[1].hits
        depth = np.where(hits.face.numpy() >= 0, hits.t.numpy(), np.float32(0))
        return depth.reshape(self.intrinsics.shape)

    def ground_truth(self, T_world_camera: ArrayLike) -> TrueView:
        """Noise-free view from pose ``T_world_camera`` (4, 4).

        Raises:
            InputError: a pose that is not a finite rigid motion.
        """
        buffers = self._cast(np.asarray(T_world_camera, dtype=np.float64)[None])
        self._shade(buffers, 1, 0.0, 0.0)
        height, width = self.intrinsics.shape
        count = height * width
        depth = wp.zeros(count, dtype=wp.float32, device=self.device)
        normals = wp.zeros(count, dtype=wp.vec3, device=self.device)
        labels = wp.zeros(count, dtype=wp.int32, device=self.device)
        points = wp.zeros(count, dtype=wp.vec3, device=self.device)
        wp.launch(
            true_geometry,
            dim=(1, height, width),
            inputs=[
                buffers.poses,
                self._camera,
                buffers.hits.t,
                buffers.hits.face,
                self._surfaces,
            ],
            outputs=[depth, normals, labels, points],
            device=self.device,
        )
        return TrueView(
            color=buffers.color.numpy().reshape(height, width, 3).copy(),
            depth=depth.numpy().reshape(height, width),
            normals=normals.numpy().reshape(height, width, 3),
            labels=labels.numpy().reshape(height, width),
            points=points.numpy().reshape(height, width, 3),
        )

    def _cast(self, poses: NDArray[np.float64]) -> _Buffers:
        """Upload the poses (B, 4, 4) and find what their rays hit."""
        for pose in poses:
            check_pose(pose, "T_world_camera")
        batch = len(poses)
        height, width = self.intrinsics.shape
        if batch not in self._buffers:
            self._buffers[batch] = _Buffers(batch, height * width, self.device)
        buffers = self._buffers[batch]
        buffers.poses.assign(poses.astype(np.float32))
        wp.launch(
            generate_rays,
            dim=(batch, height, width),
            inputs=[buffers.poses, self._camera],
            outputs=[buffers.origins, buffers.directions],
            device=self.device,
        )
        self._caster.cast(buffers.origins, buffers.directions, buffers.hits)
        return buffers

    def _shade(self, buffers: _Buffers, batch: int, shot: float, read: float) -> None:
        hits = buffers.hits
        wp.launch(
            shade,
            dim=(batch, *self.intrinsics.shape),
            inputs=[
                buffers.poses,
                self._camera,
                hits.t,
                hits.u,
                hits.v,
                hits.face,
                self._surfaces,
                self.scene.exposure,
                shot,
                read,
                buffers.keys,
                self._normals,
                self._decode,
                self._encode,
            ],
            outputs=[buffers.color],
            device=self.device,
        )

    def _measure(self, buffers: _Buffers, batch: int) -> None:
        hits = buffers.hits
        height, width = self.intrinsics.shape
        if self.noise.shadow:
            wp.launch(
                projector_shadow,
                dim=batch * height,
                inputs=[hits.t, hits.face, width, self._depth_noise],
                outputs=[buffers.shadow],
                device=self.device,
            )
        wp.launch(
            measure_depth,
            dim=(batch, height, width),
            inputs=[
                buffers.poses,
                self._camera,
                hits.t,
                hits.face,
                self._surfaces.normal,
                self._surfaces.plane,
                buffers.shadow,
                self._depth_noise,
                buffers.keys,
                self._normals,
            ],
            outputs=[buffers.depth],
            device=self.device,
        )
