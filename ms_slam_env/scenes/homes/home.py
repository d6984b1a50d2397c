"""A dwelling of several rooms as a scene, kept on disk once it is built and lit."""

from __future__ import annotations

import hashlib
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.scenes import mesh_cache
from ms_slam_env.scenes.base import Float64, Int32, Rng, TexturedMesh
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.free_space import FreeSpace
from ms_slam_env.scenes.homes.arrangement import Furnisher
from ms_slam_env.scenes.homes.floor_plan import DOOR_M, FloorPlan, draw_plan
from ms_slam_env.scenes.homes.interior import furnished
from ms_slam_env.scenes.homes.room_light import home_lighting
from ms_slam_env.scenes.homes.visibility import seen_faces
from ms_slam_env.scenes.homes.ways import Ways
from ms_slam_env.scenes.lighting import light_and_expose
from ms_slam_env.scenes.mesh_scene import MeshScene, free_space_around

_KEY = 0.18
_VARIETY = 5
_EYE_M = 1.3
_START_OBJECTS = 5  # a wall, its skirting and the floor are three
_MOST_POINTS = 3_000_000
_OF_MESH = ("vertices", "faces", "uv", "face_texture", "face_label", "irradiance")
_TEXTURE = "texture "


def home(seed: int) -> HomeScene:
    """Build the dwelling of ``seed``: 3 to 7 rooms and a hall, 40 to 120 m2; slow the first time.

    Places: the names of the rooms, as "hall", "living", "kitchen", "bedroom2".

    One has much to see: 338 m2 in the smallest of the first three test seeds (57 m2 of floor). With
    motions of 12 cm and 12 degrees, views chosen by someone who knows it all show 75 % of that in
    600 steps and 85 % in 966; with 25 cm and 20 degrees 85 % in 611, which SLAM does not survive at
    one frame a step. An episode that is to see most of a home needs more steps than 600, or several
    frames a step.
    """
    name = mesh_cache.key([], (home.__name__, version(), seed))
    return scene_from(seed, mesh_cache.remembered(name, lambda: worked_out(seed)))


def scene_from(seed: int, arrays: mesh_cache.Arrays) -> HomeScene:
    """The scene of ``seed`` from what is kept of it."""
    textures = tuple(arrays[name] for name in arrays if name.startswith(_TEXTURE))
    mesh = TexturedMesh(
        **{field: arrays[field] for field in _OF_MESH},
        textures=textures,
        labels=tuple(arrays["labels"].tolist()),
    )
    free = FreeSpace.of_grid(arrays["distance"], arrays["origin"], float(arrays["voxel_m"]))
    plan, _ = _plan(seed)
    return HomeScene(seed, plan, mesh, free, float(arrays["exposure"]), arrays["seen"])


def built(seed: int) -> tuple[FloorPlan, MeshBuilder, list[Furnisher], Rng]:
    """The dwelling of ``seed`` without its light; the generator that goes on to draw that."""
    plan, rng = _plan(seed)
    build = MeshBuilder(variety=_VARIETY)
    return plan, build, furnished(build, rng, plan), rng


def worked_out(seed: int) -> mesh_cache.Arrays:
    """What is kept of a dwelling: the lit mesh, its free space, its exposure, what can be seen."""
    plan, build, rooms, rng = built(seed)
    eyes = np.array([[*np.add(room.low, room.high) / 2, _EYE_M] for room in plan.rooms])
    mesh, exposure = light_and_expose(build, home_lighting(rng, plan, rooms), eyes, _KEY)
    free = free_space_around(mesh, eyes[-1])
    arrays = {field: getattr(mesh, field) for field in _OF_MESH}
    arrays |= {f"{_TEXTURE}{k:04d}": texture for k, texture in enumerate(mesh.textures)}
    arrays |= {"distance": free.distance, "origin": free.origin}
    arrays["voxel_m"], arrays["exposure"] = np.array(free.voxel_m), np.array(exposure)
    arrays["labels"] = np.array(mesh.labels)
    arrays["seen"] = seen_faces(mesh, free, eyes[-1])
    return arrays


@lru_cache(maxsize=1)
def version() -> str:
    """A hash of all code that dwellings are made by, and of the versions of what it calls."""
    digest = hashlib.sha256(repr((np.__version__, scipy.__version__, cv2.__version__)).encode())
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _plan(seed: int) -> tuple[FloorPlan, Rng]:
    rng = np.random.default_rng([seed, 15])
    return draw_plan(rng), rng


class HomeScene(MeshScene):
    """A dwelling: its surface is what a camera that passes through its doors can see."""

    passage_m = DOOR_M

    def __init__(
        self,
        seed: int,
        plan: FloorPlan,
        mesh: TexturedMesh,
        free_space: FreeSpace,
        exposure: float,
        seen: NDArray[np.bool_],
    ) -> None:
        """Put the parts together; ``seen`` (F,) are the faces that a camera can see."""
        self.plan = plan
        self._seen = np.flatnonzero(seen).astype(np.int32)
        super().__init__(home, seed, mesh, free_space, self._start, exposure, _START_OBJECTS)

    @cached_property
    def _ways(self) -> Ways:
        low = np.min([room.low for room in self.plan.rooms], axis=0)
        high = np.max([room.high for room in self.plan.rooms], axis=0)
        return Ways(self.free_space, low, high)

    @cached_property
    def places(self) -> dict[str, Float64]:
        """By the name of a room, the point (3,) on its floor with the most free space around."""
        points, room_there = self._ways.widest
        found = {}
        for room in self.plan.rooms:
            inside = ((points > room.low) & (points < room.high)).all(axis=1)
            best = points[np.argmax(np.where(inside, room_there, -1.0))]
            found[room.name] = np.array([*best, 0.0])
        return found

    def way(self, start: Float64, end: Float64) -> Float64:
        """See the base class.

        Raises:
            InputError: there is none, which is where one of the two is not free.
        """
        found = self._ways.between(start, end)
        if found is None:
            raise InputError(f"no way from {start[:2]} to {end[:2]} in home {self.seed}")
        return np.concatenate([found, np.zeros((len(found), 1))], axis=1)

    def surface_points(self, spacing_m: float = 0.01) -> tuple[Float64, Int32]:
        """See the base class: what shows itself to some place that a camera can reach.

        There are ``_MOST_POINTS`` at most, farther apart if they must be.
        """
        return self._open_points(self._seen, spacing_m, _MOST_POINTS)

    def _start(self, draw: Rng) -> tuple[Float64, Float64]:
        rooms = self.plan.rooms
        area = np.array([room.area for room in rooms])
        room = rooms[int(draw.choice(len(rooms), p=area / area.sum()))]
        low, high = np.array(room.low), np.array(room.high)
        eye = np.array([*draw.uniform(low + 0.4, high - 0.4), draw.uniform(1.0, 1.6)])
        target = np.array([*draw.uniform(low + 0.1, high - 0.1), draw.uniform(0.5, 1.1)])
        return eye, target
