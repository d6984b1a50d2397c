# ruff: noqa: UP018, RUF046
# Warp code: float(0.0) declares a variable that changes.
"""Warp kernel that follows the camera's straight way to every candidate with the joints.

One thread follows one candidate: inverse kinematics from waypoint to waypoint, then the checks,
in the order of ``REASONS`` of :mod:`ms_slam_env.robot.arm.reach`. Joint axes are the z axes of the
joint frames here. Joint angles and axes live in arrays of one row a candidate.
"""

from __future__ import annotations

from ms_slam_env._warp import wp

OK = wp.constant(0)
UNREACHABLE = wp.constant(1)
JOINT_LIMIT = wp.constant(2)
JOINT_SPEED = wp.constant(3)
FURNITURE = wp.constant(4)
SELF = wp.constant(5)

_ITERATIONS = wp.constant(5)
_DAMPING = wp.constant(0.005)  # metres and radians
_CONVERGED_M = wp.constant(1.0e-4)
_CONVERGED_RAD = wp.constant(1.0e-4)
_TOLERANCE_M = wp.constant(1.0e-3)
_TOLERANCE_RAD = wp.constant(1.745e-3)
_LARGEST_STEP_RAD = wp.constant(0.3)
_CHECKED_M = wp.constant(0.04)

vec6 = wp.types.vector(length=6, dtype=wp.float32)
mat66 = wp.types.matrix(shape=(6, 6), dtype=wp.float32)


@wp.struct
class Arm:
    """Geometry of a chain with n joints, m capsules and p pairs of capsules."""

    num_joints: int
    joint_R: wp.array(dtype=wp.mat33)  # (n + 1,) each joint in the link before, then the camera
    joint_t: wp.array(dtype=wp.vec3)  # (n + 1,)
    lower: wp.array(dtype=float)  # (n,)
    upper: wp.array(dtype=float)  # (n,)
    speed: wp.array(dtype=float)  # (n,)
    capsule_link: wp.array(dtype=int)  # (m,) 0 is the base
    capsule_a: wp.array(dtype=wp.vec3)  # (m,)
    capsule_b: wp.array(dtype=wp.vec3)  # (m,)
    capsule_parts: wp.array(dtype=int)  # (m,) pieces that its axis is cut into
    capsule_need: wp.array(dtype=float)  # (m,) distance of the axis to furniture
    capsule_cover: wp.array(dtype=float)  # (m,) the same for the balls that cover it
    pair: wp.array(dtype=wp.vec2i)  # (p,)
    pair_need: wp.array(dtype=float)  # (p,) distance of their axes


@wp.struct
class Grid:
    """Distances around the base."""

    distance: wp.array3d(dtype=float)
    R_grid_base: wp.mat33  # in voxels
    t_grid_base: wp.vec3


@wp.struct
class Scratch:
    """Working memory of each candidate."""

    R: wp.array2d(dtype=wp.mat33)  # (k, n + 2) links, then the camera
    t: wp.array2d(dtype=wp.vec3)
    q: wp.array3d(dtype=float)  # (k, 1, n) joint angles between two waypoints
    a: wp.array2d(dtype=wp.vec3)  # (k, m) ends of the capsules in the base frame
    b: wp.array2d(dtype=wp.vec3)


@wp.func
def forward(arm: Arm, q: wp.array3d(dtype=float), k: int, w: int, work: Scratch):
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
def cholesky_solve(M: mat66, e: vec6):
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
def column(axis: wp.vec3, lever: wp.vec3):
    """Column of the geometric Jacobian of a hinge."""
    v = wp.cross(axis, lever)
    return vec6(v[0], v[1], v[2], axis[0], axis[1], axis[2])


@wp.func
def solve_waypoint(
    arm: Arm,
    R_target: wp.mat33,
    t_target: wp.vec3,
    q: wp.array3d(dtype=float),
    k: int,
    w: int,
    work: Scratch,
):
    """Damped Newton steps from the guess in ``q``; whether the camera is within tolerance."""
    n = arm.num_joints
    close = int(0)
    for iteration in range(_ITERATIONS):
        forward(arm, q, k, w, work)
        t = work.t[k, n + 1]
        E = R_target * wp.transpose(work.R[k, n + 1])
        dt = t_target - t
        # the rotation vector to first order: what is left of it shrinks with every step
        dr = 0.5 * wp.vec3(E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1])
        off_m = wp.length(dt)
        off_rad = wp.length(dr)
        close = wp.where(off_m < _TOLERANCE_M and off_rad < _TOLERANCE_RAD, 1, 0)
        if (off_m < _CONVERGED_M and off_rad < _CONVERGED_RAD) or iteration == _ITERATIONS - 1:
            break
        M = _DAMPING * _DAMPING * wp.identity(n=6, dtype=float)
        for i in range(n):
            axis = work.R[k, i + 1] * wp.vec3(0.0, 0.0, 1.0)
            J = column(axis, t - work.t[k, i + 1])
            M += wp.outer(J, J)
        y = cholesky_solve(M, vec6(dt[0], dt[1], dt[2], dr[0], dr[1], dr[2]))
        for i in range(n):
            axis = work.R[k, i + 1] * wp.vec3(0.0, 0.0, 1.0)
            step = wp.dot(column(axis, t - work.t[k, i + 1]), y)
            q[k, w, i] = q[k, w, i] + wp.clamp(step, -_LARGEST_STEP_RAD, _LARGEST_STEP_RAD)
    return close


