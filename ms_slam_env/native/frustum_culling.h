// Find the blocks, then the surfels, that a camera may see; see frustum_culling.py.
#pragma once

#include "checked.h"

// List the blocks from `first` on that intersect a frustum; return how many were tested.
//
// A block is culled only if its box is entirely outside one plane of the frustum.
int list_some_visible_blocks(
    const auto& blocks, int b, int first, int end, const auto& frustum, int row) {
#if defined(__CUDA_ARCH__)
    constexpr int LANES = 1;  // blocks at a time
#else
    constexpr int LANES = 64;
#endif
    const int n = end - first < LANES ? end - first : LANES;
    const size_t start = size_t(b) * blocks.low.shape[1] + first;
    const auto low = VIEW(const float, blocks.low, 3 * start, 3 * n);
    const auto high = VIEW(const float, blocks.high, 3 * start, 3 * n);
    // The planes of the frustum: a point p in the camera frame is inside if m . p + d > 0.
    const wp::mat33 R = frustum.R;
    const wp::vec3 t = frustum.t;
    const float inwards[6][3] = {{0.0f, 0.0f, 1.0f},           {0.0f, 0.0f, -1.0f},
                                 {1.0f, 0.0f, -frustum.low_u}, {-1.0f, 0.0f, frustum.high_u},
                                 {0.0f, 1.0f, -frustum.low_v}, {0.0f, -1.0f, frustum.high_v}};
    int seen[LANES];
    for (int k = 0; k < n; ++k) seen[k] = 1;
#pragma unroll
    for (int plane = 0; plane < 6; ++plane) {
        const float* m = inwards[plane];
        const float ax = m[0] * R.data[0][0] + m[1] * R.data[1][0] + m[2] * R.data[2][0];
        const float ay = m[0] * R.data[0][1] + m[1] * R.data[1][1] + m[2] * R.data[2][1];
        const float az = m[0] * R.data[0][2] + m[1] * R.data[1][2] + m[2] * R.data[2][2];
        const float d = m[0] * t[0] + m[1] * t[1] + m[2] * t[2]
            + (plane == 0       ? -frustum.z_near
                   : plane == 1 ? frustum.z_far
                                : 0.0f);
        // Margin for rounding, which grows with the terms of the sum.
        const float size = fabsf(ax) + fabsf(ay) + fabsf(az);
        const float shift = fabsf(m[0] * t[0]) + fabsf(m[1] * t[1]) + fabsf(m[2] * t[2]);
        for (int k = 0; k < n; ++k) {
            const float x = 0.5f * (low[3 * k] + high[3 * k]);
            const float y = 0.5f * (low[3 * k + 1] + high[3 * k + 1]);
            const float z = 0.5f * (low[3 * k + 2] + high[3 * k + 2]);
            const float reach = fabsf(ax) * (high[3 * k] - x) + fabsf(ay) * (high[3 * k + 1] - y)
                + fabsf(az) * (high[3 * k + 2] - z);
            const float room = 1.0e-5f * (size * (1.0f + fabsf(x) + fabsf(y) + fabsf(z)) + shift);
            seen[k] &= ax * x + ay * y + az * z + d + reach + room >= 0.0f;
        }
    }
    int which[LANES];
    int found = 0;
    for (int k = 0; k < n; ++k) {
        which[found] = k;
        found += seen[k];
    }
    if (found == 0) return n;
    const int place = wp::atomic_add(&ELEMENT(blocks.num_listed, row), found);
    auto listed = VIEW(int, blocks.listed, size_t(row) * blocks.listed.shape[1] + place, found);
    for (int m = 0; m < found; ++m) listed[m] = first + which[m];
    return n;
}

