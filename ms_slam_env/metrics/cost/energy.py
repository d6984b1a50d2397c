"""Energy (ENE) of the processor, from RAPL, and of NVIDIA GPUs, from NVML.

RAPL counters, which Linux exposes under powercap, cover the whole package: everything else that
runs on the machine counts too. Layout and units: the kernel's
Documentation/power/powercap/powercap.rst and ABI/testing/sysfs-class-powercap. NVML, the library
behind nvidia-smi, counts the millijoules of the whole GPU since the driver was loaded, from the
Volta generation on.
"""

from __future__ import annotations

import math
import os
import re
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any


class EnergyCounter(ABC):
    """Counter of the energy used by one part of the machine.

    Attributes:
        source: where the figures come from, in words.
        reason: why there are no figures; empty while there are.
    """

    source: str = ""
    reason: str = ""

    @abstractmethod
    def joules(self) -> float:
        """Energy in joules since this counter was created; NaN once it fails (see ``reason``)."""


class NoEnergy(EnergyCounter):
    """Counter without figures, for the given ``reason``."""

    def __init__(self, reason: str) -> None:
        self.reason = reason

    def joules(self) -> float:
        """NaN."""
        return math.nan


POWERCAP = Path("/sys/class/powercap")

# Zones of intel-rapl-mmio repeat the same counters, psys contains the packages, and the zones core
# and uncore are parts of a package; dram is separate.
_ZONE = re.compile(r"intel-rapl:\d+(:\d+)?")
_COUNTED = re.compile(r"package.*|dram")


class _UnreadableError(Exception):
    """A counter cannot be read; the message says which and why."""


class _Zone:
    """Counter of one processor package, or of its memory."""

    def __init__(self, folder: Path) -> None:
        self._energy = folder / "energy_uj"
        self._range_uj = _number(folder / "max_energy_range_uj")
        self._last_uj = _number(self._energy)
        self._total_uj = 0

    def joules(self) -> float:
        now_uj = _number(self._energy)
        passed = now_uj - self._last_uj
        # The counter wraps to zero at the end of its range, at most once an hour at 70 W. Two wraps
        # between readings would go unnoticed, but it is read at every frame.
        self._total_uj += passed if passed >= 0 else passed + self._range_uj
        self._last_uj = now_uj
        return 1e-6 * self._total_uj


class RaplCounter(EnergyCounter):
    """Counter of all processor packages, and of their memory where the machine counts it."""

    def __init__(self, folders: list[Path]) -> None:
        self._zones = [_Zone(folder) for folder in folders]
        self.source = "RAPL: " + ", ".join(_text(folder / "name") for folder in folders)

    def joules(self) -> float:
        """Energy in joules since this counter was created; NaN once a zone cannot be read."""
        if self.reason:
            return math.nan
        try:
            return sum(zone.joules() for zone in self._zones)
        except _UnreadableError as error:
            self.reason = str(error)
            return math.nan


def rapl_counter(root: Path = POWERCAP) -> EnergyCounter:
    """Counter of the processor packages below ``root``, or `NoEnergy` if it cannot be read.

    One unreadable package means no figure at all, since a partial sum would look complete.
    """
    if not root.is_dir():
        return NoEnergy(f"{root} does not exist: no RAPL (a virtual machine, or not Linux)")
    try:
        zones = sorted(zone for zone in root.iterdir() if _ZONE.fullmatch(zone.name))
        counted = [zone for zone in zones if _COUNTED.fullmatch(_text(zone / "name"))]
        if not any(_text(zone / "name").startswith("package") for zone in counted):
            return NoEnergy(f"{root} shows no processor package")
        return RaplCounter(counted)
    except _UnreadableError as error:
        return NoEnergy(str(error))
    except OSError as error:
        return NoEnergy(f"{root} cannot be read: {error.strerror}")


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii").strip()
    except PermissionError:
        raise _UnreadableError(f"{path} may be read by root only") from None
    except (OSError, UnicodeDecodeError) as error:
        raise _UnreadableError(f"{path} cannot be read: {error}") from None


def _number(path: Path) -> int:
    text = _text(path)
    if not text.isdigit():
        raise _UnreadableError(f"{path} holds {text!r}, not a number")
    return int(text)


class NvmlCounter(EnergyCounter):
    """Counter of the GPUs that CUDA may use; ``nvml`` is the initialised module ``pynvml``."""

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
        """Energy in joules since this counter was created; NaN once a GPU cannot be read."""
        if self.reason:
            return math.nan
        try:
            return 1e-3 * (self._millijoules() - self._start_mj)
        except self._nvml.NVMLError as error:
            self.reason = f"NVML: {error}"
            return math.nan


def nvml_counter() -> EnergyCounter:
    """Counter of the GPUs in ``CUDA_VISIBLE_DEVICES``, or `NoEnergy` if they cannot be read.

    Device numbers are interpreted as NVML's. They match CUDA's if ``CUDA_DEVICE_ORDER=PCI_BUS_ID``
    or all GPUs are of one model.
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
    """Handles of GPUs listed by number or UUID, up to the first other entry; None for all."""
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


def energy_counters(device: str = "cpu") -> dict[str, EnergyCounter]:
    """Return the counters ``cpu`` and ``gpu`` for work on ``device``.

    The GPU counts only for work on ``cuda``: its idle power is not caused by the work.
    """
    on_gpu = device.startswith("cuda")
    return {"cpu": rapl_counter(), "gpu": nvml_counter() if on_gpu else NoEnergy("not used")}
