# mypy: disable-error-code="empty-body"
"""One fused pass of joint geometric and photometric alignment: normal equations and statistics.

ElasticFusion section IV: E = E_icp + w_rgb E_rgb, linearised at the current estimate. The pass
runs over the points p of the *model* (denoised by fusion) and looks them up in the live frame:

    q     = T^-1 p                 in the live camera, T = T_model_live; n_q = R^T n
    r_icp = n_q . (v - q)          metres; v is the live vertex in the pixel that q falls into
    r_rgb = I_live(pi(q)) - (gain I_p + bias)    grey levels; I_live is interpolated bilinearly

With the right perturbation T <- T exp(xi), xi = (rho, phi):

    d r_icp / d xi = (n_q, v x n_q)
    d r_rgb / d xi = -(g, q x g)       g = grad I_live . d pi / d q

Residuals are divided by their standard deviations, which makes both terms free of units:

    s_icp = depth_noise_m z^2                        axial noise of the sensor
    s_rgb^2 = intensity_noise^2 + (lateral_noise_px |grad I|)^2

The second part of s_rgb is the error of the place in the image where the grey value was sampled
(aliasing, depth, pose of the map). Without it strong edges, the best features, look like outliers.
The cost is, with w = icp_rgb_weight,

    E = (1 - w) / 50 sum rho(r_icp / s_icp) + w sum rho(r_rgb / s_rgb)

where rho(r) = c^2/2 log(1 + (r/c)^2) is Cauchy's loss: w = 0 is geometry alone, w = 1 photometry
alone. Errors of neighbouring depths are alike (filter, quantisation, map), those of grey values
are not: 50 depths count as one independent reading. The number was chosen so that the default
w = 0.1 is about the best on noisy sequences.

Gain and bias follow the camera's exposure: each step solves for them too, from points weighted by
rho's weights over s_rgb^2, so that flat regions decide, which misalignment leaves alone. The gain
moves only as far as the data ask: regression of the live on the model's values gives too small a
gain, that of the model's on the live values too large a one, where either is noisy or misaligned.
(A gain that follows the first would shrink from frame to frame, since the map is made of colours
that are freed from it.) The photometric c is the maximum-likelihood scale of Cauchy's
distribution, where the mean weight is 1/2, but at least ``cauchy_rgb``. The term is divided by
(c / least c)^2: images that are blurred or badly registered count less. ``Photometry.trust`` is
one more factor.

On the CPU the work is done for many points at once, by short loops over local arrays, which the
compiler turns into operations on eight points. A thread of a GPU takes one point at a time.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.alignment_arrays import (
    RUNNING,
    AlignedImages,
    Hypotheses,
    Photometry,
    Sum,
    Weights,
)

_PLACES = "".join(f"constexpr int SUM_{place.name} = {place.value};\n" for place in Sum)


@wp.func_native(
    _PLACES
    + """
#if defined(__CUDA_ARCH__)
constexpr int LANES = 1;  // points at a time
#else
constexpr int LANES = 64;
typedef float eight __attribute__((vector_size(32), aligned(4)));
#endif
const float fx = images.focal[0], fy = images.focal[1];
const float cx = images.centre[0], cy = images.centre[1];
const int live_width = images.live_size[0];
const float u_limit = (float)(live_width - 1), v_limit = (float)(images.live_size[1] - 1);
const float* models = (const float*)images.model_vertices.data;
const float* model_n = (const float*)images.model_normals.data;
const float* lives = (const float*)images.live_vertices.data + 3 * size_t(live_image);
const float* live_n = (const float*)images.live_normals.data + 3 * size_t(live_image);
const float* gradients = (const float*)images.live_gradient.data + 3 * size_t(live_image);
const float per_scale = 1.0f / wp::max(photometry.scale, weights.least_scale);
const float narrowing = weights.least_scale * per_scale;
const float rgb = weights.rgb * photometry.trust * narrowing * narrowing;
const float per_reference = weights.per_cauchy_rgb / photometry.reference;
const float photometric_limit = weights.photometric_inlier * wp::min(photometry.reference, 2.0f);

// Six rows of eight: a row of H, the component of g, and a zero that makes it eight.
float system[48] = {}, photometric[48] = {};
float cost = 0, squared = 0, sum_w = 0, sum_wm = 0, sum_wmm = 0, sum_wr = 0, sum_wmr = 0, rough = 0;
float tilted = 0, sum_wrr = 0;
int points = 0, visible = 0, matched = 0, inliers = 0, textured = 0;
int photometric_inliers = 0, depth_conflicts = 0;

