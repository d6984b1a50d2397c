"""The RGB-D sensor: ray casting, shading and published Kinect noise."""

from typing import TYPE_CHECKING

from ms_slam_env._runtime.lazy import lazy_names

if TYPE_CHECKING:
    from ms_slam_env.sensor.bodies import Body
    from ms_slam_env.sensor.casters import (
        EmbreeRayCaster,
        RayCaster,
        WarpRayCaster,
    )
    from ms_slam_env.sensor.changes import ChangingLight
    from ms_slam_env.sensor.noise import NOISE_MODELS, NoiseConfig, NoNoise
    from ms_slam_env.sensor.rgbd import FRAME_RATE_HZ, ROLLING_ROWS, RGBDSensor, TrueView
else:
    __getattr__ = lazy_names(__name__)

__all__ = [
    "FRAME_RATE_HZ",
    "NOISE_MODELS",
    "ROLLING_ROWS",
    "Body",
    "ChangingLight",
    "EmbreeRayCaster",
    "NoNoise",
    "NoiseConfig",
    "RGBDSensor",
    "RayCaster",
    "TrueView",
    "WarpRayCaster",
]
