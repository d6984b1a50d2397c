"""Colour of what each ray hits: texture, baked light, exposure, intensity noise, sRGB."""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.sensor.random_numbers import normal_high, normal_low, pcg, pixel_state
from ms_slam_env.sensor.rays import Pinhole, camera_centre, world_ray
from ms_slam_env.sensor.textures import ENCODE_STEPS

_ENCODE_STEPS = wp.constant(float(ENCODE_STEPS))
_MIN_COSINE = wp.constant(0.1)  # beyond 84 degrees the footprint is not stretched further


@wp.struct
class Surfaces:
    """What shading needs to know of a mesh, per face or per texture."""

    uv: wp.array2d(dtype=wp.vec2)  # (F, 3)
    irradiance: wp.array2d(dtype=wp.vec3)  # (F, 3)
    normal: wp.array(dtype=wp.vec3)  # (F,)
    plane: wp.array(dtype=wp.float32)  # (F,) normal . x
    density: wp.array(dtype=wp.float32)  # (F,) texels per metre
    texture: wp.array(dtype=wp.int32)  # (F,)
    label: wp.array(dtype=wp.int32)  # (F,)
    texels: wp.array(dtype=wp.uint32)  # packed levels of all textures
    offsets: wp.array2d(dtype=wp.int32)  # (T, L)
    sizes: wp.array(dtype=wp.vec3i)  # (T,) width, height, levels


@wp.func
def _wrap(i: int, n: int) -> int:
    """Index of a repeating texture; ``i`` is in [-1, n]."""
    if i < 0:
        return i + n
    if i >= n:
        return i - n
    return i


@wp.func
def _unpack(texel: wp.uint32) -> wp.vec3:
    return wp.vec3(
        float(texel & wp.uint32(255)),
        float((texel >> wp.uint32(8)) & wp.uint32(255)),
        float((texel >> wp.uint32(16)) & wp.uint32(255)),
    )


@wp.func
def _bilinear(texels: wp.array(dtype=wp.uint32), start: int, w: int, h: int, s: float, t: float):
    """Texture value at coordinates (s, t) in [0, 1); texel centres lie at half integers."""
    x = s * float(w) - 0.5
    y = t * float(h) - 0.5
    x_floor = wp.floor(x)
    y_floor = wp.floor(y)
    ax = x - x_floor
    ay = y - y_floor
    x0 = _wrap(int(x_floor), w)
    x1 = _wrap(int(x_floor) + 1, w)
    row_0 = start + _wrap(int(y_floor), h) * w
    row_1 = start + _wrap(int(y_floor) + 1, h) * w
    top = (1.0 - ax) * _unpack(texels[row_0 + x0]) + ax * _unpack(texels[row_0 + x1])
    bottom = (1.0 - ax) * _unpack(texels[row_1 + x0]) + ax * _unpack(texels[row_1 + x1])
    return (1.0 - ay) * top + ay * bottom


@wp.func
def sample_texture(surfaces: Surfaces, k: int, uv: wp.vec2, level: float) -> wp.vec3:
    """Trilinear sRGB value (0 to 255) of texture ``k`` at fractional mip ``level``."""
    size = surfaces.sizes[k]
    s = uv[0] - wp.floor(uv[0])
    t = uv[1] - wp.floor(uv[1])
    clamped = wp.clamp(level, 0.0, float(size[2] - 1))
    low = int(clamped)
    w = wp.max(size[0] >> low, 1)
    h = wp.max(size[1] >> low, 1)
    value = _bilinear(surfaces.texels, surfaces.offsets[k, low], w, h, s, t)
    a = clamped - float(low)
    if a > 0.0:
        w = wp.max(w >> 1, 1)
        h = wp.max(h >> 1, 1)
        coarse = _bilinear(surfaces.texels, surfaces.offsets[k, low + 1], w, h, s, t)
        value = (1.0 - a) * value + a * coarse
    return value


@wp.func
def _decode(value: float, table: wp.array(dtype=wp.float32)) -> float:
    """Linear intensity of an sRGB value in [0, 255]."""
    i = int(value)
    a = value - float(i)
    return (1.0 - a) * table[i] + a * table[i + 1]


@wp.func
def _encode(value: float, table: wp.array(dtype=wp.float32)) -> wp.uint8:
    """8-bit sRGB value of a linear intensity, clipped to [0, 1]."""
    x = wp.clamp(value, 0.0, 1.0) * _ENCODE_STEPS
    i = int(x)
    a = x - float(i)
    return wp.uint8((1.0 - a) * table[i] + a * table[i + 1] + 0.5)


