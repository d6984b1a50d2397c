// One fused pass of joint alignment over the points of the model; see normal_equations.py.
#pragma once

#include "checked.h"

GIVEN(int, SUM_GEOMETRIC_HESSIAN);
GIVEN(int, SUM_GEOMETRIC_GRADIENT);
GIVEN(int, SUM_COST);
GIVEN(int, SUM_POINTS);
GIVEN(int, SUM_VISIBLE);
GIVEN(int, SUM_MATCHED);
GIVEN(int, SUM_INLIERS);
GIVEN(int, SUM_SQUARED_M2);
GIVEN(int, SUM_TEXTURED);
GIVEN(int, SUM_PHOTOMETRIC_INLIERS);
GIVEN(int, SUM_DEPTH_CONFLICTS);
GIVEN(int, SUM_EXPOSURE_W);
GIVEN(int, SUM_EXPOSURE_WM);
GIVEN(int, SUM_EXPOSURE_WMM);
GIVEN(int, SUM_EXPOSURE_WR);
GIVEN(int, SUM_EXPOSURE_WMR);
GIVEN(int, SUM_ROUGH);
GIVEN(int, SUM_PHOTOMETRIC_HESSIAN);
GIVEN(int, SUM_PHOTOMETRIC_GRADIENT);
GIVEN(int, SUM_TILTED);
GIVEN(int, SUM_EXPOSURE_WRR);

