"""Changes from frame to frame in one image's view: moving bodies and light."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env._runtime.warp import wp
from ms_slam_env.scenes.scene import TexturedMesh
from ms_slam_env.sensor.bodies import Body, BodyCast
from ms_slam_env.sensor.casters import RayCaster
from ms_slam_env.sensor.rays import Hits, Pinhole, keep_nearer
from ms_slam_env.sensor.shading import Surfaces

_GATHER = 0.2  # light is sampled this share of the way from a corner to its face's centre
_LIFT_M = 0.006


class ChangingLight(ABC):
    """Light that changes over time.

    Attributes:
        is_added: whether it adds light to the scene's own.
    """

    is_added: bool = True

    @abstractmethod
    def level(self, time_s: float) -> float:
        """Factor > 0 on all of the scene's own light."""

    @abstractmethod
    def added(self, points: Float64, normals: Float64, time_s: float) -> Float32 | None:
        """Additional light (N, 3) at points (N, 3) with unit normals (N, 3); None = nowhere."""


class ChangingView:
    """Changes in the view of a single image; owns the changing surface arrays.

    Attributes:
        surfaces: surfaces of the joined mesh, with private arrays for what changes.
        posed_face: (H * W,) index into ``normal`` and ``plane`` of the face that a pixel sees.
        normal: unit normals; those of bodies' faces once per pose of the image.
        plane: offsets of the faces' planes; those of bodies once per pose.
        exposure_factor: factor on the exposure of the next image.
        first_face: index of the bodies' first face in the joined mesh.
    """

    def __init__(
        self,
        mesh: TexturedMesh,
        bodies: Sequence[Body],
        light: ChangingLight | None,
        casters: Sequence[RayCaster],
        surfaces: Surfaces,
        camera: Pinhole,
        hits: Hits,
        device: str,
    ) -> None:
        """Prepare for one image; ``mesh`` joins those of the scene and the bodies."""
        self._mesh, self._light, self._camera, self._hits = mesh, light, camera, hits
        self._device = device
        self._is_cpu = device == "cpu"
        poses = -(-int(camera.height) // int(camera.rows))
        first = len(mesh.faces) - sum(len(body.mesh.faces) for body in bodies)
        self.first_face, self._moving_faces = first, len(mesh.faces) - first
        self._bodies: list[BodyCast] = []
        at = first
        for body, caster in zip(bodies, casters, strict=True):
            cast = BodyCast(body, caster, at, camera, poses, device)
            self._bodies.append(cast)
            at += len(body.mesh.faces)
        self.surfaces = _copy(surfaces)
        self.surfaces.irradiance = wp.clone(surfaces.irradiance)
        self.posed_face, self.posed = hits.face, self.surfaces
        if bodies:
            self.surfaces.normal = wp.clone(surfaces.normal)
            self.surfaces.plane = wp.clone(surfaces.plane)
            if poses > 1:
                more = poses * self._moving_faces
                self.posed_face = wp.zeros_like(hits.face)
                self.posed = _copy(self.surfaces)
                self.posed.normal = wp.zeros(first + more, dtype=wp.vec3, device=device)
                self.posed.plane = wp.zeros(first + more, dtype=wp.float32, device=device)
                wp.copy(self.posed.normal, surfaces.normal, count=first)
                wp.copy(self.posed.plane, surfaces.plane, count=first)
            middle = slice(poses // 2, poses // 2 + 1)
            self._planes = [(self._rows(self.surfaces.normal, self.surfaces.plane), middle)]
            if poses > 1:
                self._planes.append((self._rows(self.posed.normal, self.posed.plane), slice(None)))
            (self._light_of_bodies,) = self._rows(self.surfaces.irradiance)
        self.exposure_factor = 1.0
        self._lit: NDArray[np.int64] = np.zeros(0, dtype=np.int64)

    def _rows(self, *arrays: wp.array) -> list[_Rows]:
        return [_Rows(array, self.first_face, self._moving_faces) for array in arrays]

    def look(self, cast_scene: Callable[[], None], T: Float64, times_s: Float64) -> None:
        """Cast the image from poses T (P, 4, 4) at times (P,), and update its light."""
        cast_scene()
        middle = float(times_s[len(times_s) // 2])
        if self._bodies:
            self._cast_bodies(T, times_s, middle)
        if self._light is not None:
            self.exposure_factor = float(self._light.level(middle))
            if self._light.is_added:
                self._add_light(self._light, middle)

    def _cast_bodies(self, T: Float64, times_s: Float64, middle: float) -> None:
        if self.posed_face is not self._hits.face:
            wp.copy(self.posed_face, self._hits.face)
        for cast in self._bodies:
            T_world_body = cast.body.pose(times_s)
            if not cast.cast(T, T_world_body):
                continue
            R = T_world_body[:, :3, :3]
            normals = cast.normals @ R.swapaxes(1, 2)
            planes = cast.planes + (normals @ T_world_body[:, :3, 3:])[..., 0]
            faces = slice(cast.faces.start - self.first_face, cast.faces.stop - self.first_face)
            for (normal, plane), poses in self._planes:
                normal.values[:, faces] = normals[poses]
                plane.values[:, faces] = planes[poses]
            self._light_of_bodies.values[:, faces] = _arriving(cast, R[len(R) // 2], middle)
            wp.launch(
                keep_nearer,
                dim=(1, int(self._camera.height), int(self._camera.width)),
                inputs=[self._camera, cast.hits, cast.faces.start, self._moving_faces],
                outputs=[self._hits, self.posed_face],
                device=self._device,
            )
        for (normal, plane), _ in self._planes:
            normal.upload()
            plane.upload()
        self._light_of_bodies.upload()

    def _add_light(self, light: ChangingLight, time_s: float) -> None:
        """Add light to the visible faces, and remove it from those of the last image."""
        static = self._lit[self._lit < self.first_face]
        irradiance = self.surfaces.irradiance.numpy()
        irradiance[static] = self._mesh.irradiance[static]
        seen = np.unique(self._hits.face.numpy())
        self._lit = seen[seen >= 0]
        points, normals = self._gathering_points()
        added = light.added(points, normals, time_s)
        if added is not None:
            irradiance[self._lit] += added.reshape(-1, 3, 3) / self.exposure_factor
        if not self._is_cpu:  # on the CPU the array above shares the memory
            self.surfaces.irradiance.assign(irradiance)

    def _gathering_points(self) -> tuple[Float64, Float64]:
        """Points (3 N, 3) just in front of the lit faces' corners, and normals (3 N, 3)."""
        faces = self._lit
        corners = self._mesh.vertices[self._mesh.faces[faces]].astype(np.float64)
        normal = self.surfaces.normal.numpy()[faces].astype(np.float64)
        for cast in self._bodies:
            is_own = (faces >= cast.faces.start) & (faces < cast.faces.stop)
            T = cast.T_world_body
            corners[is_own] = corners[is_own] @ T[:3, :3].T + T[:3, 3]
        places = (1 - _GATHER) * corners + _GATHER * corners.mean(1, keepdims=True)
        places += _LIFT_M * normal[:, None]
        return places.reshape(-1, 3), np.repeat(normal, 3, axis=0)


class _Rows:
    """The bodies' rows at the end of a surface array, writable as NumPy.

    Attributes:
        values: (P, F, ...) of F faces, once per pose; on the CPU the array itself.
    """

    def __init__(self, array: wp.array, first: int, faces: int) -> None:
        """Select the rows from ``first`` on."""
        self._rows = array[first:]
        rows = self._rows.numpy()
        self.values = rows.reshape(-1, faces, *rows.shape[1:])

    def upload(self) -> None:
        """Copy the written values to the array's device."""
        if not self._rows.device.is_cpu:
            self._rows.assign(self.values.reshape(-1, *self.values.shape[2:]))


def _arriving(cast: BodyCast, R: Float64, time_s: float) -> Float64:
    """Light (F, 3, 3) that arrives at the corners of a body rotated by R (3, 3)."""
    around = cast.body.light(time_s)
    arriving = around[0] + cast.corner_normals @ (R.T @ around[1:])
    return np.maximum(arriving, 0.0) * cast.body.mesh.irradiance


def _copy(surfaces: Surfaces) -> Surfaces:
    copied = Surfaces()
    for name in Surfaces.vars:  # type: ignore[attr-defined]
        setattr(copied, name, getattr(surfaces, name))
    return copied
