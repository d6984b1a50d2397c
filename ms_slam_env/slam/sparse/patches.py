"""Small patches around features, and their alignment with another image.

ORB's corners lie on whole pixels of their level, and come and go. A patch is warped as the motion
and its surface demand and then shifted until it fits (Lucas and Kanade; the warp as in SVO, Forster
et al., ICRA 2014, section IV-B). It stays that of the keyframe that made the point, so that errors
do not add up from keyframe to keyframe.
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
_LARGEST_ZOOM = 2.0  # between the two images, areas
_UNLIKE = 0.6  # largest RMS difference of a patch that was found, of its contrast
_LEAST_NOISE = 1.0  # grey levels
_SMALLEST_GRADIENT = 1e-2  # keeps blank patches solvable; nothing else feels it
_LEAST_SIGMA_PX = 0.2  # what warping as a plane, and by a pose not yet exact, leaves
_LARGEST_SIGMA_PX = 0.7  # a patch that fixes its place less well is on an edge, or blank


@dataclass(frozen=True)
class Patches:
    """Patches of one or several images, and where they should be in another."""

    pixels: Float64  # (N, 2) their centres
    inverse_depth: Float64  # (N,) of the centres, 1/m
    slope: Float64  # (N, 2) its change from pixel to pixel, across and down, 1/m
    T_frame_host: Float64  # (N, 4, 4) the motion between the two images
    shift: Float64  # (N, 2) pixels by which they are expected away from where the motion puts them


def warp(patches: Patches, intrinsics: Intrinsics) -> tuple[Float64, Float64]:
    """Where the motion puts the centres (N, 2), and how it distorts their surroundings (N, 2, 2).

    A centre that comes behind the camera is NaN, its distortion 0.
    """
    steps = np.array([[0.0, 0.0], [_HALF, 0.0], [0.0, _HALF]])
    pixels = patches.pixels[:, None] + steps
    inverse = patches.inverse_depth[:, None] + patches.slope @ steps.T
    rays = intrinsics.rays_at(pixels)
    # A point over its depth in the host: R ray + t / depth; the scale does not change its pixel.
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
    """What patches look like, and how they respond to a shift."""

    wanted: Float32  # (N, K) intensity of their pixels less its mean
    # (N, 2, K) shift, pixels of their image, that a difference of intensity speaks for.
    step: Float32
    contrast: Float32  # (N,) standard deviation of their intensity, levels
    # (N, 2, 2) covariance of the place found, for noise of one level, pixels squared.
    spread: Float32

    @classmethod
    def empty(cls, count: int) -> Templates:
        """Room for templates."""
        pixels = (2 * _HALF + 1) ** 2
        shapes = (count, pixels), (count, 2, pixels), (count,), (count, 2, 2)
        return cls(*(np.empty(shape, dtype=np.float32) for shape in shapes))

    def put(self, where: NDArray[Any], others: Templates) -> None:
        """Put other templates into some places."""
        for name, values in vars(others).items():
            getattr(self, name)[where] = values


def cut(image: Float32, pixels: Float64) -> Templates:
    """Templates around pixels (N, 2) of an image (H, W)."""
    side = np.arange(-_HALF - 1, _HALF + 2)
    u = pixels[:, 0, None, None] + np.broadcast_to(side[None, :], (len(side), len(side)))
    v = pixels[:, 1, None, None] + np.broadcast_to(side[:, None], (len(side), len(side)))
    square = _sample(image, u, v)
    inner = square[:, 1:-1, 1:-1].reshape(len(square), -1)
    across = (square[:, 1:-1, 2:] - square[:, 1:-1, :-2]).reshape(inner.shape) / 2
    down = (square[:, 2:, 1:-1] - square[:, :-2, 1:-1]).reshape(inner.shape) / 2
    J = np.stack([across, down], axis=1)
    J = J - J.mean(axis=2, keepdims=True)  # a change of brightness is no difference
    H = J @ np.swapaxes(J, 1, 2) + _SMALLEST_GRADIENT * np.eye(2)
    spread = np.linalg.inv(H).astype(np.float32)
    wanted = inner - inner.mean(axis=1, keepdims=True)
    step = np.asarray(spread @ J, dtype=np.float32)
    return Templates(wanted, step, wanted.std(axis=1), spread)


def find_patches(
    image: Float32, templates: Templates, patches: Patches, intrinsics: Intrinsics
) -> tuple[Float64, Float64]:
    """Where (N, 2) patches are in an image (H, W), and how surely (N,): 1 sigma, pixels.

    Infinite where a patch was not found.
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
    """Gauss-Newton over the two coordinates of every patch, with the patch's own gradients."""
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
    """Bilinear values at places of any shape (N, ...)."""
    flat = (len(u), -1)
    x, y = (np.ascontiguousarray(c.reshape(flat), dtype=np.float32) for c in (u, v))
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32).reshape(u.shape)
