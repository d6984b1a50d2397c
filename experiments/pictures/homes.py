"""The picture of some homes: `python -m ms_slam_experiments.pictures.homes`.

One row a home: its floor plan, seen from far above without the ceilings, and what an ideal sensor
sees from the scene's own start poses.
"""

from __future__ import annotations

import copy
import dataclasses
import sys
from pathlib import Path

import cv2
import numpy as np
from ms_slam_experiments.pictures.drawing import Image, run_script, shrunk, titled_row

from ms_slam_env import scenes
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.scenes.homes.home import HomeScene
from ms_slam_env.sensor import RGBDSensor

_FAR_M = 80.0  # of the eye above a plan, which makes it nearly parallel
_MARGIN_M = 0.25
_ABOVE = ("ceiling", "lamp")  # last words of the labels that a plan leaves out
_CANDIDATES = 4


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw floor plans and views of homes.

    Attributes:
        out: the file to write.
        seeds: of the homes.
        views: of each home.
        width: of a view, pixels.
    """

    out: Path = Path("docs/pictures/homes.webp")
    seeds: tuple[int, ...] = (2000, 2002)
    views: int = 6
    width: int = 180


def floor_plan(scene: HomeScene, width: int, height: int) -> Image:
    """The rooms from above and their names, (height, width, 3) RGB, y up or to the left."""
    low = np.min([room.low for room in scene.plan.rooms], axis=0) - _MARGIN_M
    high = np.max([room.high for room in scene.plan.rooms], axis=0) + _MARGIN_M
    is_turned = (high - low)[0] < (high - low)[1]
    extent = (high - low)[::-1] if is_turned else high - low
    scale = min(width / extent[0], height / extent[1])  # pixels a metre
    eye = np.eye(4)
    eye[:3, :3] = np.diag([1.0, -1.0, -1.0])
    if is_turned:
        eye[:3, :3] = [[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    eye[:3, 3] = [*(low + high) / 2, _FAR_M]
    focal = scale * _FAR_M
    intrinsics = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    view = RGBDSensor(_without_ceilings(scene), intrinsics, noise="none").ground_truth(eye)
    image = np.where((view.depth > 0)[..., None], view.color, 255).astype(np.uint8)
    for room in scene.plan.rooms:
        middle = np.array([*np.add(room.low, room.high) / 2, 0.0, 1.0])
        x, y, z, _ = np.linalg.inv(eye) @ middle
        at = (focal * x / z + width / 2 - 3.0 * len(room.name), focal * y / z + height / 2)
        where = (int(at[0]), int(at[1]))
        for colour, thick in (((20, 20, 20), 3), ((255, 255, 255), 1)):
            font = cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(image, room.name, where, font, 0.36, colour, thick, cv2.LINE_AA)
    return image


def _without_ceilings(scene: HomeScene) -> HomeScene:
    """The scene as one looks into it from above."""
    mesh = scene.mesh
    above = [k for k, name in enumerate(mesh.labels) if name.split(" ")[-1] in _ABOVE]
    kept = ~np.isin(mesh.face_label, above)
    names = ("faces", "uv", "face_texture", "face_label", "irradiance")
    open_scene = copy.copy(scene)
    fields = {name: getattr(mesh, name)[kept] for name in names}
    open_scene.mesh = dataclasses.replace(mesh, **fields)
    return open_scene


def views(scene: HomeScene, count: int) -> list[Image]:
    """Colour images (H, W, 3) from start poses that show many objects, one a room at first."""
    sensor = RGBDSensor(scene, xtion("640x480"), noise="none")
    rng = np.random.default_rng(scene.seed)
    by_room: dict[str, list[tuple[int, Image]]] = {}
    for _ in range(_CANDIDATES * count):
        pose = scene.sample_start(rng)
        view = sensor.ground_truth(pose)
        shown = len(np.unique(view.labels[::4, ::4]))
        by_room.setdefault(_room_at(scene, pose[:2, 3]), []).append((shown, view.color))
    ranked = [sorted(found, key=lambda one: -one[0]) for found in by_room.values()]
    turns = [(rank, -shown, image) for found in ranked for rank, (shown, image) in enumerate(found)]
    return [image for _, _, image in sorted(turns, key=lambda one: one[:2])[:count]]


def _room_at(scene: HomeScene, place: np.ndarray) -> str:
    inside = [r.name for r in scene.plan.rooms if (place > r.low).all() and (place < r.high).all()]
    return inside[0] if inside else ""


def draw(options: Options) -> Image:
    """The whole picture; two rows of views beside each plan."""
    rows = []
    columns = -(-options.views // 2)
    height = 3 * options.width // 2
    for seed in options.seeds:
        scene = scenes.make("home", seed)
        assert isinstance(scene, HomeScene)
        small = [shrunk(image, options.width) for image in views(scene, options.views)]
        lines = [np.concatenate(small[k : k + columns], 1) for k in (0, columns)]
        images = [floor_plan(scene, height * 4 // 3, height), np.concatenate(lines)]
        plan = scene.plan
        title = f"home, seed {seed}: {len(plan.rooms) - 1} rooms and a hall, {plan.area:.0f} m2"
        rows.append(titled_row(images, title))
    return np.concatenate(rows)


if __name__ == "__main__":
    sys.exit(run_script(Options, draw))