// Sum the terms of the model points from `start` to `end` into a row of `partial`.
//
// `R` and `t` are T_live_model.
void accumulate_points(
    const auto& images, int start, int end, int stride, int live_image, const auto& R,
    const auto& t, const auto& weights, const auto& photometry, const auto& partial, int row) {
#if defined(__CUDA_ARCH__)
    constexpr int LANES = 1;  // points at a time
#else
    constexpr int LANES = 64;
    typedef float eight __attribute__((vector_size(32), aligned(4)));
#endif
    const float fx = images.focal[0], fy = images.focal[1];
    const float cx = images.centre[0], cy = images.centre[1];
    const int live_width = images.live_size[0];
    const size_t live_pixels = size_t(live_width) * images.live_size[1];
    const float u_limit = (float)(live_width - 1), v_limit = (float)(images.live_size[1] - 1);
    const auto models = VIEW(const float, images.model_vertices, 0, 3 * size_t(end));
    const auto model_n = VIEW(const float, images.model_normals, 0, 3 * size_t(end));
    const auto lives
        = VIEW(const float, images.live_vertices, 3 * size_t(live_image), 3 * live_pixels);
    const auto live_n
        = VIEW(const float, images.live_normals, 3 * size_t(live_image), 3 * live_pixels);
    const auto gradients
        = VIEW(const float, images.live_gradient, 3 * size_t(live_image), 3 * live_pixels);
    const float per_scale = 1.0f / wp::max(photometry.scale, weights.least_scale);
    const float narrowing = weights.least_scale * per_scale;
    const float rgb = weights.rgb * photometry.trust * narrowing * narrowing;
    const float per_reference = weights.per_cauchy_rgb / photometry.reference;
    const float photometric_limit
        = weights.photometric_inlier * wp::min(photometry.reference, 2.0f);

    // Six rows of eight: a row of H, the component of g, and a zero for padding.
    float system[48] = {}, photometric[48] = {};
    float cost = 0, squared = 0, sum_w = 0, sum_wm = 0, sum_wmm = 0, sum_wr = 0, sum_wmr = 0,
          rough = 0;
    float tilted = 0, sum_wrr = 0;
    int points = 0, visible = 0, matched = 0, inliers = 0, textured = 0;
    int photometric_inliers = 0, depth_conflicts = 0;

    for (int first = start; first < end; first += LANES * stride) {
        const int left = (end - first + stride - 1) / stride;
        const int n = left < LANES ? left : LANES;
        // Project the points into the live image.
        float x[LANES], y[LANES], z[LANES], u[LANES], v[LANES];
        int is_point[LANES], is_visible[LANES];
        for (int k = 0; k < n; ++k) {
            const auto p = models + 3 * size_t(first + k * stride);
            x[k] = p[0];
            y[k] = p[1];
            z[k] = p[2];
        }
        for (int k = 0; k < n; ++k) {
            const float px = x[k], py = y[k], pz = z[k];
            x[k] = R.data[0][0] * px + R.data[0][1] * py + R.data[0][2] * pz + t[0];
            y[k] = R.data[1][0] * px + R.data[1][1] * py + R.data[1][2] * pz + t[1];
            z[k] = R.data[2][0] * px + R.data[2][1] * py + R.data[2][2] * pz + t[2];
            const float per_z = 1.0f / z[k];
            u[k] = fx * x[k] * per_z + cx;
            v[k] = fy * y[k] * per_z + cy;
            is_point[k] = pz > 0.0f;
            is_visible[k] = (pz > 0.0f) & (z[k] > 0.05f) & (u[k] >= 0.0f) & (v[k] >= 0.0f)
                & (u[k] < u_limit) & (v[k] < v_limit);
            points += is_point[k];
        }
        int which[LANES];
        int seen = 0;
        for (int k = 0; k < n; ++k) {
            which[seen] = k;
            seen += is_visible[k];
        }
        visible += seen;

        // Read the live surface, interpolated grey values and gradients, and the model's values.
        float lx[LANES], ly[LANES], lz[LANES], lnx[LANES], lny[LANES], lnz[LANES];
        float nx[LANES], ny[LANES], nz[LANES], grey[LANES], right[LANES], down[LANES];
        float corners[4][3][LANES];
        for (int m = 0; m < seen; ++m) {
            const int k = which[m];
            const int nearest = (int)(v[k] + 0.5f) * live_width + (int)(u[k] + 0.5f);
            lx[m] = lives[3 * nearest];
            ly[m] = lives[3 * nearest + 1];
            lz[m] = lives[3 * nearest + 2];
            lnx[m] = live_n[3 * nearest];
            lny[m] = live_n[3 * nearest + 1];
            lnz[m] = live_n[3 * nearest + 2];
            const size_t i = first + k * stride;
            nx[m] = model_n[3 * i];
            ny[m] = model_n[3 * i + 1];
            nz[m] = model_n[3 * i + 2];
            grey[m] = ELEMENT(images.model_intensity, i);
            const int column = (int)u[k], row = (int)v[k];
            right[m] = u[k] - (float)column;
            down[m] = v[k] - (float)row;
            const auto top = gradients + 3 * (row * live_width + column);
            const auto low = top + 3 * live_width;
            for (int c = 0; c < 3; ++c) {
                corners[0][c][m] = top[c];
                corners[1][c][m] = top[3 + c];
                corners[2][c][m] = low[c];
                corners[3][c][m] = low[3 + c];
            }
            x[m] = x[k];  // k >= m
            y[m] = y[k];
            z[m] = z[k];
        }

        // Residuals, weights and derivatives. No branches: noise makes them unpredictable. Terms
        // that do not apply get weight 0.
        float r[LANES], w[LANES], ax[LANES], ay[LANES], az[LANES];
        float r2[LANES], w2[LANES], gx[LANES], gy[LANES], gz[LANES], bx[LANES], by[LANES],
            bz[LANES];
        float cost_icp[LANES], cost_rgb[LANES], square[LANES], coarse[LANES];
        float exposed[LANES], centred[LANES], tilt[LANES];
        for (int m = 0; m < seen; ++m) {
            const float per_z = 1.0f / z[m];
            const float per_sigma = weights.per_depth_noise * per_z * per_z;
            const float gap = fabsf(lz[m] - z[m]);
            const bool is_matched = lz[m] > 0.0f;
            const bool is_other = is_matched & (gap > weights.distance_m);  // its colour differs too
            const float a = R.data[0][0] * nx[m] + R.data[0][1] * ny[m] + R.data[0][2] * nz[m];
            const float b = R.data[1][0] * nx[m] + R.data[1][1] * ny[m] + R.data[1][2] * nz[m];
            const float c = R.data[2][0] * nx[m] + R.data[2][1] * ny[m] + R.data[2][2] * nz[m];
            nx[m] = a;
            ny[m] = b;
            nz[m] = c;
            const float alignment = a * lnx[m] + b * lny[m] + c * lnz[m];
            const bool is_near = is_matched & !is_other & (alignment > weights.cos_angle);
            r[m] = a * (lx[m] - x[m]) + b * (ly[m] - y[m]) + c * (lz[m] - z[m]);
            const float normalised = r[m] * per_sigma;
            const float ratio = normalised * weights.per_cauchy_icp;
            const float robust = 1.0f / (1.0f + ratio * ratio);
            const float unlike = is_other ? 3.0f : is_matched ? 1.0f : 0.5f;
            cost_icp[m] = is_near ? 1.0f - robust : unlike;
            const bool is_inlier = is_near & (fabsf(normalised) < weights.inlier_sigmas);
            square[m] = is_inlier ? r[m] * r[m] : 0.0f;
            w[m] = is_near ? weights.icp * robust * per_sigma * per_sigma : 0.0f;
            tilt[m] = w[m] * (1.0f - alignment);
            ax[m] = ly[m] * c - lz[m] * b;
            ay[m] = lz[m] * a - lx[m] * c;
            az[m] = lx[m] * b - ly[m] * a;
            matched += is_matched;
            depth_conflicts += is_matched & (gap * per_sigma > weights.conflict_sigmas);
            inliers += is_inlier;

            float sample[3];  // I, dI/du, dI/dv
            for (int i = 0; i < 3; ++i) {
                const float top
                    = corners[0][i][m] + right[m] * (corners[1][i][m] - corners[0][i][m]);
                const float low
                    = corners[2][i][m] + right[m] * (corners[3][i][m] - corners[2][i][m]);
                sample[i] = top + down[m] * (low - top);
            }
            const float expected = photometry.gain * grey[m] + photometry.bias;
            const float positive = expected > 0.0f ? expected : 0.0f;
            r2[m] = sample[0] - (positive < 255.0f ? positive : 255.0f);
            const float slope_squared = sample[1] * sample[1] + sample[2] * sample[2];
            const float per_variance
                = 1.0f / (weights.grey_variance + weights.pixel_variance * slope_squared);
            const float sigmas = r2[m] * r2[m] * per_variance;  // squared
            const float robust2 = 1.0f / (1.0f + sigmas * per_scale * per_scale);
            const float usual = 1.0f / (1.0f + sigmas * per_reference * per_reference);
            cost_rgb[m] = is_other ? 0.0f : 2.0f * (1.0f - usual);
            const float slope = fabsf(sample[1]) + fabsf(sample[2]);
            const bool is_textured = !is_other & (slope > weights.texture);
            coarse[m] = is_textured ? 1.0f - robust2 : 0.0f;
            textured += is_textured;
            photometric_inliers += is_textured & (fabsf(r2[m]) < photometric_limit);
            const bool is_exposed = !is_other & (sample[0] > 2.0f) & (sample[0] < 250.0f);
            exposed[m] = is_exposed ? robust2 * per_variance : 0.0f;
            centred[m] = grey[m] - 128.0f;
            const float du = sample[1] * fx * per_z, dv = sample[2] * fy * per_z;
            gx[m] = -du;
            gy[m] = -dv;
            gz[m] = (du * x[m] + dv * y[m]) * per_z;
            bx[m] = y[m] * gz[m] - z[m] * gy[m];
            by[m] = z[m] * gx[m] - x[m] * gz[m];
            bz[m] = x[m] * gy[m] - y[m] * gx[m];
            w2[m] = is_textured ? rgb * robust2 * per_variance : 0.0f;
        }

        // Sum weight J J^T and weight J residual in the order of the points.
        for (int m = 0; m < seen; ++m) {
            cost += cost_icp[m];
            cost += cost_rgb[m];
            squared += square[m];
            rough += coarse[m];
            tilted += tilt[m];
            sum_w += exposed[m];
            sum_wm += exposed[m] * centred[m];
            sum_wmm += exposed[m] * centred[m] * centred[m];
            sum_wr += exposed[m] * r2[m];
            sum_wmr += exposed[m] * centred[m] * r2[m];
            sum_wrr += exposed[m] * r2[m] * r2[m];
#if defined(__CUDA_ARCH__)
            const float J[8] = {nx[m], ny[m], nz[m], ax[m], ay[m], az[m], r[m], 0.0f};
            const float G[8] = {gx[m], gy[m], gz[m], bx[m], by[m], bz[m], r2[m], 0.0f};
            for (int i = 0; i < 6; ++i) {
                for (int j = 0; j < 8; ++j) {
                    system[8 * i + j] += w[m] * J[i] * J[j];
                    photometric[8 * i + j] += w2[m] * G[i] * G[j];
                }
            }
#else
            const eight J = {nx[m], ny[m], nz[m], ax[m], ay[m], az[m], r[m], 0.0f};
            const eight G = {gx[m], gy[m], gz[m], bx[m], by[m], bz[m], r2[m], 0.0f};
            eight* H = (eight*)system;
            eight* P = (eight*)photometric;
            for (int i = 0; i < 6; ++i) {
                H[i] += w[m] * J[i] * J;
                P[i] += w2[m] * G[i] * G;
            }
#endif
        }
    }

    auto out = VIEW(float, partial, size_t(row) * partial.shape[3], partial.shape[3]);
    int at = 0;
    for (int i = 0; i < 6; ++i) {  // upper triangle by rows of six, five, four, ...
        for (int j = i; j < 6; ++j, ++at) {
            out[SUM_GEOMETRIC_HESSIAN + at] = system[8 * i + j];
            out[SUM_PHOTOMETRIC_HESSIAN + at] = photometric[8 * i + j];
        }
        out[SUM_GEOMETRIC_GRADIENT + i] = system[8 * i + 6];
        out[SUM_PHOTOMETRIC_GRADIENT + i] = photometric[8 * i + 6];
    }
    out[SUM_COST] = cost;
    out[SUM_POINTS] = (float)points;
    out[SUM_VISIBLE] = (float)visible;
    out[SUM_MATCHED] = (float)matched;
    out[SUM_INLIERS] = (float)inliers;
    out[SUM_SQUARED_M2] = squared;
    out[SUM_TEXTURED] = (float)textured;
    out[SUM_PHOTOMETRIC_INLIERS] = (float)photometric_inliers;
    out[SUM_DEPTH_CONFLICTS] = (float)depth_conflicts;
    out[SUM_EXPOSURE_W] = sum_w;
    out[SUM_EXPOSURE_WM] = sum_wm;
    out[SUM_EXPOSURE_WMM] = sum_wmm;
    out[SUM_EXPOSURE_WR] = sum_wr;
    out[SUM_EXPOSURE_WMR] = sum_wmr;
    out[SUM_ROUGH] = rough;
    out[SUM_TILTED] = tilted;
    out[SUM_EXPOSURE_WRR] = sum_wrr;
}
