"""Cost of SLAM per frame: execution time (EXT), memory (MEM), energy (ENE)."""

from ms_slam_env.metrics.cost.energy import (
    EnergyCounter,
    NoEnergy,
    energy_counters,
    nvml_counter,
    rapl_counter,
)
from ms_slam_env.metrics.cost.meter import (
    CORE_WATTS,
    CostMeter,
    FrameCost,
    forget_peak_memory,
    memory_mb,
)

__all__ = [
    "CORE_WATTS",
    "CostMeter",
    "EnergyCounter",
    "FrameCost",
    "NoEnergy",
    "energy_counters",
    "forget_peak_memory",
    "memory_mb",
    "nvml_counter",
    "rapl_counter",
]
