"""Moving objects made of rigid parts, some of which swing or roll as the object moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.scenes.builder import Geometry, MeshBuilder
from ms_slam_env.scenes.lighting import hemispheres
from ms_slam_env.scenes.mesh_queries import RayCaster
from ms_slam_env.scenes.scene import Rng, TexturedMesh
from ms_slam_env.scenes.textures import pictures
from ms_slam_env.scenes.textures.noise import grain, hsv

_OPENNESS_RAYS = 24
_DARKEST = 0.25  # share of the surrounding light where none arrives directly


@dataclass(frozen=True)
class Joint:
    """Motion of a part in the object's frame as the object moves ``s`` metres.

    Its angle is swing_rad * sin(2 pi s / stride_m + phase_rad) + s * roll_rad_m.

    Attributes:
        pivot: (3,) a point on the axis, in the object's frame.
        axis: (3,) unit vector.
        swing_rad: amplitude of the swing.
        stride_m: distance per full swing.
        phase_rad: phase of the swing at s = 0.
        roll_rad_m: rolling angle per metre.
    """

    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    swing_rad: float = 0.0
    stride_m: float = 1.0
    phase_rad: float = 0.0
    roll_rad_m: float = 0.0

    def pose(self, s: Float64) -> Float64:
        """T_whole_part (..., 4, 4) after travelled distances (...) in metres."""
        angle = self.swing_rad * np.sin(2 * np.pi * s / self.stride_m + self.phase_rad)
        angle = np.asarray(angle + s * self.roll_rad_m)
        turns = np.asarray(self.axis) * angle.reshape(-1, 1)
        T = np.zeros((*angle.shape, 4, 4))
        T[..., :3, :3] = Rotation.from_rotvec(turns).as_matrix().reshape(*angle.shape, 3, 3)
        T[..., :3, 3] = self.pivot - T[..., :3, :3] @ np.asarray(self.pivot)
        T[..., 3, 3] = 1.0
        return T


@dataclass(frozen=True)
class Part:
    """A rigid part.

    Attributes:
        mesh: mesh in the object's frame at angle 0; ``irradiance`` is the share of the surrounding
            light that reaches each corner.
        joint: how it moves in that frame.
    """

    mesh: TexturedMesh
    joint: Joint


@dataclass(frozen=True)
class Shape:
    """A moving object: x points ahead, z up.

    Attributes:
        kind: kind of object.
        parts: its parts.
        radius_m: radius of the enclosing circle about the z axis.
        length_m: extent along the direction of travel, centred at the origin.
        width_m: extent across it, centred at the origin.
        height_m: extent above the origin.
        depth_m: extent below the origin; 0 for objects that stand on the ground.
    """

    kind: str
    parts: tuple[Part, ...]
    radius_m: float
    length_m: float
    width_m: float
    height_m: float
    depth_m: float = 0.0


Piece = tuple[Callable[[MeshBuilder], None], Joint]
"""A function that adds a part's patches to a builder, and the part's joint."""


def assemble(pieces: list[Piece], cell_m: float, ground_z: float | None = 0.0) -> tuple[Part, ...]:
    """Build the parts, with the occlusion of each corner by the others and the ground."""
    geometries = []
    for add, _ in pieces:
        builder = MeshBuilder(cell_m)
        with builder.object("part"):
            add(builder)
        geometries.append(builder.build())
    counts = np.cumsum([0, *(len(g.vertices) for g in geometries)])
    rays = RayCaster(
        np.concatenate([g.vertices for g in geometries]),
        np.concatenate([g.faces + n for g, n in zip(geometries, counts[:-1], strict=True)]),
    )
    return tuple(
        Part(g.lit(_openness(g, rays, ground_z)), joint)
        for g, (_, joint) in zip(geometries, pieces, strict=True)
    )


def _openness(g: Geometry, rays: RayCaster, ground_z: float | None) -> Float32:
    """Share (F, 3, 3) of cosine-weighted directions from which light reaches each corner."""
    total = np.zeros(len(g.vertices), np.float32)
    for direction in hemispheres(g.normals, _OPENNESS_RAYS):
        distance, _ = rays.first_hit(g.light_points, direction)
        arrives = np.minimum(distance, 1.0)
        if ground_z is not None:  # near the ground less light comes from below
            height = g.light_points[:, 2] - ground_z
            arrives = np.where(direction[:, 2] < 0, arrives * np.clip(height, 0.2, 1.0), arrives)
        total += arrives
    openness = (_DARKEST + (1 - _DARKEST) * total / _OPENNESS_RAYS).astype(np.float32)
    return np.repeat(openness[g.faces][..., None], 3, axis=2)


_SIZE_M = (0.18, 0.36)  # of a side
_SIDES = "xXyYzZ"


def box(rng: Rng, size_m: tuple[float, float, float] | None = None) -> Shape:
    """Cardboard box with prints, labels and tape; its origin is its centre.

    Args:
        rng: draws colours, prints and omitted values.
        size_m: size along x, y and z.
    """
    half = 0.5 * np.array(size_m if size_m is not None else rng.uniform(*_SIZE_M, 3))
    paper = hsv(rng.uniform(0.06, 0.11), rng.uniform(0.3, 0.55), rng.uniform(0.55, 0.8))

    def add(build: MeshBuilder) -> None:
        for side in _SIDES:
            cardboard = build.material(_side(rng, paper), None)
            build.box(-half, half, cardboard, skip=_SIDES.replace(side, ""))

    parts = assemble([(add, Joint())], cell_m=0.1, ground_z=None)
    x, y, z = map(float, half)
    return Shape("box", parts, float(np.linalg.norm(half)), 2 * x, 2 * y, z, z)


def _side(rng: Rng, paper: np.ndarray, size: int = 256) -> np.ndarray:
    """One side: a print, one or two labels, tape across the middle."""
    image = np.broadcast_to(paper, (size, size, 3)).astype(np.float32).copy()
    for _ in range(int(rng.integers(1, 4))):
        h, w = (int(rng.uniform(0.2, 0.5) * size) for _ in range(2))
        y, x = int(rng.uniform(0.03, 0.97) * (size - h)), int(rng.uniform(0.03, 0.97) * (size - w))
        draw = pictures.page if rng.random() < 0.5 else pictures.cover
        image[y : y + h, x : x + w] = draw(rng, h, w)
    tape = size // 2
    image[tape - size // 24 : tape + size // 24] = 0.8 * image[tape - size // 24] + 40.0
    return grain(rng, image, (size, size), (0.06, 0.6), (0.05, 1.3))
