"""What depth images lack: readings in holes, and steps finer than the disparity's."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import Checked, bounded
from ms_slam_env.sequences.perturbations.base import ImagePerturbation, Moment, random_numbers

_ATTEMPTS = 10_000


_NATIVE_WIDTH = 640


@dataclass(frozen=True)
class DepthDropout(Checked, ImagePerturbation):
    """Holes in patches, along depth edges, and of single pixels; every frame's are its own.

    Attributes:
        patches: share of the image that elliptic patches cover, at least; 0 = none.
        patch_size: mean diameter of a patch as a share of the image's width.
        edge_px: pixels on either side of a depth edge that have no reading; 0 = none.
        edge_jump: depth edge: neighbours differ by more than this share of the nearer one.
        pixels: probability that a single pixel has no reading.
        seed: of the holes, beside the sequence's.
    """

    patches: float = bounded(0.1, 0.0, 0.95)
    patch_size: float = bounded(0.1, 0.005, 1.0)
    edge_px: int = bounded(1, 0, 1000)
    edge_jump: float = bounded(0.05, 1e-4, 1e3)
    pixels: float = bounded(0.01, 0.0, 1.0)
    seed: int = bounded(0, 0, 2**32)

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


@dataclass(frozen=True)
class DepthQuantisation(Checked, ImagePerturbation):
    """Disparity d = f b / z of the 640 pixels wide sensor, rounded to whole steps.

    Source: Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor
    Mapping Applications", Sensors 2012: baseline 7.5 cm, steps of an eighth of a pixel; the
    depth resolution step / (f b) * z^2 is their section 3.3. The sensor's noise model "kinect" has
    these steps already; this adds coarser ones, or steps to a sensor without noise.

    Attributes:
        step_px: step of the disparity in pixels; 0 = off.
        baseline_m: distance between projector and camera.
    """

    step_px: float = bounded(0.25, 0.0, 8.0)
    baseline_m: float = bounded(0.075, 1e-3, 1.0)

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        if self.step_px == 0:
            return frame
        native_fx = moment.intrinsics.fx * _NATIVE_WIDTH / moment.intrinsics.width
        unit = native_fx * self.baseline_m / self.step_px  # depth times disparity in steps
        is_read = frame.depth > 0
        steps = np.rint(unit / np.where(is_read, frame.depth, 1.0).astype(np.float64))
        depth = np.where(is_read & (steps >= 1), unit / np.maximum(steps, 1), 0.0)
        return dataclasses.replace(frame, depth=depth.astype(np.float32))
