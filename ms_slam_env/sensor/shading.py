"""Colour at each ray hit: texture, baked light, exposure, intensity noise, sRGB.

[F]: Foi et al., "Practical Poissonian-Gaussian Noise Modeling and Fitting for Single-Image
Raw-Data", IEEE TIP 2008.
"""

from __future__ import annotations

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.native import native_source
from ms_slam_env.sensor.native import VECTOR_FLAGS
from ms_slam_env.sensor.rays import Hits, Pinhole, camera_centre, pose_of_row, world_ray
from ms_slam_env.sensor.textures import ENCODE_STEPS

_MIN_COSINE = 0.1  # beyond 84 degrees the footprint is not stretched further

wp.set_module_options(VECTOR_FLAGS)


@wp.struct
class Surfaces:
    """Mesh data for shading, per face or per texture."""

    uv: wp.array2d[wp.vec2]  # (F, 3)
    irradiance: wp.array2d[wp.vec3]  # (F, 3)
    normal: wp.array[wp.vec3]  # (F,)
    plane: wp.array[wp.float32]  # (F,) normal . x
    density: wp.array[wp.float32]  # (F,) texels per metre
    texture: wp.array[wp.int32]  # (F,)
    label: wp.array[wp.int32]  # (F,)
    texels: wp.array[wp.uint32]  # packed levels of all textures
    offsets: wp.array2d[wp.int32]  # (T, L)
    sizes: wp.array[wp.vec3i]  # (T,) width, height, levels


@wp.struct
class Tables:
    """Lookup tables."""

    normals: wp.array[wp.float32]  # quantiles of N(0, 1)
    decode: wp.array[wp.float32]  # sRGB to linear
    encode: wp.array[wp.float32]  # linear to sRGB


@wp.func_native(
    native_source("shading", "shade_span", ENCODE_STEPS=float(ENCODE_STEPS), MIN_COSINE=_MIN_COSINE)
)
def shade_span(
    T: wp.mat44,
    camera: Pinhole,
    first: int,
    y: int,
    x_first: int,
    count: int,
    hits: Hits,
    surfaces: Surfaces,
    exposure: float,
    shot: float,
    read: float,
    key_0: wp.uint32,
    key_1: wp.uint32,
    tables: Tables,
    color: wp.array2d[wp.uint8],
) -> None:
    """Shade ``count`` pixels of a row."""


@wp.kernel
def shade(
    T_world_camera: wp.array[wp.mat44],  # (B * poses an image,)
    camera: Pinhole,
    span: int,
    hits: Hits,  # of B * H * W rays
    surfaces: wp.array[Surfaces],  # (B,) of each image's scene; (1,) of all
    exposure: wp.array[wp.float32],  # likewise
    shot: float,
    read: float,
    keys: wp.array2d[wp.uint32],  # (B, 2)
    tables: Tables,
    color: wp.array2d[wp.uint8],  # (B * H * W, 3)
) -> None:
    """Sensor value = exposure * radiance + noise; one thread for ``span`` pixels of a row."""
    b, y, part = wp.tid()
    scene = wp.min(b, surfaces.shape[0] - 1)
    first = b * camera.height * camera.width
    x = part * span
    count = wp.min(span, camera.width - x)
    shade_span(
        T_world_camera[pose_of_row(camera, b, y)],
        camera,
        first,
        y,
        x,
        count,
        hits,
        surfaces[scene],
        exposure[scene],
        shot,
        read,
        keys[b, 0],
        keys[b, 1],
        tables,
        color,
    )


@wp.kernel
def true_geometry(
    T_world_camera: wp.array[wp.mat44],  # (B * poses an image,)
    camera: Pinhole,
    hits: Hits,  # of B * H * W rays
    surfaces: Surfaces,
    depth: wp.array[wp.float32],  # (B * H * W,)
    normals: wp.array[wp.vec3],  # camera frame, facing the camera
    labels: wp.array[wp.int32],
    points: wp.array[wp.vec3],  # world frame
) -> None:
    """Write depth, normal, label and point of each hit; 0 and label -1 if there is none."""
    b, y, x = wp.tid()
    i = (b * camera.height + y) * camera.width + x
    face = hits.face[i]
    depth[i] = 0.0
    labels[i] = -1
    normals[i] = wp.vec3(0.0, 0.0, 0.0)
    points[i] = wp.vec3(0.0, 0.0, 0.0)
    if face >= 0:
        T = T_world_camera[pose_of_row(camera, b, y)]
        ray = world_ray(T, camera, x, y)
        normal = surfaces.normal[face]
        if wp.dot(normal, ray) > 0.0:
            normal = -normal
        depth[i] = hits.t[i]
        labels[i] = surfaces.label[face]
        normals[i] = wp.vec3(
            T[0, 0] * normal[0] + T[1, 0] * normal[1] + T[2, 0] * normal[2],
            T[0, 1] * normal[0] + T[1, 1] * normal[1] + T[2, 1] * normal[2],
            T[0, 2] * normal[0] + T[1, 2] * normal[1] + T[2, 2] * normal[2],
        )
        points[i] = camera_centre(T) + hits.t[i] * ray
