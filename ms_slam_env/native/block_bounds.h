// Bounding boxes of surfel blocks; see block_bounds.py.
#pragma once

#include "checked.h"

GIVEN(int, BLOCK_SIZE);

// Set box and expiry of the block of `n` surfels that starts at `first`.
void bound(const auto& surfels, const auto& blocks, int b, int first, int n, float threshold) {
    const size_t start = size_t(b) * surfels.radius.shape[1] + first;
    const auto p = VIEW(const float, surfels.position, 3 * start, 3 * n);
    const auto confidence = VIEW(const float, surfels.confidence, start, n);
    const auto seen = VIEW(const int, surfels.seen, start, n);
#if defined(__CUDA_ARCH__)
    constexpr int WIDE = 3;
#else
    constexpr int WIDE = 24;  // the coordinates of eight surfels at a time
#endif
    float low[WIDE], high[WIDE];
    for (int k = 0; k < WIDE; ++k) low[k] = high[k] = p[k % 3];
    int done = 0;
    for (; done + WIDE <= 3 * n; done += WIDE) {
        for (int k = 0; k < WIDE; ++k) {
            low[k] = p[done + k] < low[k] ? p[done + k] : low[k];
            high[k] = p[done + k] > high[k] ? p[done + k] : high[k];
        }
    }
    for (int k = 0; k < WIDE; ++k) {
        const int at = done + k < 3 * n ? done + k : k % 3;
        low[k] = p[at] < low[k] ? p[at] : low[k];
        high[k] = p[at] > high[k] ? p[at] : high[k];
    }
    for (int k = 3; k < WIDE; ++k) {
        low[k % 3] = low[k] < low[k % 3] ? low[k] : low[k % 3];
        high[k % 3] = high[k] > high[k % 3] ? high[k] : high[k % 3];
    }
    int expiry = 0x7fffffff;
    for (int k = 0; k < n; ++k) {
        const bool is_unstable = (confidence[k] > 0.0f) & (confidence[k] < threshold);
        const int due = is_unstable ? seen[k] : 0x7fffffff;
        expiry = due < expiry ? due : expiry;
    }
    const size_t block = size_t(b) * blocks.expiry.shape[1] + first / BLOCK_SIZE;
    ELEMENT(blocks.low, block) = wp::vec3(low[0], low[1], low[2]);
    ELEMENT(blocks.high, block) = wp::vec3(high[0], high[1], high[2]);
    ELEMENT(blocks.expiry, block) = expiry;
}
