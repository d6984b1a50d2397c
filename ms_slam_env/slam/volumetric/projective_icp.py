"""Point-to-plane alignment of a depth image with a model's view, by projective association.

Newcombe et al., "KinectFusion" (ISMAR 2011), section 3.5: a point of the frame is transformed into
the model's camera and projected; its distance to the plane at the point it lands on is minimised,

    E = sum (n . (T v - m))^2    over |T v - m| < distance_m and R n_v . n > cos_angle

linearised with T <- exp(xi) T, coarse to fine. No intensity, no weights, no robust loss.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.frame import reduce_depth
from ms_slam_env.geometry import se3_exp
from ms_slam_env.slam.volumetric.voxel_grid import CastView, smooth_depth

_SMOOTHING_M = 0.1  # range of the bilateral depth filter, as in SLAMBench
_FEWEST_POINTS = 50


@dataclass(frozen=True)
class Surface:
    """Points and normals of an image's pixels in the camera's frame, on the device.

    Attributes:
        points: (h, w) vec3 metres.
        normals: (h, w) vec3 facing the camera; 0 where there is none.
    """

    points: wp.array
    normals: wp.array

    @staticmethod
    def of(points: Float64 | Float32, normals: Float64 | Float32) -> Surface:
        """Upload points and normals (h, w, 3)."""
        arrays = (np.ascontiguousarray(each, dtype=np.float32) for each in (points, normals))
        return Surface(*(wp.array(each, dtype=wp.vec3, device="cpu") for each in arrays))


def frame_pyramid(depth: Float32, intrinsics: Intrinsics, levels: int) -> list[Surface]:
    """Filter depth (H, W) in metres and build a pyramid, finest first, each level half the size."""
    filtered = smooth_depth(depth, depth > 0, _SMOOTHING_M)
    made = []
    for level in range(levels):
        K = intrinsics
        if level:
            K = intrinsics.resized(*intrinsics.level_size(level))
            filtered = reduce_depth(filtered, (K.width, K.height))
        points = K.rays() * filtered[..., None]
        made.append(Surface.of(points, _normals(points, filtered > 0)))
    return made


def model_surface(view: CastView, intrinsics: Intrinsics) -> Surface:
    """Convert a view of the model to a surface."""
    return Surface.of(intrinsics.rays() * view.depth[..., None], view.normals)


def _normals(points: Float64, valid: Any) -> Float64:
    """Normals (h, w, 3) of a point grid by central differences; 0 if a neighbour is missing."""
    normals = np.zeros_like(points)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    found = np.cross(down, across)  # x right, y down, z forward: faces the camera
    length = np.linalg.norm(found, axis=-1, keepdims=True)
    whole = valid[1:-1, 1:-1] & valid[1:-1, 2:] & valid[1:-1, :-2] & valid[2:, 1:-1]
    whole &= valid[:-2, 1:-1] & (length[..., 0] > 0)
    normals[1:-1, 1:-1] = np.where(whole[..., None], found / np.maximum(length, 1e-12), 0)
    return normals


@wp.kernel
def _accumulate(
    live_points: wp.array2d[wp.vec3],
    live_normals: wp.array2d[wp.vec3],
    model_points: wp.array2d[wp.vec3],
    model_normals: wp.array2d[wp.vec3],
    R: wp.mat33,
    t: wp.vec3,
    focal: wp.vec2,
    centre: wp.vec2,
    distance_m: float,
    cos_angle: float,
    hessian: wp.array[wp.spatial_matrix],
    gradient: wp.array[wp.spatial_vector],
    counts: wp.array[wp.vec2],
) -> None:
    """Sum the terms of one row; ``counts`` holds inliers and their squared residuals."""
    row = wp.tid()
    H = wp.spatial_matrix()
    g = wp.spatial_vector()
    found = wp.vec2()
    for column in range(live_points.shape[1]):
        normal = live_normals[row, column]
        if wp.dot(normal, normal) > 0.5:
            p = R * live_points[row, column] + t
            if p[2] > 0.05:
                u = int(wp.floor(focal[0] * p[0] / p[2] + centre[0] + 0.5))
                v = int(wp.floor(focal[1] * p[1] / p[2] + centre[1] + 0.5))
                if u >= 0 and v >= 0 and u < model_points.shape[1] and v < model_points.shape[0]:
                    n = model_normals[v, u]
                    gap = model_points[v, u] - p
                    is_near = wp.length(gap) < distance_m and wp.dot(n, R * normal) > cos_angle
                    if is_near and wp.dot(n, n) > 0.5:
                        r = wp.dot(n, gap)
                        J = wp.spatial_vector(n, wp.cross(p, n))
                        H += wp.outer(J, J)
                        g += J * r
                        found[0] += 1.0
                        found[1] += r * r
    hessian[row] = H
    gradient[row] = g
    counts[row] = found


@dataclass(frozen=True)
class Sums:
    """Sums of one pass over a frame's points.

    Attributes:
        H: (6, 6) Gauss-Newton matrix.
        g: (6,) gradient.
        inliers: number of frame points that land on a nearby model point with a similar normal.
        residual_m: RMS distance of the inliers from their planes.
    """

    H: Float64
    g: Float64
    inliers: float
    residual_m: float


class ProjectiveICP:
    """Aligns pyramids of frames with views of the model.

    Args:
        intrinsics: intrinsics of the model's views.
        iterations: most iterations per level, finest first.
        icp_threshold: step length (metres and radians) below which a level ends.
        distance_m: largest distance of corresponding points.
        cos_angle: least cosine of the angle between their normals.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        iterations: tuple[int, ...],
        icp_threshold: float,
        distance_m: float,
        cos_angle: float,
    ) -> None:
        self.iterations, self.icp_threshold = iterations, icp_threshold
        focal = wp.vec2(intrinsics.fx, intrinsics.fy), wp.vec2(intrinsics.cx, intrinsics.cy)
        self._rule = [*focal, distance_m, cos_angle]
        height = intrinsics.height
        self._H = wp.zeros(height, dtype=wp.spatial_matrix, device="cpu")
        self._g = wp.zeros(height, dtype=wp.spatial_vector, device="cpu")
        self._counts = wp.zeros(height, dtype=wp.vec2, device="cpu")

    def align(self, frame: list[Surface], model: Surface) -> tuple[Float64 | None, Sums]:
        """Align from rest; return T_model_camera (4, 4) of the frame and the sums there.

        The pose is None if too few points correspond or they do not constrain it.
        """
        T = np.eye(4)
        for level in reversed(range(len(self.iterations))):
            for _ in range(self.iterations[level]):
                sums = self.accumulate(frame[level], model, T)
                step = _solve(sums)
                if step is None:
                    return None, sums
                T = se3_exp(step) @ T
                if np.linalg.norm(step) < self.icp_threshold:
                    break
        return T, self.accumulate(frame[0], model, T)

    def accumulate(self, live: Surface, model: Surface, T: Float64) -> Sums:
        """Sums of one level at a pose T_model_camera (4, 4)."""
        images = [live.points, live.normals, model.points, model.normals]
        pose = [wp.mat33(T[:3, :3]), wp.vec3(*T[:3, 3])]
        out = [self._H, self._g, self._counts]
        rows = live.points.shape[0]
        inputs = [*images, *pose, *self._rule]
        wp.launch(_accumulate, dim=rows, inputs=inputs, outputs=out, device="cpu")
        H, g, counts = (a.numpy()[:rows].astype(np.float64).sum(axis=0) for a in out)
        inliers, squares = counts.tolist()
        return Sums(H, g, inliers, float(np.sqrt(squares / max(inliers, 1.0))))


def _solve(sums: Sums) -> Float64 | None:
    """The Gauss-Newton step (6,) of translation and rotation."""
    if sums.inliers < _FEWEST_POINTS:
        return None
    values, vectors = np.linalg.eigh(sums.H)
    if not values[0] > 1e-6 * values[-1]:
        return None
    return np.asarray(vectors @ ((vectors.T @ sums.g) / values), dtype=np.float64)
