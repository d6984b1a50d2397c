// Voxels of the true surface that are mapped correctly; see coverage.py.
#pragma once

#include "checked.h"
#include "seen_voxel.h"

// Implements `mark_seen`.
void mark_points(
    const auto& depth, const auto& rays, const auto& poses, const auto& grid, const auto& reachable,
    const auto& mapped, const auto& counts) {
    for (int i = 0; i < depth.shape[0]; ++i) {
        const double z = (double)ELEMENT(depth, i);
        if (!(z > 0.0)) continue;
        const auto ray = VIEW(const double, rays, 3 * i, 3);
        const long long voxel = seen_voxel(z, ray, ELEMENT(poses, 0), ELEMENT(poses, 1), grid);
        if (voxel < 0 || ELEMENT(mapped, voxel)) continue;
        ELEMENT(mapped, voxel) = 1;
        ELEMENT(counts, 0) += 1;
        ELEMENT(counts, 1) += ELEMENT(reachable, voxel);
    }
}

// Implements `voxel_of_pixel`.
auto voxel_seen(
    double z, const auto& rays, int i, const auto& T_true, const auto& T_estimate,
    const auto& grid) {
    const auto ray = VIEW(const double, rays, 3 * i, 3);
    return seen_voxel(z, ray, T_true, T_estimate, grid);
}
