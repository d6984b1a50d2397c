// Sums over the parts of a pass; see solver.py.
#pragma once

#include "checked.h"

GIVEN(int, SUMS);

// Add up all sums of a hypothesis over the slots, several at a time.
void reduce_all_sums(const auto& hypotheses, int slots, int b, int k) {
    const size_t which = size_t(b) * hypotheses.sums.shape[1] + k;
    auto partial = VIEW(
        const float, hypotheses.partial, which* hypotheses.partial.shape[2] * SUMS, slots * SUMS);
    double total[SUMS] = {};
    for (int slot = 0; slot < slots; ++slot, partial += SUMS)
        for (int i = 0; i < SUMS; ++i) total[i] += (double)partial[i];
    for (int i = 0; i < SUMS; ++i) ELEMENT(hypotheses.sums, which * SUMS + i) = total[i];
}
