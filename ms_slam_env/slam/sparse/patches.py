"""Small patches around features, and their alignment with another image.

ORB corners lie on whole pixels of their level, and are not detected in every frame. A patch is
warped according to the motion and its surface, then shifted until it fits (Lucas and Kanade; the
warp as in SVO, Forster et al., ICRA 2014, section IV-B). It is always cut from the keyframe that
created the point, so that errors do not add up from keyframe to keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.shared.rows import Rows

_HALF = 3  # pixels on each side of the patch's centre
_MARGIN = 6.0  # pixels to the border
_ITERATIONS = 4
_LARGEST_ZOOM = 2.0  # largest ratio of areas between the two images
_UNLIKE = 0.6  # largest RMS difference of a found patch, as a share of its contrast
_LEAST_NOISE = 1.0  # grey levels
_SMALLEST_GRADIENT = 1e-2  # keeps blank patches solvable, otherwise negligible
_LEAST_SIGMA_PX = 0.2  # error left by the planar warp and an inexact pose
_LARGEST_SIGMA_PX = 0.7  # a less certain patch is blank or lies on an edge


@dataclass(frozen=True)
class Patches:
    """Patches of one or several images, and their expected positions in another."""

    pixels: Float64  # (N, 2) their centres
    inverse_depth: Float64  # (N,) inverse depth of the centres, 1/m
    slope: Float64  # (N, 2) its change from pixel to pixel, across and down, 1/m
    T_frame_host: Float64  # (N, 4, 4) the motion between the two images
    shift: Float64  # (N, 2) expected offset from where the motion projects them, pixels


def warp(patches: Patches, intrinsics: Intrinsics) -> tuple[Float64, Float64]:
    """Centres (N, 2) projected by the motion, and the local affine distortion (N, 2, 2).

    A centre behind the camera is NaN, its distortion 0.
    """
    steps = np.array([[0.0, 0.0], [_HALF, 0.0], [0.0, _HALF]])
    pixels = patches.pixels[:, None] + steps
    inverse = patches.inverse_depth[:, None] + patches.slope @ steps.T
    rays = intrinsics.rays_at(pixels)
    # A point divided by its depth in the host image is R ray + t / depth; scale does not move its
    # pixel.
    T = patches.T_frame_host
    there = np.einsum("nij,nkj->nki", T[:, :3, :3], rays) + inverse[..., None] * T[:, None, :3, 3]
    behind = ~(there[..., 2] > 1e-3).all(axis=1)
    there[behind] = 1.0
    projected = intrinsics.project(there)
    centre = projected[:, 0]
    distortion = np.swapaxes(projected[:, 1:] - centre[:, None], 1, 2) / _HALF
    centre[behind], distortion[behind] = np.nan, 0.0
    return centre, distortion


@dataclass(frozen=True)
class Templates(Rows):
    """Appearance of patches, and their response to a shift."""

    wanted: Float32  # (N, K) intensity of their pixels minus the mean
    # (N, 2, K) shift in pixels of their image per intensity difference.
    step: Float32
    contrast: Float32  # (N,) standard deviation of their intensity, levels
    # (N, 2, 2) covariance of the measured position for noise of one grey level, pixels squared.
    spread: Float32

    @classmethod
    def empty(cls, count: int) -> Templates:
        """Allocate ``count`` templates."""
        pixels = (2 * _HALF + 1) ** 2
        shapes = (count, pixels), (count, 2, pixels), (count,), (count, 2, 2)
        return cls(*(np.empty(shape, dtype=np.float32) for shape in shapes))

    def put(self, where: NDArray[Any], others: Templates) -> None:
        """Overwrite the selected rows with other templates."""
        for name, values in vars(others).items():
            getattr(self, name)[where] = values


def cut(image: Float32, pixels: Float64) -> Templates:
    """Cut templates around pixels (N, 2) of an image (H, W)."""
    side = np.arange(-_HALF - 1, _HALF + 2)
    u = pixels[:, 0, None, None] + np.broadcast_to(side[None, :], (len(side), len(side)))
    v = pixels[:, 1, None, None] + np.broadcast_to(side[:, None], (len(side), len(side)))
    square = _sample(image, u, v)
    inner = square[:, 1:-1, 1:-1].reshape(len(square), -1)
    across = (square[:, 1:-1, 2:] - square[:, 1:-1, :-2]).reshape(inner.shape) / 2
    down = (square[:, 2:, 1:-1] - square[:, :-2, 1:-1]).reshape(inner.shape) / 2
    J = np.stack([across, down], axis=1)
    J = J - J.mean(axis=2, keepdims=True)  # ignores a change of brightness
    H = J @ np.swapaxes(J, 1, 2) + _SMALLEST_GRADIENT * np.eye(2)
    spread = np.linalg.inv(H).astype(np.float32)
    wanted = inner - inner.mean(axis=1, keepdims=True)
    step = np.asarray(spread @ J, dtype=np.float32)
    return Templates(wanted, step, wanted.std(axis=1), spread)


def find_patches(
    image: Float32, templates: Templates, patches: Patches, intrinsics: Intrinsics
) -> tuple[Float64, Float64]:
    """Find patches in an image (H, W): positions (N, 2) and standard deviations (N,) in pixels.

    The deviation is infinite if a patch was not found.
    """
    centre, A = warp(patches, intrinsics)
    start = centre + patches.shift
    zoom = np.linalg.det(A)
    size = np.array([intrinsics.width, intrinsics.height])
    good = (zoom > 1 / _LARGEST_ZOOM) & (zoom < _LARGEST_ZOOM)
    good &= ((start > _MARGIN) & (start < size - 1 - _MARGIN)).all(axis=1)
    where = np.flatnonzero(good)
    found, sigma = start.copy(), np.full(len(start), np.inf)
    if len(where):
        found[where], sigma[where] = _shift_until_fit(
            image, templates.chosen(where), start[where], A[where]
        )
    return found, sigma


def _shift_until_fit(
    image: Float32, templates: Templates, start: Float64, A: Float64
) -> tuple[Float64, Float64]:
    """Gauss-Newton over each patch's two coordinates, with the gradients of the template."""
    offset = np.stack(np.meshgrid(*[np.arange(-_HALF, _HALF + 1)] * 2), axis=-1).reshape(-1, 2)
    warped = np.swapaxes(A @ offset.T, 1, 2).astype(np.float32)
    A, at = A.astype(np.float32), start.astype(np.float32)
    step = A @ templates.step  # from pixels of the patch's image to pixels of this one
    for _ in range(_ITERATIONS):
        seen = _sample(image, at[:, :1] + warped[..., 0], at[:, 1:] + warped[..., 1])
        difference = seen - seen.mean(axis=1, keepdims=True) - templates.wanted
        at = at - (step @ difference[:, :, None])[:, :, 0]
    rms = difference.std(axis=1)
    covariance = A @ templates.spread @ np.swapaxes(A, 1, 2)
    variance = np.trace(covariance, axis1=1, axis2=2) * np.maximum(rms, _LEAST_NOISE) ** 2
    sigma = np.sqrt(variance + _LEAST_SIGMA_PX**2).astype(np.float64)
    unlike = rms > _UNLIKE * templates.contrast
    sigma[unlike | (sigma > _LARGEST_SIGMA_PX)] = np.inf
    return at.astype(np.float64), sigma


def _sample(image: Float32, u: NDArray[Any], v: NDArray[Any]) -> Float32:
    """Interpolate bilinearly at positions of any shape (N, ...)."""
    flat = (len(u), -1)
    x, y = (np.ascontiguousarray(c.reshape(flat), dtype=np.float32) for c in (u, v))
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32).reshape(u.shape)
