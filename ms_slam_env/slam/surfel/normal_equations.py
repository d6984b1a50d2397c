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

Gain and bias follow the camera's exposure: each step solves for them too, by regression of the
residual on I_p, weighted by rho's weights over s_rgb^2, so that flat regions decide, which
misalignment leaves alone. The photometric c is the maximum-likelihood scale of Cauchy's
distribution, where the mean weight is 1/2, but at least ``cauchy_rgb``. The term is divided by
(c / least c)^2: images that are blurred or badly registered count less. ``Photometry.trust`` is
one more factor.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.memory import fetch

NUM_SUMS = 70
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


OFF = wp.constant(0)  # states of a hypothesis, in ``active``: takes no part
RUNNING = wp.constant(1)
RESTING = wp.constant(2)  # converged at its level, wakes at the next


System = wp.types.vector(length=48, dtype=wp.float32)
"""Six rows of eight: a row of H, the component of g, and a zero that makes it eight."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    wp::vec_t<48, float> sum = system;
    const float J[8] = {a.c[0], a.c[1], a.c[2], b.c[0], b.c[1], b.c[2], residual, 0.0f};
    for (int i = 0; i < 6; ++i)
        for (int k = 0; k < 8; ++k)
            sum.c[8 * i + k] += weight * J[i] * J[k];
    return sum;
#else
    typedef float eight __attribute__((vector_size(32), aligned(4)));
    wp::vec_t<48, float> sum = system;
    eight* rows = (eight*)sum.c;
    const eight J = {a.c[0], a.c[1], a.c[2], b.c[0], b.c[1], b.c[2], residual, 0.0f};
    rows[0] += weight * a.c[0] * J;
    rows[1] += weight * a.c[1] * J;
    rows[2] += weight * a.c[2] * J;
    rows[3] += weight * b.c[0] * J;
    rows[4] += weight * b.c[1] * J;
    rows[5] += weight * b.c[2] * J;
    return sum;
#endif
""")
def add_point(system: System, a: wp.vec3, b: wp.vec3, residual: float, weight: float) -> System:
    """Add weight J J^T and weight J residual for J = (a, b), a row in one instruction of a CPU."""


@wp.struct
class Weights:
    """Scales of the residuals; see the module's text. Reciprocals save divisions per pixel."""

    icp: float
    rgb: float
    per_depth_noise: float  # 1 / depth_noise_m
    per_cauchy_icp: float  # 1 / sigmas
    per_cauchy_rgb: float  # 1 / sigmas
    grey_variance: float  # of the intensity, grey levels^2
    pixel_variance: float  # of the place in the image, pixels^2
    distance_m: float
    cos_angle: float
    inlier_sigmas: float
    texture: float  # grey levels per pixel
    alike: float  # grey levels
    least_scale: float  # least c of photometric residuals, in sigmas


