# ruff: noqa: UP018
# Warp code: float(0.0) declares a variable that changes.
"""Warp kernel that follows the camera's Cartesian path to every candidate with the joints.

One thread follows one candidate: inverse kinematics from waypoint to waypoint, then the checks,
in the order of ``REASONS`` of :mod:`ms_slam_env.robot.arm.feasibility`.
"""

from __future__ import annotations

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.robot.arm.ik_kernels import Arm, Scratch, forward, solve_waypoint

OK = wp.constant(0)
UNREACHABLE = wp.constant(1)
JOINT_LIMIT = wp.constant(2)
JOINT_SPEED = wp.constant(3)
FURNITURE = wp.constant(4)
SELF = wp.constant(5)

_AT_LIMIT = wp.constant(1.0e-4)
_CHECKED_M = wp.constant(0.04)


@wp.struct
class Grid:
    """Distances around the base."""

    distance: wp.array3d[float]
    R_grid_base: wp.mat33  # in voxels
    t_grid_base: wp.vec3


@wp.func
def why_missed(arm: Arm, q: wp.array3d[float], k: int, w: int, work: Scratch) -> int:
    """Why a waypoint is not reached: a joint at its limit, or else out of reach."""
    found = int(UNREACHABLE)
    for i in range(arm.num_joints):
        if q[k, w, i] <= work.low[k, i] + _AT_LIMIT or q[k, w, i] >= work.high[k, i] - _AT_LIMIT:
            found = JOINT_LIMIT
    return found


@wp.func
def distance_at(grid: Grid, point: wp.vec3) -> float:
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
def furniture_deficit(arm: Arm, grid: Grid, k: int, work: Scratch) -> float:
    """Metres by which the moving links violate their clearance to furniture; <= 0 if none."""
    worst = float(-1.0e6)
    for i in range(arm.capsule_link.shape[0]):
        if arm.capsule_link[i] > 0:
            a = work.a[k, i]
            b = work.b[k, i]
            # enough distance in the middle implies enough all along
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
def segment_distance(a0: wp.vec3, a1: wp.vec3, b0: wp.vec3, b1: wp.vec3) -> float:
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
def self_deficit(arm: Arm, k: int, work: Scratch) -> float:
    """Metres by which two links violate their clearance to each other; <= 0 if none."""
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
def place_capsules(arm: Arm, k: int, work: Scratch) -> float:
    """Place the capsules in the base frame from the links' poses; return the largest movement."""
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
def collision(arm: Arm, grid: Grid, k: int, work: Scratch, deficit: wp.array[float]) -> int:
    """The collision of the capsules at their present place, or ``OK``."""
    if furniture_deficit(arm, grid, k, work) > deficit[0]:
        return FURNITURE
    if self_deficit(arm, k, work) > deficit[1]:
        return SELF
    return OK


@wp.func
def collision_on_part(
    arm: Arm,
    grid: Grid,
    q: wp.array3d[float],
    k: int,
    w: int,
    work: Scratch,
    deficit: wp.array[float],
) -> int:
    """The collision on the part that ends at waypoint ``w``, or ``OK``.

    Where a link moves far between two waypoints, poses between them are checked too.
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
    if checks > 1 and found == OK:  # back to the waypoint, where the next part begins
        forward(arm, q, k, w, work)
        place_capsules(arm, k, work)
    return found


@wp.kernel
def start_deficits(
    arm: Arm,
    grid: Grid,
    work: Scratch,
    q: wp.array3d[float],
    most: float,
    deficit: wp.array[float],
) -> None:
    """Violations of clearance at the start, which the arm may keep on its path."""
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
    step: wp.array[wp.vec3],
    turn: wp.array[wp.vec3],
    duration_s: wp.array[float],
    deficit: wp.array[float],
    damping: float,
    limit_margin: float,
    most_stretch: float,
    share: wp.array[float],
    q: wp.array3d[float],
    stretch: wp.array[float],
    reason: wp.array[int],
) -> None:
    """Follow one candidate's path; ``q`` (k, W, n) holds the start in its first waypoint.

    ``share`` (W,) is the share of the path completed at each waypoint.
    """
    k = wp.tid()
    n = arm.num_joints
    parts = q.shape[1] - 1
    angle = wp.length(turn[k])
    axis = wp.normalize(turn[k])
    slowest = float(1.0)
    for i in range(n):  # a joint that starts beyond its limit's margin may stay there
        work.low[k, i] = wp.min(arm.lower[i] + limit_margin, q[k, 0, i])
        work.high[k, i] = wp.max(arm.upper[i] - limit_margin, q[k, 0, i])
    forward(arm, q, k, 0, work)
    place_capsules(arm, k, work)
    for w in range(1, parts + 1):
        for i in range(n):  # extrapolation in joint space is a close first guess
            q[k, w, i] = q[k, w - 1, i]
            if w > 1:
                ahead = (share[w] - share[w - 1]) / (share[w - 1] - share[w - 2])
                q[k, w, i] += ahead * (q[k, w - 1, i] - q[k, w - 2, i])
        R_target = R_start * wp.quat_to_matrix(wp.quat_from_axis_angle(axis, share[w] * angle))
        t_target = t_start + share[w] * step[k]
        if solve_waypoint(arm, R_target, t_target, damping, q, k, w, work) == 0:
            reason[k] = why_missed(arm, q, k, w, work)
            return
        for i in range(n):
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
