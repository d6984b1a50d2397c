"""Energy (ENE): of the processor from RAPL, of NVIDIA GPUs from NVML.

RAPL, the counters that Linux shows under powercap, is of the whole package: what else runs on the
machine counts too. Layout and units: the kernel's Documentation/power/powercap/powercap.rst and
ABI/testing/sysfs-class-powercap. NVML, the library below nvidia-smi, has the millijoules of the
whole GPU since the driver was loaded, from the Volta generation on.
"""

from __future__ import annotations

import math
import os
import re
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any


class EnergyCounter(ABC):
    """Energy that a part of the machine has taken.

    Attributes:
        source: of the figures, in words.
        reason: why there are none; empty while there are.
    """

    source: str = ""
    reason: str = ""

    @abstractmethod
    def joules(self) -> float:
        """Energy in joules since this counter was made; NaN once ``reason`` says why."""


class NoEnergy(EnergyCounter):
    """Counts nothing, for the ``reason`` given."""

    def __init__(self, reason: str) -> None:
        self.reason = reason

    def joules(self) -> float:
        """NaN."""
        return math.nan


POWERCAP = Path("/sys/class/powercap")

# Zones of intel-rapl-mmio show the same counters a second time, psys contains the packages, and
# the zones core and uncore are parts of theirs; dram is not.
_ZONE = re.compile(r"intel-rapl:\d+(:\d+)?")
_COUNTED = re.compile(r"package.*|dram")


class _UnreadableError(Exception):
    """A counter cannot be read; the message says which and why."""


class _Zone:
    """One counter of a processor package, or of the memory beside it."""

    def __init__(self, folder: Path) -> None:
        self._energy = folder / "energy_uj"
        self._range_uj = _number(folder / "max_energy_range_uj")
        self._last_uj = _number(self._energy)
        self._total_uj = 0

    def joules(self) -> float:
        now_uj = _number(self._energy)
        passed = now_uj - self._last_uj
        # The counter falls back to zero above its range, once an hour or less at 70 W. A second
        # fall between two readings would go unnoticed: it is read at every frame.
        self._total_uj += passed if passed >= 0 else passed + self._range_uj
        self._last_uj = now_uj
        return 1e-6 * self._total_uj


class RaplCounter(EnergyCounter):
    """All processor packages, with the memory beside them where the machine counts that."""

    def __init__(self, folders: list[Path]) -> None:
        self._zones = [_Zone(folder) for folder in folders]
        self.source = "RAPL: " + ", ".join(_text(folder / "name") for folder in folders)

    def joules(self) -> float:
        """Energy in joules since this counter was made; NaN once a zone cannot be read."""
        if self.reason:
            return math.nan
        try:
            return sum(zone.joules() for zone in self._zones)
        except _UnreadableError as error:
            self.reason = str(error)
            return math.nan


def rapl_counter(root: Path = POWERCAP) -> EnergyCounter:
    """Count the energy of the processor packages below ``root``; `NoEnergy` where that is not so.

    One package that cannot be read leaves no figure at all: a part would look like the whole.
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
    """The GPUs that CUDA may use here; ``nvml`` is the module ``pynvml``, initialised."""

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


def energy_counters(device: str = "cpu") -> dict[str, EnergyCounter]:
    """Return the counters ``cpu`` and ``gpu`` of work on ``device``.

    A GPU counts only where the work is on ``cuda``: what it draws while it idles is not the work's.
    """
    on_gpu = device.startswith("cuda")
    return {"cpu": rapl_counter(), "gpu": nvml_counter() if on_gpu else NoEnergy("not used")}
