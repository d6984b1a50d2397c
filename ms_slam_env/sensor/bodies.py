"""Things that move through the scene while the sensor looks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.scenes.base import TexturedMesh

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Body:
    """A rigid thing that moves.

    Attributes:
        label: name of the object that it is, or is part of.
        mesh: in the body's frame; ``irradiance`` is the share of the light around that reaches a
            corner.
        pose: gives T_world_body (..., 4, 4) at times (...) in seconds.
        light: gives the light (4, 3) around the body at a time: what arrives at a surface with
            unit normal n (world) is max(light[0] + n @ light[1:], 0), linear RGB.
    """

    label: str
    mesh: TexturedMesh
    pose: Callable[[Float64], Float64]
    light: Callable[[float], Float64]


def joined(scene: TexturedMesh, bodies: Sequence[Body]) -> TexturedMesh:
    """The triangles of a scene and, after them, of bodies in their own frames, in one mesh."""
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
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros(mesh.vertices.shape)
    for k in range(3):
        np.add.at(total, mesh.faces[:, k], face)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return total[mesh.faces].astype(np.float32)
