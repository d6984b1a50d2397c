"""Depth as a structured-light sensor measures it; for the sources [K] and [N] see noise.py."""

from __future__ import annotations

import math

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.sensor.native import PCG, VECTOR_FLAGS, VECTORISE
from ms_slam_env.sensor.noise import NATIVE_WIDTH, NoiseConfig
from ms_slam_env.sensor.rays import Pinhole, pose_of_row

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


# C++, because Clang turns a loop over a row into vector instructions, provided that no branch
# depends on the pixel: a fifth of the time of Warp's one call a pixel (shading, 160x120).
_MEASURE_SPAN = """
const int* face_of = hit_face.data;
const float* z_of = hit_t.data;
const float* normal_of = (const float*)face_normal.data;  // 3 a face
const float half_pi = HALF_PI;
const float px = T.data[0][3], py = T.data[1][3], pz = T.data[2][3];
const float last_x = (float)(camera.width - 1);
const float last_y = (float)(camera.height - 1);
const bool is_bent = camera.bent.shape[0] > 0;
const float* bent = (const float*)camera.bent.data;

PCG_SOURCEauto smaller = [](float a, float b) { return a < b ? a : b; };
auto larger = [](float a, float b) { return a > b ? a : b; };
auto acos_of = [](float x) {  // of 0 to 1, error 2e-8: Abramowitz and Stegun 4.4.46
    const float top = 0.0066700901f - 0.0012624911f * x;
    const float high = 0.0308918810f + x * (-0.0170881256f + x * top);
    const float low = 0.0889789874f + x * (-0.0501743046f + x * high);
    return sqrtf(1.0f - x) * (1.5707963050f + x * (-0.2145988016f + x * low));
};

VECTORISE
for (int k = 0; k < count; ++k) {
    const int x = x_first + k;
    const int pixel = y * camera.width + x;
    const int i = first + pixel;
    bool is_read = face_of[i] >= 0 && shadow.data[i] == 0;
    const int face = face_of[i] >= 0 ? face_of[i] : 0;
    const unsigned word = pcg(first_word(pixel) + 2u);
    const unsigned axial_word = pcg(word + 1u);
    const unsigned drop_word = pcg(word + 2u);

    // Lateral jitter [N]: depth is sampled sigma_L native pixels away.
    const float plain_x = ((float)x - camera.cx) / camera.fx;
    const float plain_y = ((float)y - camera.cy) / camera.fy;
    const float dx = is_bent ? bent[2 * pixel] : plain_x;
    const float dy = is_bent ? bent[2 * pixel + 1] : plain_y;
    const float rx = T.data[0][0] * dx + T.data[0][1] * dy + T.data[0][2];
    const float ry = T.data[1][0] * dx + T.data[1][1] * dy + T.data[1][2];
    const float rz = T.data[2][0] * dx + T.data[2][1] * dy + T.data[2][2];
    const float* n = normal_of + 3 * face;
    const float towards = fabsf(n[0] * rx + n[1] * ry + n[2] * rz);
    const float angle_here = acos_of(smaller(towards / sqrtf(rx * rx + ry * ry + rz * rz), 1.0f));
    const float tilt = smaller(angle_here, MAX_LATERAL_ANGLE);
    const float sigma_px = noise.lateral * (0.8f + 0.035f * tilt / (half_pi - tilt)) / noise.pitch;
    const float u_all = (float)x + sigma_px * normals.data[word & 65535u];
    const float v_all = (float)y + sigma_px * normals.data[word >> 16];
    const float u = smaller(larger(u_all, 0.0f), last_x);
    const float v = smaller(larger(v_all, 0.0f), last_y);
    const int j = first + (int)(v + 0.5f) * camera.width + (int)(u + 0.5f);
    is_read = is_read && face_of[j] >= 0;
    const int sampled = face_of[j] >= 0 ? face_of[j] : 0;

    // The sampled surface, met by the jittered ray; a lens shifts it as it does the pixel's.
    const float ex = (u - camera.cx) / camera.fx + (is_bent ? bent[2 * pixel] - plain_x : 0.0f);
    const float ey = (v - camera.cy) / camera.fy + (is_bent ? bent[2 * pixel + 1] - plain_y : 0.0f);
    const float sx = T.data[0][0] * ex + T.data[0][1] * ey + T.data[0][2];
    const float sy = T.data[1][0] * ex + T.data[1][1] * ey + T.data[1][2];
    const float sz = T.data[2][0] * ex + T.data[2][1] * ey + T.data[2][2];
    const float* m = normal_of + 3 * sampled;
    const float approach = m[0] * sx + m[1] * sy + m[2] * sz;
    const float met = (face_plane.data[sampled] - (m[0] * px + m[1] * py + m[2] * pz)) / approach;
    const bool is_jittered = noise.lateral > 0.0f;
    const bool is_met = fabsf(approach) > 1.0e-3f && fabsf(met - z_of[j]) < 0.1f * z_of[j];
    float z = is_jittered && is_met ? met : z_of[j];
    const float cosine_there = fabsf(approach) / sqrtf(sx * sx + sy * sy + sz * sz);
    const float angle_there = acos_of(smaller(cosine_there, 1.0f));
    const float angle = is_jittered && sampled != face ? angle_there : angle_here;

    // Dropouts at grazing angles, beside depth edges, and out of range.
    const bool is_grazing = angle > noise.grazing_start;
    is_read = is_read && !(is_grazing && angle >= noise.grazing_end);
    const float ramp = (angle - noise.grazing_start) / (noise.grazing_end - noise.grazing_start);
    const float grazing_drop = is_grazing ? ramp : 0.0f;
    const float disparity = noise.disparity_at_1m / z;
    auto jumps = [&](int neighbour) {
        const float other = noise.disparity_at_1m / z_of[neighbour];
        return face_of[neighbour] < 0 || fabsf(other - disparity) > noise.edge_jump;
    };
    const bool is_edge_left = x > 0 && jumps(x > 0 ? i - 1 : i);
    const bool is_edge_right = x < camera.width - 1 && jumps(x < camera.width - 1 ? i + 1 : i);
    const bool is_edge_above = y > 0 && jumps(y > 0 ? i - camera.width : i);
    const bool is_edge_below =
        y < camera.height - 1 && jumps(y < camera.height - 1 ? i + camera.width : i);
    const bool is_edge = is_edge_left || is_edge_right || is_edge_above || is_edge_below;
    const float drop = is_edge ? larger(noise.edge_dropout, grazing_drop) : grazing_drop;
    const float chance = (float)(int)(drop_word >> 8) * (1.0f / 16777216.0f);
    is_read = is_read && !(chance < drop);
    is_read = is_read && z >= noise.min_range && z <= noise.max_range;

    // Axial noise [N], metres; its second term from 60 degrees on.
    const float a = angle / (half_pi - tilt);
    const float steep = angle > AXIAL_KNEE ? 0.0001f / sqrtf(z) * a * a : 0.0f;
    const float sigma = (0.0012f + 0.0019f * (z - 0.4f) * (z - 0.4f) + steep) * noise.axial;
    const float quantisation = z * z / noise.disparity_at_1m * noise.step / SQRT_12;
    const float rest = larger(sigma * sigma - quantisation * quantisation, 0.0f);
    const float axial = sqrtf(rest) * normals.data[axial_word & 65535u];
    z = noise.axial > 0.0f ? z + axial : z;

    // Disparity quantisation [K]; 0.49999997 rounds halves up and nothing else.
    const float steps_all = noise.disparity_at_1m / (larger(z, 1.0e-3f) * noise.step);
    const float steps = floorf(steps_all + 0.49999997f);
    is_read = is_read && (noise.step <= 0.0f || steps >= 1.0f);
    z = noise.step > 0.0f ? noise.disparity_at_1m / (steps * noise.step) : z;
    depth.data[i] = is_read ? larger(z, 0.0f) : 0.0f;
}
"""


