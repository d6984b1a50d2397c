# mypy: disable-error-code="empty-body"
"""Sums of a pass to a pose: reduction, 6x6 Cholesky solve and SE(3) update, on the device.

One thread per env and hypothesis, in float64. Source of the exponential: Sola et al., "A micro
Lie theory" (2018), equations (172) and (174).

Directions of the pose that the data do not constrain are left alone. Solution remapping: Zhang,
Kaess and Singh, "On degeneracy of optimization-based state estimation problems" (ICRA 2016),
equations (13) to (18). The update is taken only along those eigenvectors of the normal matrix with
enough information; along the others the pose keeps what was predicted. Rotations are first
multiplied by a length that makes them comparable with translations: the distance at which both move
the points alike.

Noise of the normals seems to constrain the sliding and turning of a plane too. Up to the mean of
1 - cos of the angle between model and live normals, their noise per axis, geometric information
along a direction may be only that. On blank walls and corners, with 1 mm to 4 mm of noise, it is
0.02 to 0.28 of it; in the weakest direction of a furnished room at least 0.48.
"""

from __future__ import annotations

from typing import Any

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.native import native_source
from ms_slam_env.slam.surfel.normal_equations import (
    NUM_SUMS,
    RESTING,
    RUNNING,
    AlignedImages,
    Hypotheses,
    Photometry,
    Sum,
    Weights,
    accumulate_row,
)

mat66d: Any = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
mat76d: Any = wp.types.matrix(shape=(7, 6), dtype=wp.float64)
vec6d: Any = wp.types.vector(length=6, dtype=wp.float64)
NORMAL_NOISE = wp.constant(wp.float64(0.3))  # share of that mean that counts as noise
LEAST_INFORMATION = wp.constant(wp.float64(0.5))  # per matched point, 1/m^2: 2 cm of 5000 points
OPEN_VARIANCE = wp.constant(wp.float64(0.03 * 0.03))  # m^2, of a frame's predicted motion
GEOMETRIC_NOISE = wp.constant(wp.float64(0.022))  # covariance of the gradient over A or B;
PHOTOMETRIC_NOISE = wp.constant(wp.float64(0.34))  # see experiments/pose_covariance.py
SINGULAR = wp.constant(wp.float64(1.0e-6))


@wp.func_native(native_source("eigen", "eigen"))
def eigen(H: mat66d) -> mat76d:
    """Eigenvectors of a symmetric matrix as columns, eigenvalues below, by cyclic Jacobi."""


@wp.func
def _trace(H: mat66d, first: int) -> wp.float64:
    return H[first, first] + H[first + 1, first + 1] + H[first + 2, first + 2]


@wp.func
def turning_length(H: mat66d) -> wp.float64:
    """Distance d in metres at which a rotation moves the points like a translation."""
    rho = _trace(H, 0)
    length = wp.float64(1.0)
    if rho > wp.float64(0.0):
        length = wp.clamp(wp.sqrt(_trace(H, 3) / rho), wp.float64(0.01), wp.float64(100.0))
    return length


@wp.func
def in_metres(H: mat66d, length: wp.float64) -> mat66d:
    """Normal matrix in a rotation times ``length``."""
    S = H
    for i in range(6):
        for j in range(6):
            if i >= 3:
                S[i, j] = S[i, j] / length
            if j >= 3:
                S[i, j] = S[i, j] / length
    return S


@wp.func
def is_constrained(
    E: mat76d, k: int, geometric: mat66d, tilted: wp.float64, matched: wp.float64
) -> bool:
    """Whether the data constrain eigenvector ``k`` of the normal matrix; matrices in metres."""
    known = wp.float64(0.0)
    for i in range(6):
        for j in range(6):
            known += E[i, k] * geometric[i, j] * E[j, k]
    information = E[6, k] - wp.min(known, NORMAL_NOISE * tilted)
    return information > LEAST_INFORMATION * matched + SINGULAR


@wp.func
def gradient_in_metres(g: vec6d, length: wp.float64) -> vec6d:
    """Gradient with respect to a rotation times ``length``."""
    scaled = g
    for i in range(3, 6):
        scaled[i] = g[i] / length
    return scaled


@wp.func
def remapped_step(
    A: mat66d,
    B: mat66d,
    gradient: vec6d,
    tilted: wp.float64,
    matched: wp.float64,
    damping: wp.float64,
) -> vec6d:
    """Solution of (A + B) xi = -gradient in the constrained directions, 0 in the others; metres."""
    E = eigen(A + B)
    xi = vec6d()
    for k in range(6):
        if is_constrained(E, k, A, tilted, matched):
            along = wp.float64(0.0)
            for i in range(6):
                along -= E[i, k] * gradient[i]
            along = along / (E[6, k] * (wp.float64(1.0) + damping))
            for i in range(6):
                xi[i] += E[i, k] * along
    return xi


