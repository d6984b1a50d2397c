"""Does every generated home build without faults, and how long does it take?"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.config import Checked, bounded
from ms_slam_env.report.tables import Row, Table, finished, make_table
from ms_slam_env.scenes import SEED_SPLITS
from ms_slam_env.scenes.builder import Geometry
from ms_slam_env.scenes.free_space import FreeSpace, Holding
from ms_slam_env.scenes.homes.arrangement import Furnisher, overlap
from ms_slam_env.scenes.homes.floor_plan import AREA_M2, ROOMS_M, FloorPlan
from ms_slam_env.scenes.homes.home import built, scene_from, worked_out
from ms_slam_env.scenes.mesh_queries import face_cross, sample_surface

_TRIANGLES = (60_000, 320_000)
_VOXEL_M = 0.1
_CAMERA_M = 0.1
_FREE_SHARE = 0.2  # least share of a room's volume that a camera can reach
_SEEDS = (*SEED_SPLITS["test"], *SEED_SPLITS["validation"], *SEED_SPLITS["train"])


@dataclass(frozen=True)
class HomeSpec:
    """One home; if ``lit``, its light is computed too, and it is loaded again as from the cache."""

    seed: int
    lit: bool


@dataclass(frozen=True)
class Homes(Checked, Experiment):
    """Dwellings that were built

    Builds every home and checks it for faults: number and area of rooms, doors to every room,
    furniture in doorways or in other furniture, values that are not finite, triangles without area,
    number of triangles, and free space that a camera can reach through the doors, by flood fill.
    Some homes are also lit and stored. Times are processor times.
    """

    homes: int = bounded(1000, 1, len(_SEEDS))
    """Number of homes: the seeds of test, validation and training, in this order."""
    lit_every: int = bounded(50, 1, 10_000)
    """Light one in this many homes, too."""

    unit = "homes"
    workers = 1

    def specs(self) -> list[HomeSpec]:
        """One spec per seed."""
        return [
            HomeSpec(seed, k % self.lit_every == 0) for k, seed in enumerate(_SEEDS[: self.homes])
        ]

    @staticmethod
    def run(spec: HomeSpec) -> dict[str, Any]:
        """Build a home, check it for faults, and light it if requested."""
        start = time.process_time()
        plan, build, rooms, _ = built(spec.seed)
        geometry = build.build()
        found = {
            "build_cpu_s": time.process_time() - start,
            "rooms": len(plan.rooms) - 1,
            "area_m2": plan.area,
            "triangles": len(geometry.faces),
            "faults": [*plan_faults(plan), *room_faults(rooms), *mesh_faults(plan, geometry)],
        }
        if spec.lit:
            start = time.process_time()
            arrays = worked_out(spec.seed)
            lit = time.process_time()
            scene_from(spec.seed, arrays)
            found["complete_cpu_s"] = lit - start
            found["load_cpu_s"] = time.process_time() - lit
            found["stored_mb"] = sum(array.nbytes for array in arrays.values()) / 1e6
        return found

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Numbers of homes built and with faults, and distributions of times and sizes."""
        done = [row["result"] for row in finished(rows)]
        faulty = [row for row in finished(rows) if row["result"]["faults"]]
        counts = {"homes": len(rows), "built_homes": len(done), "faulty_homes": len(faulty)}
        lines = []
        for key in _DISTRIBUTED:
            values = [one[key] for one in done if key in one]
            if values:
                low, middle, high = np.quantile(values, (0.05, 0.5, 0.95)).tolist()
                lines.append({
                    "what": key, "values": len(values), "least": min(values), "percentile_5": low,
                    "median": middle, "percentile_95": high, "most": max(values),
                })  # fmt: skip
        named = [
            {"seed": row["spec"]["seed"], "faults": "; ".join(row["result"]["faults"])}
            for row in faulty
        ]
        tables = [
            make_table(list(counts), [counts]),
            make_table(list(lines[0]), lines, "Sizes and times") if lines else None,
            make_table(["seed", "faults"], named, "Faults") if named else None,
        ]
        return [table for table in tables if table is not None]


_DISTRIBUTED = (
    "rooms", "area_m2", "triangles", "build_cpu_s", "complete_cpu_s", "load_cpu_s", "stored_mb",
)  # fmt: skip


def plan_faults(plan: FloorPlan) -> list[str]:
    """Faults of a plan: too few or many rooms, too small or large ones, or rooms without access."""
    found = []
    if not ROOMS_M[0] <= len(plan.rooms) - 1 <= ROOMS_M[1]:
        found.append(f"{len(plan.rooms) - 1} rooms")
    if not AREA_M2[0] <= plan.area <= AREA_M2[1]:
        found.append(f"{plan.area:.1f} m2")
    a, b = np.array([door.rooms for door in plan.doors if not door.is_entrance]).T
    graph = coo_array((np.ones(len(a)), (a, b)), (len(plan.rooms),) * 2)
    if connected_components(graph, directed=False)[0] > 1:
        found.append("a room without a way to it")
    return found


def room_faults(rooms: Sequence[Furnisher]) -> list[str]:
    """Faults of rooms: furniture in other furniture, in a doorway or beyond a wall."""
    found = []
    for of in rooms:
        wall = np.array(of.room.size[:2]) + 1e-6
        standing, doorsteps = of.arrangement.standing, of.arrangement.doorsteps
        if any(overlap(one, other) for one, other in combinations(standing, 2)):
            found.append(f"furniture in furniture in the {of.name}")
        if any(overlap(one, other) for one in standing for other in doorsteps):
            found.append(f"furniture in a doorway of the {of.name}")
        beyond = [min(box[:2]) < -1e-6 or (np.array(box[2:]) > wall).any() for box in standing]
        if any(beyond):
            found.append(f"furniture in a wall of the {of.name}")
    return found


def mesh_faults(plan: FloorPlan, geometry: Geometry) -> list[str]:
    """Faults of a mesh: values not finite, triangles without area or too many, closed rooms."""
    found = []
    if not (np.isfinite(geometry.vertices).all() and np.isfinite(geometry.uv).all()):
        found.append("values that are not finite")
    cross = face_cross(geometry.vertices[geometry.faces])
    if not (np.linalg.norm(cross, axis=1) > 0).all():
        found.append("triangles without area")
    if not _TRIANGLES[0] <= len(geometry.faces) <= _TRIANGLES[1]:
        found.append(f"{len(geometry.faces)} triangles")
    return found + [f"the {name} is shut" for name in shut_rooms(plan, geometry)]


def shut_rooms(plan: FloorPlan, geometry: Geometry) -> list[str]:
    """Rooms of which a camera from the hall reaches less than ``_FREE_SHARE``, by flood fill."""
    points, _ = sample_surface(geometry.vertices, geometry.faces, 0.4 * _VOXEL_M)
    hall = np.array([*np.add(plan.rooms[-1].low, plan.rooms[-1].high) / 2, 1.3])
    free = FreeSpace(points, Holding(hall[None]), _VOXEL_M)
    component, _ = ndimage.label(free.distance > _CAMERA_M)
    at = component[tuple(np.rint((hall - free.origin) / free.voxel_m).astype(int))]
    cells = free.origin + free.voxel_m * np.argwhere((component == at) & (at > 0))
    shut = []
    for room in plan.rooms:
        inside = ((cells[:, :2] > room.low) & (cells[:, :2] < room.high)).all(axis=1)
        if inside.sum() * free.voxel_m**3 < _FREE_SHARE * room.area * plan.height:
            shut.append(room.name)
    return shut
