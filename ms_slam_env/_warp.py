"""NVIDIA Warp, initialised once: quiet, forward kernels only."""

import os

import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.config.enable_backward = False


def _init_quietly() -> None:
    """Initialise; without a GPU the native library warns on file descriptor 2, at every start."""
    saved = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            wp.init()
    finally:
        os.dup2(saved, 2)
        os.close(saved)


_init_quietly()

__all__ = ["wp"]
