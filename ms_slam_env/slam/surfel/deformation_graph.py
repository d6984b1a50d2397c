"""Embedded deformation graph: a smooth motion of space, its energy, and the minimum of that.

Sumner, Schmid and Pauly, "Embedded deformation for shape manipulation" (SIGGRAPH 2007), as used
by ElasticFusion (Whelan et al., RSS 2015, section V): nodes are sampled uniformly along the order
in which surfels were created, and each is joined to its neighbours in that order. So two passes
through one place hang together along the way between them only, and can be pulled apart or onto
each other there. The energy (section V-B) is minimised by sparse Gauss-Newton:

    E_rot = sum_l |R_l^T R_l - I|^2                                                  equation 10
    E_reg = sum_l sum_n |R_l (g_n - g_l) + g_l + t_l - (g_n + t_n)|^2                equation 11
    E_con = sum_p |phi(source_p) - target_p|^2                                       equation 12

Pins are constraints whose target is their source; a relative constraint has phi(target_p) in place
of target_p (equation 14). One term is added to the paper's:

    E_twist = TWIST_M^2 sum_l sum_n |R_l - R_n|^2                     weighted like E_reg

The k nodes next in time often lie along a line, about which E_reg lets R turn freely; long chains
of nodes then fold up to make a gap of centimetres good. E_twist is E_reg for points TWIST_M beside
the nodes.

All but E_rot is linear in the unknowns, which are for every node the nine numbers of R row by row,
then t.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from ms_slam_env.slam.shared.rows import Rows
from ms_slam_env.slam.slam_backend import Float64

Int64 = NDArray[np.int64]
NEIGHBOURS = 4  # k: of a node, and nodes that influence a point
TEMPORAL_WINDOW = 20  # nodes nearest in time among which a point's nearest ones are looked for
FEWEST_NODES = NEIGHBOURS + 2


@dataclass(frozen=True)
class DeformationGraph:
    """Nodes in the order of time, each joined to its neighbours in that order."""

    positions: Float64  # (M, 3) g of the nodes, metres
    times: Float64  # (M,) when their surfels were created, ascending; any unit

    def __len__(self) -> int:
        return len(self.positions)

    def edges(self) -> Int64:
        """Directed edges (E, 2) from every node to the k nearest in the order of time."""
        count = len(self)
        half = NEIGHBOURS // 2
        first = np.clip(np.arange(count) - half, 0, count - 1 - NEIGHBOURS)
        near = first[:, None] + np.arange(NEIGHBOURS + 1)  # the node itself among them
        own = np.broadcast_to(np.arange(count)[:, None], near.shape)
        return np.stack([own, near], axis=-1)[near != own].astype(np.int64)

    def first_candidates(self, times: ArrayLike) -> Int64:
        """First node (N,) of the run of ``window`` nodes nearest in time to every point."""
        times = np.asarray(times, dtype=np.float64)
        after = np.searchsorted(self.times, times).clip(1, len(self) - 1)
        closer = times - self.times[after - 1] <= self.times[after] - times
        nearest = np.where(closer, after - 1, after)
        return np.clip(nearest - self.window // 2, 0, len(self) - self.window)

    @property
    def window(self) -> int:
        """Number of nodes among which the nearest ones of a point are looked for."""
        return min(TEMPORAL_WINDOW, len(self))

    def influence(self, points: ArrayLike, times: ArrayLike) -> tuple[Int64, Float64]:
        """Nodes (N, k) that move each point, and their weights (N, k), which sum to one.

        The k nearest of the nodes near in time, with (1 - distance / farthest)^2, where farthest
        is the distance of the next nearest one (ElasticFusion, algorithm 1 and equation 9).

        Args:
            points: (N, 3).
            times: (N,) when each was created.
        """
        points = np.asarray(points, dtype=np.float64)
        candidates = self.first_candidates(times)[:, None] + np.arange(self.window)
        distances = np.linalg.norm(self.positions[candidates] - points[:, None], axis=-1)
        order = np.argsort(distances, axis=1, kind="stable")[:, : NEIGHBOURS + 1]
        nearest = np.take_along_axis(distances, order, axis=1)
        farthest = np.maximum(nearest[:, -1:], 1e-12)
        # A little of everything, so that equal distances do not all weigh nothing.
        weights = (1.0 - nearest[:, :-1] / farthest) ** 2 + 1e-6
        nodes = np.take_along_axis(candidates, order[:, :-1], axis=1)
        return nodes, weights / weights.sum(axis=1, keepdims=True)


def sample_graph(positions: ArrayLike, times: ArrayLike, count: int) -> DeformationGraph:
    """Graph of ``count`` of the points (N, 3), evenly spaced along their ascending times (N,)."""
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
        """Where points (N, 3) of times (N,) go: ElasticFusion, equation 8."""
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
DAMPING = 1e-9  # share of the mean diagonal, for what the constraints leave free
SMALLEST_STEP = 1e-7
_ROWS, _COLUMNS = np.triu_indices(3)
_DOUBLED = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(2.0))  # R^T R is symmetric


@dataclass(frozen=True)
class Constraints(Rows):
    """Points of the map and where they should go."""

    sources: Float64  # (C, 3) points
    source_times: Float64  # (C,) when they were created
    targets: Float64  # (C, 3) where they belong
    # (C,) when the surface at the target was created; NaN: the target is fixed, otherwise it moves
    # with the deformation.
    target_times: Float64

    def errors(self, deformation: Deformation) -> Float64:
        """Distances (C,) that remain, metres."""
        moved = self.moved_by(deformation)
        return np.linalg.norm(moved.sources - moved.targets, axis=1)

    def moved_by(self, deformation: Deformation) -> Constraints:
        """The same after a deformation of the map; fixed targets stay."""
        relative = np.isfinite(self.target_times)
        targets = self.targets.copy()
        targets[relative] = deformation.points(targets[relative], self.target_times[relative])
        sources = deformation.points(self.sources, self.source_times)
        return replace(self, sources=sources, targets=targets)


def no_constraints() -> Constraints:
    """An empty set."""
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
    """The deformation of least energy, by Gauss-Newton from rest."""
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
    """The unknowns (12 M,) of a deformation."""
    count = len(deformation.graph)
    return np.concatenate([deformation.R.reshape(count, 9), deformation.t], axis=1).ravel()


def unpack(graph: DeformationGraph, x: Float64) -> Deformation:
    """The deformation of unknowns (12 M,)."""
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
