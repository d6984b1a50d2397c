// Parts of a batched environment's step; see env/batched/kernels.py. On a CPU they give NumPy's
// results bit for bit where its BLAS sums as on processors without AVX-512.
#pragma once

#include "checked.h"

// Grey level of a colour (BT.601), as `intensity_image` rounds it.
float grey_level(int r, int g, int b) {
#pragma clang fp contract(off)
    return rintf((float)r * 0.299f + (float)g * 0.587f + (float)b * 0.114f);
}

// Whether a ball can move freely from `start` to `end`, as `FreeSpace.segments_are_free` has it.
int way_is_free(
    const auto& distance, const auto& low, double edge, const auto& start, const auto& end,
    double radius) {
#pragma clang fp contract(off)
    const int shape[3] = {distance.shape[0], distance.shape[1], distance.shape[2]};
    const double way[3] = {end[0] - start[0], end[1] - start[1], end[2] - start[2]};
    const double length = sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
    const int parts = (int)ceil(length / (0.4 * edge));
    const int steps = parts > 1 ? parts : 1;
    const double needed = radius + (0.5 * length / steps + 0.4 * edge);
    for (int s = 0; s <= steps; ++s) {
        const double share = s == steps ? 1.0 : s * (1.0 / steps);
        long long base = 0;
        double f[3];
        for (int k = 0; k < 3; ++k) {
            const double at = (start[k] + share * way[k] - low[k]) / edge;
            if (!(at >= 0.0 && at <= shape[k] - 1.001)) return 0;
            const int cell = (int)at;
            f[k] = at - cell;
            base = base * shape[k] + cell;
        }
        double along_y[2], along_x[2][2];
        for (int j = 0; j < 2; ++j)
            for (int k = 0; k < 2; ++k) {
                const long long near = base + j * shape[2] + k;
                const float a = ELEMENT(distance, near);
                const float b = ELEMENT(distance, near + (long long)shape[1] * shape[2]);
                along_x[j][k] = a + (double)(b - a) * f[0];
            }
        for (int k = 0; k < 2; ++k)
            along_y[k] = along_x[0][k] + (along_x[1][k] - along_x[0][k]) * f[1];
        if (!(along_y[0] + (along_y[1] - along_y[0]) * f[2] > needed)) return 0;
    }
    return 1;
}
