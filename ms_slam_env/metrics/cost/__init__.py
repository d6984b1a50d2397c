"""What SLAM costs a frame: execution time (EXT), memory (MEM), energy (ENE)."""

from ms_slam_env.metrics.cost.energy import EnergyCounter, NoEnergy, energy_counters
from ms_slam_env.metrics.cost.memory import forget_peak_memory, memory_mb
from ms_slam_env.metrics.cost.meter import CostMeter, FrameCost
from ms_slam_env.metrics.cost.nvml import nvml_counter
from ms_slam_env.metrics.cost.rapl import rapl_counter

__all__ = [
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
