"""Mip pyramids of a mesh's textures, packed into one array, and the sRGB tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32
from ms_slam_env.scenes.lighting import linear_to_srgb, srgb_to_linear
from ms_slam_env.scenes.mesh_queries import face_cross
from ms_slam_env.scenes.scene import TexturedMesh

ENCODE_STEPS = 4096
"""Intervals of the linear-to-sRGB table."""


def decode_table() -> Float32:
    """Linear intensity (257,) of the 8-bit sRGB values 0 to 255, the last one repeated."""
    table = srgb_to_linear(np.arange(256) / 255.0)
    return np.append(table, table[-1]).astype(np.float32)


def encode_table() -> Float32:
    """8-bit sRGB value, not rounded, at i / ENCODE_STEPS, the last one repeated."""
    table = 255.0 * linear_to_srgb(np.arange(ENCODE_STEPS + 1) / ENCODE_STEPS)
    return np.append(table, table[-1]).astype(np.float32)


def mip_levels(texture: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """Pyramid of an sRGB texture (h, w, 3) down to a side of 1, averaged in linear light."""
    levels = [np.ascontiguousarray(texture)]
    linear: NDArray[Any] = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)[texture]
    while min(linear.shape[:2]) > 1:
        size = (linear.shape[1] // 2, linear.shape[0] // 2)
        linear = cv2.resize(linear, size, interpolation=cv2.INTER_AREA)
        encoded = 255.0 * linear_to_srgb(linear.astype(np.float64))
        levels.append(np.rint(encoded).astype(np.uint8))
    return levels


@dataclass(frozen=True)
class PackedTextures:
    """All levels of all textures in one array.

    Attributes:
        texels: (N,) uint32, r | g << 8 | b << 16, sRGB.
        offsets: (T, L) int32 start of each level in ``texels``.
        sizes: (T, 3) int32 width and height of level 0, number of levels.
    """

    texels: NDArray[np.uint32]
    offsets: NDArray[np.int32]
    sizes: NDArray[np.int32]


def pack_textures(textures: tuple[NDArray[np.uint8], ...]) -> PackedTextures:
    """Build the pyramids and pack them."""
    pyramids = [mip_levels(texture) for texture in textures]
    offsets = np.zeros((len(pyramids), max(len(p) for p in pyramids)), dtype=np.int32)
    blocks: list[NDArray[np.uint32]] = []
    position = 0
    for t, pyramid in enumerate(pyramids):
        for level, image in enumerate(pyramid):
            c = image.astype(np.uint32)
            packed = c[..., 0] | c[..., 1] << 8 | c[..., 2] << 16
            blocks.append(packed.astype(np.uint32).ravel())
            offsets[t, level] = position
            position += len(blocks[-1])
    sizes = np.array([(p[0].shape[1], p[0].shape[0], len(p)) for p in pyramids], dtype=np.int32)
    return PackedTextures(np.concatenate(blocks), offsets, sizes)


def face_planes(mesh: TexturedMesh) -> tuple[Float32, Float32]:
    """Unit normal n (F, 3) and offset n . x (F,) of each face's plane, positive outside."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = face_cross(corners)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    offsets = np.einsum("fd,fd->f", normals, corners[:, 0])
    return normals.astype(np.float32), offsets.astype(np.float32)


def texel_density(mesh: TexturedMesh) -> Float32:
    """Level-0 texels per metre (F,) on each face: square root of the ratio of the two areas."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(face_cross(corners), axis=1)
    sizes = np.array([texture.shape[1::-1] for texture in mesh.textures], dtype=np.float64)
    uv = mesh.uv.astype(np.float64) * sizes[mesh.face_texture][:, None]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area_texels = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return np.sqrt(area_texels / np.maximum(area, 1e-20)).astype(np.float32)
