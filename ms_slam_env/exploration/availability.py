"""Which parameters of compiler and machine act on a backend here, and why the others do not."""

from __future__ import annotations

from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.slam.machine import why_no_clock

_ON_A_CPU = {
    "compiler.fuse_fp": "on a CPU it changes no bit and no time of the kernels",
    "compiler.block_dim": "a CPU runs one thread of a block",
}
_EVERYWHERE = {
    "gpu_mhz": "a GPU's clock belongs to all who share it, and is not touched",
    "precision": "the kernels of SLAM work on 32-bit numbers alone",
}
_ON_A_GPU = {"compiler.vectorise": "it is of the CPU's compiler, and the device is a GPU"}


def why_absent(name: str, base: SlamConfiguration) -> str:
    """Why parameter ``name`` does nothing to ``base`` on this machine; empty where it does."""
    is_surfel = base.slam == "surfel"
    if name.startswith("compiler.") and not is_surfel:
        return f"backend {base.slam!r} has no kernels that are compiled here"
    on_gpu = str(base.slam_config.get("device", "cpu")).startswith("cuda")
    if name == "threads" and is_surfel:
        return "Warp runs a kernel on one thread of the CPU, or on a GPU"
    if name == "device":
        return _why_no_device(base)
    if name == "cpu_mhz":
        return why_no_clock()
    return {**_EVERYWHERE, **(_ON_A_GPU if on_gpu else _ON_A_CPU)}.get(name, "")


def _why_no_device(base: SlamConfiguration) -> str:
    if base.slam != "surfel":
        return f"backend {base.slam!r} runs on the CPU alone"
    from ms_slam_env._warp import wp

    return "" if wp.is_cuda_available() else "this machine has no CUDA device beside its CPU"
