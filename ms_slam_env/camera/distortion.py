"""Lens distortion in OpenCV's conventions, and its inverse.

Models for a ray (x, y, 1) with r = |(x, y)| and theta = atan r:

    radial-tangential  (x, y) (1 + k1 r^2 + k2 r^4 + k3 r^6)
                       + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y)
    rational           the same, the first part over 1 + k4 r^2 + k5 r^4 + k6 r^6
    equidistant        (x, y) / r theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

Sources: Brown, "Close-range camera calibration" (1971); Kannala and Brandt (PAMI 2006); OpenCV's
``calib3d`` and ``fisheye``, against which this module is tested.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError, unknown

_LARGEST = 20.0  # limit of any coefficient, larger than in calibrations
_LARGEST_RATIONAL = 1000.0  # numerator and denominator cancel out
_STEPS = 30  # of Newton's method from the distorted point; most lenses need five
_CONVERGED = 1e-9

NAMES = {
    "radial-tangential": ("k1", "k2", "p1", "p2", "k3"),
    "equidistant": ("k1", "k2", "k3", "k4"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Coefficients of each model, in the order in which calibration files list them."""

ALIASES = {
    "radtan": "radial-tangential",
    "plumb_bob": "radial-tangential",
    "rational_polynomial": "rational",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
}
"""Other names of the models."""


