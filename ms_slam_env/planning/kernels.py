"""Warp kernels for the occupancy grid, expected gain, and the information of predicted views."""

from ms_slam_env._runtime.warp import kernel_wp as wp

PASSED = wp.constant(1)  # a cell crossed by a ray that ends on a surface
STRUCK = wp.constant(2)  # a cell in which a ray ended
BLANK = wp.constant(3)  # a cell crossed by a ray without a reading: surface too far, or none
CAMERA_M = wp.constant(0.1)  # radius of the space that the camera itself fills
CARVING_STEP = wp.constant(0.7)  # cells of depth between the points of a ray
MARGIN = wp.constant(0.5)  # cells of depth in front of a surface that are not carved
NEAREST_M = wp.constant(0.3)  # the sensor has no readings nearer
GAIN_STEP = wp.constant(0.8)  # cells of depth between the points of a ray, so that none is skipped
SEEN_THROUGH = wp.constant(0.85**0.8)  # chance that a step through unknown cells hits nothing
BLOCK = wp.constant(2.0)  # cells along an edge of a block that is counted once
STILL_BLANK = wp.constant(0.7)  # factor on a cell's gain per look without a reading
DEPTH_NOISE = wp.constant(wp.vec3(0.0012, 0.0019, 0.4))  # m, 1/m, m; see view_information

mat66 = wp.types.matrix(shape=(6, 6), dtype=wp.float32)
vec6 = wp.types.vector(length=6, dtype=wp.float32)


@wp.func
def _cell(at: wp.vec3, shape: wp.vec3i) -> wp.vec3i:
    """The cell of a point, in cells; (-1, -1, -1) outside."""
    cell = wp.vec3i(int(wp.floor(at[0])), int(wp.floor(at[1])), int(wp.floor(at[2])))
    for axis in range(3):
        if cell[axis] < 0 or cell[axis] >= shape[axis]:
            return wp.vec3i(-1, -1, -1)
    return cell


@wp.kernel
def mark_rays(
    directions: wp.array[wp.vec3],  # at depth 1 m, in cells
    depths: wp.array[float],
    start: wp.vec3,  # of all rays, in cells of ``marks``
    shape: wp.vec3i,  # of ``marks``
    cell_m: float,
    reach_m: float,
    mark: int,
    marks: wp.array3d[wp.int8],
) -> None:
    """Mark the cells of every ray with one kind of mark."""
    ray = wp.tid()
    depth = depths[ray]
    z = wp.float32(CAMERA_M)
    end = wp.float32(reach_m)
    if mark == STRUCK:
        z = depth
        end = wp.where(depth > 0.0 and depth < reach_m, depth + 0.5 * cell_m, 0.0)
    elif mark == PASSED:
        end = wp.where(depth > 0.0, wp.min(reach_m, depth - MARGIN * cell_m), 0.0)
    elif depth > 0.0:
        end = 0.0
    while z < end:
        cell = _cell(start + z * directions[ray], shape)
        if cell[0] >= 0:
            marks[cell[0], cell[1], cell[2]] = wp.int8(mark)
        z += CARVING_STEP * cell_m


@wp.func
def _value(cells: wp.array3d[wp.int8], cell: wp.vec3i) -> int:
    """Value of a cell; 0 outside the grid."""
    value = wp.int32(0)
    if cell[0] >= 0:
        value = wp.int32(cells[cell[0], cell[1], cell[2]])
    return value


@wp.func
def _still_blank(blanks: wp.array3d[wp.int8], cell: wp.vec3i) -> float:
    """Share of an unknown cell that still counts after frames without a reading there."""
    share = wp.float32(1.0)
    looks = _value(blanks, cell)
    if looks > 0:
        share = wp.pow(STILL_BLANK, float(looks))
    return share


@wp.kernel
def sum_unknown(
    directions: wp.array[wp.vec3],  # in the camera frame, z = 1 m
    rotations: wp.array[wp.mat33],  # to the world, in cells
    starts: wp.array[wp.vec3],  # in cells
    log_odds: wp.array3d[wp.int8],
    blanks: wp.array3d[wp.int8],
    cell_m: float,
    reach_m: float,
    gains: wp.array2d[float],
    depths: wp.array2d[float],
) -> None:
    """Sum the unknown length of each ray of each pose, weighted by z^2 and the chance to see it.

    Also returns the depth of the first occupied cell that it hits, 0 if none.
    """
    pose, ray = wp.tid()
    shape = wp.vec3i(log_odds.shape[0], log_odds.shape[1], log_odds.shape[2])
    direction = rotations[pose] * directions[ray]
    dz = GAIN_STEP * cell_m
    chance = wp.float32(1.0)
    gain = wp.float32(0.0)
    z = wp.float32(NEAREST_M)
    while z < reach_m:
        cell = _cell(starts[pose] + z * direction, shape)
        state = _value(log_odds, cell)
        if state > 0:
            depths[pose, ray] = z
            break
        if state == 0:
            gain += chance * z * z * dz * _still_blank(blanks, cell)
            chance *= SEEN_THROUGH
        z += dz
    gains[pose, ray] = gain


