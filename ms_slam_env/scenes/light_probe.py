"""The light around a place in a scene, estimated from what is baked into its surfaces."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes.base import Float64, TexturedMesh
from ms_slam_env.scenes.mesh_queries import face_cross

_REACH_M = (
    1.0  # surfaces count with exp(-(distance / reach)^2), or the nearest ones if none is near
)
_FEWEST = 200.0  # corners' worth of weight
_GLOW = 4.0  # times the median: what is brighter shines by itself
_RIDGE = 0.05  # share of the weight that holds the light's direction back where little tells of it
_MOST_FACES = 60_000


class LightProbe:
    """Fits E(n) = c + n . d, light as a function of a surface's normal, to the surfaces around.

    A sum of light from everywhere and light from one side, as the first two bands of spherical
    harmonics: Ramamoorthi and Hanrahan, "An Efficient Representation for Irradiance Environment
    Maps", SIGGRAPH 2001, keep three.
    """

    def __init__(self, mesh: TexturedMesh) -> None:
        """Sort out the surfaces that tell of the light."""
        step = max(1, len(mesh.faces) // _MOST_FACES)
        corners = mesh.vertices[mesh.faces[::step]].astype(np.float64)
        cross = face_cross(corners)
        area = 0.5 * np.linalg.norm(cross, axis=1)
        light = mesh.irradiance[::step].mean(axis=1).astype(np.float64)  # (F, 3)
        brightness = light.mean(axis=1)
        typical = np.median(brightness[brightness > 0]) if (brightness > 0).any() else 0.0
        # Insides and backs, which no light reaches and no camera sees, tell nothing.
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
        # c is the mean over all directions, not over those that happen to be there.
        full = np.concatenate([np.ones((len(basis), 1)), basis], axis=1)
        B = (full * weight[:, None]).T @ full
        B[1:, 1:] = A
        solution = np.linalg.solve(B, (full * weight[:, None]).T @ self._light)
        c = np.clip(solution[0], 0.3 * mean, 2.0 * mean)
        d = solution[1:]
        longest = np.linalg.norm(d, axis=0)
        d *= np.minimum(1.0, 0.8 * c / np.maximum(longest, 1e-12))
        return np.concatenate([c[None], d])