@wp.kernel
def shade(
    T_world_camera: wp.array(dtype=wp.mat44),  # (B,)
    camera: Pinhole,
    hit_t: wp.array(dtype=wp.float32),  # (B * H * W,)
    hit_u: wp.array(dtype=wp.float32),
    hit_v: wp.array(dtype=wp.float32),
    hit_face: wp.array(dtype=wp.int32),
    surfaces: Surfaces,
    exposure: float,
    shot: float,
    read: float,
    keys: wp.array2d(dtype=wp.uint32),  # (B, 2)
    normals: wp.array(dtype=wp.float32),  # quantiles of N(0, 1)
    decode: wp.array(dtype=wp.float32),
    encode: wp.array(dtype=wp.float32),
    color: wp.array2d(dtype=wp.uint8),  # (B * H * W, 3)
):
    """Radiance = linear albedo * irradiance; sensor value = exposure * radiance + noise."""
    b, y, x = wp.tid()
    pixel = y * camera.width + x
    i = b * camera.height * camera.width + pixel
    face = hit_face[i]
    value = wp.vec3(0.0, 0.0, 0.0)
    if face >= 0:
        u = hit_u[i]
        v = hit_v[i]
        w = 1.0 - u - v
        ray = world_ray(T_world_camera[b], camera, float(x), float(y))
        cosine = wp.abs(wp.dot(surfaces.normal[face], ray)) / wp.length(ray)
        footprint_m = hit_t[i] / (camera.fx * wp.max(cosine, _MIN_COSINE))
        level = wp.log2(wp.max(footprint_m * surfaces.density[face], 1.0e-6))
        uv = w * surfaces.uv[face, 0] + u * surfaces.uv[face, 1] + v * surfaces.uv[face, 2]
        albedo = sample_texture(surfaces, surfaces.texture[face], uv, level)
        light = (
            w * surfaces.irradiance[face, 0]
            + u * surfaces.irradiance[face, 1]
            + v * surfaces.irradiance[face, 2]
        )
        value = exposure * wp.vec3(
            _decode(albedo[0], decode) * light[0],
            _decode(albedo[1], decode) * light[1],
            _decode(albedo[2], decode) * light[2],
        )
    if shot > 0.0 or read > 0.0:
        word = pixel_state(keys[b, 0], keys[b, 1], pixel)
        more = pcg(word + wp.uint32(1))
        noise = wp.vec3(
            normal_low(word, normals), normal_high(word, normals), normal_low(more, normals)
        )
        dark = read * read  # variance = read^2 + shot * intensity (Foi et al. 2008)
        value += wp.vec3(
            wp.sqrt(dark + shot * value[0]) * noise[0],
            wp.sqrt(dark + shot * value[1]) * noise[1],
            wp.sqrt(dark + shot * value[2]) * noise[2],
        )
    color[i, 0] = _encode(value[0], encode)
    color[i, 1] = _encode(value[1], encode)
    color[i, 2] = _encode(value[2], encode)


@wp.kernel
def true_geometry(
    T_world_camera: wp.array(dtype=wp.mat44),  # (B,)
    camera: Pinhole,
    hit_t: wp.array(dtype=wp.float32),  # (B * H * W,)
    hit_face: wp.array(dtype=wp.int32),
    surfaces: Surfaces,
    depth: wp.array(dtype=wp.float32),  # (B * H * W,)
    normals: wp.array(dtype=wp.vec3),  # camera frame, towards the camera
    labels: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),  # world frame
):
    """Write depth, normal, label and point of each hit; 0 and label -1 where there is none."""
    b, y, x = wp.tid()
    i = (b * camera.height + y) * camera.width + x
    face = hit_face[i]
    depth[i] = 0.0
    labels[i] = -1
    normals[i] = wp.vec3(0.0, 0.0, 0.0)
    points[i] = wp.vec3(0.0, 0.0, 0.0)
    if face >= 0:
        T = T_world_camera[b]
        ray = world_ray(T, camera, float(x), float(y))
        normal = surfaces.normal[face]
        if wp.dot(normal, ray) > 0.0:
            normal = -normal
        depth[i] = hit_t[i]
        labels[i] = surfaces.label[face]
        normals[i] = wp.vec3(
            T[0, 0] * normal[0] + T[1, 0] * normal[1] + T[2, 0] * normal[2],
            T[0, 1] * normal[0] + T[1, 1] * normal[1] + T[2, 1] * normal[2],
            T[0, 2] * normal[0] + T[1, 2] * normal[1] + T[2, 2] * normal[2],
        )
        points[i] = camera_centre(T) + hit_t[i] * ray
