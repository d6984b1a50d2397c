"""One moving body as one image sees it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.geometry import invert
from ms_slam_env.sensor.bodies import Body, corner_normals
from ms_slam_env.sensor.casters import Hits, RayCaster
from ms_slam_env.sensor.rays import Pinhole
from ms_slam_env.sensor.textures import face_planes

Float64 = NDArray[np.float64]


class BodyCast:
    """Casts the rays of an image in the frame of a body.

    Attributes:
        body: the body.
        faces: its faces in the joined mesh.
        normals: (F, 3) unit normals in the body's frame.
        planes: (F,) offsets of the faces' planes, likewise.
        corner_normals: (F, 3, 3) smooth ones.
        hits: what the last cast met.
        T_world_body: (4, 4) in the middle of the image that was cast last.
    """

    def __init__(
        self,
        body: Body,
        caster: RayCaster,
        first_face: int,
        camera: Pinhole,
        shape: tuple[int, int, int],
        poses: int,
        device: str,
    ) -> None:
        """Prepare for an image (1, H, W) with so many poses."""
        self.body = body
        self.faces = slice(first_face, first_face + len(body.mesh.faces))
        self.normals, self.planes = face_planes(body.mesh)
        self.corner_normals = corner_normals(body.mesh)
        self.hits = Hits(shape, device)
        self._poses = wp.zeros(poses, dtype=wp.mat44, device=device)
        self._cast = caster.bind(self._poses, camera, self.hits)
        low, high = body.mesh.vertices.min(0), body.mesh.vertices.max(0)
        self.T_world_body = np.eye(4)
        self._middle = np.array([*(0.5 * (low + high)), 1.0], dtype=np.float64)
        self._radius = float(np.linalg.norm(body.mesh.vertices - 0.5 * (low + high), axis=1).max())
        self._edges = _frustum(camera)

    def cast(self, T_world_camera: Float64, T_world_body: Float64) -> bool:
        """Cast the rays of poses (P, 4, 4); False, and no rays, if the body is out of sight."""
        self.T_world_body = T_world_body[len(T_world_body) // 2]
        T_body_camera = invert(T_world_body) @ T_world_camera
        middle = (invert(T_body_camera) @ self._middle)[:, :3]
        if ((middle @ self._edges.T) < -self._radius).any(axis=1).all():
            return False
        self._poses.assign(T_body_camera.astype(np.float32))
        self._cast()
        return True


def _frustum(camera: Pinhole) -> Float64:
    """Inward unit normals (5, 3) of the planes that bound what an image sees."""
    left, right = -0.5 - camera.cx, camera.width - 0.5 - camera.cx
    top, bottom = -0.5 - camera.cy, camera.height - 0.5 - camera.cy
    planes = np.array(
        [
            (0.0, 0.0, 1.0),
            (1.0, 0.0, -left / camera.fx),
            (-1.0, 0.0, right / camera.fx),
            (0.0, 1.0, -top / camera.fy),
            (0.0, -1.0, bottom / camera.fy),
        ]
    )
    return planes / np.linalg.norm(planes, axis=1, keepdims=True)
