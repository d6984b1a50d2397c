"""The pinhole camera and its lens, RGB-D frames and images."""

from ms_slam_env.camera.distortion import Distortion
from ms_slam_env.camera.frame import RGBDFrame, check_camera, check_frame, intensity_image
from ms_slam_env.camera.image_size import parse_image_size, pinhole, rendered_size, xtion
from ms_slam_env.camera.intrinsics import XTION_SIZES, Intrinsics

__all__ = [
    "XTION_SIZES",
    "Distortion",
    "Intrinsics",
    "RGBDFrame",
    "check_camera",
    "check_frame",
    "intensity_image",
    "parse_image_size",
    "pinhole",
    "rendered_size",
    "xtion",
]
