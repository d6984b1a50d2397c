"""A home of several rooms as a scene, cached on disk once built and lit."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Bool, Float64, Int32
from ms_slam_env.errors import InputError
from ms_slam_env.scenes import mesh_cache
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.free_space import FreeSpace
from ms_slam_env.scenes.homes.arrangement import Furnisher
from ms_slam_env.scenes.homes.floor_plan import DOOR_M, FloorPlan, RoomPlan, draw_plan
from ms_slam_env.scenes.homes.interior import furnished, lamp_size
from ms_slam_env.scenes.homes.ways import Ways
from ms_slam_env.scenes.lighting import (
    Lamp,
    Light,
    Lighting,
    Panel,
    RoomLight,
    Sun,
    light_and_expose,
)
from ms_slam_env.scenes.mesh_queries import RayCaster, face_cross
from ms_slam_env.scenes.mesh_scene import MeshScene, free_space_around, unit_rows
from ms_slam_env.scenes.room import PANE, Room, Window
from ms_slam_env.scenes.scene import Rng, TexturedMesh

_KEY = 0.18
_VARIETY = 5
_EYE_M = 1.3
_START_OBJECTS = 5  # a wall, its skirting board and the floor are three
_MOST_POINTS = 3_000_000
_OF_MESH = ("vertices", "faces", "uv", "face_texture", "face_label", "irradiance")
_TEXTURE = "texture "


def home(seed: int) -> HomeScene:
    """Build the home of ``seed``: 3 to 7 rooms and a hall, 40 to 120 m2; slow the first time.

    Places: the names of the rooms, such as "hall", "living", "kitchen", "bedroom2".

    A home has much surface: 338 m2 in the smallest of the first three test seeds (57 m2 of floor).
    With motions of 12 cm and 12 degrees, views chosen with full knowledge of the home show 75 % of
    it in 600 steps and 85 % in 966. With 25 cm and 20 degrees they show 85 % in 611, but SLAM does
    not survive that at one frame per step. To see most of a home, an episode needs more than 600
    steps, or several frames per step.
    """
    name = mesh_cache.key([], (home.__name__, version(), seed))
    return scene_from(seed, mesh_cache.remembered(name, lambda: worked_out(seed)))


def scene_from(seed: int, arrays: mesh_cache.Arrays) -> HomeScene:
    """Make the scene of ``seed`` from its cached arrays."""
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
    """Build the home of ``seed`` without light; return the generator that then draws the light."""
    plan, rng = _plan(seed)
    build = MeshBuilder(variety=_VARIETY)
    return plan, build, furnished(build, rng, plan), rng


def worked_out(seed: int) -> mesh_cache.Arrays:
    """Compute a home's cached data: the lit mesh, free space, exposure and visible faces."""
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
    """A hash of all code that makes homes, and of the versions of its dependencies."""
    digest = hashlib.sha256(repr((np.__version__, scipy.__version__, cv2.__version__)).encode())
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _plan(seed: int) -> tuple[FloorPlan, Rng]:
    rng = np.random.default_rng([seed, 15])
    return draw_plan(rng), rng


class HomeScene(MeshScene):
    """A home; its surface is what a camera moving through its doors can see."""

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
        """Assemble the scene; ``seen`` (F,) marks the faces that a camera can see."""
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
        """The point (3,) with the most free space on each room's floor, by room name."""
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
            InputError: there is none, because an end is not free.
        """
        found = self._ways.between(start, end)
        if found is None:
            raise InputError(f"no way from {start[:2]} to {end[:2]} in home {self.seed}")
        return np.concatenate([found, np.zeros((len(found), 1))], axis=1)

    def surface_points(self, spacing_m: float = 0.01) -> tuple[Float64, Int32]:
        """See the base class; only surface visible from where a camera can get.

        At most ``_MOST_POINTS`` points, spaced wider if necessary.
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


_SKY = np.array([0.95, 1.0, 1.08]) * 6.0
_WARM = np.array([1.0, 0.9, 0.75])
_BULB = np.array([1.0, 0.78, 0.5])
_LEVEL = (0.09, 0.13)  # total light flux of a room over its surface area
_LEAST_LAMP = 0.015  # least flux of the ceiling lamp, in the same units
_REVEAL_M = 0.14  # a window's light comes from behind its reveal


