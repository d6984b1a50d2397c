# ruff: noqa: UP018, RUF046
# Warp code: int(0) declares a variable that changes.
"""Inverse kinematics on the device: from one waypoint to the next, within the joints' limits.

Joint axes are the z axes of the joint frames here. Joint angles and axes are in arrays with one row
per candidate ``k``.
"""

from __future__ import annotations

from typing import Any

from ms_slam_env._runtime.warp import kernel_wp as wp

_ITERATIONS = wp.constant(8)
_CONVERGED_M = wp.constant(1.0e-4)
_CONVERGED_RAD = wp.constant(1.0e-4)
_TOLERANCE_M = wp.constant(1.8e-3)
_TOLERANCE_RAD = wp.constant(3.14e-3)
_LARGEST_STEP_RAD = wp.constant(0.3)

vec6: Any = wp.types.vector(length=6, dtype=wp.float32)
mat66: Any = wp.types.matrix(shape=(6, 6), dtype=wp.float32)


@wp.struct
class Arm:
    """Geometry of a chain with n joints, m capsules and p pairs of capsules."""

    num_joints: int
    joint_R: wp.array[wp.mat33]  # (n + 1,) each joint in the link before, then the camera
    joint_t: wp.array[wp.vec3]  # (n + 1,)
    lower: wp.array[float]  # (n,)
    upper: wp.array[float]  # (n,)
    speed: wp.array[float]  # (n,)
    capsule_link: wp.array[int]  # (m,) 0 is the base
    capsule_a: wp.array[wp.vec3]  # (m,)
    capsule_b: wp.array[wp.vec3]  # (m,)
    capsule_parts: wp.array[int]  # (m,) pieces into which its axis is cut
    capsule_need: wp.array[float]  # (m,) distance of the axis to furniture
    capsule_cover: wp.array[float]  # (m,) the same for the balls that cover it
    pair: wp.array[wp.vec2i]  # (p,)
    pair_need: wp.array[float]  # (p,) distance of their axes


@wp.struct
class Scratch:
    """Working memory of each candidate."""

    R: wp.array2d[wp.mat33]  # (k, n + 2) links, then the camera
    t: wp.array2d[wp.vec3]
    q: wp.array3d[float]  # (k, 1, n) joint angles between two waypoints
    low: wp.array2d[float]  # (k, n) limits of the joint angles on this path
    high: wp.array2d[float]
    J: wp.array2d[vec6]  # (k, n) columns of the geometric Jacobian
    step: wp.array2d[float]  # (k, n) of one iteration
    held: wp.array2d[int]  # (k, n) 1 for a joint held at its bound
    a: wp.array2d[wp.vec3]  # (k, m) ends of the capsules in the base frame
    b: wp.array2d[wp.vec3]


@wp.func
def forward(arm: Arm, q: wp.array3d[float], k: int, w: int, work: Scratch) -> None:
    """Poses of links and camera at waypoint ``w``."""
    R = wp.identity(n=3, dtype=float)
    t = wp.vec3(0.0, 0.0, 0.0)
    work.R[k, 0] = R
    work.t[k, 0] = t
    for i in range(arm.num_joints):
        t = t + R * arm.joint_t[i]
        F = R * arm.joint_R[i]
        c = wp.cos(q[k, w, i])
        s = wp.sin(q[k, w, i])
        R = wp.mat33(
            F[0, 0] * c + F[0, 1] * s,
            F[0, 1] * c - F[0, 0] * s,
            F[0, 2],
            F[1, 0] * c + F[1, 1] * s,
            F[1, 1] * c - F[1, 0] * s,
            F[1, 2],
            F[2, 0] * c + F[2, 1] * s,
            F[2, 1] * c - F[2, 0] * s,
            F[2, 2],
        )
        work.R[k, i + 1] = R
        work.t[k, i + 1] = t
    work.t[k, arm.num_joints + 1] = t + R * arm.joint_t[arm.num_joints]
    work.R[k, arm.num_joints + 1] = R * arm.joint_R[arm.num_joints]


