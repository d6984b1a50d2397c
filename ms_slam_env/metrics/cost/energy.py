"""The counters of energy that a run needs."""

from __future__ import annotations

from ms_slam_env.metrics.cost.counter import EnergyCounter, NoEnergy
from ms_slam_env.metrics.cost.nvml import nvml_counter
from ms_slam_env.metrics.cost.rapl import rapl_counter

__all__ = ["EnergyCounter", "NoEnergy", "energy_counters"]


def energy_counters(device: str = "cpu") -> dict[str, EnergyCounter]:
    """Return the counters ``cpu`` and ``gpu`` of work on ``device``.

    A GPU counts only where the work is on ``cuda``: what it draws while it idles is not the work's.
    """
    on_gpu = device.startswith("cuda")
    return {"cpu": rapl_counter(), "gpu": nvml_counter() if on_gpu else NoEnergy("not used")}
