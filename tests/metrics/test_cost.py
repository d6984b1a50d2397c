"""EXT, MEM and ENE: RAPL from a made-up sysfs, NVML from a made-up module, clocks by hand."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.metrics.cost import (
    CostMeter,
    EnergyCounter,
    NoEnergy,
    energy_counters,
    forget_peak_memory,
    memory_mb,
    meter,
    nvml_counter,
    rapl_counter,
)
from ms_slam_env.metrics.cost.meter import resident_mb

RANGE_UJ = 262_143_328_850


def zone(root: Path, name: str, label: str, energy_uj: int | str, range_uj: int = RANGE_UJ) -> Path:
    folder = root / name
    folder.mkdir(parents=True)
    (folder / "name").write_text(f"{label}\n")
    (folder / "energy_uj").write_text(f"{energy_uj}\n")
    (folder / "max_energy_range_uj").write_text(f"{range_uj}\n")
    return folder


def advance(folder: Path, energy_uj: int | str) -> None:
    (folder / "energy_uj").write_text(f"{energy_uj}\n")


def test_rapl_sums_packages_and_memory_and_nothing_twice(tmp_path: Path) -> None:
    (tmp_path / "intel-rapl").mkdir()  # the control type: no counter
    folders = {
        "package-0": zone(tmp_path, "intel-rapl:0", "package-0", 100),
        "core": zone(tmp_path, "intel-rapl:0:0", "core", 0),
        "dram": zone(tmp_path, "intel-rapl:0:1", "dram", 7),
        "package-1": zone(tmp_path, "intel-rapl:1", "package-1", 5_000_000),
        "psys": zone(tmp_path, "intel-rapl:2", "psys", 0),
        "mmio": zone(tmp_path, "intel-rapl-mmio:0", "package-0", 0),
    }
    counter = rapl_counter(tmp_path)
    assert (counter.reason, counter.source) == ("", "RAPL: package-0, dram, package-1")
    assert counter.joules() == 0
    advance(folders["package-0"], 100 + 2_000_000)
    advance(folders["dram"], 7 + 500_000)
    advance(folders["package-1"], 6_000_000)
    for other in ("core", "psys", "mmio"):
        advance(folders[other], 999_000_000)
    assert counter.joules() == pytest.approx(3.5)
    assert counter.joules() == pytest.approx(3.5)  # what is read twice does not count twice


@given(
    range_uj=st.integers(1, 10_000_000),
    steps=st.lists(st.integers(0, 10_000_000), max_size=20),
    start=st.integers(0),
)
def test_rapl_counts_across_the_end_of_its_range(
    range_uj: int, steps: list[int], start: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    root = tmp_path_factory.mktemp("rapl")
    folder = zone(root, "intel-rapl:0", "package-0", start % range_uj, range_uj)
    counter = rapl_counter(root)
    now, total = start % range_uj, 0
    for step in steps:
        step %= range_uj  # less than one round between readings
        now, total = (now + step) % range_uj, total + step
        advance(folder, now)
        assert counter.joules() == pytest.approx(1e-6 * total, abs=1e-9)


def test_rapl_says_why_it_is_not_available(tmp_path: Path) -> None:
    assert "does not exist" in rapl_counter(tmp_path / "none").reason
    assert "no processor package" in rapl_counter(tmp_path).reason
    zone(tmp_path, "intel-rapl:0", "package-0", 1)
    second = zone(tmp_path, "intel-rapl:1", "package-1", "what")
    assert "intel-rapl:1/energy_uj holds 'what'" in rapl_counter(tmp_path).reason
    (second / "energy_uj").unlink()
    counter = rapl_counter(tmp_path)
    assert "intel-rapl:1/energy_uj cannot be read" in counter.reason
    assert math.isnan(counter.joules())


def test_rapl_says_that_it_is_for_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zone(tmp_path, "intel-rapl:0", "package-0", 1)
    read = Path.read_text

    def refuse(path: Path, *args: object, **options: object) -> str:
        if path.name == "energy_uj":
            raise PermissionError(13, "Permission denied", str(path))
        return read(path, *args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Path, "read_text", refuse)
    assert "may be read by root only" in rapl_counter(tmp_path).reason


def test_rapl_that_goes_away_leaves_no_figure(tmp_path: Path) -> None:
    folder = zone(tmp_path, "intel-rapl:0", "package-0", 0)
    costs = CostMeter(counters={"cpu": rapl_counter(tmp_path)})
    with costs.frame():
        advance(folder, 3_000_000)
    assert costs.summary()["ene_j"] == pytest.approx(3)
    with costs.frame():
        (folder / "energy_uj").unlink()
    found = costs.summary()
    assert (found["ene_j"], found["ene_cpu_j"]) == (None, None)
    assert "cpu: not available" in found["ene_source"]


class FakeNvml(types.ModuleType):
    """GPUs whose counters are set by hand."""

    class NVMLError(Exception):
        pass

    def __init__(self, millijoules: list[int]) -> None:
        super().__init__("pynvml")
        self.millijoules = millijoules
        self.broken = False

    def nvmlInit(self) -> None:
        if self.broken:
            raise self.NVMLError("Driver Not Loaded")

    def nvmlDeviceGetCount(self) -> int:
        return len(self.millijoules)

    def nvmlDeviceGetHandleByIndex(self, index: int) -> int:
        if index >= len(self.millijoules):
            raise self.NVMLError("Invalid Argument")
        return index

    def nvmlDeviceGetHandleByUUID(self, uuid: str) -> int:
        return int(uuid.removeprefix("GPU-"))

    def nvmlDeviceGetName(self, handle: int) -> str:
        return f"gpu{handle}"

    def nvmlDeviceGetTotalEnergyConsumption(self, handle: int) -> int:
        if self.broken:
            raise self.NVMLError("Not Supported")
        return self.millijoules[handle]


@pytest.fixture
def nvml(monkeypatch: pytest.MonkeyPatch) -> FakeNvml:
    fake = FakeNvml([5000, 70_000])
    monkeypatch.setitem(sys.modules, "pynvml", fake)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    return fake


@pytest.mark.parametrize(
    ("visible", "source", "joules"),
    [
        (None, "NVML: gpu0, gpu1", 3.0),
        ("1", "NVML: gpu1", 2.0),
        ("GPU-0", "NVML: gpu0", 1.0),
        ("0,-1,1", "NVML: gpu0", 1.0),
    ],
)
def test_nvml_counts_the_visible_gpus(
    nvml: FakeNvml, monkeypatch: pytest.MonkeyPatch, visible: str | None, source: str, joules: float
) -> None:
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    counter = nvml_counter()
    assert (counter.reason, counter.source, counter.joules()) == ("", source, 0)
    nvml.millijoules = [6000, 72_000]
    assert counter.joules() == pytest.approx(joules)
    nvml.broken = True
    assert math.isnan(counter.joules())
    assert counter.reason == "NVML: Not Supported"


def test_nvml_says_why_it_is_not_available(nvml: FakeNvml, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert nvml_counter().reason == "no NVIDIA GPU is visible"
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5")
    assert nvml_counter().reason == "NVML: Invalid Argument"
    nvml.broken = True
    assert nvml_counter().reason == "NVML: Driver Not Loaded"
    monkeypatch.setitem(sys.modules, "pynvml", None)
    assert "ms-slam-env[energy]" in nvml_counter().reason


def test_a_gpu_counts_only_where_the_work_is(nvml: FakeNvml) -> None:
    assert energy_counters("cpu")["gpu"].reason == "not used"
    assert energy_counters("cuda:0")["gpu"].source == "NVML: gpu0, gpu1"


class Ramp(EnergyCounter):
    """One joule more at every reading."""

    source = "ramp"

    def __init__(self) -> None:
        self.total = 0.0

    def joules(self) -> float:
        self.total += 1.0
        return self.total


def test_times_and_energy_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = {"now": 0.0}
    monkeypatch.setattr(meter.time, "perf_counter", lambda: clock["now"])
    monkeypatch.setattr(meter.time, "process_time", lambda: 2 * clock["now"])
    costs = CostMeter(counters={"cpu": Ramp(), "gpu": NoEnergy("none here")})
    seconds = np.array([9.0, *np.random.default_rng(0).uniform(0.01, 0.05, 50)])
    for duration in seconds:
        with costs.frame():
            clock["now"] += duration
        clock["now"] += 1.0  # between frames: not counted
    found = costs.summary(skip=1)
    ms = 1e3 * seconds[1:]
    expected = {
        "ext_ms": ms.mean(),
        "ext_ms_median": np.median(ms),
        "ext_ms_p95": np.percentile(ms, 95),
        "ext_ms_p99": np.percentile(ms, 99),
        "ext_ms_max": ms.max(),
        "cpu_ms_mean": 2 * ms.mean(),
        "cpu_ms_median": 2 * np.median(ms),
        "cpu_ms_p95": 2 * np.percentile(ms, 95),
        "ene_j": 50.0,
        "ene_frame_j": 1.0,
        "ene_cpu_j": 50.0,
    }
    for name, value in expected.items():
        assert found[name] == pytest.approx(value), name
    assert found["ene_gpu_j"] is None
    assert found["ene_source"] == "cpu: ramp; gpu: not available: none here"


def test_memory_of_frames_is_what_they_hold() -> None:
    if forget_peak_memory() is None:
        pytest.skip("this system does not tell peak memory")
    # In a process of its own: in this one an allocator may keep what other tests have freed.
    code = """
