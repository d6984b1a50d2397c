// Sums over the pieces of a pass; see solver.py.
#pragma once

#include "checked.h"

GIVEN(int, SUMS);

// The same for all of them, several at a time.
void reduce_all_sums(const auto& hypotheses, int slots, int b, int k) {
    const size_t which = size_t(b) * hypotheses.sums.shape[1] + k;
    auto partial = VIEW(
        const float, hypotheses.partial, which* hypotheses.partial.shape[2] * SUMS, slots * SUMS);
    double total[SUMS] = {};
    for (int slot = 0; slot < slots; ++slot, partial += SUMS)
        for (int i = 0; i < SUMS; ++i) total[i] += (double)partial[i];
    for (int i = 0; i < SUMS; ++i) ELEMENT(hypotheses.sums, which * SUMS + i) = total[i];
}