@dataclass(frozen=True)
class Distortion(Checked):
    """Lens distortion; none by default.

    Attributes:
        model: none, radial-tangential, rational (eight numbers) or equidistant (a fisheye).
        k1: coefficient of r^2 or theta^2.
        k2: coefficient of the fourth power.
        p1: first tangential coefficient; not in equidistant.
        p2: second tangential coefficient; not in equidistant.
        k3: coefficient of the sixth power.
        k4: equidistant: coefficient of the eighth power; rational: of r^2 in the denominator.
        k5: rational: coefficient of r^4 in the denominator.
        k6: rational: coefficient of r^6 in the denominator.

    Raises:
        InputError: an unknown model, a coefficient out of range, or one that the model does not
            have.
    """

    model: str = chosen("none", "none", *NAMES)
    k1: float = bounded(0.0, -_LARGEST_RATIONAL, _LARGEST_RATIONAL)
    k2: float = bounded(0.0, -_LARGEST_RATIONAL, _LARGEST_RATIONAL)
    p1: float = bounded(0.0, -_LARGEST, _LARGEST)
    p2: float = bounded(0.0, -_LARGEST, _LARGEST)
    k3: float = bounded(0.0, -_LARGEST_RATIONAL, _LARGEST_RATIONAL)
    k4: float = bounded(0.0, -_LARGEST_RATIONAL, _LARGEST_RATIONAL)
    k5: float = bounded(0.0, -_LARGEST_RATIONAL, _LARGEST_RATIONAL)
    k6: float = bounded(0.0, -_LARGEST_RATIONAL, _LARGEST_RATIONAL)

    def __post_init__(self) -> None:
        """Refuse coefficients that the model does not have."""
        super().__post_init__()
        own = NAMES.get(self.model, ())
        for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"):
            value = getattr(self, name)
            if name not in own and value != 0:
                raise InputError(f"distortion {self.model} has no {name}; it has: {list(own)}")
            if self.model != "rational" and abs(value) > _LARGEST:
                limits = f"[{-_LARGEST:g}, {_LARGEST:g}]"
                raise InputError(f"distortion {self.model}: {name} = {value} is outside {limits}")

    @staticmethod
    def of(model: str, coefficients: Sequence[float]) -> Distortion:
        """Make a distortion from a model or its alias and ordered coefficients; the rest are 0.

        All zeros mean no distortion, unless the model is equidistant.

        Raises:
            InputError: an unknown model, or more coefficients than it has.
        """
        name = ALIASES.get(model, model)
        if name not in NAMES:
            raise unknown("distortion model", model, (*NAMES, *ALIASES))
        if name == "rational" and not any(coefficients[5:]):
            name = "radial-tangential"
        names = NAMES[name]
        if any(coefficients[len(names) :]):
            raise InputError(f"distortion {name} has {len(names)} numbers, got {coefficients}")
        if name == "radial-tangential" and not any(coefficients):
            return Distortion()
        pairs = zip(names, map(float, coefficients), strict=False)
        return Distortion(name, **dict(pairs))

    def __bool__(self) -> bool:
        """Whether there is any distortion."""
        return self.model != "none"

    def distort(self, points: ArrayLike) -> Float64:
        """Distort rays (..., 2) with z = 1, before focal length and centre are applied."""
        p = np.asarray(points, dtype=np.float64)
        if self.model == "none":
            return p
        x, y = p[..., 0], p[..., 1]
        squared = x**2 + y**2
        if self.model == "equidistant":
            return p * self._bent_angle(np.sqrt(squared))[0][..., None]
        radial, _ = self._radial(squared)
        across = 2 * self.p1 * x * y + self.p2 * (squared + 2 * x**2)
        down = self.p1 * (squared + 2 * y**2) + 2 * self.p2 * x * y
        return p * radial[..., None] + np.stack([across, down], axis=-1)

    def undistort(self, points: ArrayLike) -> Float64:
        """The inverse of ``distort``, by Newton's method.

        Raises:
            InputError: a point that no ray in front of the camera maps to.
        """
        bent = np.asarray(points, dtype=np.float64)
        if self.model == "none":
            return bent
        found = bent.copy()
        with np.errstate(all="ignore"):  # divergence is refused below
            for _ in range(_STEPS):
                rest = self.distort(found) - bent
                xx, xy, yy = self._jacobian(found)
                determinant = xx * yy - xy**2
                found[..., 0] -= (yy * rest[..., 0] - xy * rest[..., 1]) / determinant
                found[..., 1] -= (xx * rest[..., 1] - xy * rest[..., 0]) / determinant
                if np.abs(rest).max(initial=0) < _CONVERGED:
                    break
            reached = np.abs(self.distort(found) - bent).max(axis=-1) < 1e3 * _CONVERGED
        if not reached.all() or not self.is_one_to_one(found):
            raise InputError(f"{self} leads no ray to some of the pixels")
        return found

    def is_one_to_one(self, points: ArrayLike) -> bool:
        """Whether the distortion does not fold the image at rays (..., 2) with z = 1."""
        if self.model == "none":
            return True
        xx, xy, yy = self._jacobian(np.asarray(points, dtype=np.float64))
        return bool(((xx * yy - xy**2 > 0) & (xx + yy > 0)).all())

    def _bent_angle(self, r: Float64) -> tuple[Float64, Float64]:
        """theta_d / r (...,) of the equidistant model at r (...,), and d theta_d / d r."""
        theta = np.arctan(r)
        t = theta**2
        grown = 1 + t * (self.k1 + t * (self.k2 + t * (self.k3 + t * self.k4)))
        slope = 1 + t * (3 * self.k1 + t * (5 * self.k2 + t * (7 * self.k3 + t * 9 * self.k4)))
        ratio = np.where(r > 1e-9, theta * grown / np.maximum(r, 1e-9), 1.0)
        return ratio, slope / (1 + r**2)

    def _radial(self, s: Float64) -> tuple[Float64, Float64]:
        """The radial factor (...,) at s = r^2 (...,), and its derivative d / d s."""
        above = 1 + s * (self.k1 + s * (self.k2 + s * self.k3))
        slope = self.k1 + s * (2 * self.k2 + s * 3 * self.k3)
        if self.model != "rational":
            return above, slope
        below = 1 + s * (self.k4 + s * (self.k5 + s * self.k6))
        falling = self.k4 + s * (2 * self.k5 + s * 3 * self.k6)
        with np.errstate(all="ignore"):  # no ray maps to a zero denominator
            ratio = above / below
            return ratio, (slope - ratio * falling) / below

    def _jacobian(self, p: Float64) -> tuple[Float64, Float64, Float64]:
        """d distort / d(x, y), a symmetric matrix: its entries xx, xy and yy (...,)."""
        x, y = p[..., 0], p[..., 1]
        squared = x**2 + y**2
        if self.model == "equidistant":
            ratio, slope = self._bent_angle(np.sqrt(squared))
            growth = np.where(squared > 1e-18, (slope - ratio) / np.maximum(squared, 1e-18), 0.0)
            return ratio + growth * x**2, growth * x * y, ratio + growth * y**2
        radial, slope = self._radial(squared)
        growth = 2 * slope
        return (
            radial + growth * x**2 + 2 * self.p1 * y + 6 * self.p2 * x,
            growth * x * y + 2 * self.p1 * x + 2 * self.p2 * y,
            radial + growth * y**2 + 6 * self.p1 * y + 2 * self.p2 * x,
        )


NO_DISTORTION = Distortion()
