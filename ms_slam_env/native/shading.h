// Colour at each ray hit along a row of pixels; see shading.py.
//
// No branch depends on the pixel, so Clang vectorises the loop.
#pragma once

#include "checked.h"
#include "random.h"

GIVEN(float, ENCODE_STEPS);
GIVEN(float, MIN_COSINE);

void shade_span(
    const auto& T, const auto& camera, int first, int y, int x_first, int count, const auto& hits,
    const auto& surfaces, float exposure, float shot, float read, unsigned key_0, unsigned key_1,
    const auto& tables, const auto& color) {
    const int end = first + camera.height * camera.width;
    const int face_count = surfaces.texture.shape[0];
    const auto face_of = VIEW(const int, hits.face, 0, end);
    const auto decode = VIEW(const float, tables.decode, 0, tables.decode.shape[0]);
    const auto encode = VIEW(const float, tables.encode, 0, tables.encode.shape[0]);
    const auto t_of = VIEW(const float, hits.t, 0, end);
    const auto u_of = VIEW(const float, hits.u, 0, end);
    const auto v_of = VIEW(const float, hits.v, 0, end);
    const auto uv = VIEW(const float, surfaces.uv, 0, 6 * face_count);  // 6 per face
    const auto irradiance = VIEW(const float, surfaces.irradiance, 0, 9 * face_count);  // 9 per face
    const auto normal = VIEW(const float, surfaces.normal, 0, 3 * face_count);
    const auto sizes = VIEW(const int, surfaces.sizes, 0, 3 * surfaces.sizes.shape[0]);
    const auto texels = VIEW(const unsigned, surfaces.texels, 0, surfaces.texels.shape[0]);
    const int level_count = surfaces.offsets.shape[1];
    const float dark = read * read;
    const float dy = ((float)y - camera.cy) / camera.fy;

    const auto log2_of = [](float value) {  // exponent, and the atanh series for the mantissa
        union {
            float f;
            int i;
        } bits;
        bits.f = value;
        const int exponent
            = (bits.i - 0x3f3504f3) >> 23;  // the mantissa is in [1/sqrt(2), sqrt(2)]
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

        // Mip level: the width of the pixel's footprint on the surface, in texels; distortion is
        // ignored.
        const float dx = ((float)x - camera.cx) / camera.fx;
        const float rx = T.data[0][0] * dx + T.data[0][1] * dy + T.data[0][2];
        const float ry = T.data[1][0] * dx + T.data[1][1] * dy + T.data[1][2];
        const float rz = T.data[2][0] * dx + T.data[2][1] * dy + T.data[2][2];
        const float along = normal[3 * f] * rx + normal[3 * f + 1] * ry + normal[3 * f + 2] * rz;
        const float cosine = fabsf(along) / sqrtf(rx * rx + ry * ry + rz * rz);
        const float facing = cosine > MIN_COSINE ? cosine : MIN_COSINE;
        const float texel_count = t_of[i] / (camera.fx * facing) * ELEMENT(surfaces.density, f);
        const float level = log2_of(texel_count > 1.0e-6f ? texel_count : 1.0e-6f);

        // Trilinear sRGB value; texel centres lie at half integers, textures repeat.
        const int texture = ELEMENT(surfaces.texture, f);
        const int top = sizes[3 * texture + 2] - 1;
        const float not_above = level < (float)top ? level : (float)top;
        const float clamped = not_above > 0.0f ? not_above : 0.0f;
        const int low = (int)clamped;
        const float a_level = clamped - (float)low;
        const float s_all = w * uv[6 * f] + u * uv[6 * f + 2] + v * uv[6 * f + 4];
        const float t_all = w * uv[6 * f + 1] + u * uv[6 * f + 3] + v * uv[6 * f + 5];
        const float s = s_all - floorf(s_all);
        const float t = t_all - floorf(t_all);
        auto bilinear
            = [&](int l, float& red, float& green, float& blue) __attribute__((always_inline)) {
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
                  const int start = ELEMENT(surfaces.offsets, texture * level_count + l);
                  const unsigned p00 = texels[start + above * width + left];
                  const unsigned p01 = texels[start + above * width + right];
                  const unsigned p10 = texels[start + below * width + left];
                  const unsigned p11 = texels[start + below * width + right];
                  auto mix = [&](int shift) {
                      auto channel
                          = [&](unsigned texel) { return (float)(int)((texel >> shift) & 255u); };
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
        const auto e = irradiance + 9 * f;
        const float scale = is_hit ? exposure : 0.0f;
        const float r = scale * (decode_of(red) * (w * e[0] + u * e[3] + v * e[6]));
        const float g = scale * (decode_of(green) * (w * e[1] + u * e[4] + v * e[7]));
        const float b = scale * (decode_of(blue) * (w * e[2] + u * e[5] + v * e[8]));
        const unsigned word = first_word(pixel, key_0, key_1);
        const unsigned more = pcg(word + 1u);
        const float r_noise = sqrtf(dark + shot * r) * ELEMENT(tables.normals, word & 65535u);
        const float g_noise = sqrtf(dark + shot * g) * ELEMENT(tables.normals, word >> 16);
        const float b_noise = sqrtf(dark + shot * b) * ELEMENT(tables.normals, more & 65535u);
        ELEMENT(color, 3 * i) = encode_of(r + r_noise);
        ELEMENT(color, 3 * i + 1) = encode_of(g + g_noise);
        ELEMENT(color, 3 * i + 2) = encode_of(b + b_noise);
    }
}
