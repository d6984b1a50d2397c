"""NVIDIA Warp, initialised once: quiet, forward kernels only."""

import atexit
import errno
import os
import shutil
import tempfile
import warnings

import warp as wp

from ms_slam_env.errors import InputError, InputWarning

wp.config.log_level = wp.LOG_ERROR
wp.config.enable_backward = False


def _init_quietly() -> OSError | None:
    """Initialise; without a GPU the native library warns on file descriptor 2, at every start."""
    saved = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            return _init()
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def _check_home() -> None:
    """Refuse a user without a home folder: Warp would make one that is called ``~``.

    Raises:
        FileNotFoundError: saying so.
    """
    told = os.environ.get("WARP_CACHE_PATH") or os.environ.get("XDG_CACHE_HOME")
    if not told and os.path.expanduser("~") == "~":
        raise FileNotFoundError(errno.ENOENT, "this user has no home folder", "~")


def _init() -> OSError | None:
    """Initialise; where no kernels can be kept they go into a passing folder. Return why not."""
    try:
        _check_home()
        wp.init()
    except OSError as error:
        try:
            passing = tempfile.mkdtemp(prefix="ms_slam_env-")
        except OSError as none:
            raise InputError(f"no place for compiled kernels: {none.strerror}") from None
        atexit.register(shutil.rmtree, passing, ignore_errors=True)
        wp.config.kernel_cache_dir = passing
        wp.init()
        return error
    return None


_refused = _init_quietly()
if _refused is not None:
    warnings.warn(
        f"compiled kernels cannot be kept: {_refused.filename}: {_refused.strerror}; they are "
        "compiled anew each time unless WARP_CACHE_PATH names a folder to write to",
        InputWarning,
        stacklevel=2,
    )

__all__ = ["wp"]