@wp.func
def distance_at(grid: Grid, point: wp.vec3):
    """Trilinear distance at a point of the base frame; 0 off the grid."""
    p = grid.R_grid_base * point + grid.t_grid_base
    nx = grid.distance.shape[0]
    ny = grid.distance.shape[1]
    nz = grid.distance.shape[2]
    if (
        p[0] < 0.0
        or p[1] < 0.0
        or p[2] < 0.0
        or p[0] > float(nx - 1)
        or p[1] > float(ny - 1)
        or p[2] > float(nz - 1)
    ):
        return float(0.0)
    x = wp.min(int(p[0]), nx - 2)
    y = wp.min(int(p[1]), ny - 2)
    z = wp.min(int(p[2]), nz - 2)
    fx = p[0] - float(x)
    fy = p[1] - float(y)
    fz = p[2] - float(z)
    d00 = wp.lerp(grid.distance[x, y, z], grid.distance[x + 1, y, z], fx)
    d10 = wp.lerp(grid.distance[x, y + 1, z], grid.distance[x + 1, y + 1, z], fx)
    d01 = wp.lerp(grid.distance[x, y, z + 1], grid.distance[x + 1, y, z + 1], fx)
    d11 = wp.lerp(grid.distance[x, y + 1, z + 1], grid.distance[x + 1, y + 1, z + 1], fx)
    return wp.lerp(wp.lerp(d00, d10, fy), wp.lerp(d01, d11, fy), fz)


@wp.func
def furniture_deficit(arm: Arm, grid: Grid, k: int, work: Scratch):
    """Metres by which the moving links come closer to furniture than they may; <= 0 if none."""
    worst = float(-1.0e6)
    for i in range(arm.capsule_link.shape[0]):
        if arm.capsule_link[i] > 0:
            a = work.a[k, i]
            b = work.b[k, i]
            # far from everything in the middle is far enough all along
            spare = distance_at(grid, 0.5 * (a + b)) - 0.5 * wp.length(b - a)
            if spare >= arm.capsule_need[i]:
                worst = wp.max(worst, arm.capsule_need[i] - spare)
            else:
                parts = arm.capsule_parts[i]
                for j in range(parts + 1):
                    point = wp.lerp(a, b, float(j) / float(wp.max(parts, 1)))
                    worst = wp.max(worst, arm.capsule_cover[i] - distance_at(grid, point))
    return worst


@wp.func
def segment_distance(a0: wp.vec3, a1: wp.vec3, b0: wp.vec3, b1: wp.vec3):
    """Distance between two segments (Ericson, Real-Time Collision Detection, 5.1.9)."""
    d1 = a1 - a0
    d2 = b1 - b0
    r = a0 - b0
    aa = wp.dot(d1, d1)
    ee = wp.dot(d2, d2)
    bb = wp.dot(d1, d2)
    cc = wp.dot(d1, r)
    ff = wp.dot(d2, r)
    s = float(0.0)
    denominator = aa * ee - bb * bb
    if denominator > 1.0e-12:
        s = wp.clamp((bb * ff - cc * ee) / denominator, 0.0, 1.0)
    t = (bb * s + ff) / wp.max(ee, 1.0e-12)
    if t < 0.0 or t > 1.0:
        t = wp.clamp(t, 0.0, 1.0)
        s = wp.clamp((bb * t - cc) / wp.max(aa, 1.0e-12), 0.0, 1.0)
    return wp.length(r + s * d1 - t * d2)


@wp.func
def self_deficit(arm: Arm, k: int, work: Scratch):
    """Metres by which two links come closer than they may; <= 0 if none do."""
    worst = float(-1.0e6)
    for i in range(arm.pair.shape[0]):
        pair = arm.pair[i]
        a0 = work.a[k, pair[0]]
        a1 = work.b[k, pair[0]]
        b0 = work.a[k, pair[1]]
        b1 = work.b[k, pair[1]]
        middle = wp.length(0.5 * (a0 + a1 - b0 - b1))
        spare = middle - 0.5 * (wp.length(a1 - a0) + wp.length(b1 - b0)) - arm.pair_need[i]
        if spare < 0.0:
            spare = segment_distance(a0, a1, b0, b1) - arm.pair_need[i]
        worst = wp.max(worst, -spare)
    return worst


