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
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.point_sums import Photometry, Weights, sum_points

NUM_SUMS = 71
"""Sums of a pass: geometric term, statistics, exposure, photometric term.

A term has 21 sums of H (upper triangle by rows) and 6 of g = J^T W r.
"""
SUM_COST = 27  # truncated robust cost of the visible points, in [0, 3] each
SUM_POINTS = 28  # model points looked at
SUM_VISIBLE = 29  # of those, inside the live image
SUM_MATCHED = 30  # of those, with a live vertex
SUM_INLIERS = 31  # of those, within the gates and a few sigmas of the model's plane
SUM_SQUARED_M2 = 32  # squared point-to-plane residuals of the inliers, m^2
SUM_TEXTURED = 33  # visible, with a marked intensity gradient
SUM_ALIKE = 34  # of those, with a small photometric residual
SUM_APART = 35  # matched, but the live surface is clearly nearer or farther than the model's
SUM_EXPOSURE = 36  # sums of w, w m, w m^2, w r, w m r over exposed points, m = I_p - 128
SUM_ROUGH = 41  # of the textured: 1 - robust weight; half their number at the right scale
SUM_PHOTOMETRIC = 42  # the photometric term's
SUM_TILTED = 69  # geometric weights times 1 - cosine of the angle between the normals
SUM_EXPOSURE_SQUARED = 70  # of w r^2 over exposed points


OFF = wp.constant(0)  # states of a hypothesis, in ``active``: takes no part
RUNNING = wp.constant(1)
RESTING = wp.constant(2)  # converged at its level, wakes at the next


@wp.kernel
def accumulate(
    model_vertices: wp.array(dtype=wp.vec3),
    model_normals: wp.array(dtype=wp.vec3),
    model_intensity: wp.array(dtype=wp.float32),
    live_vertices: wp.array(dtype=wp.vec3),
    live_normals: wp.array(dtype=wp.vec3),
    live_gradient: wp.array(dtype=wp.vec3),
    model_size: wp.vec2i,  # (width, height) of the model images
    live_size: wp.vec2i,
    focal: wp.vec2,
    centre: wp.vec2,
    weights: Weights,
    stride: wp.int32,
    columns: wp.int32,  # of the image, per thread
    pose: wp.array2d(dtype=wp.mat44d),  # T_model_live (B, K)
    photometry: wp.array2d(dtype=Photometry),
    active: wp.array2d(dtype=wp.int32),
    partial: wp.array4d(dtype=wp.float32),  # (B, K, rows * pieces, NUM_SUMS)
):
    """Sum the terms of one piece of a row of model points, for every active hypothesis."""
    b, k, row_index, piece = wp.tid()
    if active[b, k] != RUNNING:
        return
    width = model_size[0]
    T = pose[b, k]
    R_inverse = wp.mat33(
        float(T[0, 0]), float(T[1, 0]), float(T[2, 0]),
        float(T[0, 1]), float(T[1, 1]), float(T[2, 1]),
        float(T[0, 2]), float(T[1, 2]), float(T[2, 2]),
    )  # fmt: skip
    t_inverse = -(R_inverse * wp.vec3(float(T[0, 3]), float(T[1, 3]), float(T[2, 3])))
    # Neighbouring rows sample different columns, like a chessboard.
    start = piece * columns + (row_index % 2) * (stride // 2)
    model_row = (b * model_size[1] + row_index * stride) * width
    pieces = (width + columns - 1) // columns
    sum_points(
        model_vertices,
        model_normals,
        model_intensity,
        live_vertices,
        live_normals,
        live_gradient,
        model_row + start,
        model_row + wp.min((piece + 1) * columns, width),
        stride,
        b * live_size[0] * live_size[1],
        live_size,
        focal,
        centre,
        R_inverse,
        t_inverse,
        weights,
        photometry[b, k],
        partial,
        (b * partial.shape[1] + k) * partial.shape[2] + row_index * pieces + piece,
    )