def home_lighting(rng: Rng, plan: FloorPlan, rooms: Sequence[Furnisher]) -> Lighting:
    """Equal daylight for all windows, and lamps that complement it in each room."""
    day = rng.uniform(0.4, 1.0)
    sky = _SKY * day
    angle = rng.uniform(0, 2 * np.pi)
    sun = (np.cos(angle), np.sin(angle), rng.uniform(0.5, 0.9))
    lights: list[Light] = [Sun(sun, tuple(np.array([3.0, 2.7, 2.2]) * rng.uniform(0.0, day)))]
    glow = {}
    for own, of in zip(plan.rooms, rooms, strict=True):
        w, d, h = of.room.size
        surface = 2 * (w * d + (w + d) * h)
        flux = rng.uniform(*_LEVEL) * surface
        panes = [_window_light(own, of.room, *one, sky) for one in own.windows]
        from_windows = sum(one.width * one.height for _, one in own.windows) * float(sky.mean())
        wide, deep = lamp_size(own)
        strength = max(_LEAST_LAMP * surface, flux - from_windows) / (wide * deep)
        x, y = np.add(own.low, own.high) / 2
        ceiling = Panel(
            (x - wide / 2, y + deep / 2, h - 0.05),
            (wide, 0, 0),
            (0, -deep, 0),
            tuple(_WARM * strength),
            (2, 2),
        )
        bulbs = [
            Lamp(
                tuple(np.add(place, (*own.low, 0.0))),
                tuple(_BULB * rng.uniform(0.04, 0.14)),
                0.08,
                2,
            )
            for place in of.bulbs
        ]
        low, high = (*own.low, 0.0), (*own.high, h)
        lights += [RoomLight(light, low, high) for light in (*panes, ceiling, *bulbs)]
        bright = min(3.0, 0.3 + 0.25 * strength)
        glow[f"{own.name} ceiling lamp"] = (bright, 0.96 * bright, 0.86 * bright)
        glow[f"{own.name} {PANE}"] = tuple(sky.tolist())
        glow[f"{own.name} lamp shade"] = (0.62, 0.51, 0.34)
        glow[f"{own.name} TV screen"] = (0.45, 0.47, 0.5)
    shining = frozenset(name for name in glow if not name.endswith("TV screen"))
    return Lighting(tuple(lights), glow, shining, bounce_rays=20)


def _window_light(own: RoomPlan, room: Room, wall: int, window: Window, sky: Float64) -> Panel:
    """Skylight through a window, in the home's frame."""
    half = window.width / 2
    right, left = (
        room.to_world(wall, (window.along + side * half, _REVEAL_M, window.sill))
        for side in (1, -1)
    )
    # The front of the panel, edge_u x edge_v, faces the room.
    origin = tuple(np.add(left, (*own.low, 0.0)).tolist())
    return Panel(origin, tuple(right - left), (0, 0, window.height), tuple(sky), (3, 2))


CAMERA_M = 0.15
"""Free space around a moving camera."""
_SPACING_M = 0.4  # between viewpoints
_HEIGHTS_M = (0.4, 1.1, 1.8)  # of viewpoints; none from the floor up under tables
_LOOKS = ((6, 1), (240, 5), (700, 7))
"""Rounds of (number of nearest viewpoints, stride) in which a face is tested. Faces not visible in
a round are tested in the next, from viewpoints on more sides."""
_HIT = 0.99
_LEAST_COSINE = 0.15
"""Least cosine of the angle of incidence; a depth camera has no reading at more oblique angles."""


def reachable_cells(free: FreeSpace, start: Float64, radius_m: float = CAMERA_M) -> Bool:
    """Voxels (nx, ny, nz) that a ball of ``radius_m`` can reach from ``start`` (3,)."""
    component, _ = ndimage.label(free.distance > radius_m)
    at = component[tuple(np.rint((start - free.origin) / free.voxel_m).astype(int))]
    return (component == at) & (at > 0)


def viewpoints(free: FreeSpace, start: Float64) -> Float64:
    """Viewpoints (K, 3) on a grid over all free space that a camera can reach."""
    step = max(1, round(_SPACING_M / free.voxel_m))
    cells = reachable_cells(free, start)
    heights = np.rint((np.array(_HEIGHTS_M) - free.origin[2]) / free.voxel_m).astype(int)
    grid = np.zeros_like(cells)
    grid[::step, ::step, heights] = True
    return free.origin + free.voxel_m * np.argwhere(cells & grid)


def seen_faces(mesh: TexturedMesh, free: FreeSpace, start: Float64) -> Bool:
    """Which faces (F,) open into free space and show their centre to a viewpoint.

    Misses a few per cent of the faces, which are visible from few viewpoints only.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    middle, normal = corners.mean(axis=1), unit_rows(face_cross(corners))
    eyes = viewpoints(free, start)
    rays = RayCaster(mesh.vertices, mesh.faces)
    seen = np.zeros(len(middle), bool)
    opens = np.flatnonzero(free.clearance(middle + 1.2 * free.voxel_m * normal) > 0)
    tree = cKDTree(eyes)
    for nearest, stride in _LOOKS:
        rest = opens[~seen[opens]]
        of_rest = tree.query(middle[rest], min(nearest, len(eyes)))[1][:, ::stride]
        for rank in range(of_rest.shape[1]):
            left = np.flatnonzero(~seen[rest])
            face, eye = rest[left], eyes[of_rest[left, rank]]
            towards = middle[face] - eye
            cosine = -np.einsum("ij,ij->i", towards, normal[face])
            facing = cosine > _LEAST_COSINE * np.linalg.norm(towards, axis=1)
            face, eye, towards = face[facing], eye[facing], towards[facing]
            distance, _ = rays.first_hit(eye, towards)
            seen[face[distance > _HIT]] = True
    return seen