for (int first = start; first < end; first += LANES * stride) {
    const int left = (end - first + stride - 1) / stride;
    const int n = left < LANES ? left : LANES;
    // Where the points are in the live image.
    float x[LANES], y[LANES], z[LANES], u[LANES], v[LANES];
    int is_point[LANES], is_visible[LANES];
    for (int k = 0; k < n; ++k) {
        const float* p = models + 3 * size_t(first + k * stride);
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

    // What is there: the live surface, interpolated grey values and gradients, the model's own.
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
        grey[m] = images.model_intensity.data[i];
        const int column = (int)u[k], row = (int)v[k];
        right[m] = u[k] - (float)column;
        down[m] = v[k] - (float)row;
        const float* top = gradients + 3 * (row * live_width + column);
        const float* low = top + 3 * live_width;
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

    // Residuals, weights and derivatives. No branches: noise would make each a guess. What does
    // not apply gets the weight 0.
    float r[LANES], w[LANES], ax[LANES], ay[LANES], az[LANES];
    float r2[LANES], w2[LANES], gx[LANES], gy[LANES], gz[LANES], bx[LANES], by[LANES], bz[LANES];
    float cost_icp[LANES], cost_rgb[LANES], square[LANES], coarse[LANES];
    float exposed[LANES], centred[LANES], tilt[LANES];
    for (int m = 0; m < seen; ++m) {
        const float per_z = 1.0f / z[m];
        const float per_sigma = weights.per_depth_noise * per_z * per_z;
        const float gap = fabsf(lz[m] - z[m]);
        const bool is_matched = lz[m] > 0.0f;
        const bool is_other = is_matched & (gap > weights.distance_m);  // of another colour too
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
            const float top = corners[0][i][m] + right[m] * (corners[1][i][m] - corners[0][i][m]);
            const float low = corners[2][i][m] + right[m] * (corners[3][i][m] - corners[2][i][m]);
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

    // Sums, in the order of the points: weight J J^T and weight J residual.
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

float* out = partial.data + size_t(row) * partial.shape[3];
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
"""
)
def accumulate_points(
    images: AlignedImages,
    start: int,
    end: int,
    stride: int,
    live_image: int,
    R: wp.mat33,
    t: wp.vec3,
    weights: Weights,
    photometry: Photometry,
    partial: wp.array4d(dtype=wp.float32),
    row: int,
):
    """Sum the terms of the model points from ``start`` to ``end`` into a row of ``partial``.

    ``R`` and ``t`` are T_live_model.
    """


@wp.func
def accumulate_row(
    images: AlignedImages,
    weights: Weights,
    stride: int,
    columns: int,  # of the image, per piece
    hypotheses: Hypotheses,
    b: int,
    k: int,
    row_index: int,
    piece: int,
):
    """Sum the terms of one piece of a row of model points for hypothesis k of env b."""
    width = images.model_size[0]
    T = hypotheses.pose[b, k]
    R_inverse = wp.mat33(
        float(T[0, 0]), float(T[1, 0]), float(T[2, 0]),
        float(T[0, 1]), float(T[1, 1]), float(T[2, 1]),
        float(T[0, 2]), float(T[1, 2]), float(T[2, 2]),
    )  # fmt: skip
    t_inverse = -(R_inverse * wp.vec3(float(T[0, 3]), float(T[1, 3]), float(T[2, 3])))
    # Neighbouring rows sample different columns, like a chessboard.
    start = piece * columns + (row_index % 2) * (stride // 2)
    model_row = (b * images.model_size[1] + row_index * stride) * width
    pieces = (width + columns - 1) // columns
    slots = hypotheses.partial.shape[2]
    row = (b * hypotheses.partial.shape[1] + k) * slots + row_index * pieces + piece
    accumulate_points(
        images,
        model_row + start,
        model_row + wp.min((piece + 1) * columns, width),
        stride,
        b * images.live_size[0] * images.live_size[1],
        R_inverse,
        t_inverse,
        weights,
        hypotheses.photometry[b, k],
        hypotheses.partial,
        row,
    )


@wp.kernel
def accumulate_normal_equations(
    images: AlignedImages, weights: Weights, stride: int, columns: int, hypotheses: Hypotheses
):
    """Sum the terms of one piece of a row of model points, for every active hypothesis."""
    b, k, row_index, piece = wp.tid()
    if hypotheses.state[b, k] == RUNNING:
        accumulate_row(images, weights, stride, columns, hypotheses, b, k, row_index, piece)