@wp.func
def pose_covariance(
    E: mat76d, A: mat66d, B: mat66d, tilted: wp.float64, matched: wp.float64, length: wp.float64
) -> wp.spatial_matrixd:
    """Covariance H^-1 (a A + b B) H^-1 of the pose, metres and radians, H = A + B in metres.

    The weights of the two terms were chosen for accuracy, so H^-1 is no covariance; a A and b B are
    the covariances of the gradients. Unconstrained directions have the prediction's covariance.
    """
    inverse = mat66d()
    C = mat66d()
    for k in range(6):
        is_open = not is_constrained(E, k, A, tilted, matched)
        for i in range(6):
            for j in range(6):
                along = E[i, k] * E[j, k]
                if is_open:
                    C[i, j] += OPEN_VARIANCE * along
                else:
                    inverse[i, j] += along / E[6, k]
    C += inverse * (GEOMETRIC_NOISE * A + PHOTOMETRIC_NOISE * B) * inverse
    C = in_metres(C, length)
    return wp.float64(0.5) * (C + wp.transpose(C))


@wp.func
def reduce_sum(hypotheses: Hypotheses, slots: int, b: int, k: int, i: int) -> None:
    """Add up one of the partial sums of hypothesis k of env b, always in the same order."""
    total = wp.float64(0.0)
    for slot in range(slots):
        total += wp.float64(hypotheses.partial[b, k, slot, i])
    hypotheses.sums[b, k, i] = total


@wp.func_native(native_source("sum_reduction", "reduce_all_sums", SUMS=NUM_SUMS))
def reduce_all_sums(hypotheses: Hypotheses, slots: int, b: int, k: int) -> None:
    """Add up all partial sums of hypothesis k of env b, several at a time."""


@wp.kernel
def reduce_sums(hypotheses: Hypotheses, slots: int) -> None:
    """Add up the partial sums of every active hypothesis."""
    b, k, i = wp.tid()
    if hypotheses.state[b, k] == RUNNING:
        reduce_sum(hypotheses, slots, b, k, i)


@wp.func
def load_hessian(sums: wp.array3d[wp.float64], b: int, k: int, first: int) -> mat66d:
    """Symmetric H of 21 sums from ``first`` on."""
    H = mat66d()
    index = wp.int32(first)
    for i in range(6):
        for j in range(6):
            if j >= i:
                H[i, j] = sums[b, k, index]
                H[j, i] = sums[b, k, index]
                index += 1
    return H


@wp.func
def load_terms(
    sums: wp.array3d[wp.float64], b: int, k: int
) -> tuple[mat66d, mat66d, vec6d, vec6d, wp.float64]:
    """Both terms' H and g for a rotation times a length, and that length in metres."""
    A = load_hessian(sums, b, k, Sum.GEOMETRIC_HESSIAN)
    B = load_hessian(sums, b, k, Sum.PHOTOMETRIC_HESSIAN)
    g_a = vec6d()
    g_b = vec6d()
    for i in range(6):
        g_a[i] = sums[b, k, Sum.GEOMETRIC_GRADIENT + i]
        g_b[i] = sums[b, k, Sum.PHOTOMETRIC_GRADIENT + i]
    length = turning_length(A + B)
    A = in_metres(A, length)
    B = in_metres(B, length)
    g_a = gradient_in_metres(g_a, length)
    g_b = gradient_in_metres(g_b, length)
    return A, B, g_a, g_b, length


@wp.func
def cholesky(H: mat66d) -> mat66d:
    """Lower factor L of H = L L^T; L[0, 0] = 0 if H is not positive definite."""
    L = mat66d()
    for i in range(6):
        for j in range(6):
            if j <= i:
                rest = H[i, j]
                for m in range(6):
                    if m < j:
                        rest -= L[i, m] * L[j, m]
                if i == j:
                    # Relative to the diagonal: a pivot lost to cancellation is no pivot.
                    if rest <= H[i, i] * wp.float64(1.0e-9):
                        return mat66d()
                    L[i, j] = wp.sqrt(rest)
                else:
                    L[i, j] = rest / L[j, j]
    return L


@wp.func
def cholesky_solve(L: mat66d, right: vec6d) -> vec6d:
    """Solution x of L L^T x = right."""
    y = vec6d()
    for i in range(6):
        rest = right[i]
        for m in range(6):
            if m < i:
                rest -= L[i, m] * y[m]
        y[i] = rest / L[i, i]
    x = vec6d()
    for n in range(6):
        i = 5 - n
        rest = y[i]
        for m in range(6):
            if m > i:
                rest -= L[m, i] * x[m]
        x[i] = rest / L[i, i]
    return x


