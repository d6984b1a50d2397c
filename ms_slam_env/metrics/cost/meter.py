"""Meter of the cost of SLAM, frame by frame.

Measures and their names: EXT, MEM and ENE of Saeedi et al., ICRA 2017, section II-A; USME (Qu,
Zhang, Yang, Dong, Navigation Positioning and Timing 2021), section 1.4 (2), asks for memory per
frame and for energy.
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.errors import InputError
from ms_slam_env.metrics.cost.energy import EnergyCounter, energy_counters

CORE_WATTS = 10.0
"""Power in watts of a busy core in the energy model.

Not measured on any machine: the thermal design power per core of processors of the 2020s is 3 to
10 W in servers and 4 to 15 W in laptops. It ranks configurations by their processor time.
"""


def memory_mb(name: str) -> float | None:
    """Field ``name`` of this process's Linux status file, megabytes; None on other systems."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1024
    return None


def resident_mb() -> float | None:
    """Memory in use now, megabytes: VmRSS, read the fast way. None on other systems than Linux."""
    try:
        with open("/proc/self/statm", "rb") as file:
            pages = int(file.read().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def forget_peak_memory() -> float | None:
    """Reset the peak memory to the memory in use now (proc(5)), and return that in megabytes.

    Freed memory is first returned to the system, since reusing it would not be counted.
    """
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, AttributeError):  # no Linux, or no glibc
        return None
    return memory_mb("VmRSS")


@dataclass(frozen=True)
class FrameCost:
    """Cost of one frame.

    Attributes:
        ext_s: execution time by the clock, seconds.
        cpu_s: processor time of all threads, seconds.
        mem_mb: memory in use after the frame minus that when the meter was created, megabytes;
            NaN if the system does not report it.
        ene_j: energy of each counter, joules; NaN if it cannot be read.
    """

    ext_s: float
    cpu_s: float
    mem_mb: float
    ene_j: dict[str, float]

    @property
    def joules(self) -> float:
        """Energy of all counters; NaN if one is missing, since a partial sum would look complete.

        A GPU that the work does not use needs no counter.
        """
        return sum(self.ene_j.values()) if self.ene_j else math.nan


class CostMeter:
    """Measures the frames that run inside ``with meter.frame():``.

    Create it before the SLAM system, so that the system's initial allocations count. The meter
    resets the process's peak memory: of two meters in one process, only the later one's peak is
    valid.

    Args:
        device: device that the work runs on, ``cpu`` or ``cuda``.
        counters: energy counters by name; None for those of the machine.
        core_watts: power of a core, in watts, for the model used where no counter can be read:
            energy is processor time times this. Its figures have separate keys.

    Raises:
        InputError: watts that are not positive.
    """

    def __init__(
        self,
        device: str = "cpu",
        counters: Mapping[str, EnergyCounter] | None = None,
        core_watts: float = CORE_WATTS,
    ) -> None:
        if not (math.isfinite(core_watts) and core_watts > 0):
            raise InputError(f"core_watts must be finite and > 0, got {core_watts}")
        self._core_watts = core_watts
        self.frames: list[FrameCost] = []
        self._counters = dict(energy_counters(device) if counters is None else counters)
        self._used = [name for name in self._counters if name != "gpu" or "cuda" in device]
        self._start_mb = forget_peak_memory()

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Measure the enclosed work as one frame; work that raises an exception does not count."""
        energy = {name: counter.joules() for name, counter in self._counters.items()}
        clock, processor = time.perf_counter(), time.process_time()
        yield
        cpu_s, ext_s = time.process_time() - processor, time.perf_counter() - clock
        taken = {name: self._counters[name].joules() - before for name, before in energy.items()}
        now = resident_mb()
        known = now is not None and self._start_mb is not None
        mem = now - self._start_mb if known else math.nan  # type: ignore[operator]
        self.frames.append(FrameCost(ext_s, cpu_s, mem, {name: taken[name] for name in self._used}))

    def summary(self, skip: int = 0) -> dict[str, Any]:
        """Costs by metric key; None for a figure that is not available.

        Time: ``ext_ms`` (mean per frame, by the clock), ``ext_ms_median``, ``_p95``, ``_p99``,
        ``_max``; ``cpu_ms_mean`` (processor time of all threads), ``cpu_ms_median``,
        ``cpu_ms_p95``.

        Memory: ``mem_peak_mb`` and ``mem_mb`` (peak, and mean over the frames, minus what was in
        use when the meter was created), ``mem_process_mb`` (peak of the whole process).

        Energy: ``ene_j`` (all frames together) and ``ene_frame_j`` (mean), both None if a device
        was used without a counter; ``ene_cpu_j``, ``ene_gpu_j`` and so on for each counter; and
        ``ene_source``, which names the counters or says why there are none. If no counter could be
        read, ``ene_model_j`` and ``ene_model_frame_j`` come from the model that ``energy_source``
        names; never both. Energy used between frames does not count.

        Args:
            skip: number of first frames to leave out of times and energy, while buffers grow and
                kernels load.

        Raises:
            InputError: no frame is left.
        """
        counted = self.frames[skip:]
        if not counted:
            raise InputError(f"{len(self.frames)} frames were measured and {skip} left out")
        ext = 1e3 * np.array([cost.ext_s for cost in counted])
        cpu = 1e3 * np.array([cost.cpu_s for cost in counted])
        memory = float(np.mean([cost.mem_mb for cost in self.frames]))
        peak = memory_mb("VmHWM")
        above = None if peak is None or self._start_mb is None else max(0.0, peak - self._start_mb)
        return {
            "ext_ms": float(ext.mean()),
            "ext_ms_median": float(np.median(ext)),
            "ext_ms_p95": float(np.percentile(ext, 95)),
            "ext_ms_p99": float(np.percentile(ext, 99)),
            "ext_ms_max": float(ext.max()),
            "cpu_ms_mean": float(cpu.mean()),
            "cpu_ms_median": float(np.median(cpu)),
            "cpu_ms_p95": float(np.percentile(cpu, 95)),
            "mem_peak_mb": above,
            "mem_mb": memory if math.isfinite(memory) else None,
            "mem_process_mb": peak,
            **self._energy(counted),
        }

    def _energy(self, counted: list[FrameCost]) -> dict[str, Any]:
        by_counter = dict.fromkeys(self._counters, math.nan)
        for name in self._used:
            by_counter[name] = float(np.sum([cost.ene_j[name] for cost in counted]))
        total = float(np.sum([cost.joules for cost in counted]))
        is_whole = math.isfinite(total)
        is_known = any(map(math.isfinite, by_counter.values()))
        said = [
            f"{name}: {f'not available: {counter.reason}' if counter.reason else counter.source}"
            for name, counter in self._counters.items()
        ]
        return {
            "ene_j": total if is_whole else None,
            "ene_frame_j": total / len(counted) if is_whole else None,
            **{f"ene_{k}_j": v if math.isfinite(v) else None for k, v in by_counter.items()},
            "ene_source": "; ".join(said),
            **({} if is_known else self._estimate(counted)),
        }

    def _estimate(self, counted: list[FrameCost]) -> dict[str, Any]:
        """Energy from the model, for when nothing was measured."""
        joules = self._core_watts * sum(cost.cpu_s for cost in counted)
        return {
            "ene_model_j": joules,
            "ene_model_frame_j": joules / len(counted),
            "energy_source": f"model, not measured: processor time x {self._core_watts:g} W a core",
        }
