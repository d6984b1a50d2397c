"""Ray casting and surface sampling of a triangle mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.extension import load_reference
from ms_slam_env.scenes.scene import TexturedMesh

_WITHOUT_EMBREE = "ms_slam_env.scenes.warp_queries:WarpScene"


class RayCaster:
    """An Embree scene of one mesh, or Warp's where embreex is missing; cheap to rebuild."""

    def __init__(self, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> None:
        """Build the hierarchy of ``vertices`` (V, 3) and ``faces`` (F, 3)."""
        corners = np.ascontiguousarray(vertices, dtype=np.float32)
        indices = np.ascontiguousarray(faces, dtype=np.int32)
        try:
            from embreex import rtcore_scene
            from embreex.mesh_construction import TriangleMesh
        except ImportError:
            self._scene = load_reference(_WITHOUT_EMBREE)(corners, indices)
        else:
            self._scene = rtcore_scene.EmbreeScene()
            self._mesh = TriangleMesh(self._scene, corners, indices)

    def first_hit(
        self, origins: Float64, directions: Float64
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return distances (N,), inf without a hit, and faces (N,), -1 without a hit.

        Distances are in units of the length of ``directions`` (N, 3), which need not be 1.
        """
        hit = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            output=1,
        )
        face = np.asarray(hit["primID"], dtype=np.int32)
        return np.where(face >= 0, hit["tfar"], np.inf).astype(np.float32), face


_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])  # R2 low-discrepancy sequence


def face_cross(corners: NDArray[np.floating]) -> NDArray[Any]:
    """Normals (F, 3) with length twice the area, of faces with corners (F, 3, 3)."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def sample_surface(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], spacing_m: float
) -> tuple[Float64, NDArray[np.int64]]:
    """Points (N, 3), one per ``spacing_m`` squared of area, and the face (N,) each lies on.

    Triangles are visited by index, and each gets points in exact proportion to its area. Positions
    inside follow the R2 sequence, so points spread evenly.
    """
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.linalg.norm(np.cross(e1, e2), axis=1)
    total = np.cumsum(area)
    n = max(1, int(total[-1] / spacing_m**2))
    face = np.searchsorted(total, (np.arange(n) + 0.5) * (total[-1] / n))
    face = np.minimum(face, len(faces) - 1)
    r = np.mod(np.arange(1, n + 1)[:, None] * _PLASTIC, 1.0)
    fold = r.sum(1) > 1.0
    r[fold] = 1.0 - r[fold]
    return corners[face, 0] + r[:, :1] * e1[face] + r[:, 1:] * e2[face], face


_REACH_M = (
    1.0  # surfaces have weight exp(-(distance / reach)^2); the nearest ones count if none is near
)
_FEWEST = 200.0  # least weight, in corners
_GLOW = 4.0  # times the median; brighter surfaces are light sources
_RIDGE = 0.05  # regularises the light's direction where there is little evidence
_MOST_FACES = 60_000


class LightProbe:
    """Fits E(n) = c + n . d, light as a function of the surface normal, to nearby surfaces.

    The sum of uniform and one-sided light, like the first two bands of spherical harmonics:
    Ramamoorthi and Hanrahan, "An Efficient Representation for Irradiance Environment Maps",
    SIGGRAPH 2001, keep three.
    """

    def __init__(self, mesh: TexturedMesh) -> None:
        """Select the surfaces that carry information about the light."""
        step = max(1, len(mesh.faces) // _MOST_FACES)
        corners = mesh.vertices[mesh.faces[::step]].astype(np.float64)
        cross = face_cross(corners)
        area = 0.5 * np.linalg.norm(cross, axis=1)
        light = mesh.irradiance[::step].mean(axis=1).astype(np.float64)  # (F, 3)
        brightness = light.mean(axis=1)
        typical = np.median(brightness[brightness > 0]) if (brightness > 0).any() else 0.0
        # Insides and backs, which receive no light and are never seen, carry no information.
        is_used = (area > 0) & (brightness > 0.05 * typical) & (brightness < _GLOW * typical)
        self._centres = corners[is_used].mean(axis=1)
        self._normals = cross[is_used] / (2 * area[is_used, None])
        self._areas = area[is_used]
        self._light = light[is_used]

    def around(self, point: Float64) -> Float64:
        """Light (4, 3) around a point (3,): c and the three rows of d, linear RGB."""
        if not len(self._areas):
            return np.concatenate([np.ones((1, 3)), np.zeros((3, 3))])
        square = ((self._centres - point) ** 2).sum(axis=1)
        reach = _REACH_M**2
        for _ in range(20):
            weight = self._areas * np.exp(-(square - square.min()) / reach)
            if weight.sum() > _FEWEST * self._areas.min():
                break
            reach *= 2.0
        weight /= weight.sum()
        mean = weight @ self._light
        basis = self._normals
        A = (basis * weight[:, None]).T @ basis + _RIDGE * np.eye(3)
        # c is the mean over all directions, not only over those of the surfaces.
        full = np.concatenate([np.ones((len(basis), 1)), basis], axis=1)
        B = (full * weight[:, None]).T @ full
        B[1:, 1:] = A
        solution = np.linalg.solve(B, (full * weight[:, None]).T @ self._light)
        c = np.clip(solution[0], 0.3 * mean, 2.0 * mean)
        d = solution[1:]
        longest = np.linalg.norm(d, axis=0)
        d *= np.minimum(1.0, 0.8 * c / np.maximum(longest, 1e-12))
        return np.concatenate([c[None], d])
