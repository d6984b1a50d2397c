"""The pinhole camera, RGB-D frames and images."""

from ms_slam_env.camera.frame import RGBDFrame, intensity_image
from ms_slam_env.camera.intrinsics import XTION_SIZES, Intrinsics, xtion

__all__ = ["XTION_SIZES", "Intrinsics", "RGBDFrame", "intensity_image", "xtion"]
