"""Directions of the pose that the data do not constrain, and the step that leaves them alone.

Solution remapping: Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation
problems" (ICRA 2016), equations (13) to (18). The update is taken only along those eigenvectors of
the normal matrix with enough information; along the others the pose keeps what was predicted.
Rotations are first multiplied by a length that makes them comparable with translations: the
distance at which both move the points alike.

Noise of the normals seems to constrain the sliding and turning of a plane too. Up to the mean of
1 - cos of the angle between model and live normals, their noise per axis, geometric information
along a direction may be only that. On blank walls and corners, with 1 mm to 4 mm of noise, it is
0.02 to 0.28 of it; in the weakest direction of a furnished room at least 0.48.
"""

from __future__ import annotations

from ms_slam_env._runtime.warp import wp
from ms_slam_env.native import native_source

mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
mat76d = wp.types.matrix(shape=(7, 6), dtype=wp.float64)
vec6d = wp.types.vector(length=6, dtype=wp.float64)
NORMAL_NOISE = wp.constant(wp.float64(0.3))  # share of that mean that is worth nothing
LEAST_INFORMATION = wp.constant(wp.float64(0.5))  # per matched point, 1/m^2: 2 cm of 5000 points
OPEN_VARIANCE = wp.constant(wp.float64(0.03 * 0.03))  # m^2, of a frame's predicted motion
GEOMETRIC_NOISE = wp.constant(wp.float64(0.022))  # covariance of the gradient over A or B;
PHOTOMETRIC_NOISE = wp.constant(wp.float64(0.34))  # see experiments/pose_covariance.py
SINGULAR = wp.constant(wp.float64(1.0e-6))


@wp.func_native(native_source("eigen", "eigen"))
def eigen(H: mat66d) -> mat76d:
    """Eigenvectors of a symmetric matrix as columns, eigenvalues below, by cyclic Jacobi."""


@wp.func
def _trace(H: mat66d, first: int):
    return H[first, first] + H[first + 1, first + 1] + H[first + 2, first + 2]


@wp.func
def turning_length(H: mat66d):
    """Distance d in metres at which a rotation moves the points like a translation."""
    rho = _trace(H, 0)
    length = wp.float64(1.0)
    if rho > wp.float64(0.0):
        length = wp.clamp(wp.sqrt(_trace(H, 3) / rho), wp.float64(0.01), wp.float64(100.0))
    return length


@wp.func
def in_metres(H: mat66d, length: wp.float64):
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
def is_constrained(E: mat76d, k: int, geometric: mat66d, tilted: wp.float64, matched: wp.float64):
    """Whether the data constrain eigenvector ``k`` of the normal matrix; matrices in metres."""
    known = wp.float64(0.0)
    for i in range(6):
        for j in range(6):
            known += E[i, k] * geometric[i, j] * E[j, k]
    information = E[6, k] - wp.min(known, NORMAL_NOISE * tilted)
    return information > LEAST_INFORMATION * matched + SINGULAR


@wp.func
def gradient_in_metres(g: vec6d, length: wp.float64):
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
):
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
):
    """Covariance H^-1 (a A + b B) H^-1 of the pose, metres and radians, H = A + B in metres.

    The weights of the two terms were chosen for accuracy, so H^-1 is no covariance: a A and b B
    are those of the gradients. Along directions that the view leaves open it is the prediction's.
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
