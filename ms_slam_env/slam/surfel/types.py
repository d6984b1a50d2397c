"""What the stages of the surfel SLAM hand to each other: device arrays, leading axis = env."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env._warp import wp


@dataclass(frozen=True)
class LiveFrame:
    """The sensor's frames of B envs after preprocessing, on the device.

    Attributes:
        raw_depth: (B, H, W) float32 metres as sensed; 0 = no reading or beyond the cutoff.
        depth: (B, H, W) float32 metres, bilaterally filtered and cut off; 0 = no reading.
        vertices: (B, H, W) vec3 back-projected ``depth``, camera frame; z = 0 where invalid.
        normals: (B, H, W) vec3 unit normals, camera frame, towards the camera; 0 where invalid.
        color: (B, H, W) vec3 RGB in [0, 255].
        intensity: (B, H, W) float32 in [0, 255] (BT.601 luma of ``color``).
    """

    raw_depth: wp.array
    depth: wp.array
    vertices: wp.array
    normals: wp.array
    color: wp.array
    intensity: wp.array


@dataclass(frozen=True)
class ModelView:
    """The map rendered from one pose per env, on the device.

    The view may hold only every n-th row and column of the camera's image.

    Attributes:
        vertices: (B, H, W) vec3 camera frame of the rendering pose; z = 0 where the map is empty.
        normals: (B, H, W) vec3 unit normals, same frame, towards the camera; 0 where empty.
        intensity: (B, H, W) float32 in [0, 255]; 0 where empty.
        color: (B, H, W) vec3 RGB in [0, 255]; 0 where empty.
    """

    vertices: wp.array
    normals: wp.array
    intensity: wp.array
    color: wp.array
