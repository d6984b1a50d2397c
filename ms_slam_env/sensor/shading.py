"""Colour of what each ray hits: texture, baked light, exposure, intensity noise, sRGB.

[F]: Foi et al., "Practical Poissonian-Gaussian Noise Modeling and Fitting for Single-Image
Raw-Data", IEEE TIP 2008.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.sensor.native import PCG, VECTOR_FLAGS, VECTORISE
from ms_slam_env.sensor.rays import Hits, Pinhole, camera_centre, pose_of_row, world_ray
from ms_slam_env.sensor.textures import ENCODE_STEPS

_MIN_COSINE = 0.1  # beyond 84 degrees the footprint is not stretched further

wp.set_module_options(VECTOR_FLAGS)


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


@wp.struct
class Tables:
    """Functions of one number, tabulated."""

    normals: wp.array(dtype=wp.float32)  # quantiles of N(0, 1)
    decode: wp.array(dtype=wp.float32)  # sRGB to linear
    encode: wp.array(dtype=wp.float32)  # linear to sRGB


# C++, because Clang turns a loop over a row into vector instructions, provided that no branch
# depends on the pixel: a fifth of the time of Warp's one call a pixel (shading, 160x120).
_SHADE_SPAN = """
const int* face_of = hits.face.data;
const float* decode = tables.decode.data;
const float* encode = tables.encode.data;
const float* t_of = hits.t.data;
const float* u_of = hits.u.data;
const float* v_of = hits.v.data;
const float* uv = (const float*)surfaces.uv.data;  // 6 a face
const float* irradiance = (const float*)surfaces.irradiance.data;  // 9 a face
const float* normal = (const float*)surfaces.normal.data;
const int* sizes = (const int*)surfaces.sizes.data;
const unsigned* texels = surfaces.texels.data;
const int level_count = surfaces.offsets.shape[1];
const float dark = read * read;
const float dy = ((float)y - camera.cy) / camera.fy;

PCG_SOURCEauto log2_of = [](float value) {  // exponent, and the series of atanh for the rest
    union { float f; int i; } bits;
    bits.f = value;
    const int exponent = (bits.i - 0x3f3504f3) >> 23;  // the rest is within 1/sqrt(2) and sqrt(2)
    bits.i -= exponent << 23;
    const float s = (bits.f - 1.0f) / (bits.f + 1.0f);
    const float s2 = s * s;
    const float high = 0.577078016f + s2 * (0.412198583f + s2 * 0.320598898f);
    return (float)exponent + s * (2.885390082f + s2 * (0.961796694f + s2 * high));
};
auto decode_of = [&](float value) {  // linear intensity of an sRGB value in [0, 255]
    const int i = (int)value;
    const float a = value - (float)i;
    return (1.0f - a) * decode[i] + a * decode[i + 1];
};
auto encode_of = [&](float value) {  // 8-bit sRGB value of a linear intensity
    const float below = value < 1.0f ? value : 1.0f;
    const float x = (below > 0.0f ? below : 0.0f) * ENCODE_STEPS;
    const int i = (int)x;
    const float a = x - (float)i;
    return (unsigned char)(int)((1.0f - a) * encode[i] + a * encode[i + 1] + 0.5f);
};