@wp.func
def se3_exp(xi: vec6d) -> wp.mat44d:
    """Rigid motion of the twist (rho in metres, phi in radians)."""
    one = wp.float64(1.0)
    x = xi[3]
    y = xi[4]
    z = xi[5]
    squared = x * x + y * y + z * z
    angle = wp.sqrt(squared)
    a = one - squared / wp.float64(6.0)  # sin / angle
    b = wp.float64(0.5) - squared / wp.float64(24.0)  # (1 - cos) / angle^2
    c = one / wp.float64(6.0) - squared / wp.float64(120.0)  # (angle - sin) / angle^3
    if angle > wp.float64(1.0e-4):
        a = wp.sin(angle) / angle
        b = (one - wp.cos(angle)) / squared
        c = (angle - wp.sin(angle)) / (squared * angle)
    zero = wp.float64(0.0)
    skew = wp.mat33d(zero, -z, y, z, zero, -x, -y, x, zero)
    skew2 = skew * skew
    unit = wp.mat33d(one, zero, zero, zero, one, zero, zero, zero, one)
    R = unit + a * skew + b * skew2
    t = (unit + b * skew + c * skew2) * wp.vec3d(xi[0], xi[1], xi[2])
    return wp.mat44d(
        R[0, 0], R[0, 1], R[0, 2], t[0],
        R[1, 0], R[1, 1], R[1, 2], t[1],
        R[2, 0], R[2, 1], R[2, 2], t[2],
        zero, zero, zero, one,
    )  # fmt: skip


@wp.func
def se3_log(T: wp.mat44d) -> vec6d:
    """Twist of a small rigid motion: exact in the rotation, to third order in the translation."""
    half = wp.float64(0.5)
    w = half * wp.vec3d(T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1])
    sine = wp.length(w)
    angle = wp.atan2(sine, half * (T[0, 0] + T[1, 1] + T[2, 2] - wp.float64(1.0)))
    if sine > wp.float64(1.0e-9):
        w = w * (angle / sine)
    t = wp.vec3d(T[0, 3], T[1, 3], T[2, 3])
    turned = wp.cross(w, t)
    t = t - half * turned + wp.cross(w, turned) / wp.float64(12.0)
    return vec6d(t[0], t[1], t[2], w[0], w[1], w[2])


@wp.func
def invert_rigid(T: wp.mat44d) -> wp.mat44d:
    """Inverse of a rigid motion."""
    zero = wp.float64(0.0)
    x = wp.vec3d(T[0, 0], T[1, 0], T[2, 0])
    y = wp.vec3d(T[0, 1], T[1, 1], T[2, 1])
    z = wp.vec3d(T[0, 2], T[1, 2], T[2, 2])
    t = wp.vec3d(T[0, 3], T[1, 3], T[2, 3])
    return wp.mat44d(
        x[0], x[1], x[2], -wp.dot(x, t),
        y[0], y[1], y[2], -wp.dot(y, t),
        z[0], z[1], z[2], -wp.dot(z, t),
        zero, zero, zero, wp.float64(1.0),
    )  # fmt: skip


@wp.func
def orthonormalise(T: wp.mat44d) -> wp.mat44d:
    """Rigid motion nearest to a product of rigid motions, by Gram-Schmidt on its columns."""
    x = wp.normalize(wp.vec3d(T[0, 0], T[1, 0], T[2, 0]))
    y = wp.vec3d(T[0, 1], T[1, 1], T[2, 1])
    y = wp.normalize(y - wp.dot(x, y) * x)
    z = wp.cross(x, y)
    zero = wp.float64(0.0)
    return wp.mat44d(
        x[0], y[0], z[0], T[0, 3],
        x[1], y[1], z[1], T[1, 3],
        x[2], y[2], z[2], T[2, 3],
        zero, zero, zero, wp.float64(1.0),
    )  # fmt: skip


SMALLEST_GAIN = wp.constant(wp.float64(0.2))
LARGEST_GAIN = wp.constant(wp.float64(5.0))


