"""Baked light: lamps, windows and sun with shadows, and one diffuse bounce.

Irradiance 1.0 gives a white diffuse surface the radiance 1.0, so it is the physical irradiance
divided by pi.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.scenes.builder import Geometry, MeshBuilder
from ms_slam_env.scenes.mesh_queries import RayCaster, face_cross
from ms_slam_env.scenes.scene import TexturedMesh

_FAR_M = 100.0
_SHADOW_END = 0.999  # a shadow ray stops just before the light, which may be a surface itself


class Light(ABC):
    """A light source."""

    @abstractmethod
    def irradiance(self, points: Float64, normals: Float64, rays: RayCaster) -> Float32:
        """Light (N, 3) arriving at points (N, 3) with unit normals (N, 3), shadows included."""


@dataclass(frozen=True)
class Lamp(Light):
    """A small glowing ball.

    Attributes:
        position: (3,) metres.
        intensity: (3,) linear RGB; arrives as intensity * cos / r^2.
        radius_m: radius of the ball, which softens shadows; 0 is a point light.
        samples: shadow rays per point.
    """

    position: tuple[float, float, float]
    intensity: tuple[float, float, float]
    radius_m: float = 0.0
    samples: int = 1

    def irradiance(self, points: Float64, normals: Float64, rays: RayCaster) -> Float32:
        """See the base class."""
        total = np.zeros(len(points), np.float32)
        for offset in _ball(self.samples):
            source = np.asarray(self.position) + self.radius_m * offset
            total += _point_light(points, normals, source, rays)
        return _tint((total / self.samples).astype(np.float32), self.intensity)


@dataclass(frozen=True)
class Panel(Light):
    """A parallelogram that emits diffusely from its front, such as a window or a ceiling panel.

    Attributes:
        origin: (3,) a corner, metres.
        edge_u: (3,) one side; the front faces edge_u x edge_v.
        edge_v: (3,) the other side.
        radiance: (3,) linear RGB.
        grid: samples along edge_u and edge_v.
    """

    origin: tuple[float, float, float]
    edge_u: tuple[float, float, float]
    edge_v: tuple[float, float, float]
    radiance: tuple[float, float, float]
    grid: tuple[int, int] = (2, 2)

    def irradiance(self, points: Float64, normals: Float64, rays: RayCaster) -> Float32:
        """See the base class: 1/pi times the integral of L cos cos' / r^2 over the panel."""
        o, u, v = (np.asarray(x) for x in (self.origin, self.edge_u, self.edge_v))
        front = np.cross(u, v)
        area = float(np.linalg.norm(front))
        front = front / area
        total = np.zeros(len(points), np.float32)
        nu, nv = self.grid
        for i in range(nu):
            for j in range(nv):
                source = o + (i + 0.5) / nu * u + (j + 0.5) / nv * v
                total += _point_light(points, normals, source, rays, front)
        return _tint(total * (area / (nu * nv) / np.pi), self.radiance)


@dataclass(frozen=True)
class RoomLight(Light):
    """A light in one room of several; beyond the room it fades out.

    Attributes:
        light: the source.
        low: (3,) lower corner of its room, metres.
        high: (3,) upper corner.
        reach_m: distance from the room at which the light has faded out.
    """

    light: Light
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    reach_m: float = 2.0

    def irradiance(self, points: Float64, normals: Float64, rays: RayCaster) -> Float32:
        """See the base class."""
        nearest = np.clip(points, self.low, self.high)
        share = 1.0 - np.linalg.norm(points - nearest, axis=1) / self.reach_m
        near = np.flatnonzero(share > 0)
        total = np.zeros((len(points), 3), np.float32)
        total[near] = self.light.irradiance(points[near], normals[near], rays)
        total[near] *= share[near, None].astype(np.float32)
        return total


@dataclass(frozen=True)
class Sun(Light):
    """Parallel light.

    Attributes:
        towards_sun: (3,) direction from the scene to the sun.
        strength: (3,) linear RGB irradiance on a surface that faces it.
    """

    towards_sun: tuple[float, float, float]
    strength: tuple[float, float, float]

    def irradiance(self, points: Float64, normals: Float64, rays: RayCaster) -> Float32:
        """See the base class."""
        direction = np.asarray(self.towards_sun) / np.linalg.norm(self.towards_sun)
        total = np.zeros(len(points), np.float32)
        lit, value = _from_afar(points, normals, direction, rays)
        total[lit] = value
        return _tint(total, self.strength)