@wp.struct
class Photometry:
    """How the live grey values relate to the model's: I_live ~ gain I_model + bias."""

    gain: float
    bias: float  # grey levels
    scale: float  # c of the photometric loss, in sigmas: half of all textured residuals exceed it
    reference: float  # the same as it usually is, over its least value; the unit of the verdict
    trust: float  # weight of the photometric term, [0, 1]


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
    live_width = live_size[0]
    live_image = b * live_width * live_size[1]
    T = pose[b, k]
    R_inverse = wp.mat33(
        float(T[0, 0]), float(T[1, 0]), float(T[2, 0]),
        float(T[0, 1]), float(T[1, 1]), float(T[2, 1]),
        float(T[0, 2]), float(T[1, 2]), float(T[2, 2]),
    )  # fmt: skip
    t_inverse = -(R_inverse * wp.vec3(float(T[0, 3]), float(T[1, 3]), float(T[2, 3])))
    u_limit = float(live_width - 1)
    v_limit = float(live_size[1] - 1)
    system = System()
    photometric = System()
    cost = wp.float32(0.0)
    points = wp.float32(0.0)
    visible = wp.float32(0.0)
    matched = wp.float32(0.0)
    inliers = wp.float32(0.0)
    squared = wp.float32(0.0)
    textured = wp.float32(0.0)
    alike = wp.float32(0.0)
    apart = wp.float32(0.0)
    sum_w = wp.float32(0.0)
    sum_wm = wp.float32(0.0)
    sum_wmm = wp.float32(0.0)
    sum_wr = wp.float32(0.0)
    sum_wmr = wp.float32(0.0)
    rough = wp.float32(0.0)
    tilted = wp.float32(0.0)
    light = photometry[b, k]
    gain = light.gain
    bias = light.bias
    per_scale = 1.0 / wp.max(light.scale, weights.least_scale)
    narrowing = weights.least_scale * per_scale
    rgb = weights.rgb * light.trust * narrowing * narrowing
    per_reference = weights.per_cauchy_rgb / light.reference
    alike_limit = weights.alike * wp.min(light.reference, 2.0)
    v = row_index * stride
    # Neighbouring rows sample different columns, like a chessboard.
    start = piece * columns + (row_index % 2) * (stride // 2)
    model_row = (b * model_size[1] + v) * width
    i = model_row + start - stride
    end = model_row + wp.min((piece + 1) * columns, width) - stride
    while i < end:
        i += stride
        p = fetch(model_vertices, i)
        if p[2] <= 0.0:
            continue
        points += 1.0
        q = R_inverse * p + t_inverse
        if q[2] <= 0.05:
            continue
        per_z = 1.0 / q[2]
        x = focal[0] * q[0] * per_z + centre[0]
        y = focal[1] * q[1] * per_z + centre[1]
        if x < 0.0 or y < 0.0 or x >= u_limit or y >= v_limit:
            continue
        visible += 1.0
        column = int(x)
        row = int(y)
        right = x - float(column)
        down = y - float(row)
        nearest = live_image + int(y + 0.5) * live_width + int(x + 0.5)
        live = fetch(live_vertices, nearest)
        # No branches from here on: noise would make each a guess, and a wrong one waits for all
        # the loads above. What does not apply gets the weight 0.
        per_sigma = weights.per_depth_noise * per_z * per_z
        gap = wp.abs(live[2] - q[2])
        is_matched = live[2] > 0.0
        is_other = is_matched and gap > weights.distance_m  # another surface, of another colour
        n = R_inverse * fetch(model_normals, i)
        alignment = wp.dot(n, fetch(live_normals, nearest))
        is_near = is_matched and not is_other and alignment > weights.cos_angle
        residual = wp.dot(n, live - q)
        normalised = residual * per_sigma
        ratio = normalised * weights.per_cauchy_icp
        robust = 1.0 / (1.0 + ratio * ratio)
        matched += wp.where(is_matched, 1.0, 0.0)
        apart += wp.where(is_matched and gap * per_sigma > 8.0, 1.0, 0.0)
        cost += wp.where(
            is_near,
            1.0 - robust,
            wp.where(is_other, 3.0, wp.where(is_matched, 1.0, 0.5)),
        )
        is_inlier = is_near and wp.abs(normalised) < weights.inlier_sigmas
        inliers += wp.where(is_inlier, 1.0, 0.0)
        squared += wp.where(is_inlier, residual * residual, 0.0)
        weight = wp.where(is_near, weights.icp * robust * per_sigma * per_sigma, 0.0)
        tilted += weight * (1.0 - alignment)
        system = add_point(system, n, wp.cross(live, n), residual, weight)
        corner = live_image + row * live_width + column
        top_left = fetch(live_gradient, corner)
        top_right = fetch(live_gradient, corner + 1)
        low_left = fetch(live_gradient, corner + live_width)
        low_right = fetch(live_gradient, corner + live_width + 1)
        top = top_left + right * (top_right - top_left)
        low = low_left + right * (low_right - low_left)
        seen = top + down * (low - top)  # (I, dI/du, dI/dv)
        grey = fetch(model_intensity, i)
        residual = seen[0] - wp.clamp(gain * grey + bias, 0.0, 255.0)
        slope_squared = seen[1] * seen[1] + seen[2] * seen[2]
        per_variance = 1.0 / (weights.grey_variance + weights.pixel_variance * slope_squared)
        squared_sigmas = residual * residual * per_variance
        robust = 1.0 / (1.0 + squared_sigmas * per_scale * per_scale)
        usual = 1.0 / (1.0 + squared_sigmas * per_reference * per_reference)
        cost += wp.where(is_other, 0.0, 2.0 * (1.0 - usual))
        slope = wp.abs(seen[1]) + wp.abs(seen[2])
        is_textured = not is_other and slope > weights.texture
        textured += wp.where(is_textured, 1.0, 0.0)
        rough += wp.where(is_textured, 1.0 - robust, 0.0)
        alike += wp.where(is_textured and wp.abs(residual) < alike_limit, 1.0, 0.0)
        is_exposed = not is_other and seen[0] > 2.0 and seen[0] < 250.0
        weight = wp.where(is_exposed, robust * per_variance, 0.0)
        centred = grey - 128.0
        sum_w += weight
        sum_wm += weight * centred
        sum_wmm += weight * centred * centred
        sum_wr += weight * residual
        sum_wmr += weight * centred * residual
        gx = seen[1] * focal[0] * per_z
        gy = seen[2] * focal[1] * per_z
        g = -wp.vec3(gx, gy, -(gx * q[0] + gy * q[1]) * per_z)
        weight = wp.where(is_textured, rgb * robust * per_variance, 0.0)
        photometric = add_point(photometric, g, wp.cross(q, g), residual, weight)
    slot = row_index * ((width + columns - 1) // columns) + piece
    for i in range(6):
        for j in range(6):
            if j >= i:  # upper triangle by rows of six, five, four, ...
                partial[b, k, slot, i * (11 - i) / 2 + j] = system[8 * i + j]
                partial[b, k, slot, 42 + i * (11 - i) / 2 + j] = photometric[8 * i + j]
        partial[b, k, slot, 21 + i] = system[8 * i + 6]
        partial[b, k, slot, 63 + i] = photometric[8 * i + 6]
    partial[b, k, slot, 27] = cost
    partial[b, k, slot, 28] = points
    partial[b, k, slot, 29] = visible
    partial[b, k, slot, 30] = matched
    partial[b, k, slot, 31] = inliers
    partial[b, k, slot, 32] = squared
    partial[b, k, slot, 33] = textured
    partial[b, k, slot, 34] = alike
    partial[b, k, slot, 35] = apart
    partial[b, k, slot, 36] = sum_w
    partial[b, k, slot, 37] = sum_wm
    partial[b, k, slot, 38] = sum_wmm
    partial[b, k, slot, 39] = sum_wr
    partial[b, k, slot, 40] = sum_wmr
    partial[b, k, slot, 41] = rough
    partial[b, k, slot, 69] = tilted
