// Voxels of the true surface that are mapped correctly; see coverage.py.
//
// Matrix-vector products are summed in the order of BLAS, with fused multiply-add where the
// processor has it, so that they equal NumPy's bit for bit.
#pragma once

#include "checked.h"

// Implements `mark_seen`.
void mark_points(
    const auto& depth, const auto& rays, const auto& poses, const auto& grid, const auto& reachable,
    const auto& mapped, const auto& counts) {
#pragma clang fp contract(off)
    auto product = [](const double* row, const double* p) {
#pragma clang fp contract(on)
        return row[2] * p[2] + (row[1] * p[1] + row[0] * p[0]);
    };
    const wp::mat_t<4, 4, double>& T_true = ELEMENT(poses, 0);
    const wp::mat_t<4, 4, double>& T_estimate = ELEMENT(poses, 1);
    for (int i = 0; i < depth.shape[0]; ++i) {
        const double z = (double)ELEMENT(depth, i);
        if (!(z > 0.0)) continue;
        const auto ray = VIEW(const double, rays, 3 * i, 3);
        const double p[3] = {ray[0] * z, ray[1] * z, ray[2] * z};
        double squared = 0.0;
        long long flat = 0;
        bool inside = true;
        for (int k = 0; k < 3; ++k) {
            const double at = product(T_true.data[k], p) + T_true.data[k][3];
            const double off = product(T_estimate.data[k], p) + T_estimate.data[k][3] - at;
            squared += off * off;
            const double cell = floor((at - grid.origin[k]) / grid.voxel_m);
            inside = inside && cell >= 0.0 && cell < (double)grid.shape[k];
            flat = flat * grid.shape[k] + (inside ? (long long)cell : 0);
        }
        if (!inside || !(sqrt(squared) < grid.voxel_m) || ELEMENT(mapped, flat)) continue;
        ELEMENT(mapped, flat) = 1;
        ELEMENT(counts, 0) += 1;
        ELEMENT(counts, 1) += ELEMENT(reachable, flat);
    }
}
