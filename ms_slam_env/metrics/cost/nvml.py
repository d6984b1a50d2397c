"""Energy of NVIDIA GPUs from NVML, the library below nvidia-smi.

``nvmlDeviceGetTotalEnergyConsumption``: millijoules since the driver was loaded, of the whole GPU;
from the Volta generation on.
"""

from __future__ import annotations

import math
import os
from typing import Any

from ms_slam_env.metrics.cost.counter import EnergyCounter, NoEnergy


class NvmlCounter(EnergyCounter):
    """The GPUs that CUDA may use here.

    Args:
        nvml: the module ``pynvml``, initialised.
        handles: of the GPUs.

    Raises:
        pynvml.NVMLError: a GPU without the counter.
    """

    def __init__(self, nvml: Any, handles: list[Any]) -> None:
        self._nvml = nvml
        self._handles = handles
        names = [nvml.nvmlDeviceGetName(handle) for handle in handles]
        self.source = "NVML: " + ", ".join(map(str, names))
        self._start_mj = self._millijoules()

    def _millijoules(self) -> int:
        read = self._nvml.nvmlDeviceGetTotalEnergyConsumption
        return sum(int(read(handle)) for handle in self._handles)

    def joules(self) -> float:
        """Energy in joules since this counter was made; NaN once a GPU does not tell."""
        if self.reason:
            return math.nan
        try:
            return 1e-3 * (self._millijoules() - self._start_mj)
        except self._nvml.NVMLError as error:
            self.reason = f"NVML: {error}"
            return math.nan


def nvml_counter() -> EnergyCounter:
    """Count the energy of the GPUs that ``CUDA_VISIBLE_DEVICES`` leaves; `NoEnergy` if none tells.

    Its numbers are taken as NVML's, which are CUDA's where ``CUDA_DEVICE_ORDER=PCI_BUS_ID`` or all
    GPUs are of one model.
    """
    try:
        import pynvml
    except ImportError:
        return NoEnergy("the package nvidia-ml-py is missing: pip install 'ms-slam-env[energy]'")
    try:
        pynvml.nvmlInit()
        handles = _visible(pynvml, os.environ.get("CUDA_VISIBLE_DEVICES"))
        if not handles:
            return NoEnergy("no NVIDIA GPU is visible")
        return NvmlCounter(pynvml, handles)
    except pynvml.NVMLError as error:
        return NoEnergy(f"NVML: {error}")


def _visible(nvml: Any, listed: str | None) -> list[Any]:
    """Handles of the GPUs listed by number or UUID, up to the first that is neither; None = all."""
    if listed is None:
        return [nvml.nvmlDeviceGetHandleByIndex(k) for k in range(nvml.nvmlDeviceGetCount())]
    handles = []
    for name in map(str.strip, listed.split(",")):
        if name.isdigit():
            handles.append(nvml.nvmlDeviceGetHandleByIndex(int(name)))
        elif name.startswith("GPU-"):
            handles.append(nvml.nvmlDeviceGetHandleByUUID(name))
        else:
            break
    return handles
