"""Depth images with holes."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import check_range
from ms_slam_env.sequences.perturbations.base import ImagePerturbation, Moment, random_numbers

_ATTEMPTS = 10_000


@dataclass(frozen=True)
class DepthDropout(ImagePerturbation):
    """Holes in patches, along depth edges, and of single pixels; every frame's are its own.

    Attributes:
        patches: share of the image that elliptic patches cover, at least; 0 = none.
        patch_size: mean diameter of a patch as a share of the image's width.
        edge_px: pixels on either side of a depth edge that have no reading; 0 = none.
        edge_jump: depth edge: neighbours differ by more than this share of the nearer one.
        pixels: probability that a single pixel has no reading.
        seed: of the holes, beside the sequence's.

    Raises:
        InputError: a value out of range.
    """

    patches: float = 0.1
    patch_size: float = 0.1
    edge_px: int = 1
    edge_jump: float = 0.05
    pixels: float = 0.01
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "patches", 0.0, 0.95)
        check_range(self, "patch_size", 0.005, 1.0)
        check_range(self, "edge_px", 0, 1000)
        check_range(self, "edge_jump", 1e-4, 1e3)
        check_range(self, "pixels", 0.0, 1.0)
        check_range(self, "seed", 0, 2**32)

    def holes(self, depth: NDArray[np.float32], moment: Moment) -> NDArray[np.bool_]:
        """Mask (H, W) of the pixels that lose their reading."""
        rng = random_numbers(moment.seed, self.seed, moment.index, name="depth-dropout")
        mask = self._patches(depth.shape, rng)
        if self.edge_px:
            distance = ndimage.distance_transform_cdt(~self._edges(depth), "taxicab")
            mask |= (distance >= 0) & (distance < self.edge_px)  # -1 without any edge
        return mask | (rng.random(depth.shape) < self.pixels)

    def _patches(self, shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
        height, width = shape
        mask = np.zeros((height, width), dtype=bool)
        v, u = np.mgrid[:height, :width]
        for _ in range(_ATTEMPTS):
            if mask.mean() >= self.patches:
                break
            centre = rng.uniform((0, 0), (height, width))
            radii = 0.5 * self.patch_size * width * rng.uniform(0.5, 1.5, 2)
            mask |= ((v - centre[0]) / radii[0]) ** 2 + ((u - centre[1]) / radii[1]) ** 2 < 1.0
        return mask

    def _edges(self, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Pixels on both sides of a jump between two readings."""
        edges = np.zeros(depth.shape, dtype=bool)
        for axis in (0, 1):
            for turn in (1, -1):
                other = np.roll(depth, turn, axis)
                nearer = np.minimum(depth, other)
                jumps = (nearer > 0) & (np.abs(depth - other) > nearer * self.edge_jump)
                jumps[(slice(None),) * axis + (0 if turn == 1 else -1,)] = False  # rolled around
                edges |= jumps
        return edges

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        depth = np.where(self.holes(frame.depth, moment), np.float32(0), frame.depth)
        return dataclasses.replace(frame, depth=depth)
