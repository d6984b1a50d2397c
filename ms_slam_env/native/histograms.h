// Inner loops of the divergence: images must be contiguous.
#pragma once

#include "checked.h"

// Inverse depth of a row of pixels.
void invert_row(const auto& depth, int width, const auto& inverse) {
    for (int u = 0; u < width; ++u) {
        const float z = ELEMENT(depth, u);
        ELEMENT(inverse, u) = 1.0f / (z > 1.0e-20f ? z : 1.0e-20f);
    }
}

// Add the weights of direction `n`, of length 1 / `inverse`, to the bins near its cell.
void add_to_bins(
    const auto& n, float inverse, const auto& directions, const auto& near, int cell,
    float cos_alpha, int first, const auto& sums) {
    const auto listed = VIEW(const int, near, size_t(cell) * near.shape[1], near.shape[1]);
    auto out = VIEW(float, sums, first, directions.shape[0]);
    for (int k = 1; k <= listed[0]; ++k) {
        const wp::vec3& d = ELEMENT(directions, listed[k]);
        const float cosine = (n[0] * d[0] + n[1] * d[1] + n[2] * d[2]) * inverse;
        out[listed[k]] += cosine > cos_alpha ? cosine - cos_alpha : 0.0f;
    }
}

// Count the grey levels of a row of pixels.
void count_row(
    const auto& intensity, const auto& depth, int only_with_depth, const auto& column_window,
    int width, int first, const auto& counts) {
    const auto grey = VIEW(const float, intensity, 0, width);
    const auto z = VIEW(const float, depth, 0, width);
    for (int u = 0; u < width; ++u) {
        if (only_with_depth && !(z[u] > 0.0f)) continue;
        int level = (int)(grey[u] + 0.5f);
        level = level < 0 ? 0 : level > 255 ? 255 : level;
        wp::atomic_add(&ELEMENT(counts, first + 256 * ELEMENT(column_window, u) + level), 1);
    }
}
