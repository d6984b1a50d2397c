"""NVIDIA Warp, initialised once: quiet, forward kernels only."""

import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.config.enable_backward = False
wp.init()

__all__ = ["wp"]
