"""Live frames of a tilted textured plane with a box before it, made in NumPy."""

from __future__ import annotations

import numpy as np

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap

SMALL = Intrinsics(fx=40.0, fy=42.0, cx=19.3, cy=14.8, width=40, height=30)
WALL_NORMAL = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
WALL_POINT = np.array([0.0, 0.0, 2.0])
BOX_Z = 1.2  # front of a 0.3 m square about the axis of the identity camera
BOX_HALF = 0.15


def texture(points: np.ndarray) -> np.ndarray:
    """Smooth RGB (..., 3) in [0, 255] of world points (..., 3)."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = [np.sin(2.5 * x + 1), np.sin(2 * y + x), np.sin(3 * (x + y) + z)]
    return 128 + 80 * np.stack(waves, -1)


def ray_cast(T: np.ndarray, camera: Intrinsics, box: bool = True) -> tuple[np.ndarray, ...]:
    """Closed-form depth (H, W), camera-frame normals and colour (H, W, 3) from pose T."""
    rays = camera.rays() @ T[:3, :3].T
    origin = T[:3, 3]
    depth = (WALL_POINT - origin) @ WALL_NORMAL / (rays @ WALL_NORMAL)
    normals = np.broadcast_to(WALL_NORMAL @ T[:3, :3], rays.shape).copy()
    if box:
        front = (BOX_Z - origin[2]) / rays[..., 2]
        hit = origin + front[..., None] * rays
        on_box = (np.abs(hit[..., :2]) <= BOX_HALF).all(-1) & (front > 0) & (front < depth)
        depth = np.where(on_box, front, depth)
        normals[on_box] = np.array([0.0, 0.0, -1.0]) @ T[:3, :3]
    return depth, normals, texture(origin + depth[..., None] * rays)


def live_frame(
    poses: np.ndarray,
    camera: Intrinsics = SMALL,
    noise_m: float = 0.0,
    rng: np.random.Generator | None = None,
    box: bool = True,
) -> LiveFrame:
    """Frames of B poses (B, 4, 4); normals are exact, depth has Gaussian noise."""
    depths, normals, colors = [], [], []
    for T in poses:
        depth, normal, color = ray_cast(T, camera, box)
        if noise_m:
            assert rng is not None
            depth = depth + rng.normal(0, noise_m, depth.shape)
        depths.append(depth)
        normals.append(normal)
        colors.append(color)
    depth = np.array(depths, dtype=np.float32)
    color = np.array(colors, dtype=np.float32)
    vertices = (depth[..., None] * camera.rays()).astype(np.float32)
    return LiveFrame(
        raw_depth=wp.array(depth, dtype=wp.float32),
        depth=wp.array(depth, dtype=wp.float32),
        vertices=wp.array(vertices, dtype=wp.vec3),
        normals=wp.array(np.array(normals, dtype=np.float32), dtype=wp.vec3),
        color=wp.array(color, dtype=wp.vec3),
        intensity=wp.array(color @ np.float32([0.299, 0.587, 0.114]), dtype=wp.float32),
        moving=wp.zeros(depth.shape, dtype=wp.int32),
    )


def device_poses(poses: np.ndarray) -> wp.array:
    """Poses (B, 4, 4) on the device."""
    return wp.array(np.asarray(poses, dtype=np.float32).reshape(-1, 4, 4), dtype=wp.mat44)


def fuse(
    surfel_map: SurfelMap,
    live: LiveFrame,
    poses: np.ndarray,
    time: int | np.ndarray,
    weight: float = 1.0,
    mask: np.ndarray | None = None,
) -> None:
    """Fuse one frame per env."""
    batch = surfel_map.batch
    surfel_map.fuse(
        live,
        device_poses(poses),
        wp.array(np.full(batch, time, dtype=np.int32), dtype=wp.int32),
        wp.full(batch, weight, dtype=wp.float32),
        wp.array(np.ones(batch) if mask is None else mask, dtype=wp.int32),
    )


def build_map(
    poses: np.ndarray, noise_m: float = 0.0, seed: int = 0, **config: object
) -> SurfelMap:
    """The map of one env after fusing the frames of ``poses`` (N, 4, 4)."""
    config.setdefault("max_surfels", 20_000)
    surfel_map = SurfelMap(1, SMALL, SurfelConfig(**config))  # type: ignore[arg-type]
    rng = np.random.default_rng(seed)
    for time, pose in enumerate(poses):
        fuse(surfel_map, live_frame(pose[None], noise_m=noise_m, rng=rng), pose[None], time)
    return surfel_map