VECTORISE
for (int k = 0; k < count; ++k) {
    const int x = x_first + k;
    const int pixel = y * camera.width + x;
    const int i = first + pixel;
    const bool is_hit = face_of[i] >= 0;
    const int f = is_hit ? face_of[i] : 0;
    const float u = u_of[i];
    const float v = v_of[i];
    const float w = 1.0f - u - v;

    // Mip level: the width of the pixel's footprint on the surface, in texels; as without a lens.
    const float dx = ((float)x - camera.cx) / camera.fx;
    const float rx = T.data[0][0] * dx + T.data[0][1] * dy + T.data[0][2];
    const float ry = T.data[1][0] * dx + T.data[1][1] * dy + T.data[1][2];
    const float rz = T.data[2][0] * dx + T.data[2][1] * dy + T.data[2][2];
    const float along = normal[3 * f] * rx + normal[3 * f + 1] * ry + normal[3 * f + 2] * rz;
    const float cosine = fabsf(along) / sqrtf(rx * rx + ry * ry + rz * rz);
    const float facing = cosine > MIN_COSINE ? cosine : MIN_COSINE;
    const float texel_count = t_of[i] / (camera.fx * facing) * surfaces.density.data[f];
    const float level = log2_of(texel_count > 1.0e-6f ? texel_count : 1.0e-6f);

    // Trilinear sRGB value; texel centres lie at half integers, textures repeat.
    const int texture = surfaces.texture.data[f];
    const int top = sizes[3 * texture + 2] - 1;
    const float not_above = level < (float)top ? level : (float)top;
    const float clamped = not_above > 0.0f ? not_above : 0.0f;
    const int low = (int)clamped;
    const float a_level = clamped - (float)low;
    const float s_all = w * uv[6 * f] + u * uv[6 * f + 2] + v * uv[6 * f + 4];
    const float t_all = w * uv[6 * f + 1] + u * uv[6 * f + 3] + v * uv[6 * f + 5];
    const float s = s_all - floorf(s_all);
    const float t = t_all - floorf(t_all);
    auto bilinear = [&](int l, float& red, float& green, float& blue) INLINE {
        const int shifted_width = sizes[3 * texture] >> l;
        const int shifted_height = sizes[3 * texture + 1] >> l;
        const int width = shifted_width > 1 ? shifted_width : 1;
        const int height = shifted_height > 1 ? shifted_height : 1;
        const float xt = s * (float)width - 0.5f;
        const float yt = t * (float)height - 0.5f;
        const float x_floor = floorf(xt);
        const float y_floor = floorf(yt);
        const float ax = xt - x_floor;
        const float ay = yt - y_floor;
        const int left = (int)x_floor < 0 ? (int)x_floor + width : (int)x_floor;
        const int above = (int)y_floor < 0 ? (int)y_floor + height : (int)y_floor;
        const int right = (int)x_floor + 1 >= width ? 0 : (int)x_floor + 1;
        const int below = (int)y_floor + 1 >= height ? 0 : (int)y_floor + 1;
        const int start = surfaces.offsets.data[texture * level_count + l];
        const unsigned p00 = texels[start + above * width + left];
        const unsigned p01 = texels[start + above * width + right];
        const unsigned p10 = texels[start + below * width + left];
        const unsigned p11 = texels[start + below * width + right];
        auto mix = [&](int shift) {
            auto channel = [&](unsigned texel) { return (float)(int)((texel >> shift) & 255u); };
            const float upper = (1.0f - ax) * channel(p00) + ax * channel(p01);
            const float lower = (1.0f - ax) * channel(p10) + ax * channel(p11);
            return (1.0f - ay) * upper + ay * lower;
        };
        red = mix(0);
        green = mix(8);
        blue = mix(16);
    };
    float red, green, blue, coarse_red, coarse_green, coarse_blue;
    bilinear(low, red, green, blue);
    bilinear(low < top ? low + 1 : top, coarse_red, coarse_green, coarse_blue);
    red = (1.0f - a_level) * red + a_level * coarse_red;
    green = (1.0f - a_level) * green + a_level * coarse_green;
    blue = (1.0f - a_level) * blue + a_level * coarse_blue;

    // Radiance = linear albedo * irradiance; variance = read^2 + shot * intensity [F].
    const float* e = irradiance + 9 * f;
    const float scale = is_hit ? exposure : 0.0f;
    const float r = scale * (decode_of(red) * (w * e[0] + u * e[3] + v * e[6]));
    const float g = scale * (decode_of(green) * (w * e[1] + u * e[4] + v * e[7]));
    const float b = scale * (decode_of(blue) * (w * e[2] + u * e[5] + v * e[8]));
    const unsigned word = first_word(pixel);
    const unsigned more = pcg(word + 1u);
    const float r_noise = sqrtf(dark + shot * r) * tables.normals.data[word & 65535u];
    const float g_noise = sqrtf(dark + shot * g) * tables.normals.data[word >> 16];
    const float b_noise = sqrtf(dark + shot * b) * tables.normals.data[more & 65535u];
    color.data[3 * i] = encode_of(r + r_noise);
    color.data[3 * i + 1] = encode_of(g + g_noise);
    color.data[3 * i + 2] = encode_of(b + b_noise);
}
"""


@wp.func_native(
    _SHADE_SPAN.replace("PCG_SOURCE", PCG)
    .replace("VECTORISE", VECTORISE)
    .replace("INLINE", "__attribute__((always_inline))")
    .replace("ENCODE_STEPS", f"{ENCODE_STEPS}.0f")
    .replace("MIN_COSINE", f"{_MIN_COSINE}f")
)
def _shade_span(
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
    color: wp.array2d(dtype=wp.uint8),
): ...


@wp.kernel
def shade(
    T_world_camera: wp.array(dtype=wp.mat44),  # (B * poses an image,)
    camera: Pinhole,
    span: int,
    hits: Hits,  # of B * H * W rays
    surfaces: Surfaces,
    exposure: float,
    shot: float,
    read: float,
    keys: wp.array2d(dtype=wp.uint32),  # (B, 2)
    tables: Tables,
    color: wp.array2d(dtype=wp.uint8),  # (B * H * W, 3)
):
    """Sensor value = exposure * radiance + noise; one thread for ``span`` pixels of a row."""
    b, y, part = wp.tid()
    first = b * camera.height * camera.width
    x = part * span
    count = wp.min(span, camera.width - x)
    _shade_span(
        T_world_camera[pose_of_row(camera, b, y)],
        camera,
        first,
        y,
        x,
        count,
        hits,
        surfaces,
        exposure,
        shot,
        read,
        keys[b, 0],
        keys[b, 1],
        tables,
        color,
    )


@wp.kernel
def true_geometry(
    T_world_camera: wp.array(dtype=wp.mat44),  # (B * poses an image,)
    camera: Pinhole,
    hits: Hits,  # of B * H * W rays
    surfaces: Surfaces,
    depth: wp.array(dtype=wp.float32),  # (B * H * W,)
    normals: wp.array(dtype=wp.vec3),  # camera frame, towards the camera
    labels: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),  # world frame
):
    """Write depth, normal, label and point of each hit; 0 and label -1 where there is none."""
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
