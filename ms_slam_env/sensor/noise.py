"""Noise models of RGB-D sensors: Kinect v1 and Xtion, a longer-range camera, no noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError, unknown

NATIVE_WIDTH = 640
"""Width in pixels of the physical sensor; disparity is always quantised at this width."""


@dataclass(frozen=True)
class NoiseConfig(Checked):
    """Strengths of the noise; 1 = as published, 0 = off. The defaults are the Kinect's.

    An image smaller than 640x480 is a subsample of the native pixels, not their average, so each
    pixel has the noise of one native pixel whatever the size. Noise is independent between pixels.

    Sources: [K] Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor
    Mapping Applications", Sensors 2012; [N] Nguyen, Izadi and Lovell, "Modeling Kinect Sensor
    Noise for Improved 3D Reconstruction and Tracking", 3DIMPVT 2012; [F] Foi et al., "Practical
    Poissonian-Gaussian Noise Modeling and Fitting for Single-Image Raw-Data", IEEE TIP 2008.

    Attributes:
        baseline_m: distance between projector and camera [K].
        disparity_step_px: step of the measured disparity at 640 pixels [K]; 0 = not quantised.
        axial: factor on the depth noise [N]. [N] measured quantised depth, so the quantisation's
            variance is subtracted first: the sum is as published.
        lateral: factor on the jitter of the image position at which depth is sampled [N].
        grazing_start_deg: incidence angle above which readings start to drop out; [N] found none
            beyond 80.
        grazing_end_deg: incidence angle above which all readings drop out.
        edge_dropout: probability that a pixel beside a depth edge has no reading.
        edge_jump_px: disparity jump between neighbours, at 640 pixels, that counts as a depth edge.
        shadow: 1 = no reading on surfaces that the projector does not reach, 0 = readings there
            too.
        min_range_m: nearest reading; [N] measured from 0.4 m.
        max_range_m: farthest reading; [K] measured up to 5 m.
        shot: variance of the linear intensity per unit of intensity [F].
        read: standard deviation of the linear intensity in the dark [F].

    Raises:
        InputError: a value outside its range.
    """

    baseline_m: float = bounded(0.075, 1e-3, 1.0)
    disparity_step_px: float = bounded(0.125, 0.0, 8.0)
    axial: float = bounded(1.0, 0.0, 100.0)
    lateral: float = bounded(1.0, 0.0, 100.0)
    grazing_start_deg: float = bounded(70.0, 0.0, 90.0)
    grazing_end_deg: float = bounded(82.0, 0.0, 90.0)
    edge_dropout: float = bounded(0.5, 0.0, 1.0)
    edge_jump_px: float = bounded(2.0, 0.0, 1e6)
    shadow: float = bounded(1.0, 0.0, 1.0)
    min_range_m: float = bounded(0.4, 0.0, 100.0)
    max_range_m: float = bounded(5.0, 0.0, 1e6)
    shot: float = bounded(2e-4, 0.0, 1.0)
    read: float = bounded(2e-3, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Refuse values out of range, and ends before their starts."""
        super().__post_init__()
        if self.grazing_end_deg < self.grazing_start_deg:
            raise InputError(
                f"NoiseConfig.grazing_end_deg = {self.grazing_end_deg} is below "
                f"grazing_start_deg = {self.grazing_start_deg}"
            )
        if self.max_range_m <= self.min_range_m:
            raise InputError(
                f"NoiseConfig.max_range_m = {self.max_range_m} is not above "
                f"min_range_m = {self.min_range_m}"
            )

    def depth_sigma_m(self, depth_m: float) -> float:
        """Standard deviation of the depth of a surface head-on at ``depth_m`` (metres) [N].

        Beyond the sensor's range, that at its end, as there are no readings.
        """
        z = min(max(depth_m, self.min_range_m), self.max_range_m)
        return self.axial * (0.0012 + 0.0019 * (z - 0.4) ** 2)


@dataclass(frozen=True)
class NoNoise(NoiseConfig):
    """An ideal sensor that measures every visible surface exactly, at any distance and angle."""

    disparity_step_px: float = 0.0
    axial: float = 0.0
    lateral: float = 0.0
    grazing_start_deg: float = 90.0
    grazing_end_deg: float = 90.0
    edge_dropout: float = 0.0
    shadow: float = 0.0
    min_range_m: float = 0.0
    max_range_m: float = 1e6
    shot: float = 0.0
    read: float = 0.0


@dataclass(frozen=True)
class RangeNoise(NoiseConfig):
    """A depth camera for streets and halls, up to 12 m, with a quarter of the Kinect's noise.

    A Kinect sees 5 m and is blind in sunlight. This one represents a laser camera or wide-baseline
    stereo: no disparity steps and no projector shadow. Head-on the noise is 0.5 mm at 1 m, 10 mm at
    5 m and 64 mm at 12 m (0.25 of [N], whose formula was measured up to 3 m and is extrapolated).
    Fewer readings are lost at edges, and there are none beyond 88 degrees of incidence. It is a
    model, not a measured device.
    """

    disparity_step_px: float = 0.0
    axial: float = 0.25
    lateral: float = 0.5
    grazing_start_deg: float = 80.0
    grazing_end_deg: float = 88.0
    edge_dropout: float = 0.3
    shadow: float = 0.0
    min_range_m: float = 0.3
    max_range_m: float = 12.0


NOISE_MODELS: dict[str, NoiseConfig] = {
    "kinect": NoiseConfig(),
    "range": RangeNoise(),
    "none": NoNoise(),
}
"""Noise models by name."""


_MOST_STRENGTH = 100
_STRENGTHS = ("disparity_step_px", "axial", "lateral", "edge_dropout", "shot", "read")


def noise_config(noise: str | NoiseConfig | Mapping[str, Any]) -> NoiseConfig:
    """Return the configuration of a noise model given by name, by options, or directly.

    Options are ``name`` (kinect by default), ``strength``, and fields of ``NoiseConfig``, which
    take precedence. ``strength`` scales everything random or quantised in the model, up to the end
    of each range.

    Raises:
        InputError: an unknown name or option, a value out of range, or an unsupported type.
    """
    if isinstance(noise, NoiseConfig):
        return noise
    options = dict(noise) if isinstance(noise, Mapping) else {"name": noise}
    name, strength = options.pop("name", "kinect"), options.pop("strength", 1.0)
    if not isinstance(name, str) or name not in NOISE_MODELS:
        raise unknown("noise model", name, NOISE_MODELS)
    names = [field.name for field in fields(NoiseConfig)]
    for option in options:
        if option not in names:
            raise unknown("option of noise", option, ("name", "strength", *names))
    return replace(_scaled(NOISE_MODELS[name], strength), **options)


def _scaled(model: NoiseConfig, strength: Any) -> NoiseConfig:
    is_number = isinstance(strength, (int, float)) and not isinstance(strength, bool)
    if not is_number or not 0 <= strength <= _MOST_STRENGTH:
        raise InputError(f"noise strength = {strength!r} is outside [0, {_MOST_STRENGTH}]")
    if strength == 1:
        return model
    most = {field.name: field.metadata["range"][1] for field in fields(NoiseConfig)}
    scaled = {name: strength * getattr(model, name) for name in _STRENGTHS}
    return replace(model, **{name: min(value, most[name]) for name, value in scaled.items()})