@wp.func
def place_capsules(arm: Arm, k: int, work: Scratch):
    """Ends of the capsules in the base frame, from the links' poses; how far the farthest moved."""
    farthest = float(0.0)
    for i in range(arm.capsule_link.shape[0]):
        link = arm.capsule_link[i]
        R = work.R[k, link]
        t = work.t[k, link]
        a = R * arm.capsule_a[i] + t
        b = R * arm.capsule_b[i] + t
        farthest = wp.max(farthest, wp.length(a - work.a[k, i]))
        farthest = wp.max(farthest, wp.length(b - work.b[k, i]))
        work.a[k, i] = a
        work.b[k, i] = b
    return farthest


@wp.func
def collision(arm: Arm, grid: Grid, k: int, work: Scratch, deficit: wp.array(dtype=float)):
    """The reason against the capsules where they are now, or ``OK``."""
    if furniture_deficit(arm, grid, k, work) > deficit[0]:
        return FURNITURE
    if self_deficit(arm, k, work) > deficit[1]:
        return SELF
    return OK


@wp.func
def collision_on_part(
    arm: Arm,
    grid: Grid,
    q: wp.array3d(dtype=float),
    k: int,
    w: int,
    work: Scratch,
    deficit: wp.array(dtype=float),
):
    """The reason against the part that ends at waypoint ``w``, or ``OK``.

    Where a link moves far between two waypoints places between them are checked too.
    """
    moved = place_capsules(arm, k, work)
    found = collision(arm, grid, k, work, deficit)
    checks = int(wp.ceil(moved / _CHECKED_M))
    for j in range(1, checks):
        if found == OK:
            share = float(j) / float(checks)
            for i in range(arm.num_joints):
                work.q[k, 0, i] = wp.lerp(q[k, w - 1, i], q[k, w, i], share)
            forward(arm, work.q, k, 0, work)
            place_capsules(arm, k, work)
            found = collision(arm, grid, k, work, deficit)
    if checks > 1 and found == OK:  # back to the waypoint, from where the next part begins
        forward(arm, q, k, w, work)
        place_capsules(arm, k, work)
    return found


@wp.kernel
def start_deficits(
    arm: Arm,
    grid: Grid,
    work: Scratch,
    q: wp.array3d(dtype=float),
    most: float,
    deficit: wp.array(dtype=float),
):
    """How much closer to furniture and to itself the arm may come because it already is."""
    forward(arm, q, 0, 0, work)
    place_capsules(arm, 0, work)
    deficit[0] = wp.clamp(furniture_deficit(arm, grid, 0, work), 0.0, most)
    deficit[1] = wp.clamp(self_deficit(arm, 0, work), 0.0, most)


@wp.kernel
def follow(
    arm: Arm,
    grid: Grid,
    work: Scratch,
    R_start: wp.mat33,
    t_start: wp.vec3,
    step: wp.array(dtype=wp.vec3),
    turn: wp.array(dtype=wp.vec3),
    duration_s: wp.array(dtype=float),
    deficit: wp.array(dtype=float),
    limit_margin: float,
    most_stretch: float,
    share: wp.array(dtype=float),
    q: wp.array3d(dtype=float),
    stretch: wp.array(dtype=float),
    reason: wp.array(dtype=int),
):
    """Follow one candidate's way; ``q`` (k, W, n) holds the start in its first waypoint.

    ``share`` (W,) is how much of the way is made at each waypoint.
    """
    k = wp.tid()
    n = arm.num_joints
    parts = q.shape[1] - 1
    angle = wp.length(turn[k])
    axis = wp.normalize(turn[k])
    slowest = float(1.0)
    forward(arm, q, k, 0, work)
    place_capsules(arm, k, work)
    for w in range(1, parts + 1):
        for i in range(n):  # straight on in joint space is a close first guess
            q[k, w, i] = q[k, w - 1, i]
            if w > 1:
                ahead = (share[w] - share[w - 1]) / (share[w - 1] - share[w - 2])
                q[k, w, i] += ahead * (q[k, w - 1, i] - q[k, w - 2, i])
        R_target = R_start * wp.quat_to_matrix(wp.quat_from_axis_angle(axis, share[w] * angle))
        if solve_waypoint(arm, R_target, t_start + share[w] * step[k], q, k, w, work) == 0:
            reason[k] = UNREACHABLE
            return
        for i in range(n):
            low = wp.min(arm.lower[i] + limit_margin, q[k, 0, i])
            high = wp.max(arm.upper[i] - limit_margin, q[k, 0, i])
            if q[k, w, i] < low or q[k, w, i] > high:
                reason[k] = JOINT_LIMIT
                return
            moved = wp.abs(q[k, w, i] - q[k, w - 1, i])
            needed_s = float(parts) * moved / arm.speed[i]
            if needed_s > duration_s[k] * slowest:
                slowest = needed_s / duration_s[k]
        if slowest > most_stretch:
            reason[k] = JOINT_SPEED
            return
        found = collision_on_part(arm, grid, q, k, w, work, deficit)
        if found != OK:
            reason[k] = found
            return
    stretch[k] = slowest
    reason[k] = OK
