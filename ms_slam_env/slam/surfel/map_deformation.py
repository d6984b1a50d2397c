"""Deform the map of one env so that its present part meets the inactive one, and join them.

The motion of space is an embedded deformation graph: Sumner, Schmid and Pauly, "Embedded
deformation for shape manipulation" (SIGGRAPH 2007), as used by ElasticFusion (Whelan et al., RSS
2015, section V). Nodes are sampled uniformly in the order in which surfels were created, and each
is joined to its neighbours in that order. So two passes through one place are connected only along
the path between them, and can be pulled onto each other. The energy (section V-B) is minimised by
sparse Gauss-Newton:

    E_rot = sum_l |R_l^T R_l - I|^2                                                  equation 10
    E_reg = sum_l sum_n |R_l (g_n - g_l) + g_l + t_l - (g_n + t_n)|^2                equation 11
    E_con = sum_p |phi(source_p) - target_p|^2                                       equation 12

Pins are constraints whose target is their source; a relative constraint has phi(target_p) in place
of target_p (equation 14). We add one term:

    E_twist = TWIST_M^2 sum_l sum_n |R_l - R_n|^2                     weighted like E_reg

The k nodes nearest in time often lie along a line, about which E_reg lets R turn freely; long
chains of nodes then fold up to close a gap of centimetres. E_twist is E_reg for points TWIST_M
beside the nodes.

All terms but E_rot are linear in the unknowns: for every node the nine numbers of R row by row,
then t.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.slam.shared.rows import Rows, join
from ms_slam_env.slam.surfel.device import SavedBuffer
from ms_slam_env.slam.surfel.rendering import SplatRenderer
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.surfels import (
    SplatCamera,
    Surfels,
    VisibleList,
    depth_tolerance,
    floor_int,
)

NEIGHBOURS = 4  # k: neighbours of a node, and nodes that influence a point
TEMPORAL_WINDOW = 20  # a point's nearest nodes are sought among this many nearest in time
FEWEST_NODES = NEIGHBOURS + 2


@dataclass(frozen=True)
class DeformationGraph:
    """Nodes in temporal order, each joined to its neighbours in that order."""

    positions: Float64  # (M, 3) g of the nodes, metres
    times: Float64  # (M,) when their surfels were created, ascending; any unit

    def __len__(self) -> int:
        return len(self.positions)

    def edges(self) -> Int64:
        """Directed edges (E, 2) from every node to the k nearest in temporal order."""
        count = len(self)
        half = NEIGHBOURS // 2
        first = np.clip(np.arange(count) - half, 0, count - 1 - NEIGHBOURS)
        near = first[:, None] + np.arange(NEIGHBOURS + 1)  # the node itself among them
        own = np.broadcast_to(np.arange(count)[:, None], near.shape)
        return np.stack([own, near], axis=-1)[near != own].astype(np.int64)

    def first_candidates(self, times: ArrayLike) -> Int64:
        """First (N,) of the ``window`` consecutive nodes nearest in time to every point."""
        times = np.asarray(times, dtype=np.float64)
        after = np.searchsorted(self.times, times).clip(1, len(self) - 1)
        closer = times - self.times[after - 1] <= self.times[after] - times
        nearest = np.where(closer, after - 1, after)
        return np.clip(nearest - self.window // 2, 0, len(self) - self.window)

    @property
    def window(self) -> int:
        """Number of nodes among which the nearest ones of a point are sought."""
        return min(TEMPORAL_WINDOW, len(self))

    def influence(self, points: ArrayLike, times: ArrayLike) -> tuple[Int64, Float64]:
        """Nodes (N, k) that move each point, and their weights (N, k), which sum to one.

        These are the k nearest of the nodes near in time. Their weight is (1 - distance /
        farthest)^2, where farthest is the distance of the next nearest node (ElasticFusion,
        algorithm 1 and equation 9).

        Args:
            points: (N, 3).
            times: (N,) creation time of each.
        """
        points = np.asarray(points, dtype=np.float64)
        candidates = self.first_candidates(times)[:, None] + np.arange(self.window)
        distances = np.linalg.norm(self.positions[candidates] - points[:, None], axis=-1)
        order = np.argsort(distances, axis=1, kind="stable")[:, : NEIGHBOURS + 1]
        nearest = np.take_along_axis(distances, order, axis=1)
        farthest = np.maximum(nearest[:, -1:], 1e-12)
        # A small constant keeps weights positive when all distances are equal.
        weights = (1.0 - nearest[:, :-1] / farthest) ** 2 + 1e-6
        nodes = np.take_along_axis(candidates, order[:, :-1], axis=1)
        return nodes, weights / weights.sum(axis=1, keepdims=True)


def sample_graph(positions: ArrayLike, times: ArrayLike, count: int) -> DeformationGraph:
    """Graph of ``count`` of the points (N, 3), evenly spaced in order of ascending times (N,)."""
    points = np.asarray(positions, dtype=np.float64)
    count = max(FEWEST_NODES, min(count, len(points)))
    chosen = np.linspace(0, len(points) - 1, count).round().astype(np.int64)
    return DeformationGraph(points[chosen], np.asarray(times, dtype=np.float64)[chosen])


@dataclass(frozen=True)
class Deformation:
    """The motion of the nodes of a graph."""

    graph: DeformationGraph  # the nodes
    R: Float64  # (M, 3, 3) linear part of each, close to a rotation
    t: Float64  # (M, 3) translation of each, metres

    def points(self, points: ArrayLike, times: ArrayLike) -> Float64:
        """Points (N, 3), created at times (N,), after deformation: ElasticFusion, equation 8."""
        points = np.asarray(points, dtype=np.float64)
        nodes, weights = self.graph.influence(points, times)
        centres = self.graph.positions[nodes]
        offsets = points[:, None] - centres
        moved = np.einsum("nkij,nkj->nki", self.R[nodes], offsets) + centres + self.t[nodes]
        return np.einsum("nk,nki->ni", weights, moved)


def identity(graph: DeformationGraph) -> Deformation:
    """The deformation that moves nothing."""
    count = len(graph)
    return Deformation(graph, np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))


UNKNOWNS = 12  # of a node
W_ROT, W_REG, W_CON = 1.0, 10.0, 100.0
TWIST_M = 0.3
DAMPING = 1e-9  # share of the mean diagonal, for directions that the constraints leave free
SMALLEST_STEP = 1e-7
_ROWS, _COLUMNS = np.triu_indices(3)
_DOUBLED = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(2.0))  # R^T R is symmetric


@dataclass(frozen=True)
class Constraints(Rows):
    """Points of the map and their targets."""

    sources: Float64  # (C, 3) points
    source_times: Float64  # (C,) their creation times
    targets: Float64  # (C, 3) where they belong
    # (C,) creation time of the surface at the target, which moves with the deformation; NaN: the
    # target is fixed.
    target_times: Float64

    def errors(self, deformation: Deformation) -> Float64:
        """Remaining distances (C,) to the targets, metres."""
        moved = self.moved_by(deformation)
        return np.linalg.norm(moved.sources - moved.targets, axis=1)

    def moved_by(self, deformation: Deformation) -> Constraints:
        """A copy moved by a deformation of the map; fixed targets stay."""
        relative = np.isfinite(self.target_times)
        targets = self.targets.copy()
        targets[relative] = deformation.points(targets[relative], self.target_times[relative])
        sources = deformation.points(self.sources, self.source_times)
        return replace(self, sources=sources, targets=targets)


def no_constraints() -> Constraints:
    """An empty set of constraints."""
    return Constraints(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0))


class Energy:
    """The weighted residuals of a graph under constraints."""

    def __init__(self, graph: DeformationGraph, constraints: Constraints) -> None:
        self.graph = graph
        edges, edge_offset = _edge_rows(graph, W_REG**0.5)
        twist = _twist_rows(graph, TWIST_M * W_REG**0.5)
        points, point_offset = _constraint_rows(graph, constraints, W_CON**0.5)
        self._matrix = sparse.vstack([edges, twist, points], format="csr")
        self._offset = np.concatenate([edge_offset, np.zeros(twist.shape[0]), point_offset])
        self._normal = (self._matrix.T @ self._matrix).tocsc()

    def residuals(self, x: Float64) -> Float64:
        """All residuals at unknowns x (12 M,); their squares sum to the energy."""
        return np.concatenate([self._matrix @ x + self._offset, self._rotation_residuals(x)])

    def jacobian(self, x: Float64) -> sparse.csr_matrix:
        """Derivatives of ``residuals``."""
        return sparse.vstack([self._matrix, self._rotation_jacobian(x)], format="csr")

    def _rotation_residuals(self, x: Float64) -> Float64:
        R = x.reshape(-1, UNKNOWNS)[:, :9].reshape(-1, 3, 3)
        excess = np.swapaxes(R, 1, 2) @ R - np.eye(3)
        return (W_ROT**0.5 * _DOUBLED * excess[:, _ROWS, _COLUMNS]).ravel()

    def _rotation_jacobian(self, x: Float64) -> sparse.csr_matrix:
        """d (column_i . column_j) = column_j . d column_i + column_i . d column_j."""
        count = len(self.graph)
        R = x.reshape(-1, UNKNOWNS)[:, :9].reshape(-1, 3, 3)
        blocks = np.zeros((count, 6, 3, 3))  # residual, row of R, column of R
        for residual, (i, j) in enumerate(zip(_ROWS, _COLUMNS, strict=True)):
            blocks[:, residual, :, i] += R[:, :, j]
            blocks[:, residual, :, j] += R[:, :, i]
        values = W_ROT**0.5 * _DOUBLED[:, None] * blocks.reshape(count, 6, 9)
        rows = np.broadcast_to(np.arange(6 * count).reshape(count, 6, 1), values.shape)
        columns = UNKNOWNS * np.arange(count)[:, None, None] + np.arange(9)
        columns = np.broadcast_to(columns, values.shape)
        shape = (6 * count, UNKNOWNS * count)
        return sparse.csr_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)

    def step(self, x: Float64) -> Float64:
        """The Gauss-Newton step at x."""
        rotation = self._rotation_jacobian(x)
        H = (self._normal + rotation.T @ rotation).tocsc()
        H = H + DAMPING * H.diagonal().mean() * sparse.identity(len(x), format="csc")
        gradient = self._matrix.T @ (self._matrix @ x + self._offset)
        gradient += rotation.T @ self._rotation_residuals(x)
        factors = splu(
            H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        return -factors.solve(gradient)


def optimise(
    graph: DeformationGraph, constraints: Constraints, iterations: int = 10
) -> Deformation:
    """The deformation of least energy, by Gauss-Newton from the identity."""
    if not len(constraints):
        return identity(graph)
    energy = Energy(graph, constraints)
    x = pack(identity(graph))
    for _ in range(iterations):
        step = energy.step(x)
        x = x + step
        if np.abs(step).max() < SMALLEST_STEP:
            break
    return unpack(graph, x)


def pack(deformation: Deformation) -> Float64:
    """Flatten a deformation into its unknowns (12 M,)."""
    count = len(deformation.graph)
    return np.concatenate([deformation.R.reshape(count, 9), deformation.t], axis=1).ravel()


def unpack(graph: DeformationGraph, x: Float64) -> Deformation:
    """Rebuild a deformation from its unknowns (12 M,)."""
    nodes = x.reshape(len(graph), UNKNOWNS)
    return Deformation(graph, nodes[:, :9].reshape(-1, 3, 3).copy(), nodes[:, 9:].copy())


def _edge_rows(graph: DeformationGraph, weight: float) -> tuple[sparse.csr_matrix, Float64]:
    """E_reg: three rows an edge (l, n): R_l (g_n - g_l) + t_l - t_n + (g_l - g_n)."""
    edges = graph.edges()
    own, other = edges[:, 0], edges[:, 1]
    offsets = graph.positions[other] - graph.positions[own]  # (E, 3)
    ones = np.ones((len(edges), 1))
    values = np.concatenate([offsets, ones, -ones], axis=1)  # (E, 5), the same for each axis
    linear = UNKNOWNS * own[:, None, None] + 3 * np.arange(3)[:, None] + np.arange(3)  # (E, 3, 3)
    axis = np.arange(3)[:, None]
    shift = UNKNOWNS * own[:, None, None] + 9 + axis
    back = UNKNOWNS * other[:, None, None] + 9 + axis
    columns = np.concatenate([linear, shift, back], axis=2)  # (E, 3, 5)
    return _rows(weight * values[:, None], columns, len(graph)), -weight * offsets.ravel()


def _twist_rows(graph: DeformationGraph, weight: float) -> sparse.csr_matrix:
    """E_twist: nine rows an edge (l, n): R_l - R_n."""
    edges = UNKNOWNS * graph.edges()[:, None] + np.arange(9)[:, None]  # (E, 9, 2)
    values = np.broadcast_to([weight, -weight], edges.shape)
    starts = 2 * np.arange(edges.size // 2 + 1)
    shape = (edges.size // 2, UNKNOWNS * len(graph))
    return sparse.csr_matrix((values.ravel(), edges.ravel(), starts), shape=shape)


def _constraint_rows(
    graph: DeformationGraph, constraints: Constraints, weight: float
) -> tuple[sparse.csr_matrix, Float64]:
    """E_con: three rows a constraint."""
    rows, offset = _point_rows(graph, constraints.sources, constraints.source_times)
    relative = np.isfinite(constraints.target_times)
    times = np.where(relative, constraints.target_times, 0.0)
    target_rows, target_offset = _point_rows(graph, constraints.targets, times)
    moves = np.repeat(relative.astype(float), 3)
    rows = rows - sparse.diags(moves) @ target_rows
    fixed = constraints.targets.ravel()
    offset = offset - np.where(moves > 0, target_offset, fixed)
    return (weight * rows).tocsr(), weight * offset


def _point_rows(
    graph: DeformationGraph, points: Float64, times: Float64
) -> tuple[sparse.csr_matrix, Float64]:
    """phi(points) = matrix @ x + offset, three rows a point."""
    nodes, weights = graph.influence(points, times)  # (C, k)
    centres = graph.positions[nodes]
    offsets = np.concatenate([points[:, None] - centres, np.ones((*nodes.shape, 1))], axis=2)
    values = weights[..., None] * offsets  # (C, k, 4)
    axis = np.arange(3)
    linear = 3 * axis[:, None] + np.arange(3)  # (3, 3): row of R, its columns
    within = np.concatenate([linear, 9 + axis[:, None]], axis=1)  # (3, 4)
    columns = UNKNOWNS * nodes[:, None, :, None] + within[:, None]  # (C, 3, k, 4)
    count = len(points)
    shared = np.broadcast_to(values[:, None], columns.shape).reshape(count, 3, -1)
    matrix = _rows(shared, columns.reshape(count, 3, -1), len(graph))
    return matrix, np.einsum("nk,nki->ni", weights, centres).ravel()


def _rows(values: Float64, columns: NDArray[np.int64], nodes: int) -> sparse.csr_matrix:
    """Sparse rows (N * 3, 12 M) of values and columns (N, 3, entries)."""
    values = np.broadcast_to(values, columns.shape)
    count, entries = columns.shape[0] * 3, columns.shape[2]
    starts = np.arange(count + 1) * entries
    return sparse.csr_matrix(
        (values.ravel(), columns.ravel(), starts), shape=(count, UNKNOWNS * nodes)
    )


FEWEST_CONSTRAINTS = 12
SURFELS_PER_NODE, MAX_NODES = 400, 100
CONSTRAINT_COLUMNS = 16
"""Number of columns into which the image is divided; its cells are square.

