"""Embedded deformation graph: a smooth motion of space, given at nodes sampled from the map.

Sumner, Schmid and Pauly, "Embedded deformation for shape manipulation" (SIGGRAPH 2007), as used
by ElasticFusion (Whelan et al., RSS 2015, section V): nodes are sampled uniformly along the order
in which surfels were created, and each is joined to its neighbours in that order. So two passes
through one place hang together along the way between them only, and can be pulled apart or onto
each other there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NEIGHBOURS = 4  # k: of a node, and nodes that influence a point
TEMPORAL_WINDOW = 20  # nodes nearest in time among which a point's nearest ones are looked for
FEWEST_NODES = NEIGHBOURS + 2


@dataclass(frozen=True)
class DeformationGraph:
    """Nodes in the order of time, each joined to its neighbours in that order.

    Attributes:
        positions: (M, 3) g of the nodes, metres.
        times: (M,) when their surfels were created, ascending; any unit.
    """

    positions: Float64
    times: Float64

    def __len__(self) -> int:
        """Number of nodes M."""
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
    """The motion of the nodes of a graph.

    Attributes:
        graph: the nodes.
        R: (M, 3, 3) linear part of each, close to a rotation.
        t: (M, 3) translation of each, metres.
    """

    graph: DeformationGraph
    R: Float64
    t: Float64

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