@wp.func_native(
    _MEASURE_SPAN.replace("PCG_SOURCE", PCG)
    .replace("VECTORISE", VECTORISE)
    .replace("HALF_PI", f"{math.pi / 2:.9f}f")
    .replace("MAX_LATERAL_ANGLE", f"{_MAX_LATERAL_ANGLE:.9f}f")
    .replace("AXIAL_KNEE", f"{_AXIAL_KNEE:.9f}f")
    .replace("SQRT_12", f"{math.sqrt(12.0):.9f}f")
)
def _measure_span(
    T: wp.mat44,
    camera: Pinhole,
    first: int,
    y: int,
    x_first: int,
    count: int,
    hit_t: wp.array(dtype=wp.float32),
    hit_face: wp.array(dtype=wp.int32),
    face_normal: wp.array(dtype=wp.vec3),
    face_plane: wp.array(dtype=wp.float32),
    shadow: wp.array(dtype=wp.uint8),
    noise: DepthNoise,
    key_0: wp.uint32,
    key_1: wp.uint32,
    normals: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def measure_depth(
    T_world_camera: wp.array(dtype=wp.mat44),  # (B * poses an image,)
    camera: Pinhole,
    span: int,
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
    """Jitter, dropouts, range, axial noise, quantisation; one thread for ``span`` pixels."""
    b, y, part = wp.tid()
    x = part * span
    _measure_span(
        T_world_camera[pose_of_row(camera, b, y)],
        camera,
        b * camera.height * camera.width,
        y,
        x,
        wp.min(span, camera.width - x),
        hit_t,
        hit_face,
        face_normal,
        face_plane,
        shadow,
        noise,
        keys[b, 0],
        keys[b, 1],
        normals,
        depth,
    )