@wp.func
def update_photometry(
    sums: wp.array3d[wp.float64], b: int, k: int, photometry: Photometry, least_scale: float
) -> Photometry:
    """Gain and bias from the sums of a pass; scale by a step to its fixed point.

    The gain stays where it is between the slopes of the regressions of the live on the model's
    grey values and the other way around.

    At the scale c of Cauchy's distribution the mean weight is 1/2; from far away, c^2 is off by
    about the ratio of (1 - weight) and weight.
    """
    weight = sums[b, k, Sum.EXPOSURE_W]
    if weight > wp.float64(0.0):
        mean = sums[b, k, Sum.EXPOSURE_WM] / weight
        mean_residual = sums[b, k, Sum.EXPOSURE_WR] / weight
        variance = sums[b, k, Sum.EXPOSURE_WMM] / weight - mean * mean
        covariance = sums[b, k, Sum.EXPOSURE_WMR] / weight - mean * mean_residual
        spread = sums[b, k, Sum.EXPOSURE_WRR] / weight - mean_residual * mean_residual
        gain64 = wp.float64(photometry.gain)
        common = covariance + gain64 * variance  # of the live and the model's values
        live_variance = spread + gain64 * (covariance + common)
        # Without contrast, well below 5 grey levels, the gain stays.
        slack = wp.float64(625.0) / wp.max(variance, wp.float64(1.0))
        low = common / (variance + slack)
        high = (live_variance + slack) / wp.max(common, wp.float64(1.0e-3))
        high = wp.max(low, high)
        moved = wp.min(wp.max(gain64, low), high)
        gain = wp.float32(wp.min(wp.max(moved, SMALLEST_GAIN), LARGEST_GAIN))
        photometry.bias += wp.float32(mean_residual) - (gain - photometry.gain) * (
            wp.float32(mean) + 128.0
        )
        photometry.gain = gain
    textured = sums[b, k, Sum.TEXTURED]
    if textured > wp.float64(50.0):
        rough = sums[b, k, Sum.ROUGH] / textured
        ratio = wp.sqrt(rough / wp.max(wp.float64(1.0) - rough, wp.float64(1.0e-3)))
        photometry.scale = wp.clamp(
            wp.max(photometry.scale, least_scale) * wp.float32(ratio), 0.1, 100.0
        )
    return photometry


@wp.func
def take_step(
    hypotheses: Hypotheses,
    damping: wp.float64,
    smallest_step: wp.float64,
    least_scale: float,
    b: int,
    k: int,
) -> None:
    """Move hypothesis k of env b where the data constrain it; it rests once it has converged."""
    sums = hypotheses.sums
    before = hypotheses.photometry[b, k]
    hypotheses.photometry[b, k] = update_photometry(sums, b, k, before, least_scale)
    A, B, g_a, g_b, length = load_terms(sums, b, k)
    tilted, matched = sums[b, k, Sum.TILTED], sums[b, k, Sum.MATCHED]
    xi = remapped_step(A, B, g_a + g_b, tilted, matched, damping)
    for i in range(3, 6):
        xi[i] = xi[i] / length
    size = wp.float64(0.0)
    for i in range(6):
        size = wp.max(size, wp.abs(xi[i]))
    hypotheses.pose[b, k] = orthonormalise(hypotheses.pose[b, k] * se3_exp(xi))
    if size < smallest_step:
        hypotheses.state[b, k] = RESTING


@wp.kernel
def gauss_newton_step(
    hypotheses: Hypotheses,
    damping: wp.float64,
    smallest_step: wp.float64,  # metres and radians; below it the level has converged
    last: wp.int32,  # 1: last iteration of its level, so the next level may go on
    least_scale: wp.float32,
) -> None:
    """Move every active hypothesis; stop those that converged."""
    b, k = wp.tid()
    if hypotheses.state[b, k] == RUNNING:
        take_step(hypotheses, damping, smallest_step, least_scale, b, k)
    if last != 0 and hypotheses.state[b, k] == RESTING:
        hypotheses.state[b, k] = RUNNING


@wp.kernel
def iterate_at_once(
    images: AlignedImages,
    weights: Weights,
    stride: int,
    columns: int,
    hypotheses: Hypotheses,
    damping: wp.float64,
    smallest_step: wp.float64,
    iterations: int,
    ends_with_sums: int,  # 1: leave the sums at the poses that the last steps led to
) -> None:
    """Run all iterations of a level, one thread per hypothesis.

    Equals alternating ``accumulate_normal_equations``, ``reduce_sums`` and ``gauss_newton_step``.
    For the CPU, where a launch takes as long as a tenth of the work.
    """
    b, k = wp.tid()
    pieces = (images.model_size[0] + columns - 1) // columns
    rows = (images.model_size[1] + stride - 1) // stride
    for iteration in range(iterations + ends_with_sums):
        is_over = iteration == iterations
        if is_over and hypotheses.state[b, k] == RESTING:
            hypotheses.state[b, k] = RUNNING
        if hypotheses.state[b, k] == RUNNING:
            for row in range(rows):
                for piece in range(pieces):
                    accumulate_row(images, weights, stride, columns, hypotheses, b, k, row, piece)
            reduce_all_sums(hypotheses, rows * pieces, b, k)
            if not is_over:
                take_step(hypotheses, damping, smallest_step, weights.least_scale, b, k)
    if hypotheses.state[b, k] == RESTING:
        hypotheses.state[b, k] = RUNNING