@wp.kernel
def sum_unknown_held(
    directions: wp.array[wp.vec3],  # in the camera frame, z = 1 m
    rotations: wp.array2d[wp.mat33],  # (motions, steps) to the world, in cells
    starts: wp.array2d[wp.vec3],  # in cells
    log_odds: wp.array3d[wp.int8],
    blanks: wp.array3d[wp.int8],
    cell_m: float,
    reach_m: float,
    low: wp.vec3,  # first cell of the first block
    first_seen: wp.array4d[wp.int8],  # (motions, blocks) step that first sees it, from 1; 0: none
    gains: wp.array2d[float],  # (motions, steps)
) -> None:
    """As `sum_unknown`, along repeated motions; a block counts in the first step that sees it.

    A motion ends where the camera would enter a cell that is not known to be free.
    """
    motion = wp.tid()
    shape = wp.vec3i(log_odds.shape[0], log_odds.shape[1], log_odds.shape[2])
    blocks = wp.vec3i(first_seen.shape[1], first_seen.shape[2], first_seen.shape[3])
    dz = GAIN_STEP * cell_m
    for step in range(starts.shape[1]):
        here = _cell(starts[motion, step], shape)
        if step > 0 and (here[0] < 0 or log_odds[here[0], here[1], here[2]] >= wp.int8(0)):
            break
        gain = wp.float32(0.0)
        for ray in range(directions.shape[0]):
            direction = rotations[motion, step] * directions[ray]
            chance = wp.float32(1.0)
            z = wp.float32(NEAREST_M)
            while z < reach_m:
                at = starts[motion, step] + z * direction
                cell = _cell(at, shape)
                state = _value(log_odds, cell)
                if state > 0:
                    break
                if state == 0:
                    block = _cell((at - low) / BLOCK, blocks)
                    seen = wp.int32(0)
                    if block[0] >= 0:
                        seen = wp.int32(first_seen[motion, block[0], block[1], block[2]])
                        if seen == 0:
                            seen = step + 1
                            first_seen[motion, block[0], block[1], block[2]] = wp.int8(seen)
                    if seen == step + 1:
                        gain += chance * z * z * dz * _still_blank(blanks, cell)
                    chance *= SEEN_THROUGH
                z += dz
        gains[motion, step] = gain


@wp.kernel
def sum_information(
    depth: wp.array3d[float],
    normals: wp.array3d[wp.vec3],
    lengths: wp.array[float],
    focal: wp.vec2,
    centre: wp.vec2,
    sums: wp.array2d[mat66],
) -> None:
    """Sum of J^T J / sigma^2 over a row of each view, rotations times the view's length."""
    view, v = wp.tid()
    H = mat66()
    for u in range(depth.shape[2]):
        z = depth[view, v, u]
        if z > 0.0:
            x = (float(u) - centre[0]) / focal[0]
            y = (float(v) - centre[1]) / focal[1]
            beyond = wp.max(z - DEPTH_NOISE[2], 0.0)
            n = normals[view, v, u] / (DEPTH_NOISE[0] + DEPTH_NOISE[1] * beyond * beyond)
            turn = wp.cross(wp.vec3(x * z, y * z, z), n) / lengths[view]
            J = vec6(n[0], n[1], n[2], turn[0], turn[1], turn[2])
            H += wp.outer(J, J)
    sums[view, v] = H


@wp.kernel
def sum_remaining(
    depth: wp.array2d[float],
    normals: wp.array2d[wp.vec3],
    T_there_here: wp.array[wp.mat44],
    length: float,
    nearest: float,  # metres, below which a pixel counts as near
    focal: wp.vec2,
    centre: wp.vec2,
    sums: wp.array2d[mat66],
    counts: wp.array2d[wp.vec2],  # pixels that remain, and those of them that are near
) -> None:
    """As `sum_information`, over the pixels of one view that remain visible in nearby views."""
    there, v = wp.tid()
    H = mat66()
    count = wp.vec2()
    for u in range(depth.shape[1]):
        z = depth[v, u]
        if z > 0.0:
            ray = wp.vec3((float(u) - centre[0]) / focal[0], (float(v) - centre[1]) / focal[1], 1.0)
            p = wp.transform_point(T_there_here[there], z * ray)
            n = wp.transform_vector(T_there_here[there], normals[v, u])
            at = wp.vec2(focal[0] * p[0] / p[2] + centre[0], focal[1] * p[1] / p[2] + centre[1])
            inside = p[2] > CAMERA_M and at[0] > -0.5 and at[0] < float(depth.shape[1]) - 0.5
            if inside and at[1] > -0.5 and at[1] < float(depth.shape[0]) - 0.5:
                beyond = wp.max(p[2] - DEPTH_NOISE[2], 0.0)
                n /= DEPTH_NOISE[0] + DEPTH_NOISE[1] * beyond * beyond
                turn = wp.cross(p, n) / length
                J = vec6(n[0], n[1], n[2], turn[0], turn[1], turn[2])
                H += wp.outer(J, J)
                count += wp.vec2(1.0, wp.where(p[2] < nearest, 1.0, 0.0))
    sums[there, v] = H
    counts[there, v] = count


@wp.kernel
def count_states(
    log_odds: wp.array3d[wp.int8],
    rotation: wp.mat33,  # from blocks to cells
    start: wp.vec3,  # corner of the first block, in cells
    samples: int,  # along an edge of a block
    shares: wp.array4d[float],
) -> None:
    """Shares of free (0) and occupied (1) sample points in each block."""
    i, j, k = wp.tid()
    shape = wp.vec3i(log_odds.shape[0], log_odds.shape[1], log_odds.shape[2])
    edge = 1.0 / float(samples)
    free = wp.int32(0)
    occupied = wp.int32(0)
    for a in range(samples):
        for b in range(samples):
            for c in range(samples):
                place = wp.vec3(float(a) + 0.5, float(b) + 0.5, float(c) + 0.5) * edge
                at = start + rotation * (wp.vec3(float(i), float(j), float(k)) + place)
                cell = _cell(at, shape)
                if cell[0] >= 0:
                    state = wp.int32(log_odds[cell[0], cell[1], cell[2]])
                    free += wp.where(state < 0, 1, 0)
                    occupied += wp.where(state > 0, 1, 0)
    places = float(samples * samples * samples)
    shares[0, i, j, k] = float(free) / places
    shares[1, i, j, k] = float(occupied) / places
