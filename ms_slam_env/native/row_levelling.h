// Rectifies rolling-shutter images to one instant; see rolling_shutter.py.
#pragma once

#include "checked.h"

GIVEN(int, PIECE);  // columns processed together

// Fill a piece of row v of env b's rectified images, all its pixels step by step.
void level_piece(const auto& rows, int b, int v, int piece, const auto& color, const auto& depth) {
    constexpr int STEPS = 2;  // of the search for the point that moves into a pixel
    constexpr float NEAR_SQUARED
        = 0.25f;  // a pixel without such a point within half a pixel has no depth
    constexpr float SAME_SURFACE
        = 0.03f;  // largest difference of inverse depth within one surface, 1/m
    const int width = rows.size[0], height = rows.size[1];
    const int first = piece * PIECE, n = width - first < PIECE ? width - first : PIECE;
    const size_t image = size_t(b) * width * height;
    const auto depths = VIEW(const float, rows.depth, image, width* height);
    const auto colors = VIEW(const unsigned char, rows.color, 3 * image, 3 * width * height);
    const float fx = rows.focal[0], fy = rows.focal[1], cx = rows.centre[0], cy = rows.centre[1];
    const float per_fx = 1.0f / fx, per_fy = 1.0f / fy, per_height = 1.0f / (float)height;
    const float last_u = (float)(width - 1), last_v = (float)(height - 1);
    const wp::vec_t<3, float> turn = ELEMENT(rows.turn, b), step = ELEMENT(rows.step, b);
    const auto clamped = [](float value, float most) {
        const float low = value > 0.0f ? value : 0.0f;
        return low < most ? low : most;
    };
    float x[PIECE], y[PIECE], z[PIECE], qx[PIECE], qy[PIECE], qz[PIECE];
    // Positions of the points at depth z of row y at the time of the middle row, to second order in
    // the rotation; pixels without depth, z = 0, are far away.
    const auto to_middle = [&]() {
        for (int k = 0; k < n; ++k) {
            const float s = (y[k] + 0.5f) * per_height - 0.5f;
            const float scale = z[k] > 0.0f ? z[k] : 1.0f, moves = z[k] > 0.0f ? s : 0.0f;
            const float px = scale * (x[k] - cx) * per_fx, py = scale * (y[k] - cy) * per_fy;
            const float wx = s * turn[0], wy = s * turn[1], wz = s * turn[2];
            const float mx = wy * scale - wz * py + moves * step[0];
            const float my = wz * px - wx * scale + moves * step[1];
            const float mz = wx * py - wy * px + moves * step[2];
            qx[k] = px + mx + 0.5f * (wy * mz - wz * my);
            qy[k] = py + my + 0.5f * (wz * mx - wx * mz);
            qz[k] = scale + mz + 0.5f * (wx * my - wy * mx);
        }
    };
    float gap[PIECE], right[PIECE], down[PIECE], nearest[PIECE];
    int at[PIECE], is_inside[PIECE];
    const auto look = [&](int i) {
        return depths
            [(int)(clamped(y[i], last_v) + 0.5f) * width + (int)(clamped(x[i], last_u) + 0.5f)];
    };
    for (int k = 0; k < n; ++k) {
        x[k] = (float)(first + k);
        y[k] = (float)v;
    }
    for (int i = 0; i < STEPS; ++i) {
        for (int k = 0; k < n; ++k) z[k] = look(k);
        to_middle();
        for (int k = 0; k < n; ++k) {
            const float per_z = 1.0f / qz[k];
            const float gap_x = (float)(first + k) - (fx * qx[k] * per_z + cx);
            const float gap_y = (float)v - (fy * qy[k] * per_z + cy);
            gap[k] = gap_x * gap_x + gap_y * gap_y;
            x[k] += gap_x;
            y[k] += gap_y;
        }
    }
    for (int k = 0; k < n; ++k) {
        is_inside[k] = (x[k] > -0.5f) & (y[k] > -0.5f) & (x[k] < last_u + 0.5f)
            & (y[k] < last_v + 0.5f) & (gap[k] < NEAR_SQUARED);
        const float u = clamped(x[k], last_u), w = clamped(y[k], last_v);
        const int column = (int)clamped(u, last_u - 1.0f), row = (int)clamped(w, last_v - 1.0f);
        right[k] = u - (float)column;
        down[k] = w - (float)row;
        at[k] = row * width + column;
    }
    // Interpolate inverse depth between the pixels on the same surface as the nearest one.
    for (int k = 0; k < n; ++k) nearest[k] = look(k);
    for (int k = 0; k < n; ++k) {
        float sum = 0.0f, whole = 0.0f;
        for (int i = 0; i < 4; ++i) {
            const float there = depths[at[k] + (i / 2) * width + i % 2];
            const bool is_same
                = (there > 0.0f) & (fabsf(nearest[k] - there) <= SAME_SURFACE * nearest[k] * there);
            const float weight
                = (i % 2 ? right[k] : 1.0f - right[k]) * (i / 2 ? down[k] : 1.0f - down[k]);
            whole += is_same ? weight : 0.0f;
            sum += is_same ? weight / there : 0.0f;
        }
        z[k] = sum > 0.0f ? whole / sum : nearest[k];
    }
    to_middle();
    const size_t here = image + size_t(v) * width + first;
    for (int k = 0; k < n; ++k)
        ELEMENT(depth, here + k) = is_inside[k] && nearest[k] > 0.0f ? qz[k] : 0.0f;
    for (int k = 0; k < n; ++k) {
        for (int c = 0; c < 3; ++c) {
            const auto p = colors + 3 * at[k] + c;
            const auto q = p + 3 * width;
            const float top = p[0] + right[k] * (float)(p[3] - p[0]);
            const float low = q[0] + right[k] * (float)(q[3] - q[0]);
            ELEMENT(color, 3 * (here + k) + c)
                = (unsigned char)(top + down[k] * (low - top) + 0.5f);
        }
    }
}
