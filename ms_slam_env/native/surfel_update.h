// Averages surfels of the map with the readings of a frame; see surfel_update.py.
#pragma once

#include "checked.h"

GIVEN(float, STEEPEST);
GIVEN(float, COARSER);

// Update the listed surfels from `first` on, at most to `end`; return their number.
int update_some(
    const auto& surfels, const auto& visible, int b, int first, int end, const auto& camera,
    const auto& parameters, const auto& frame) {
#if defined(__CUDA_ARCH__)
    constexpr int LANES = 1;  // surfels at a time
#define SINGLE_LOADS
#else
    constexpr int LANES = 64;
#define SINGLE_LOADS _Pragma("clang loop vectorize(disable)")  // faster than gathers
    typedef float four __attribute__((vector_size(16), aligned(4)));
#endif
    const wp::mat44 T = ELEMENT(frame.poses, b);
    const int now = ELEMENT(frame.time, b);
    const float gain = ELEMENT(frame.weight, b);
    const int n = end - first < LANES ? end - first : LANES;
    const int width = camera.width, height = camera.height;
    const float fx = camera.focal[0], fy = camera.focal[1];
    const float cx = camera.centre[0], cy = camera.centre[1];
    const size_t listed = size_t(b) * visible.index.shape[1] + first;
    const size_t map = size_t(b) * surfels.radius.shape[1];
    const int image = b * height * width, pixels = height * width;
    const auto depths = VIEW(const float, frame.depth, image, pixels);
    const auto colors = VIEW(const float, frame.color, 3 * size_t(image), 3 * pixels);
    const auto live_normals = VIEW(const float, frame.normals, 3 * size_t(image), 3 * pixels);
    const auto covered = VIEW(int, frame.covered, image, pixels);
    const auto P = VIEW(const float, visible.position, 3 * listed, 3 * n);
    const auto N = VIEW(const float, visible.normal, 3 * listed, 3 * n);
    const auto index = VIEW(const int, visible.index, listed, n);

    // Image positions and planes of the surfels: a reading at depth z is z (x, y, 1), and its
    // distance along n is z n . (x, y, 1) - n . p = z slope - offset.
    int pixel[LANES];
    float right[LANES], down[LANES], tolerance[LANES], offset[LANES], slope[LANES];
    const float per_fx = 1.0f / fx, per_fy = 1.0f / fy;
    for (int k = 0; k < n; ++k) {
        const float x = P[3 * k], y = P[3 * k + 1], z = P[3 * k + 2];
        const float nx = N[3 * k], ny = N[3 * k + 1], nz = N[3 * k + 2];
        const float per_z = 1.0f / z;
        const float u = fx * x * per_z + cx;
        const float v = fy * y * per_z + cy;
        int u0 = (int)u, v0 = (int)v;
        u0 = u0 > 0 ? u0 : 0;
        v0 = v0 > 0 ? v0 : 0;
        u0 = u0 < width - 2 ? u0 : width - 2;
        v0 = v0 < height - 2 ? v0 : height - 2;
        const float r = u - (float)u0 > 0.0f ? u - (float)u0 : 0.0f;
        const float d = v - (float)v0 > 0.0f ? v - (float)v0 : 0.0f;
        right[k] = r < 1.0f ? r : 1.0f;
        down[k] = d < 1.0f ? d : 1.0f;
        pixel[k] = v0 * width + u0;
        tolerance[k] = parameters.distance_m * (0.7f + 0.3f * z * z);
        offset[k] = nx * x + ny * y + nz * z;
        slope[k] = ((float)u0 - cx) * (nx * per_fx) + ((float)v0 - cy) * (ny * per_fy) + nz;
    }

#if !defined(__CUDA_ARCH__) && !defined(MS_SLAM_CHECKED)
    for (int k = 0; k < n; ++k) {  // prefetch what is needed later
        const float* color = colors + 3 * size_t(pixel[k]);
        const float* normal = live_normals + 3 * size_t(pixel[k]);
        __builtin_prefetch(color);
        __builtin_prefetch(color + 3 * width);
        __builtin_prefetch(normal);
        __builtin_prefetch(normal + 3 * width);
    }
#endif

    // The four surrounding readings: bilinear weight on the surfel's surface, otherwise 0.
    float w00[LANES], w01[LANES], w10[LANES], w11[LANES];
    SINGLE_LOADS
    for (int k = 0; k < n; ++k) {
        const auto z = depths + pixel[k];
        w00[k] = z[0];
        w01[k] = z[1];
        w10[k] = z[width];
        w11[k] = z[width + 1];
    }
    float total[LANES], shift[LANES];
    int behind[LANES], c00[LANES], c01[LANES], c10[LANES], c11[LANES];
    const float covers = parameters.coverage_px * parameters.coverage_px;
    for (int k = 0; k < n; ++k) {
        const float z = P[3 * k + 2];
        const float step_u = N[3 * k] * per_fx, step_v = N[3 * k + 1] * per_fy;
        const float within = tolerance[k], along = 3.0f * tolerance[k];
        const float left = 1.0f - right[k], up = 1.0f - down[k];
        const float d00 = slope[k] * w00[k] - offset[k];
        const float d01 = (slope[k] + step_u) * w01[k] - offset[k];
        const float d10 = (slope[k] + step_v) * w10[k] - offset[k];
        const float d11 = (slope[k] + step_u + step_v) * w11[k] - offset[k];
        const float b00 = w00[k] - z, b01 = w01[k] - z, b10 = w10[k] - z, b11 = w11[k] - z;
        const bool v00 = w00[k] > 0.0f, v01 = w01[k] > 0.0f, v10 = w10[k] > 0.0f,
                   v11 = w11[k] > 0.0f;
        const bool n00 = v00 & (fabsf(d00) < within) & (fabsf(b00) < along);
        const bool n01 = v01 & (fabsf(d01) < within) & (fabsf(b01) < along);
        const bool n10 = v10 & (fabsf(d10) < within) & (fabsf(b10) < along);
        const bool n11 = v11 & (fabsf(d11) < within) & (fabsf(b11) < along);
        const bool beyond = (b00 > along) & (b01 > along) & (b10 > along) & (b11 > along);
        behind[k] = v00 & v01 & v10 & v11 & beyond;
        w00[k] = n00 ? left * up : 0.0f;
        w01[k] = n01 ? right[k] * up : 0.0f;
        w10[k] = n10 ? left * down[k] : 0.0f;
        w11[k] = n11 ? right[k] * down[k] : 0.0f;
        total[k] = w00[k] + w01[k] + w10[k] + w11[k];
        shift[k] = w00[k] * d00 + w01[k] * d01 + w10[k] * d10 + w11[k] * d11;
        const float l2 = left * left, r2 = right[k] * right[k], u2 = up * up,
                    d2 = down[k] * down[k];
        c00[k] = (w00[k] > 0.0f) & (r2 + d2 < covers);
        c01[k] = (w01[k] > 0.0f) & (l2 + d2 < covers);
        c10[k] = (w10[k] > 0.0f) & (r2 + u2 < covers);
        c11[k] = (w11[k] > 0.0f) & (l2 + u2 < covers);
    }
    for (int k = 0; k < n; ++k) {
        const auto at = covered + pixel[k];
#if defined(__CUDA_ARCH__)
        if (c00[k]) at[0] = 1;
        if (c01[k]) at[1] = 1;
        if (c10[k]) at[width] = 1;
        if (c11[k]) at[width + 1] = 1;
#else
        at[0] |= c00[k];
        at[1] |= c01[k];
        at[width] |= c10[k];
        at[width + 1] |= c11[k];
#endif
    }

    // Values of the frame and of the map.
    float alpha[LANES], confidence[LANES], radius[LANES];
    int moving[LANES];
    float lx[LANES], ly[LANES], lz[LANES], red[LANES], green[LANES], blue[LANES];
    float old_red[LANES], old_green[LANES], old_blue[LANES];
    SINGLE_LOADS
    for (int k = 0; k < n; ++k) {
        const int nearest = pixel[k] + (right[k] >= 0.5f ? 1 : 0) + (down[k] >= 0.5f ? width : 0);
        const auto normal = live_normals + 3 * size_t(nearest);
        lx[k] = normal[0];
        ly[k] = normal[1];
        lz[k] = normal[2];
        alpha[k] = gain * ELEMENT(frame.radial, nearest);
        moving[k] = ELEMENT(frame.moving, image + nearest);
    }
    SINGLE_LOADS
    for (int k = 0; k < n; ++k) {
        const size_t i = map + index[k];
        confidence[k] = ELEMENT(surfels.confidence, i);
        radius[k] = ELEMENT(surfels.radius, i);
        const auto color = VIEW(const float, surfels.color, 3 * i, 3);
        old_red[k] = color[0];
        old_green[k] = color[1];
        old_blue[k] = color[2];
    }
    for (int k = 0; k < n; ++k) {
        const auto color = colors + 3 * size_t(pixel[k]);
        const auto below = color + 3 * width;
#if defined(__CUDA_ARCH__)
        red[k] = w00[k] * color[0] + w01[k] * color[3] + w10[k] * below[0] + w11[k] * below[3];
        green[k] = w00[k] * color[1] + w01[k] * color[4] + w10[k] * below[1] + w11[k] * below[4];
        blue[k] = w00[k] * color[2] + w01[k] * color[5] + w10[k] * below[2] + w11[k] * below[5];
#else
        // Two neighbours are six floats: the first three, and the last three as part of four.
        const four t = PACKED(const four, color + 2), l = PACKED(const four, below + 2);
        const four sum = w00[k] * PACKED(const four, color)
            + w01[k] * __builtin_shufflevector(t, t, 1, 2, 3, 3)
            + w10[k] * PACKED(const four, below)
            + w11[k] * __builtin_shufflevector(l, l, 1, 2, 3, 3);
        red[k] = sum[0];
        green[k] = sum[1];
        blue[k] = sum[2];
#endif
    }

    // The weighted average; confidence is the weight of earlier readings.
    float px[LANES], py[LANES], pz[LANES], nx[LANES], ny[LANES], nz[LANES];
    int matched[LANES], refined[LANES];
    for (int k = 0; k < n; ++k) {
        const float x = P[3 * k], y = P[3 * k + 1], z = P[3 * k + 2];
        const float cosine = -(lx[k] * x + ly[k] * y + lz[k] * z) / sqrtf(x * x + y * y + z * z);
        const float steep = cosine > STEEPEST ? cosine : STEEPEST;
        const float live_radius = parameters.radius_px * z / (fx * steep);
        const float nearness = z > parameters.full_m ? parameters.full_m / z : 1.0f;
        alpha[k] *= nearness * nearness * nearness * nearness;
        const float agreement = lx[k] * N[3 * k] + ly[k] * N[3 * k + 1] + lz[k] * N[3 * k + 2];
        const float squared = lx[k] * lx[k] + ly[k] * ly[k] + lz[k] * lz[k];
        const bool hit = total[k] > 0.25f, agrees = agreement > parameters.min_cosine;
        const bool goes = hit & (moving[k] != 0);
        matched[k] = hit & !goes;
        refined[k] = matched[k] & agrees & (live_radius < COARSER * radius[k]);
        const float per_total = 1.0f / total[k];
        const float keep = confidence[k] / (confidence[k] + alpha[k]);
        const float take = 1.0f - keep;
        const float move = take * (shift[k] * per_total);
        px[k] = x + move * N[3 * k];
        py[k] = y + move * N[3 * k + 1];
        pz[k] = z + move * N[3 * k + 2];
        const float a = keep * N[3 * k] + take * lx[k];
        const float b = keep * N[3 * k + 1] + take * ly[k];
        const float c = keep * N[3 * k + 2] + take * lz[k];
        const float size = sqrtf(a * a + b * b + c * c);
        nx[k] = a / size;
        ny[k] = b / size;
        nz[k] = c / size;
        const float share = take * per_total;
        red[k] = keep * old_red[k] + share * red[k];
        green[k] = keep * old_green[k] + share * green[k];
        blue[k] = keep * old_blue[k] + share * blue[k];
        radius[k] = keep * radius[k] + take * live_radius;
        const float more = confidence[k] + alpha[k];
        const float grown = more < parameters.max_confidence ? more : parameters.max_confidence;
        const float doubted = squared > 0.0f ? confidence[k] - 0.5f * alpha[k] : confidence[k];
        const float halved = (behind[k] | goes) ? 0.5f * confidence[k] - 0.5f : confidence[k];
        const float result = (hit & !goes) ? (agrees ? grown : doubted) : halved;
        confidence[k] = result > 0.0f ? result : 0.0f;
    }

    int dead = 0;
    for (int k = 0; k < n; ++k) {
        const size_t i = map + index[k];
        ELEMENT(surfels.confidence, i) = confidence[k];
        dead += confidence[k] == 0.0f;
        if (matched[k]) ELEMENT(surfels.seen, i) = now;
        if (refined[k]) {
            auto position = VIEW(float, surfels.position, 3 * i, 3);
            auto normal = VIEW(float, surfels.normal, 3 * i, 3);
            auto color = VIEW(float, surfels.color, 3 * i, 3);
            for (int row = 0; row < 3; ++row) {
                const float* R = T.data[row];
                position[row] = R[0] * px[k] + R[1] * py[k] + R[2] * pz[k] + R[3];
                normal[row] = R[0] * nx[k] + R[1] * ny[k] + R[2] * nz[k];
            }
            color[0] = red[k];
            color[1] = green[k];
            color[2] = blue[k];
            ELEMENT(surfels.radius, i) = radius[k];
        }
    }
    if (dead) wp::atomic_add(&ELEMENT(surfels.dead, b), dead);
#undef SINGLE_LOADS
    return n;
}
