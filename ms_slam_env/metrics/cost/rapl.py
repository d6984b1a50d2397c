"""Energy of the processor from RAPL, the counters that Linux shows under powercap.

The counters are of the whole package: what else runs on the machine counts too. Layout and units:
the kernel's Documentation/power/powercap/powercap.rst and ABI/testing/sysfs-class-powercap.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from ms_slam_env.metrics.cost.counter import EnergyCounter, NoEnergy

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
    """All processor packages, with the memory beside them where the machine counts that.

    Args:
        folders: of the zones.

    Raises:
        _UnreadableError: one of them cannot be read.
    """

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