Each cell gives one constraint and one pin.
"""
ERROR_M = 0.01  # largest RMS distance of the constraints after optimisation
ERROR_SHARE = 0.3  # largest share of the distance before optimisation
NEAREST = wp.constant(5)  # the NEIGHBOURS that move a point, and the next nearest one


@dataclass(frozen=True)
class VisiblePoints(Rows):
    """Surfels in sight of a camera."""

    camera: Float64  # (N, 3) positions in the camera's frame
    world: Float64  # (N, 3) positions in the world
    times: Float64  # (N,) creation times, see ``creation_times``


def creation_times(created: NDArray[np.int32]) -> tuple[Int64, Float64]:
    """Order (N,) of surfels by creation, and their times (N,) in frames, in that order.

    Surfels of one frame get evenly spaced times within that frame, in the order of their slots,
    which is the order of image rows. So neighbours in time are also neighbours in space, and the
    first frame, a third of a small map, gets its share of the graph's nodes.
    """
    order = np.argsort(created, kind="stable")
    ordered = created[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=-1))  # of every frame's surfels
    counts = np.diff(starts, append=len(ordered))
    places = np.arange(len(ordered)) - np.repeat(starts, counts)
    times = ordered + places / np.repeat(counts, counts)
    return order.astype(np.int64), times.astype(np.float64)


def choose_points(
    points: VisiblePoints,
    intrinsics: Intrinsics,
    depth: NDArray[np.float32],
    columns: int,
    tolerance_m: float,
) -> Int64:
    """Indices (M,) of one surfel for each cell of the image, the nearest to its centre.

    Args:
        points: surfels in sight.
        intrinsics: of ``depth``.
        depth: (H, W) metres, the surface on which the surfels must lie; 0 = ignore the pixel.
        columns: number of cells side by side.
        tolerance_m: largest distance from the surface, at 1 m; grows with depth squared.
    """
    z = points.camera[:, 2]
    place = intrinsics.project(points.camera)
    u, v = np.floor(place + 0.5).astype(np.int64).T
    inside = (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)
    inside = np.flatnonzero(inside)
    front = depth[v[inside], u[inside]]
    on_surface = np.abs(z[inside] - front) < tolerance_m * (0.7 + 0.3 * front**2)
    usable = inside[(front > 0) & on_surface]
    cells = (place[usable] + 0.5) / (intrinsics.width / columns)
    off_centre = np.linalg.norm(cells - np.floor(cells) - 0.5, axis=1)
    order = np.argsort(off_centre, kind="stable")
    column, row = np.floor(cells[order]).astype(np.int64).T
    _, firsts = np.unique(row * (columns + 1) + column, return_index=True)
    return usable[order[firsts]]


def surface_constraints(
    active: VisiblePoints, inactive: VisiblePoints, correction: Float64
) -> Constraints:
    """Constrain active points to move by ``correction`` (4, 4), and pin inactive ones."""
    targets = transform_points(correction, active.world)
    moves = Constraints(active.world, active.times, targets, np.full(len(targets), np.nan))
    pins = np.full(len(inactive.world), np.nan)
    return join([moves, Constraints(inactive.world, inactive.times, inactive.world, pins)])


def relative_to(
    constraints: Constraints, active: VisiblePoints, inactive: VisiblePoints
) -> Constraints:
    """The moves of ``surface_constraints`` as relative ones, which later loops must respect.

    The creation time of a target is that of the nearest pin.
    """
    count = len(active.world)
    targets = constraints.targets[:count]
    _, nearest = cKDTree(inactive.world).query(targets)
    return Constraints(active.world, active.times, targets, inactive.times[nearest])


@wp.struct
class Nodes:
    """A deformation of one map: position (M,), linear part and translation of the nodes."""

    position: wp.array[wp.vec3]
    R: wp.array[wp.mat33]
    t: wp.array[wp.vec3]


@wp.kernel
def deform_surfels(
    surfels: Surfels,
    b: int,
    nodes: Nodes,
    first: wp.array[wp.int32],  # of each surfel's candidate nodes
    window: int,  # number of candidates
) -> None:
    """Move position and normal of every surfel of env b: ``Deformation.points`` in float32.

    The normal turns with the blend of R. The paper uses the inverse transpose of R, which is the
    same for a rotation, and R is close to one.
    """
    i = wp.tid()
    p = surfels.position[b, i]
    index = wp.vector(length=NEAREST, dtype=wp.int32)
    distance = wp.vector(length=NEAREST, dtype=wp.float32)
    for k in range(NEAREST):
        distance[k] = 1.0e30
    for candidate in range(window):
        n = first[i] + candidate
        d = wp.length(nodes.position[n] - p)
        place = int(NEAREST)
        while place > 0 and d < distance[place - 1]:
            place -= 1
        k = int(NEAREST) - 1
        while k > place:
            distance[k] = distance[k - 1]
            index[k] = index[k - 1]
            k -= 1
        if place < NEAREST:
            distance[place] = d
            index[place] = n
    per_farthest = 1.0 / wp.max(distance[NEAREST - 1], 1.0e-12)
    total = wp.float32(0.0)
    moved = wp.vec3(0.0, 0.0, 0.0)
    turned = wp.vec3(0.0, 0.0, 0.0)
    normal = surfels.normal[b, i]
    for k in range(NEAREST - 1):
        share = 1.0 - distance[k] * per_farthest
        weight = share * share + 1.0e-6
        n = index[k]
        centre = nodes.position[n]
        total += weight
        moved += weight * (nodes.R[n] * (p - centre) + centre + nodes.t[n])
        turned += weight * (nodes.R[n] * normal)
    surfels.position[b, i] = moved / total
    surfels.normal[b, i] = wp.normalize(turned)


@wp.func
def pixel_of(p: wp.vec3, camera: SplatCamera) -> wp.vec2i:
    """Pixel (u, v) of the image nearest to the projection of a point."""
    u = floor_int(camera.focal[0] * p[0] / p[2] + camera.centre[0] + 0.5)
    v = floor_int(camera.focal[1] * p[1] / p[2] + camera.centre[1] + 0.5)
    return wp.vec2i(wp.clamp(u, 0, camera.width - 1), wp.clamp(v, 0, camera.height - 1))


@wp.kernel
def reactivate(surfels: Surfels, b: int, seen_from: int, seen_to: int, now: int) -> None:
    """Mark the surfels of env b last seen within these frames as seen now."""
    i = wp.tid()
    seen = surfels.seen[b, i]
    if seen >= seen_from and seen <= seen_to:
        surfels.seen[b, i] = now


@wp.kernel
def merge(
    surfels: Surfels,
    b: int,
    visible: VisibleList,  # of the active surfels
    camera: SplatCamera,
    vertices: wp.array3d[wp.vec3],  # image of the inactive surfels
    normals: wp.array3d[wp.vec3],
    min_cosine: float,
    stable: float,  # confidence
) -> None:
    """Remove the unstable active surfels of env b that lie on a previously mapped surface."""
    j = wp.tid()
    p = visible.position[b, j]
    pixel = pixel_of(p, camera)
    front = vertices[b, pixel[1], pixel[0]][2]
    if front > 0.0 and wp.abs(p[2] - front) < depth_tolerance(camera.tolerance_m, front):
        i = visible.index[b, j]
        alike = wp.dot(visible.normal[b, j], normals[b, pixel[1], pixel[0]]) > min_cosine
        if alike and surfels.confidence[b, i] < stable:
            surfels.confidence[b, i] = 0.0
            wp.atomic_add(surfels.dead, b, 1)


class MapDeformer:
    """Deforms the maps of B envs, one at a time."""

    def __init__(
        self,
        surfel_map: SurfelMap,
        inactive: SplatRenderer,
        active: SplatRenderer,
        config: SurfelConfig,
        device: str,
    ) -> None:
        self.map = surfel_map
        self.config = config.loops
        self.device = device
        self._inactive = inactive
        self._active = active
        self._tolerance_m = config.fusion_distance_m
        self._stable = config.confidence_threshold
        self._min_cosine = float(np.cos(np.radians(config.fusion_angle_deg)))
        self._poses = SavedBuffer(surfel_map.batch, wp.mat44, device)

    def deform(
        self, env: int, pose: Float64, corrected: Float64, earlier: Constraints
    ) -> tuple[Deformation, Constraints] | None:
        """Deform a map so that surfels seen from ``pose`` come to be seen from ``corrected``.

        Args:
            env: index of the map.
            pose: (4, 4) camera pose relative to the active part.
            corrected: (4, 4) camera pose relative to the inactive part.
            earlier: relative constraints of the loops closed before.

        Returns:
            The deformation, and the relative constraints of this loop after it; None, with the map
            unchanged, if there are too few points or the result is not acceptable.
        """
        used = int(self.map.surfels.count.numpy()[env])
        if used < FEWEST_NODES:
            return None
        order, ordered_times = creation_times(self.map.surfels.created[env, :used].numpy())
        times = np.empty(used)
        times[order] = ordered_times
        old, old_depth = self._look(self._inactive, env, corrected, times)
        new, new_depth = self._look(self._active, env, pose, times)
        old = old.chosen(self._choose(old, old_depth))
        new = new.chosen(self._choose(new, np.where(old_depth > 0, new_depth, 0.0)))
        if min(len(old.world), len(new.world)) < FEWEST_CONSTRAINTS:
            return None
        surface = surface_constraints(new, old, corrected @ invert(pose))
        constraints = join([surface, earlier])
        positions = self.map.surfels.position[env, :used].numpy()
        count = min(MAX_NODES, used // SURFELS_PER_NODE)
        graph = sample_graph(positions[order], ordered_times, count)
        deformation = optimise(graph, constraints)
        if not self._is_acceptable(constraints, deformation):
            return None
        self._move_surfels(env, deformation, times)
        return deformation, relative_to(surface, new, old).moved_by(deformation)

    def _is_acceptable(self, constraints: Constraints, deformation: Deformation) -> bool:
        """Whether the deformation meets the constraints closely enough."""
        before = _rms(constraints.errors(identity(deformation.graph)))
        after = _rms(constraints.errors(deformation))
        allowed = max(self.config.smallest_m, ERROR_SHARE * before)
        return after <= min(ERROR_M, allowed)

    def _look(
        self, renderer: SplatRenderer, env: int, pose: Float64, times: Float64
    ) -> tuple[VisiblePoints, NDArray[np.float32]]:
        """Surfels of one env that a renderer shows, ordered by slot, and its depth image."""
        self._cull(renderer, pose)
        depth = renderer.splat().vertices.numpy()[env, ..., 2].copy()
        index = np.sort(self._visible(renderer, env))
        world = self.map.surfels.position[env].numpy()[index].astype(np.float64)
        camera = (world - pose[:3, 3]) @ pose[:3, :3]
        return VisiblePoints(camera, world, times[index]), depth

    def _cull(self, renderer: SplatRenderer, pose: Float64) -> None:
        self._poses.write(np.broadcast_to(pose, (self.map.batch, 4, 4)))
        renderer.cull(self._poses.array)

    def _visible(self, renderer: SplatRenderer, env: int) -> NDArray[np.int32]:
        """Slots of the surfels listed by the last cull."""
        count = int(renderer.visible.count.numpy()[env])
        return renderer.visible.index[env, :count].numpy() if count else np.zeros(0, np.int32)

    def _choose(self, points: VisiblePoints, depth: NDArray[np.float32]) -> Int64:
        """Indices of points on a surface, spread over the image."""
        intrinsics, tolerance_m = self._inactive.intrinsics, self._tolerance_m
        return choose_points(points, intrinsics, depth, CONSTRAINT_COLUMNS, tolerance_m)

    def _move_surfels(self, env: int, deformation: Deformation, times: Float64) -> None:
        graph = deformation.graph
        nodes = Nodes()
        nodes.position = wp.array(graph.positions, dtype=wp.vec3, device=self.device)
        nodes.R = wp.array(deformation.R, dtype=wp.mat33, device=self.device)
        nodes.t = wp.array(deformation.t, dtype=wp.vec3, device=self.device)
        first = graph.first_candidates(times).astype(np.int32)
        candidates: Any = wp.array(first, dtype=wp.int32, device=self.device)
        self._launch(deform_surfels, len(times), env, [nodes, candidates, graph.window])
        self.map.surfels_moved()

    def _launch(self, kernel: Any, count: int, env: int, inputs: list[Any]) -> None:
        """Run a kernel on ``count`` surfels of one env."""
        inputs = [self.map.surfels, env, *inputs]
        wp.launch(kernel, dim=count, inputs=inputs, device=self.device)

    def join_parts(self, env: int, pose: Float64, now: int) -> None:
        """Merge both parts in view from ``pose`` (4, 4), and make the old one active.

        Surfels last seen at about the same time as those in view become active with them, because
        they belong to the same part.
        """
        self._cull(self._inactive, pose)
        view = self._inactive.splat()
        listed = self._visible(self._inactive, env)
        if not len(listed):
            return
        seen = self.map.surfels.seen[env].numpy()[listed]
        self._cull(self._active, pose)
        active = self._active.visible
        shown = [active, self._inactive.camera, view.vertices, view.normals]
        rule = [self._min_cosine, self._stable]
        self._launch(merge, int(active.count.numpy()[env]), env, [*shown, *rule])
        reach = self.config.window // 2
        first, last = (int(np.quantile(seen, q)) for q in (0.1, 0.9))
        count = int(self.map.surfels.count.numpy()[env])
        self._launch(reactivate, count, env, [first - reach, last + reach, now])
        self.map.surfels_moved()


def _rms(distances: Float64) -> float:
    return float(np.sqrt(np.mean(distances**2)))
