// Noise of a structured-light depth camera along a row of pixels; see depth_noise.py.
//
// No branch depends on the pixel, so Clang vectorises the loop: it takes a fifth of the time of
// one Warp call per pixel (160x120).
#pragma once

#include "checked.h"
#include "random.h"

GIVEN(float, MAX_LATERAL_ANGLE);
GIVEN(float, AXIAL_KNEE);

void measure_span(
    const auto& T, const auto& camera, int first, int y, int x_first, int count, const auto& hit_t,
    const auto& hit_face, const auto& face_normal, const auto& face_plane, const auto& shadow,
    const auto& noise, unsigned key_0, unsigned key_1, const auto& normals, const auto& depth) {
    const int pixels = camera.height * camera.width;
    const auto face_of = VIEW(const int, hit_face, 0, first + pixels);
    const auto z_of = VIEW(const float, hit_t, 0, first + pixels);
    const auto normal_of = VIEW(const float, face_normal, 0, 3 * face_normal.shape[0]);  // 3 per face
    const float half_pi = 1.570796327f;
    const float px = T.data[0][3], py = T.data[1][3], pz = T.data[2][3];
    const float last_x = (float)(camera.width - 1);
    const float last_y = (float)(camera.height - 1);
    const bool is_bent = camera.bent.shape[0] > 0;
    const auto bent = VIEW(const float, camera.bent, 0, 2 * camera.bent.shape[0]);

    const auto smaller = [](float a, float b) { return a < b ? a : b; };
    auto larger = [](float a, float b) { return a > b ? a : b; };
    auto acos_of = [](float x) {  // for 0 to 1, error 2e-8: Abramowitz and Stegun 4.4.46
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
        bool is_read = face_of[i] >= 0 && ELEMENT(shadow, i) == 0;
        const int face = face_of[i] >= 0 ? face_of[i] : 0;
        const unsigned word = pcg(first_word(pixel, key_0, key_1) + 2u);
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
        const auto n = normal_of + 3 * face;
        const float towards = fabsf(n[0] * rx + n[1] * ry + n[2] * rz);
        const float angle_here
            = acos_of(smaller(towards / sqrtf(rx * rx + ry * ry + rz * rz), 1.0f));
        const float tilt = smaller(angle_here, MAX_LATERAL_ANGLE);
        const float sigma_px
            = noise.lateral * (0.8f + 0.035f * tilt / (half_pi - tilt)) / noise.pitch;
        const float u_all = (float)x + sigma_px * ELEMENT(normals, word & 65535u);
        const float v_all = (float)y + sigma_px * ELEMENT(normals, word >> 16);
        const float u = smaller(larger(u_all, 0.0f), last_x);
        const float v = smaller(larger(v_all, 0.0f), last_y);
        const int j = first + (int)(v + 0.5f) * camera.width + (int)(u + 0.5f);
        is_read = is_read && face_of[j] >= 0;
        const int sampled = face_of[j] >= 0 ? face_of[j] : 0;

        // The jittered ray hits the sampled surface; distortion shifts both rays alike.
        const float ex = (u - camera.cx) / camera.fx + (is_bent ? bent[2 * pixel] - plain_x : 0.0f);
        const float ey
            = (v - camera.cy) / camera.fy + (is_bent ? bent[2 * pixel + 1] - plain_y : 0.0f);
        const float sx = T.data[0][0] * ex + T.data[0][1] * ey + T.data[0][2];
        const float sy = T.data[1][0] * ex + T.data[1][1] * ey + T.data[1][2];
        const float sz = T.data[2][0] * ex + T.data[2][1] * ey + T.data[2][2];
        const auto m = normal_of + 3 * sampled;
        const float approach = m[0] * sx + m[1] * sy + m[2] * sz;
        const float met
            = (ELEMENT(face_plane, sampled) - (m[0] * px + m[1] * py + m[2] * pz)) / approach;
        const bool is_jittered = noise.lateral > 0.0f;
        const bool is_met = fabsf(approach) > 1.0e-3f && fabsf(met - z_of[j]) < 0.1f * z_of[j];
        float z = is_jittered && is_met ? met : z_of[j];
        const float cosine_there = fabsf(approach) / sqrtf(sx * sx + sy * sy + sz * sz);
        const float angle_there = acos_of(smaller(cosine_there, 1.0f));
        const float angle = is_jittered && sampled != face ? angle_there : angle_here;

        // Dropouts at grazing angles, beside depth edges, and out of range.
        const bool is_grazing = angle > noise.grazing_start;
        is_read = is_read && !(is_grazing && angle >= noise.grazing_end);
        const float ramp
            = (angle - noise.grazing_start) / (noise.grazing_end - noise.grazing_start);
        const float grazing_drop = is_grazing ? ramp : 0.0f;
        const float disparity = noise.disparity_at_1m / z;
        auto jumps = [&](int neighbour) {
            const float other = noise.disparity_at_1m / z_of[neighbour];
            return face_of[neighbour] < 0 || fabsf(other - disparity) > noise.edge_jump;
        };
        const bool is_edge_left = x > 0 && jumps(x > 0 ? i - 1 : i);
        const bool is_edge_right = x < camera.width - 1 && jumps(x < camera.width - 1 ? i + 1 : i);
        const bool is_edge_above = y > 0 && jumps(y > 0 ? i - camera.width : i);
        const bool is_edge_below
            = y < camera.height - 1 && jumps(y < camera.height - 1 ? i + camera.width : i);
        const bool is_edge = is_edge_left || is_edge_right || is_edge_above || is_edge_below;
        const float drop = is_edge ? larger(noise.edge_dropout, grazing_drop) : grazing_drop;
        const float chance = (float)(int)(drop_word >> 8) * (1.0f / 16777216.0f);
        is_read = is_read && !(chance < drop);
        is_read = is_read && z >= noise.min_range && z <= noise.max_range;

        // Axial noise [N], metres; its second term applies above 60 degrees.
        const float a = angle / (half_pi - tilt);
        const float steep = angle > AXIAL_KNEE ? 0.0001f / sqrtf(z) * a * a : 0.0f;
        const float sigma = (0.0012f + 0.0019f * (z - 0.4f) * (z - 0.4f) + steep) * noise.axial;
        const float quantisation = z * z / noise.disparity_at_1m * noise.step / 3.464101615f;
        const float rest = larger(sigma * sigma - quantisation * quantisation, 0.0f);
        const float axial = sqrtf(rest) * ELEMENT(normals, axial_word & 65535u);
        z = noise.axial > 0.0f ? z + axial : z;

        // Disparity quantisation [K]; 0.49999997 rounds halves up, and nothing smaller.
        const float steps_all = noise.disparity_at_1m / (larger(z, 1.0e-3f) * noise.step);
        const float steps = floorf(steps_all + 0.49999997f);
        is_read = is_read && (noise.step <= 0.0f || steps >= 1.0f);
        z = noise.step > 0.0f ? noise.disparity_at_1m / (steps * noise.step) : z;
        ELEMENT(depth, i) = is_read ? larger(z, 0.0f) : 0.0f;
    }
}