@wp.func
def cholesky_solve(M: mat66, e: vec6) -> vec6:
    """Solution of M x = e for a symmetric positive definite M."""
    L = mat66(0.0)
    x = vec6(0.0)
    for i in range(6):
        for j in range(i + 1):
            total = M[i, j]
            for c in range(j):
                total = total - L[i, c] * L[j, c]
            if i == j:
                L[i, i] = wp.sqrt(wp.max(total, 1.0e-12))
            else:
                L[i, j] = total / L[j, j]
    for i in range(6):
        total = e[i]
        for c in range(i):
            total = total - L[i, c] * x[c]
        x[i] = total / L[i, i]
    for r in range(6):
        i = 5 - r
        total = x[i]
        for c in range(i + 1, 6):
            total = total - L[c, i] * x[c]
        x[i] = total / L[i, i]
    return x


@wp.func
def place_columns(arm: Arm, k: int, work: Scratch) -> None:
    """The Jacobian's columns from the links' poses."""
    t = work.t[k, arm.num_joints + 1]
    for i in range(arm.num_joints):
        axis = work.R[k, i + 1] * wp.vec3(0.0, 0.0, 1.0)
        v = wp.cross(axis, t - work.t[k, i + 1])
        work.J[k, i] = vec6(v[0], v[1], v[2], axis[0], axis[1], axis[2])


@wp.func
def bounded_step(
    arm: Arm, error: vec6, damping: float, q: wp.array3d[float], k: int, w: int, work: Scratch
) -> None:
    """Newton step that stays between ``work.low`` and ``work.high``, in ``work.step``.

    Solves the controller's quadratic programme: the squared pose error plus ``damping`` times the
    squared path from the waypoint before. Joints that would leave their bounds are held there and
    the others compensate, until none leaves.
    """
    n = arm.num_joints
    for i in range(n):
        work.held[k, i] = 0
    for _attempt in range(n + 1):
        M = damping * wp.identity(n=6, dtype=float)
        rest = error
        for i in range(n):
            J = work.J[k, i]
            if work.held[k, i] == 1:
                rest -= J * work.step[k, i]
            else:
                M += wp.outer(J, J)
                rest -= J * (q[k, w - 1, i] - q[k, w, i])
        y = cholesky_solve(M, rest)
        left = int(0)
        for i in range(n):
            if work.held[k, i] == 0:
                wanted = q[k, w - 1, i] - q[k, w, i] + wp.dot(work.J[k, i], y)
                low = wp.max(work.low[k, i] - q[k, w, i], -_LARGEST_STEP_RAD)
                high = wp.min(work.high[k, i] - q[k, w, i], _LARGEST_STEP_RAD)
                work.step[k, i] = wp.clamp(wanted, low, high)
                if wanted < low or wanted > high:
                    work.held[k, i] = 1
                    left = 1
        if left == 0:
            break


@wp.func
def solve_waypoint(
    arm: Arm,
    R_target: wp.mat33,
    t_target: wp.vec3,
    damping: float,
    q: wp.array3d[float],
    k: int,
    w: int,
    work: Scratch,
) -> int:
    """Take Newton steps from the guess in ``q``; return whether the camera is within tolerance."""
    n = arm.num_joints
    close = int(0)
    for iteration in range(_ITERATIONS):
        forward(arm, q, k, w, work)
        E = R_target * wp.transpose(work.R[k, n + 1])
        dt = t_target - work.t[k, n + 1]
        # the rotation vector to first order, whose error shrinks with every step
        dr = 0.5 * wp.vec3(E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1])
        off_m = wp.length(dt)
        off_rad = wp.length(dr)
        close = wp.where(off_m < _TOLERANCE_M and off_rad < _TOLERANCE_RAD, 1, 0)
        converged = iteration > 0 and off_m < _CONVERGED_M and off_rad < _CONVERGED_RAD
        if converged or iteration == _ITERATIONS - 1:
            break
        place_columns(arm, k, work)
        error = vec6(dt[0], dt[1], dt[2], dr[0], dr[1], dr[2])
        bounded_step(arm, error, damping, q, k, w, work)
        for i in range(n):
            q[k, w, i] = q[k, w, i] + work.step[k, i]
    return close
