// Resolves weighted sums of splats to images; see splatting.py.
#pragma once

#include "checked.h"

// Resolve the columns [start, end) of the row of pixels that starts at `first`; its rays have `y`
// at z = 1.
void resolve_row(
    const auto& sums, const auto& camera, float y, int first, int start, int end,
    const auto& vertices, const auto& normals, const auto& intensity, const auto& color) {
    const size_t from = size_t(first) + start;
    const int count = end - start;
    auto s = VIEW(const float, sums, 8 * from, 8 * count);
    RESTRICT(float) v = VIEW(float, vertices, 3 * from, 3 * count);
    RESTRICT(float) n = VIEW(float, normals, 3 * from, 3 * count);
    RESTRICT(float) c = VIEW(float, color, 3 * from, 3 * count);
    RESTRICT(float) grey = VIEW(float, intensity, from, count);
    const float per_column = 1.0f / camera.focal[0];
    for (int u = start; u < end; ++u, s += 8, v += 3, n += 3, c += 3) {
        const bool is_covered = s[3] > 0.0f;
        const float scale = is_covered ? 1.0f / s[3] : 0.0f;
        const float z = s[7] * scale;
        v[0] = is_covered ? z * ((float)u - camera.centre[0]) * per_column : 0.0f;
        v[1] = is_covered ? z * y : 0.0f;
        v[2] = z;
        const float length = sqrtf(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
        const float size = length > 0.0f ? length : 1.0f;
        n[0] = s[0] / size;
        n[1] = s[1] / size;
        n[2] = s[2] / size;
        c[0] = s[4] * scale;
        c[1] = s[5] * scale;
        c[2] = s[6] * scale;
        grey[u - start] = 0.299f * c[0] + 0.587f * c[1] + 0.114f * c[2];  // ITU-R BT.601 luma
    }
}