@dataclass(frozen=True)
class SkyLight(Light):
    """Light of an open sky, uniform above the horizon.

    Attributes:
        radiance: (3,) linear RGB.
        rays: number of directions in which each point tests for the sky.
    """

    radiance: tuple[float, float, float]
    rays: int = 24

    def irradiance(self, points: Float64, normals: Float64, rays: RayCaster) -> Float32:
        """See the base class: 1/pi times the integral of L cos over the open part of the sky."""
        total = np.zeros(len(points), np.float32)
        k = np.arange(self.rays) + 0.5
        up, angle = k / self.rays, np.pi * (1 + 5**0.5) * k  # uniform over the upper hemisphere
        side = np.sqrt(1 - up * up)
        for direction in np.stack([side * np.cos(angle), side * np.sin(angle), up], -1):
            lit, value = _from_afar(points, normals, direction, rays)
            total[lit] += value
        return _tint((total * (2.0 / self.rays)).astype(np.float32), self.radiance)


@dataclass(frozen=True)
class Lighting:
    """All light of a scene.

    Attributes:
        lights: the sources.
        glow: (3,) irradiance by label of self-luminous surfaces (window panes, lamp shades,
            screens); light passes through the labels in ``clear``.
        clear: labels that cast no shadow.
        ambient: (3,) linear RGB light from all directions, in addition to the sources.
        bounce_rays: number of directions in which each point gathers reflected light.
        bounce_gain: factor on the one bounce that accounts for further ones.
    """

    lights: tuple[Light, ...]
    glow: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    clear: frozenset[str] = frozenset()
    ambient: tuple[float, float, float] = (0.1, 0.1, 0.1)
    bounce_rays: int = 24
    bounce_gain: float = 2.2


def light_mesh(geometry: Geometry, lighting: Lighting) -> TexturedMesh:
    """Bake ``lighting`` into the irradiance of every face corner."""
    g = geometry
    blocks = np.array([name not in lighting.clear for name in g.labels])[g.face_label]
    rays = RayCaster(g.vertices, g.faces[blocks])
    direct = np.zeros((len(g.vertices), 3), np.float32)
    for light in lighting.lights:
        direct += light.irradiance(g.light_points, g.normals, rays)
    total = direct + _bounce(g, direct, lighting)
    corner = total[g.faces]  # (F, 3, 3)
    for name, value in lighting.glow.items():
        if name in g.labels:
            corner[g.face_label == g.labels.index(name)] = value
    return g.lit(corner)


def light_and_expose(
    build: MeshBuilder, lighting: Lighting, focus: Float64, key: float
) -> tuple[TexturedMesh, float]:
    """Bake ``lighting`` into the mesh; return it and the exposure for non-glowing surfaces."""
    mesh = light_mesh(build.build(), lighting)
    return mesh, auto_exposure(mesh, focus, key, frozenset(lighting.glow))


def _bounce(g: Geometry, direct: Float32, lighting: Lighting) -> Float32:
    """Light (V, 3) that arrives by one reflection, and ambient light where rays miss.

    All points use the same directions in their tangent frames, so that sampling error varies
    smoothly over a surface instead of causing speckle.
    """
    rays = RayCaster(g.vertices, g.faces)
    albedo = mean_albedo(g.textures)[g.face_texture]  # (F, 3)
    leaving = albedo * direct[g.faces].mean(1)
    # A few rays sample small sunlit patches badly: limit the contribution of one ray.
    leaving = np.minimum(leaving, 4.0 * leaving.mean(0))
    for name, value in lighting.glow.items():
        if name in g.labels:
            of = g.face_label == g.labels.index(name)
            # The lights already represent glowing surfaces; only their appearance remains.
            leaving[of] = 0.0 if name in lighting.clear else 0.2 * albedo[of] * np.array(value)
    leaving = np.concatenate([leaving, np.zeros((1, 3))]).astype(np.float32)  # a miss adds nothing
    gathered = np.zeros((len(g.vertices), 3), np.float32)
    openness = np.zeros(len(g.vertices), np.float32)
    for directions in hemispheres(g.normals, lighting.bounce_rays):
        distance, face = rays.first_hit(g.light_points, directions)
        gathered += leaving[face]
        openness += np.minimum(distance, 0.8) / 0.8
    gathered *= lighting.bounce_gain / lighting.bounce_rays
    openness /= lighting.bounce_rays
    return gathered + openness[:, None] * np.asarray(lighting.ambient, np.float32)