import json
import numpy as np
from ms_slam_env.metrics.cost import CostMeter
costs = CostMeter(counters={})
blocks = []
for _ in range(4):
    with costs.frame():
        blocks.append(np.ones(5_000_000))  # 38 MB
        passing = np.ones(10_000_000)  # 76 MB, gone after the frame
        del passing
print(json.dumps([[cost.mem_mb for cost in costs.frames], costs.summary()]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    held, found = json.loads(done.stdout)
    one = 5_000_000 * 8 / 2**20
    np.testing.assert_allclose(held, one * np.arange(1, 5), rtol=0.1)
    assert found["mem_mb"] == pytest.approx(2.5 * one, rel=0.1)
    assert found["mem_peak_mb"] == pytest.approx(6 * one, rel=0.1)
    assert found["mem_process_mb"] >= found["mem_peak_mb"]
    assert found["ene_j"] is None


def test_peak_memory_counts_what_was_taken_in_between() -> None:
    before = forget_peak_memory()
    if before is None:
        pytest.skip("this system does not tell peak memory")
    block = np.ones(25_000_000)
    del block
    peak = memory_mb("VmHWM")
    assert peak is not None
    assert peak - before == pytest.approx(25_000_000 * 8 / 2**20, rel=0.1)


def test_the_cheap_reading_of_memory_is_that_of_the_status_file() -> None:
    slow = memory_mb("VmRSS")
    if slow is None:
        pytest.skip("this system does not tell memory")
    assert resident_mb() == pytest.approx(slow, rel=0.02)


def test_work_that_fails_is_no_frame() -> None:
    costs = CostMeter(counters={})
    with pytest.raises(KeyError), costs.frame():
        raise KeyError
    with pytest.raises(InputError, match="0 frames were measured"):
        costs.summary()


class _Counted(EnergyCounter):
    """Takes 2 J a reading."""

    source = "made up"

    def __init__(self) -> None:
        self._taken = 0.0

    def joules(self) -> float:
        self._taken += 2.0
        return self._taken


def test_a_model_stands_only_where_nothing_is_measured(monkeypatch) -> None:
    seconds = iter([0.0, 0.5, 1.0, 1.25])
    monkeypatch.setattr(meter.time, "process_time", lambda: next(seconds))
    estimated = CostMeter(counters={"cpu": NoEnergy("no RAPL")}, core_watts=8.0)
    for _ in range(2):
        with estimated.frame():
            pass
    found = estimated.summary()
    assert found["ene_j"] is found["ene_cpu_j"] is None
    assert found["ene_model_j"] == pytest.approx(8.0 * 0.75)
    assert found["ene_model_frame_j"] == pytest.approx(3.0)
    assert "not measured" in found["energy_source"]
    assert "8 W" in found["energy_source"]
    seconds = iter([0.0, 0.5])
    monkeypatch.setattr(meter.time, "process_time", lambda: next(seconds))
    measured = CostMeter(counters={"cpu": _Counted(), "gpu": NoEnergy("no GPU")})
    with measured.frame():
        pass
    found = measured.summary()
    assert found["ene_j"] == 2.0
    assert not [key for key in found if "model" in key or key == "energy_source"]
    monkeypatch.setattr(meter.time, "process_time", lambda: 0.0)
    part = CostMeter("cuda", counters={"cpu": NoEnergy("no RAPL"), "gpu": _Counted()})
    with part.frame():
        pass
    found = part.summary()
    assert (found["ene_j"], found["ene_cpu_j"], found["ene_gpu_j"]) == (None, None, 2.0)
    assert "ene_model_j" not in found
    assert np.isnan(part.frames[0].joules)
    with pytest.raises(InputError, match="core_watts"):
        CostMeter(core_watts=0)
