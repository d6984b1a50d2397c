"""Compiler, cores and clock of a configuration: in force for a while, and then as before."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import (
    SlamConfiguration,
    read_configuration,
    write_configuration,
)
from ms_slam_env.slam.machine import (
    CompilerOptions,
    clock_range_mhz,
    compiled,
    limited_clock,
    why_no_clock,
)
from ms_slam_env.slam.surfel import SurfelConfig, preprocessing

KERNELS = wp.get_module(preprocessing.__name__)


def hash_of_kernels() -> bytes:
    KERNELS.mark_modified()
    return KERNELS.get_module_hash(1)


def test_options_hold_for_the_enclosed_work_and_name_other_binaries():
    """Other hashes: kernels of other options never take the default's place in the cache."""
    before, hashes = dict(KERNELS.options), {hash_of_kernels()}
    for options in (
        CompilerOptions(optimization_level=3),
        CompilerOptions(fast_math=True),
        CompilerOptions(vectorise=False),
        CompilerOptions(grid_stride=False),
        CompilerOptions(fast_math=True, vectorise=False),
    ):
        with compiled(options):
            hashes.add(hash_of_kernels())
        assert KERNELS.options == before
    assert len(hashes) == 6
    assert hash_of_kernels() in hashes


def test_the_default_changes_nothing():
    options = CompilerOptions().module_options()
    for key, value in options.items():
        assert KERNELS.options[key] == value, key


def test_a_configuration_says_how_it_is_compiled(tmp_path):
    given = SlamConfiguration(compiler={"fast_math": True, "optimization_level": 3})
    write_configuration(tmp_path / "fast.yaml", given)
    assert read_configuration(tmp_path / "fast.yaml") == given
    with given.machine():
        assert "-mreassociate" in KERNELS.options["cpu_compiler_flags"]
    assert KERNELS.options["cpu_compiler_flags"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": 1}, "compiler.speed"),
        ({"optimization_level": 4}, "optimization_level = 4 is outside"),
        ({"fast_math": "yes"}, "fast_math"),
    ],
)
def test_bad_options_are_one_line(options, message):
    with pytest.raises(InputError, match=message):
        SlamConfiguration(compiler=options)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system sets no affinity")
def test_threads_reach_opencv():
    before = cv2.getNumThreads()
    with SlamConfiguration(slam="odometry", threads=1).machine():
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == before


def cores(root: Path) -> list[Path]:
    """Two cores as Linux shows them."""
    for number in range(2):
        folder = root / f"cpu{number}" / "cpufreq"
        folder.mkdir(parents=True)
        for name, khz in (("cpuinfo_min", 800_000), ("cpuinfo_max", 3_200_000)):
            (folder / f"{name}_freq").write_text(f"{khz}\n")
        (folder / "scaling_max_freq").write_text("3200000\n")
    return sorted(root.glob("*/*/scaling_max_freq"))


def test_the_clock_is_limited_for_a_while(tmp_path):
    files = cores(tmp_path)
    assert why_no_clock(tmp_path) == ""
    assert clock_range_mhz(tmp_path) == (800, 3200)
    with limited_clock(1200, tmp_path):
        assert [file.read_text() for file in files] == ["1200000"] * 2
    assert [file.read_text() for file in files] == ["3200000\n"] * 2


def test_a_machine_without_a_clock_says_so(tmp_path):
    assert "has no cpufreq" in why_no_clock(tmp_path)
    with (
        pytest.raises(InputError, match=r"cpu_mhz = 1200: .* has no cpufreq"),
        limited_clock(1200, tmp_path),
    ):
        pass


def test_other_options_leave_the_default_as_it_was():
    """A compiled module of the default is the same file before and after, and gives every bit."""
    rng = np.random.default_rng(0)
    color = rng.integers(0, 255, (1, 60, 80, 3), dtype=np.uint8)
    depth = rng.uniform(0.5, 5.0, (1, 60, 80)).astype(np.float32)

    def normals() -> np.ndarray:
        live = preprocessing.Preprocessor(1, xtion("80x60"), SurfelConfig())(color, depth)
        return np.asarray(live.normals.numpy())

    default = normals()
    kept = Path(wp.config.kernel_cache_dir or "") / KERNELS.get_module_identifier(1)
    binaries = {file: file.read_bytes() for file in kept.glob("*.o")}
    assert binaries
    with compiled(CompilerOptions(optimization_level=1, fast_math=True, vectorise=False)):
        other = Path(wp.config.kernel_cache_dir or "") / KERNELS.get_module_identifier(1)
        np.testing.assert_allclose(normals(), default, atol=1e-3)
        assert other != kept
        assert other.is_dir()
    np.testing.assert_array_equal(normals(), default)
    assert {file: file.read_bytes() for file in kept.glob("*.o")} == binaries
