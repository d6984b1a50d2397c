"""One process of the speed measurement: times the surfel SLAM on a stored sequence.

``slam_speed`` runs this file with the package of this checkout, and with that of another checkout
for comparison. Therefore it uses only long-standing parts of the package.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import xtion
from ms_slam_env.config import from_dict
from ms_slam_env.slam.surfel import BatchedSurfelSlam, SurfelConfig

STAGES = {
    "preprocess": (("preprocess",),),
    "render": (("map", "render_model"),),
    "track": (("tracker", "set_frame"), ("tracker", "align")),
    "fuse": (("map", "fuse"),),
}
"""Stage to the methods (attribute paths of the SLAM object) that do its work."""
APART_M = 40.0  # distance between stored places, far beyond the camera's range


class StageClock:
    """Sums the processor time of each stage of SLAM, on a CPU, where kernel launches block."""

    def __init__(self, slam: BatchedSurfelSlam) -> None:
        """Put a clock around every method of ``STAGES``."""
        self.milliseconds = dict.fromkeys(STAGES, 0.0)
        for stage, paths in STAGES.items():
            for *owners, name in paths:
                owner: Any = slam
                for part in owners:
                    owner = getattr(owner, part)
                setattr(owner, name, self._timed(getattr(owner, name), stage))

    def _timed(self, method: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            try:
                return method(*arguments, **options)
            finally:
                self.milliseconds[stage] += 1e3 * (time.process_time() - start)

        return call


def with_far_places(state: dict[str, Any], stored: int, stable: float) -> dict[str, Any]:
    """SLAM state with other places in its map, with ``stored`` surfels in total.

    The other places are rotated copies of the map, far away and older, as for a robot that came
    from there. Their surfels are marked stable, or they would be removed.
    """
    surfels = state["map"]["surfels"][0]
    here = len(surfels["radius"])
    parts: list[dict[str, NDArray[Any]]] = []
    missing = stored - here
    side = int(np.ceil(np.sqrt(max(missing, 0) / here + 1)))
    place = 0
    while missing > 0:
        place += 1
        row, column = divmod(place, side + 1)
        angle = 2.4 * place
        turn = np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]],
            dtype=np.float32,
        )
        shift = np.array([APART_M * (row + 1), APART_M * column, 0], dtype=np.float32)
        copy = {name: values[:missing].copy() for name, values in surfels.items()}
        copy["position"] = copy["position"] @ turn.T + shift
        copy["normal"] = copy["normal"] @ turn.T
        copy["confidence"] = np.maximum(copy["confidence"], np.float32(stable))
        parts.append(copy)
        missing -= len(copy["radius"])
    joined = {
        name: np.concatenate([*(part[name] for part in parts), values])
        for name, values in surfels.items()
    }
    counters = {name: values.copy() for name, values in state["map"]["counters"].items()}
    counters["count"][0] = len(joined["radius"])
    return {**state, "map": {**state["map"], "counters": counters, "surfels": [joined]}}


def measure(
    sequence: str, size: str, stored: Sequence[int], warm_up: int, backend: dict[str, Any]
) -> list[dict[str, Any]]:
    """Time every frame after the warm-up, once for each number of stored surfels."""
    with np.load(sequence) as data:
        color, depth, poses = data["color"], data["depth"], data["poses"]
    # With spare capacity, since a full map spends time on making room.
    capacity = max(400_000, max(stored) * 5 // 4 + 8 * depth[0].size)
    config = from_dict(SurfelConfig, {"max_surfels": capacity, **backend}, "backend")
    slam = BatchedSurfelSlam(1, xtion(size), config)
    slam.reset(poses[0])
    for image, distance in zip(color[:warm_up], depth[:warm_up], strict=True):
        slam.track(image[None], distance[None])
    state = slam.get_state()
    clock = StageClock(slam)
    rows = []
    for target in stored:
        slam.set_state(with_far_places(state, target, config.confidence_threshold))
        rows.append(_time_frames(slam, clock, color[warm_up:], depth[warm_up:]))
        rows[-1]["target"] = target
    return rows


def _time_frames(
    slam: BatchedSurfelSlam, clock: StageClock, color: NDArray[np.uint8], depth: NDArray[np.float32]
) -> dict[str, Any]:
    totals: list[float] = []
    stages: dict[str, list[float]] = {stage: [] for stage in STAGES}
    estimates, surfels, lost = [], [], 0
    for image, distance in zip(color, depth, strict=True):
        clock.milliseconds = dict.fromkeys(STAGES, 0.0)
        start = time.process_time()
        result = slam.track(image[None], distance[None])[0]
        totals.append(1e3 * (time.process_time() - start))
        for stage, milliseconds in clock.milliseconds.items():
            stages[stage].append(milliseconds)
        estimates.append(result.T_world_camera)
        surfels.append(slam.map.count())
        lost += not result.tracking_ok
    return {
        "frame_ms": totals,
        "stages_ms": stages,
        "surfels": float(np.mean(surfels)),
        "lost_frames": lost,
        "estimates": hashlib.sha256(np.stack(estimates).tobytes()).hexdigest(),
    }


if __name__ == "__main__":
    print(json.dumps(measure(**json.loads(sys.argv[1]))))
