"""Depth as a structured-light sensor measures it."""

from __future__ import annotations

import math

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.sensor.noise import NATIVE_WIDTH, NoiseConfig
from ms_slam_env.sensor.random_numbers import (
    normal_high,
    normal_low,
    pcg,
    pixel_state,
    uniform,
)
from ms_slam_env.sensor.rays import Pinhole, camera_centre, world_ray

_HALF_PI = wp.constant(math.pi / 2.0)
_MAX_LATERAL_ANGLE = wp.constant(math.radians(80.0))  # the published fit ends there
_AXIAL_KNEE = wp.constant(math.radians(60.0))
_SQRT_12 = wp.constant(math.sqrt(12.0))
_NOTHING = wp.constant(1.0e30)


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
    hit_t: wp.array(dtype=wp.float32),  # (B * H * W,)
    hit_face: wp.array(dtype=wp.int32),
    width: int,
    noise: DepthNoise,
    shadow: wp.array(dtype=wp.uint8),  # (B * H * W,)
):
    """Mark what the projector, right of the camera, does not reach; one thread per image row.

    The projector sees a point of native column c and depth z in its own column c - f b / z. Along
    a row these columns must ascend: where one does not, a nearer surface to the right hides it.
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


@wp.func
def _jumps(disparity: float, t: float, face: int, noise: DepthNoise) -> bool:
    """Whether a neighbour at depth ``t`` lies across a depth edge."""
    return face < 0 or wp.abs(noise.disparity_at_1m / t - disparity) > noise.edge_jump


@wp.kernel
def measure_depth(
    T_world_camera: wp.array(dtype=wp.mat44),  # (B,)
    camera: Pinhole,
    hit_t: wp.array(dtype=wp.float32),  # (B * H * W,)
    hit_face: wp.array(dtype=wp.int32),
    face_normal: wp.array(dtype=wp.vec3),  # (F,)
    face_plane: wp.array(dtype=wp.float32),  # (F,)
    shadow: wp.array(dtype=wp.uint8),  # (B * H * W,)
    noise: DepthNoise,
    keys: wp.array2d(dtype=wp.uint32),  # (B, 2)
    normals: wp.array(dtype=wp.float32),  # quantiles of N(0, 1)
    depth: wp.array(dtype=wp.float32),  # (B * H * W,)
):
    """Lateral jitter, dropouts, range, axial noise, disparity quantisation."""
    b, y, x = wp.tid()
    pixel = y * camera.width + x
    first = b * camera.height * camera.width
    i = first + pixel
    depth[i] = 0.0
    face = hit_face[i]
    if face < 0 or shadow[i] > wp.uint8(0):
        return
    T = T_world_camera[b]
    word = pcg(pixel_state(keys[b, 0], keys[b, 1], pixel) + wp.uint32(2))
    axial_word = pcg(word + wp.uint32(1))
    drop_word = pcg(word + wp.uint32(2))

    # Lateral jitter (Nguyen et al. 2012): depth is sampled sigma_L native pixels away.
    ray = world_ray(T, camera, float(x), float(y))
    angle = wp.acos(wp.min(wp.abs(wp.dot(face_normal[face], ray)) / wp.length(ray), 1.0))
    tilt = wp.min(angle, _MAX_LATERAL_ANGLE)
    sigma_px = noise.lateral * (0.8 + 0.035 * tilt / (_HALF_PI - tilt)) / noise.pitch
    u = wp.clamp(float(x) + sigma_px * normal_low(word, normals), 0.0, float(camera.width - 1))
    v = wp.clamp(float(y) + sigma_px * normal_high(word, normals), 0.0, float(camera.height - 1))
    j = first + int(v + 0.5) * camera.width + int(u + 0.5)
    sampled = hit_face[j]
    if sampled < 0:
        return
    z = hit_t[j]
    if noise.lateral > 0.0:  # the sampled surface, met by the jittered ray
        shifted = world_ray(T, camera, u, v)
        normal = face_normal[sampled]
        approach = wp.dot(normal, shifted)
        if wp.abs(approach) > 1.0e-3:
            met = (face_plane[sampled] - wp.dot(normal, camera_centre(T))) / approach
            if wp.abs(met - z) < 0.1 * z:
                z = met
        if sampled != face:
            angle = wp.acos(wp.min(wp.abs(approach) / wp.length(shifted), 1.0))

    # Dropouts at grazing angles, beside depth edges, and out of range.
    drop = float(0.0)  # noqa: UP018 (Warp needs a variable, not a constant)
    if angle > noise.grazing_start:
        if angle >= noise.grazing_end:
            return
        drop = (angle - noise.grazing_start) / (noise.grazing_end - noise.grazing_start)
    disparity = noise.disparity_at_1m / z
    if noise.edge_dropout > drop:
        is_edge = bool(False)  # noqa: UP018
        if x > 0:
            is_edge = _jumps(disparity, hit_t[i - 1], hit_face[i - 1], noise)
        if x < camera.width - 1 and not is_edge:
            is_edge = _jumps(disparity, hit_t[i + 1], hit_face[i + 1], noise)
        if y > 0 and not is_edge:
            k = i - camera.width
            is_edge = _jumps(disparity, hit_t[k], hit_face[k], noise)
        if y < camera.height - 1 and not is_edge:
            k = i + camera.width
            is_edge = _jumps(disparity, hit_t[k], hit_face[k], noise)
        if is_edge:
            drop = noise.edge_dropout
    if drop > 0.0 and uniform(drop_word) < drop:
        return
    if z < noise.min_range or z > noise.max_range:
        return

    # Axial noise (Nguyen et al. 2012), metres; the second term from 60 degrees on.
    if noise.axial > 0.0:
        sigma_z = 0.0012 + 0.0019 * (z - 0.4) * (z - 0.4)
        if angle > _AXIAL_KNEE:
            a = angle / (_HALF_PI - tilt)
            sigma_z += 0.0001 / wp.sqrt(z) * a * a
        sigma_z *= noise.axial
        quantisation = z * z / noise.disparity_at_1m * noise.step / _SQRT_12
        rest = wp.max(sigma_z * sigma_z - quantisation * quantisation, 0.0)
        z += wp.sqrt(rest) * normal_low(axial_word, normals)
    # Disparity quantisation (Khoshelham and Elberink 2012).
    if noise.step > 0.0:
        steps = wp.round(noise.disparity_at_1m / (wp.max(z, 1.0e-3) * noise.step))
        if steps < 1.0:
            return
        z = noise.disparity_at_1m / (steps * noise.step)
    depth[i] = wp.max(z, 0.0)
