"""Machine settings for running SLAM: kernel compiler options and processor clock.

The compiler and hardware levels of the design space (Saeedi et al., ICRA 2017, section II-B).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError

_WARP_FLAGS = (
    "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000 "
    "-mllvm=-slp-recursion-max-depth=4"
)  # Warp 1.19's own; repeated here so that the user's global setting does not matter
# Clang's -ffast-math as its front end spells it, but without assuming finite numbers: kernels test
# readings for infinity and NaN.
_FAST_MATH = " -mreassociate -freciprocal-math -fno-signed-zeros -fapprox-func -ffp-contract=fast"
_NO_VECTORS = " -fno-vectorize -fno-slp-vectorize"
CPU_FREQUENCIES = Path("/sys/devices/system/cpu")
"""Where Linux keeps the frequencies of the cores."""


@dataclass(frozen=True)
class CompilerOptions(Checked):
    """How Warp compiles the SLAM kernels; the defaults are Warp's own.

    Attributes:
        optimization_level: 0 to 3; None for Warp's own, 2 on a CPU and 3 on a GPU.
        fast_math: allow reordered and approximate arithmetic. Warp passes its option only to the
            GPU compiler; the CPU compiler gets Clang's flags for it.
        vectorise: allow vector instructions on a CPU.
        grid_stride: kernels loop over more threads than the device runs at once.
        fuse_fp: allow fused multiply-add, which rounds once. On a CPU it changed no bit of a run.
        block_dim: threads per block on a GPU; a CPU runs one.
    """

    optimization_level: int | None = bounded(None, 0, 3)
    fast_math: bool = False
    vectorise: bool = True
    grid_stride: bool = True
    fuse_fp: bool = True
    block_dim: int = bounded(256, 32, 1024)

    def module_options(self) -> dict[str, Any]:
        """These options as Warp's module options."""
        flags = _FAST_MATH * self.fast_math + _NO_VECTORS * (not self.vectorise)
        return {
            "optimization_level": self.optimization_level,
            "fast_math": self.fast_math,
            "cpu_compiler_flags": _WARP_FLAGS + flags if flags else None,
            "default_grid_stride": None if self.grid_stride else False,
            "fuse_fp": self.fuse_fp,
            "block_dim": self.block_dim,
        }


@contextmanager
def compiled(options: CompilerOptions) -> Iterator[None]:
    """Compile the surfel SLAM's kernels with ``options`` when the enclosed code launches them.

    Compiled kernels are cached under a hash that includes the options, so kernels compiled with
    other options are unaffected. The options apply to the whole process; a SLAM made earlier keeps
    the kernels it has already launched.
    """
    if options == CompilerOptions():
        yield
        return
    from ms_slam_env._runtime.warp import wp

    import_module("ms_slam_env.slam.surfel")
    modules = [
        wp.get_module(name)
        for name, module in list(sys.modules.items())
        if name.startswith("ms_slam_env.slam.")
        and any(isinstance(value, wp.Kernel) for value in vars(module).values())
    ]
    new = options.module_options()
    before = [{key: module.options[key] for key in new} for module in modules]
    for module in modules:
        wp.set_module_options(new, module)
    try:
        yield
    finally:
        for module, old in zip(modules, before, strict=True):
            wp.set_module_options(old, module)


@contextmanager
def limited_clock(mhz: int | None, root: Path = CPU_FREQUENCIES) -> Iterator[None]:
    """Limit every core to ``mhz`` during the enclosed code; None leaves the clock alone.

    Raises:
        InputError: the clock cannot be set on this machine.
    """
    if mhz is None:
        yield
        return
    why = why_no_clock(root)
    if why:
        raise InputError(f"cpu_mhz = {mhz}: {why}")
    files = sorted(root.glob("cpu[0-9]*/cpufreq/scaling_max_freq"))
    before = [file.read_text() for file in files]
    try:
        for file in files:
            file.write_text(str(1000 * mhz))
        yield
    finally:
        for file, old in zip(files, before, strict=True):
            file.write_text(old)


def why_no_clock(root: Path = CPU_FREQUENCIES) -> str:
    """Why the processor's clock cannot be set here; empty if it can."""
    files = sorted(root.glob("cpu[0-9]*/cpufreq/scaling_max_freq"))
    if not files:
        return f"{root} has no cpufreq: the machine keeps its clock to itself"
    try:
        for file in files:
            file.open("r+").close()
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    return ""


def clock_range_mhz(root: Path = CPU_FREQUENCIES) -> tuple[int, int]:
    """Lowest and highest frequency of the first core, MHz."""
    low, high = (
        int((root / "cpu0" / "cpufreq" / f"cpuinfo_{end}_freq").read_text()) // 1000
        for end in ("min", "max")
    )
    return low, high