// List the visible surfels from `first` on; return how many were tested.
//
// Several at a time on the CPU, at most to `end`; one per thread on a GPU.
//
// A surface consists of about 1 / r^2 discs of radius r pixels per pixel. If `layers` of the
// frustum is finite, a surfel is listed with probability `layers` r^2. The choice depends on its
// slot in the map, so it is always the same.
int list_some_visible(
    const auto& surfels, int b, int first, int end, const auto& frustum, int seen_from, int seen_to,
    int row, const auto& visible) {
#if defined(__CUDA_ARCH__)
    constexpr int LANES = 1;  // surfels at a time
#else
    constexpr int LANES = 64;
#endif
    const int n = end - first < LANES ? end - first : LANES;
    const size_t start = size_t(b) * surfels.radius.shape[1] + first;
    const auto positions = VIEW(const float, surfels.position, 3 * start, 3 * n);
    const auto normals = VIEW(const float, surfels.normal, 3 * start, 3 * n);
    const auto confidence = VIEW(const float, surfels.confidence, start, n);
    const auto seen = VIEW(const int, surfels.seen, start, n);
    const wp::mat33 R = frustum.R;
    const wp::vec3 t = frustum.t;
    float x[LANES], y[LANES], z[LANES];
    int inside[LANES];
    int found = 0;
    for (int k = 0; k < n; ++k) {
        const float px = positions[3 * k], py = positions[3 * k + 1], pz = positions[3 * k + 2];
        x[k] = R.data[0][0] * px + R.data[0][1] * py + R.data[0][2] * pz + t[0];
        y[k] = R.data[1][0] * px + R.data[1][1] * py + R.data[1][2] * pz + t[1];
        z[k] = R.data[2][0] * px + R.data[2][1] * py + R.data[2][2] * pz + t[2];
        inside[k] = (z[k] > frustum.z_near) & (z[k] < frustum.z_far) & (x[k] > frustum.low_u * z[k])
            & (x[k] < frustum.high_u * z[k]) & (y[k] > frustum.low_v * z[k])
            & (y[k] < frustum.high_v * z[k]) & (confidence[k] > 0.0f) & (seen[k] >= seen_from)
            & (seen[k] <= seen_to);
        found += inside[k];
    }
    if (found == 0) return n;
    float nx[LANES], ny[LANES], nz[LANES];
    for (int k = 0; k < n; ++k) {
        const float px = normals[3 * k], py = normals[3 * k + 1], pz = normals[3 * k + 2];
        nx[k] = R.data[0][0] * px + R.data[0][1] * py + R.data[0][2] * pz;
        ny[k] = R.data[1][0] * px + R.data[1][1] * py + R.data[1][2] * pz;
        nz[k] = R.data[2][0] * px + R.data[2][1] * py + R.data[2][2] * pz;
        inside[k] &= nx[k] * x[k] + ny[k] * y[k] + nz[k] * z[k] < 0.0f;
    }
    if (frustum.layers < INFINITY) {
        const auto radius = VIEW(const float, surfels.radius, start, n);
        for (int k = 0; k < n; ++k) {
            const float radius_px = radius[k] * frustum.focal / z[k];
            const float draw = (((unsigned)(first + k) * 2654435769u) >> 8) / 16777216.0f;
            inside[k] &= draw < frustum.layers * radius_px * radius_px;
        }
    }
    int which[LANES];
    found = 0;
    for (int k = 0; k < n; ++k) {
        which[found] = k;
        found += inside[k];
    }
    const size_t place = size_t(row) * visible.index.shape[1]
        + wp::atomic_add(&ELEMENT(visible.count, row), found);
    for (int m = 0; m < found; ++m) {
        const int k = which[m];
        ELEMENT(visible.index, place + m) = first + k;
        ELEMENT(visible.position, place + m) = wp::vec3(x[k], y[k], z[k]);
        ELEMENT(visible.normal, place + m) = wp::vec3(nx[k], ny[k], nz[k]);
        ELEMENT(visible.radius, place + m) = ELEMENT(surfels.radius, start + k);
    }
    return n;
}
