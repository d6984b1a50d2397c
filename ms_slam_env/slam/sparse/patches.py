"""Registers small patches of keyframes in a frame, to a fraction of a pixel.

ORB's corners lie on whole pixels of their level, and come and go. A patch is warped as the motion
and its surface demand and then shifted until it fits (Lucas and Kanade; the warp as in SVO, Forster
et al., ICRA 2014, section IV-B). It stays that of the keyframe that made the point, so that errors
do not add up from keyframe to keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.base import Float32, Float64

_HALF = 3  # pixels on each side of the patch's centre
_MARGIN = 6.0  # pixels to the border
_ITERATIONS = 5
_LARGEST_ZOOM = 2.0  # between the two images, areas
_LEVELS = 12.0  # largest RMS difference of a patch that was found, grey levels
_LEAST_NOISE = 1.0  # grey levels
_LARGEST_SIGMA_PX = 0.6  # a patch that fixes its place less well is on an edge, or blank


@dataclass(frozen=True)
class Patches:
    """Patches of one or several images, and where they should be in another.

    Attributes:
        pixels: (N, 2) their centres.
        inverse_depth: (N,) of the centres, 1/m.
        slope: (N, 2) its change from pixel to pixel, across and down, 1/m.
        T_frame_host: (N, 4, 4) the motion between the two images.
        shift: (N, 2) pixels by which they are expected away from where the motion puts them.
    """

    pixels: Float64
    inverse_depth: Float64
    slope: Float64
    T_frame_host: Float64
    shift: Float64


def warp(patches: Patches, intrinsics: Intrinsics) -> tuple[Float64, Float64]:
    """Where the motion puts the centres (N, 2), and how it distorts their surroundings (N, 2, 2).

    A centre that comes behind the camera is NaN.
    """
    steps = np.array([[0.0, 0.0], [_HALF, 0.0], [0.0, _HALF]])
    pixels = patches.pixels[:, None] + steps
    inverse = patches.inverse_depth[:, None] + patches.slope @ steps.T
    rays = np.ones((*pixels.shape[:2], 3))
    rays[..., 0] = (pixels[..., 0] - intrinsics.cx) / intrinsics.fx
    rays[..., 1] = (pixels[..., 1] - intrinsics.cy) / intrinsics.fy
    # A point over its depth in the host: R ray + t / depth; the scale does not change its pixel.
    T = patches.T_frame_host
    there = np.einsum("nij,nkj->nki", T[:, :3, :3], rays) + inverse[..., None] * T[:, None, :3, 3]
    there[~(there[..., 2] > 1e-3).all(axis=1)] = np.nan
    projected = intrinsics.project(there)
    centre = projected[:, 0]
    return centre, np.swapaxes(projected[:, 1:] - centre[:, None], 1, 2) / _HALF


def cut(image: Float32, pixels: Float64) -> Float32:
    """Squares (N, 2 h + 3, 2 h + 3) around pixels (N, 2) of an image, h = 3, one pixel wider."""
    side = np.arange(-_HALF - 1, _HALF + 2)
    u = pixels[:, 0, None, None] + np.broadcast_to(side[None, :], (len(side), len(side)))
    v = pixels[:, 1, None, None] + np.broadcast_to(side[:, None], (len(side), len(side)))
    return _sample(image, u, v)


def find_patches(
    image: Float32, squares: Float32, patches: Patches, intrinsics: Intrinsics
) -> tuple[Float64, NDArray[np.bool_]]:
    """Where (N, 2) patches are in an image (H, W), and whether (N,) they are there.

    Args:
        image: intensity, levels.
        squares: of the patches, from ``cut``.
        patches: where they come from.
        intrinsics: of all images.
    """
    centre, A = warp(patches, intrinsics)
    start = centre + patches.shift
    zoom = np.linalg.det(A)
    size = np.array([intrinsics.width, intrinsics.height])
    good = (zoom > 1 / _LARGEST_ZOOM) & (zoom < _LARGEST_ZOOM)
    good &= ((start > _MARGIN) & (start < size - 1 - _MARGIN)).all(axis=1)
    found = np.full_like(start, np.nan)
    if good.any():
        where = np.flatnonzero(good)
        found[where], fits = _shift_until_fit(image, squares[where], start[where], A[where])
        good[where] = fits
    return found, good


def _shift_until_fit(
    image: Float32, squares: Float32, start: Float64, A: Float64
) -> tuple[Float64, NDArray[np.bool_]]:
    """Gauss-Newton over the two coordinates of every patch, with the patch's own gradients."""
    inner = squares[:, 1:-1, 1:-1].reshape(len(squares), -1)
    gradient = np.stack(
        [
            (squares[:, 1:-1, 2:] - squares[:, 1:-1, :-2]).reshape(inner.shape) / 2,
            (squares[:, 2:, 1:-1] - squares[:, :-2, 1:-1]).reshape(inner.shape) / 2,
        ],
        axis=-1,
    )
    J = gradient @ np.linalg.inv(A)  # chain rule: offsets of the patch to pixels of the image
    J -= J.mean(axis=1, keepdims=True)  # a change of brightness is no difference
    H = np.swapaxes(J, 1, 2) @ J
    trace, det = H[:, 0, 0] + H[:, 1, 1], np.linalg.det(H)
    least = trace / 2 - np.sqrt(np.maximum(trace**2 / 4 - det, 0))
    H[least < 1e-3] = np.eye(2)  # a blank patch: of no consequence, below
    solve = np.linalg.inv(H) @ np.swapaxes(J, 1, 2)
    wanted = inner - inner.mean(axis=1, keepdims=True)
    offset = np.stack(np.meshgrid(*[np.arange(-_HALF, _HALF + 1)] * 2), axis=-1).reshape(-1, 2)
    warped = np.einsum("nij,kj->nki", A, offset)
    at = start.copy()
    for _ in range(_ITERATIONS):
        pixels = at[:, None] + warped
        seen = _sample(image, pixels[..., 0], pixels[..., 1])
        difference = seen - seen.mean(axis=1, keepdims=True) - wanted
        at -= np.einsum("nik,nk->ni", solve, difference)
        at = np.clip(at, start - _MARGIN, start + _MARGIN)
    rms = np.sqrt((difference**2).mean(axis=1))
    sigma = np.maximum(rms, _LEAST_NOISE) / np.sqrt(np.maximum(least, 1e-9))
    return at, (rms < _LEVELS) & (sigma < _LARGEST_SIGMA_PX)


def _sample(image: Float32, u: Float64, v: Float64) -> Float32:
    """Bilinear values at places of any shape (N, ...)."""
    flat = (len(u), -1)
    x, y = (np.ascontiguousarray(c.reshape(flat), dtype=np.float32) for c in (u, v))
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32).reshape(u.shape)
