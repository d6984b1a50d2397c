"""Nothing that users see has changed; ``python tests/golden/update.py`` says that it should have.

Processors with AVX2 run the same kernels (``tests/same_kernels.py``); what is left is which of two
faces Embree meets at their common edge. On others libraries and kernels are compiled or chosen for
the processor at hand, and a last bit decides now and then whether a pixel counts. Therefore two
limits for each array: three quarters of the values keep the first, all of them the second. They are
beyond what was seen when kernels, BLAS, NumPy and Embree were confined to older processors, and
when half of the depth readings were one last bit larger. ``update.py --compare`` shows what stays
within them.
"""

from __future__ import annotations

import numpy as np
import pytest
from cases import ARM, CASES, Arrays, why_not
from stored import kept, read

GROUPS = {group: read(group) for group in ("slam", "env")}

ANY = np.inf  # an edge that moves by a pixel changes its value by as much as there is
RELATIVE = ("map_size", "surface_count", "surface_sum", "energy")  # the others in their own unit
LIMITS = {
    "T_world_camera": (6e-4, 3e-3),  # m
    "T_world_camera_estimate": (6e-4, 3e-3),
    "corrected_poses": (1e-4, 2e-3),
    "pose_error": (6e-4, 3e-3),
    "ate": (6e-4, 3e-3),
    "sigmas": (2e-6, 1e-4),
    "inlier_fraction": (5e-4, 5e-2),
    "residual_m": (1e-4, 6e-2),
    "degenerate_directions": (0, 2),
    "map_size": (1e-3, 5e-3),
    "surface_count": (1e-3, 5e-3),
    "surface_sum": (1e-3, 5e-3),
    "surface_mean": (2e-3, 1e-2),
    "color_mean": (0.03, 0.2),  # grey levels
    "predicted_intensity": (20, ANY),
    "predicted_depth": (0.01, ANY),
    "predicted_normals": (0.1, ANY),
    "energy": (1e-4, 1e-3),
    "mapped_area": (0.02, 0.05),  # m2
    "mapped_share": (2e-4, 1e-3),
    "divergence": (4e-4, 3e-3),  # nats; the terms below are these by their weights
    "lookahead": (1e-2, 3e-2),
    "reward_terms.intensity_divergence": (7e-4, 3e-3),
    "reward_terms.depth_divergence": (1e-4, 6e-4),
    "reward_terms.trajectory_error": (6e-3, 3e-2),
    "reward_terms.new_surface": (0.02, 0.05),
    "reward_terms.ate_growth": (6e-2, 3e-1),
    "reward": (6e-2, 3e-1),
    "observation": (5e-3, 0.1),
    "observation.state": (5e-3, 0.1),
    "observation.color": (2, ANY),
    "observation.depth": (1e-3, ANY),
}
OTHER_FLOATS = (1e-5, 1e-4)

# Where small differences grow from frame to frame, or a lookahead is part of what is seen.
WIDER = {
    "slam/odometry/": 10,
    "slam/volumetric/": 10,
    f"env/{ARM}": 10,
    "env/MSActiveSLAM-Adaptive-v0": 10,
    "env/MSActiveSLAM-DepthQuantisation-v0": 10,
    "env/MSActiveSLAM-FreeCamera-DepthQuantisation-v0": 10,
    "env/MSActiveSLAM-MovingObjects-v0": 50,  # a pose more or less is taken
    "env/MSActiveSLAM-FreeCamera-RollingShutter-v0": 20,
    "env/observation-lookahead": 10,
    "env/slam-sparse": 10,
}


def changes(case: str, stored: Arrays, now: Arrays) -> list[str]:
    """What is not as it was stored, one line for each array."""
    lines = [f"{name}: only one of stored and computed" for name in stored.keys() ^ now.keys()]
    for name in stored.keys() & now.keys():
        before, after = stored[name], now[name]
        if before.shape != after.shape:
            lines.append(f"{name}: shape {before.shape} became {after.shape}")
        elif before.size:
            most, largest = limits(case, name, before)
            apart = distances(before, after)
            quarter = float(np.quantile(apart, 0.75))
            if not (quarter <= most and apart.max() <= largest):
                lines.append(
                    f"{name}: three quarters within {quarter:.3g} (limit {most:.3g}), "
                    f"all within {apart.max():.3g} (limit {largest:.3g})"
                )
    return sorted(lines)


def limits(case: str, name: str, values: np.ndarray) -> tuple[float, float]:
    """How far three quarters of the values, and how far all of them, may be from the stored."""
    quantity = name.split("/")[-1].removeprefix("info.")
    exact = (0.0, 0.0) if values.dtype.kind in "biu" else OTHER_FLOATS
    most, largest = LIMITS.get(quantity, exact)
    wider = max((factor for start, factor in WIDER.items() if case.startswith(start)), default=1)
    scale = np.abs(values).max() if quantity in RELATIVE else 1
    return most * wider * scale, largest * wider * scale


def distances(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Distances between values; two that are no number or infinite agree, one and a number not."""
    a, b = before.astype(float), after.astype(float)
    with np.errstate(invalid="ignore"):  # infinity less infinity
        apart = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
    return np.nan_to_num(apart, nan=np.inf)


def test_every_case_is_stored() -> None:
    assert set(CASES) == {name for group in GROUPS.values() for name in group}


@pytest.mark.parametrize("name", CASES)
def test_as_stored(name: str) -> None:
    if reason := why_not(name):
        pytest.skip(reason)
    lines = changes(name, GROUPS[name.split("/")[0]][name], kept(CASES[name]()))
    assert not lines, f"{name} has changed:\n" + "\n".join(lines)


@pytest.mark.parametrize("name", [name for name in CASES if "round-trip" in name])
def test_a_restored_environment_goes_on_bit_for_bit(name: str) -> None:
    arrays = CASES[name]()
    first = {key.removeprefix("first/"): a for key, a in arrays.items() if key.startswith("first/")}
    assert first
    for key, array in first.items():
        np.testing.assert_array_equal(array, arrays[f"again/{key}"], err_msg=key)


@pytest.mark.parametrize("change", [0.0, 1e-2])
def test_a_changed_pose_is_noticed(change: float) -> None:
    stored = GROUPS["slam"]["slam/surfel/handheld"]
    now = {**stored, "T_world_camera": stored["T_world_camera"] + np.float32(change)}
    assert len(changes("slam/surfel/handheld", stored, now)) == (change > 0)
