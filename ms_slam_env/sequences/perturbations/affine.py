"""Gain and bias on the values of a colour image."""

from __future__ import annotations

import dataclasses

import numpy as np

from ms_slam_env.camera import RGBDFrame


def with_gain_and_bias(frame: RGBDFrame, gain: float, bias: float) -> RGBDFrame:
    """Colour values c become round(gain * c + bias), held within [0, 255].

    The values are as stored (sRGB), so a gain g is a change of the light by about g^2.2.
    """
    changed = np.rint(gain * frame.color.astype(np.float32) + bias)
    return dataclasses.replace(frame, color=np.clip(changed, 0, 255).astype(np.uint8))
