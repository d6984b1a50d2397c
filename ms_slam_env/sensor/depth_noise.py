"""Depth measured by a structured-light sensor; for the sources [K] and [N] see noise.py."""

from __future__ import annotations

import math

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.native import native_source
from ms_slam_env.sensor.native import VECTOR_FLAGS
from ms_slam_env.sensor.noise import NATIVE_WIDTH, NoiseConfig
from ms_slam_env.sensor.rays import Pinhole, pose_of_row
from ms_slam_env.sensor.shading import Surfaces

_MAX_LATERAL_ANGLE = math.radians(80.0)  # the published fit ends there
_AXIAL_KNEE = math.radians(60.0)
_NOTHING = wp.constant(1.0e30)

wp.set_module_options(VECTOR_FLAGS)


@wp.struct
class DepthNoise:
    """Parameters of the depth noise for kernels; see NoiseConfig."""

    disparity_at_1m: wp.float32  # focal length at 640 pixels times baseline, px m
    pitch: wp.float32  # native pixels per pixel
    step: wp.float32
    axial: wp.float32
    lateral: wp.float32
    grazing_start: wp.float32  # rad
    grazing_end: wp.float32  # rad
    edge_dropout: wp.float32
    edge_jump: wp.float32
    min_range: wp.float32
    max_range: wp.float32


def make_depth_noise(config: NoiseConfig, intrinsics: Intrinsics) -> DepthNoise:
    """Parameters for images of the size of ``intrinsics``."""
    noise = DepthNoise()
    noise.pitch = NATIVE_WIDTH / intrinsics.width
    noise.disparity_at_1m = intrinsics.fx * noise.pitch * config.baseline_m
    noise.step = config.disparity_step_px
    noise.axial = config.axial
    noise.lateral = config.lateral
    noise.grazing_start = math.radians(config.grazing_start_deg)
    noise.grazing_end = math.radians(config.grazing_end_deg)
    noise.edge_dropout = config.edge_dropout
    noise.edge_jump = config.edge_jump_px
    noise.min_range = config.min_range_m
    noise.max_range = config.max_range_m
    return noise


@wp.kernel
def projector_shadow(
    hit_t: wp.array[wp.float32],  # (B * H * W,)
    hit_face: wp.array[wp.int32],
    width: int,
    noise: DepthNoise,
    shadow: wp.array[wp.uint8],  # (B * H * W,)
) -> None:
    """Mark pixels that the projector, right of the camera, does not reach; one thread per row.

    The projector sees a point of native column c and depth z in its column c - f b / z. Along a row
    these columns must ascend: where one does not, a nearer surface to the right hides it.
    """
    row = wp.tid()
    nearest = float(_NOTHING)
    for k in range(width):
        x = width - 1 - k
        i = row * width + x
        hidden = wp.uint8(0)
        if hit_face[i] >= 0:
            column = float(x) * noise.pitch - noise.disparity_at_1m / hit_t[i]
            if column >= nearest:
                hidden = wp.uint8(1)
            nearest = wp.min(nearest, column)
        shadow[i] = hidden


@wp.func_native(
    native_source(
        "depth_noise",
        "measure_span",
        MAX_LATERAL_ANGLE=_MAX_LATERAL_ANGLE,
        AXIAL_KNEE=_AXIAL_KNEE,
    )
)
def measure_span(
    T: wp.mat44,
    camera: Pinhole,
    first: int,
    y: int,
    x_first: int,
    count: int,
    hit_t: wp.array[wp.float32],
    hit_face: wp.array[wp.int32],
    face_normal: wp.array[wp.vec3],
    face_plane: wp.array[wp.float32],
    shadow: wp.array[wp.uint8],
    noise: DepthNoise,
    key_0: wp.uint32,
    key_1: wp.uint32,
    normals: wp.array[wp.float32],
    depth: wp.array[wp.float32],
) -> None:
    """Measure the depth of ``count`` pixels of a row."""


@wp.kernel
def measure_depth(
    T_world_camera: wp.array[wp.mat44],  # (B * poses an image,)
    camera: Pinhole,
    span: int,
    hit_t: wp.array[wp.float32],  # (B * H * W,)
    hit_face: wp.array[wp.int32],
    surfaces: wp.array[Surfaces],  # (B,) of each image's scene; (1,) of all
    shadow: wp.array[wp.uint8],  # (B * H * W,)
    noise: DepthNoise,
    keys: wp.array2d[wp.uint32],  # (B, 2)
    normals: wp.array[wp.float32],  # quantiles of N(0, 1)
    depth: wp.array[wp.float32],  # (B * H * W,)
) -> None:
    """Jitter, dropouts, range, axial noise, quantisation; one thread for ``span`` pixels."""
    b, y, part = wp.tid()
    scene = surfaces[wp.min(b, surfaces.shape[0] - 1)]
    x = part * span
    measure_span(
        T_world_camera[pose_of_row(camera, b, y)],
        camera,
        b * camera.height * camera.width,
        y,
        x,
        wp.min(span, camera.width - x),
        hit_t,
        hit_face,
        scene.normal,
        scene.plane,
        shadow,
        noise,
        keys[b, 0],
        keys[b, 1],
        normals,
        depth,
    )