def mean_albedo(textures: tuple[NDArray[np.uint8], ...]) -> Float32:
    """Mean linear albedo (T, 3) of each texture, from a sparse grid of its texels."""
    table = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    return np.stack(
        [
            table[t[:: max(1, t.shape[0] // 32), :: max(1, t.shape[1] // 32)]].mean((0, 1))
            for t in textures
        ]
    )


def srgb_to_linear(value: Float64) -> Float64:
    """Convert sRGB values in [0, 1] to linear light (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: Float64) -> Float64:
    """Convert linear intensities in [0, 1] to sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)


def auto_exposure(mesh: TexturedMesh, points: Float64, key: float, skip: frozenset[str]) -> float:
    """Exposure that maps the median radiance to ``key``.

    Args:
        mesh: lit mesh.
        points: (K, 3) where cameras look; faces are weighted by area and nearness to these.
        key: linear sensor value of the median, 0.18 for mid grey.
        skip: labels to leave out, such as panes and lamps.
    """
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(face_cross(corners), axis=1)
    centre = corners.mean(1)
    nearest = np.min(np.linalg.norm(centre[:, None] - points[None], axis=2), axis=1)
    weight = area * np.exp(-((nearest / 2.0) ** 2))
    weight[np.isin(mesh.face_label, [k for k, n in enumerate(mesh.labels) if n in skip])] = 0.0
    radiance = (mean_albedo(mesh.textures)[mesh.face_texture] * mesh.irradiance.mean(1)).mean(1)
    weight[radiance < 0.05 * radiance.mean()] = 0.0  # backs and insides that no camera sees
    order = np.argsort(radiance)
    middle = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    return float(key / radiance[order[middle]])


def _from_afar(
    points: Float64, normals: Float64, direction: Float64, rays: RayCaster
) -> tuple[NDArray[np.int64], Float64]:
    """Indices (L,) of points facing a direction (3,), and their cosines to it, 0 in shadow."""
    cosine = normals @ direction
    facing = np.flatnonzero(cosine > 0)
    towards = np.broadcast_to(direction * _FAR_M, (len(facing), 3))
    distance, _ = rays.first_hit(points[facing], towards)
    return facing, cosine[facing] * (distance > 1.0)


def _point_light(
    points: Float64,
    normals: Float64,
    source: Float64,
    rays: RayCaster,
    front: Float64 | None = None,
) -> Float32:
    """Return cos / r^2 (N,), times cos' if the source has a ``front``, 0 in shadow."""
    to_light = source - points
    square = np.einsum("ij,ij->i", to_light, to_light)
    cosine = np.einsum("ij,ij->i", to_light, normals) / np.sqrt(square)
    value = np.maximum(cosine, 0.0) / np.maximum(square, 0.01)
    if front is not None:
        value *= np.maximum(-(to_light @ front) / np.sqrt(square), 0.0)
    lit = np.flatnonzero(value > 1e-5)
    distance, _ = rays.first_hit(points[lit], to_light[lit])
    result = np.zeros(len(points), np.float32)
    result[lit] = value[lit] * (distance > _SHADOW_END)
    return result


def _tint(value: NDArray[np.float32], rgb: tuple[float, float, float]) -> Float32:
    return value[:, None] * np.asarray(rgb, np.float32)


def _ball(n: int) -> Float64:
    """Points (n, 3) spread over the unit sphere; one point is its centre."""
    if n == 1:
        return np.zeros((1, 3))
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)


def hemispheres(normals: Float64, n: int) -> Iterator[Float64]:
    """The ``n`` directions (V, 3) of :func:`cosine_directions` around normals (V, 3)."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(helper, normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    bitangent = np.cross(normals, tangent)
    for x, y, z in cosine_directions(n):
        yield x * tangent + y * bitangent + z * normals


def cosine_directions(n: int) -> Float64:
    """Directions (n, 3) of the upper half sphere, density proportional to the cosine."""
    u = qmc.Halton(2, scramble=False).random(n + 1)[1:]
    r, angle = np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    return np.stack([r * np.cos(angle), r * np.sin(angle), np.sqrt(1 - u[:, 0])], -1)
