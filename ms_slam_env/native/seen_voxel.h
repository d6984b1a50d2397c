// Which voxel of the true surface a pixel maps; see coverage.py.
//
// Matrix-vector products are summed in the order of BLAS, with fused multiply-add where the
// processor has it, so that they equal NumPy's bit for bit.
#pragma once

// Voxel of the point at depth `z` > 0 along `ray`; -1 outside the grid, or if the estimated pose
// puts the point a voxel or more from its true place.
const auto seen_voxel = [](
    double z, const auto& ray, const auto& T_true, const auto& T_estimate, const auto& grid) {
#pragma clang fp contract(off)
    auto product = [](const double* row, const double* p) {
#pragma clang fp contract(on)
        return row[2] * p[2] + (row[1] * p[1] + row[0] * p[0]);
    };
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
    return inside && sqrt(squared) < grid.voxel_m ? flat : -1LL;
};
