"""Rigid bodies that move through the scene during a capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import wp
from ms_slam_env.geometry import invert
from ms_slam_env.scenes.mesh_queries import face_cross
from ms_slam_env.scenes.scene import TexturedMesh
from ms_slam_env.sensor.casters import RayCaster
from ms_slam_env.sensor.rays import Pinhole, make_hits
from ms_slam_env.sensor.textures import face_planes


@dataclass(frozen=True)
class Body:
    """A moving rigid body.

    Attributes:
        label: name of the object it belongs to.
        mesh: mesh in the body's frame; ``irradiance`` is the share of the surrounding light that
            reaches each corner.
        pose: function that returns T_world_body (..., 4, 4) at times (...) in seconds.
        light: function that returns the light (4, 3) around the body at a time: a surface with unit
            normal n (world) receives max(light[0] + n @ light[1:], 0), linear RGB.
    """

    label: str
    mesh: TexturedMesh
    pose: Callable[[Float64], Float64]
    light: Callable[[float], Float64]


def joined(scene: TexturedMesh, bodies: Sequence[Body]) -> TexturedMesh:
    """Join a scene's triangles and, after them, the bodies' in their own frames into one mesh."""
    labels = list(scene.labels)
    meshes = [scene, *(body.mesh for body in bodies)]
    face_labels = [scene.face_label]
    for body in bodies:
        if body.label not in labels:
            labels.append(body.label)
        face_labels.append(np.full(len(body.mesh.faces), labels.index(body.label), dtype=np.int32))
    vertices = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    textures = np.cumsum([0, *(len(mesh.textures) for mesh in meshes)])
    return TexturedMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=_shifted([mesh.faces for mesh in meshes], vertices),
        uv=np.concatenate([mesh.uv for mesh in meshes]),
        face_texture=_shifted([mesh.face_texture for mesh in meshes], textures),
        face_label=np.concatenate(face_labels),
        irradiance=np.concatenate([mesh.irradiance for mesh in meshes]),
        textures=tuple(texture for mesh in meshes for texture in mesh.textures),
        labels=tuple(labels),
    )


def _shifted(indices: list[NDArray[np.int32]], shifts: NDArray[np.int64]) -> NDArray[np.int32]:
    parts = [index + shift for index, shift in zip(indices, shifts, strict=False)]
    return np.concatenate(parts).astype(np.int32)


def corner_normals(mesh: TexturedMesh) -> NDArray[np.float32]:
    """Smooth unit normals (F, 3, 3) at the corners: the mean over the faces that share a vertex."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    face = face_cross(corners)
    total = np.zeros(mesh.vertices.shape)
    for k in range(3):
        np.add.at(total, mesh.faces[:, k], face)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return total[mesh.faces].astype(np.float32)


class BodyCast:
    """Casts the rays of an image in a body's frame.

    Attributes:
        body: the body.
        faces: its faces in the joined mesh.
        normals: (F, 3) unit normals in the body's frame.
        planes: (F,) offsets of the faces' planes in the body's frame.
        corner_normals: (F, 3, 3) smooth unit normals at the corners.
        hits: hits of the last cast.
        T_world_body: (4, 4) at the middle of the last image.
    """

    def __init__(
        self,
        body: Body,
        caster: RayCaster,
        first_face: int,
        camera: Pinhole,
        poses: int,
        device: str,
    ) -> None:
        """Prepare for an image (1, H, W) with ``poses`` poses."""
        self.body = body
        self.faces = slice(first_face, first_face + len(body.mesh.faces))
        self.normals, self.planes = face_planes(body.mesh)
        self.corner_normals = corner_normals(body.mesh)
        shape = 1, int(camera.height), int(camera.width)
        self.hits = make_hits(shape[1] * shape[2], device)
        self._poses = wp.zeros(poses, dtype=wp.mat44, device=device)
        self._cast = caster.bind(self._poses, camera, self.hits, shape)
        low, high = body.mesh.vertices.min(0), body.mesh.vertices.max(0)
        self.T_world_body = np.eye(4)
        self._middle = np.array([*(0.5 * (low + high)), 1.0], dtype=np.float64)
        self._radius = float(np.linalg.norm(body.mesh.vertices - 0.5 * (low + high), axis=1).max())
        self._edges = _frustum(camera)

    def cast(self, T_world_camera: Float64, T_world_body: Float64) -> bool:
        """Cast the rays of poses (P, 4, 4); False without casting if the body is out of view."""
        self.T_world_body = T_world_body[len(T_world_body) // 2]
        T_body_camera = invert(T_world_body) @ T_world_camera
        middle = (invert(T_body_camera) @ self._middle)[:, :3]
        if ((middle @ self._edges.T) < -self._radius).any(axis=1).all():
            return False
        self._poses.assign(T_body_camera.astype(np.float32))
        self._cast()
        return True


def _frustum(camera: Pinhole) -> Float64:
    """Inward unit normals (5, 3) of the planes that bound the image's view."""
    left, right = (np.array([-0.5, camera.width - 0.5]) - camera.cx) / camera.fx
    top, bottom = (np.array([-0.5, camera.height - 0.5]) - camera.cy) / camera.fy
    if camera.bent.shape[0] > 0:
        rays = camera.bent.numpy()
        half = 0.5 / np.array([camera.fx, camera.fy])
        (left, top), (right, bottom) = rays.min(axis=0) - half, rays.max(axis=0) + half
    planes = np.array(
        [
            (0.0, 0.0, 1.0),
            (1.0, 0.0, -left),
            (-1.0, 0.0, right),
            (0.0, 1.0, -top),
            (0.0, -1.0, bottom),
        ]
    )
    return planes / np.linalg.norm(planes, axis=1, keepdims=True)
