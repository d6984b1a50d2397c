"""The kernels of the surfel SLAM as CUDA code: compiled here, run only where there is a GPU.

On the CPU the loops over local arrays treat many surfels at once; a GPU compiles the same text with
one surfel a thread. That it compiles, and keeps those arrays in registers, needs no GPU.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from ms_slam_env._runtime.warp import wp

HOPPER = 90
MODULES = (
    *("acceptance", "free_space_mask", "frustum_culling", "map_deformation", "normal_equations"),
    *("photometry", "pose_hypotheses", "preprocessing", "rendering", "rolling_shutter", "solver"),
    *("surfel_map", "surfel_update", "view_prediction"),
)
SHARED = ("device_ferns", "images")
IN_REGISTERS = ("frustum_culling", "rendering", "surfel_update")


@pytest.mark.parametrize("name", [*MODULES, *SHARED])
def test_kernels_compile_for_a_gpu(name: str, tmp_path: Path) -> None:
    place = "shared" if name in SHARED else "surfel"
    module = importlib.import_module(f"ms_slam_env.slam.{place}.{name}")
    wp.compile_aot_module(module, arch=HOPPER, module_dir=str(tmp_path), use_ptx=True)
    [file] = tmp_path.glob("*.ptx")
    code = file.read_text()
    assert code.count(".entry") >= 1
    if name in IN_REGISTERS:
        assert not re.search(r"\.local\s+\.align", code)
