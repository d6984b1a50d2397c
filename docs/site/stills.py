"""Pictures for the pages: `python -m ms_slam_docs.stills scenes homes usme arm`.

``scenes``: two seeds of each scene in colour, depth and normals, as seen by an ideal sensor from
the scene's start poses. ``homes``: floor plans, seen from far above without the ceilings, and
views. ``usme``: two frames of each of its sequences. ``arm``: the arm in an episode, seen from
outside by the project's renderer, and its camera's view. No OpenGL is needed.
"""

from __future__ import annotations

import copy
import inspect
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
import tyro
from ms_slam_experiments.arm_masks import floor_below, start_arm
from numpy.typing import NDArray

from ms_slam_env import scenes
from ms_slam_env._runtime.arrays import Float64, Image
from ms_slam_env._runtime.command_line import exit_code, parse
from ms_slam_env._runtime.output_files import check_out_file, check_out_folder, write_bytes
from ms_slam_env._runtime.timings import Timings
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.env.env_config import EnvConfig
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import invert, look_at, transform_points
from ms_slam_env.robot.arm import ArmConfig
from ms_slam_env.robot.arm.arm import KinematicArm
from ms_slam_env.robot.arm.shape import Part, arm_parts, column_parts
from ms_slam_env.scenes import Scene, TexturedMesh
from ms_slam_env.scenes.homes.home import HomeScene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences.usme_suite import SUITE, render

BORDER, TITLE = 4, 18  # pixels


def run_script(
    options: type[Any],
    draw: Callable[[Any], str],
    check_out: Callable[[Path], None] = check_out_file,
    arguments: Sequence[str] | None = None,
) -> int:
    """Draw with options from the command line, parsed as dataclass ``options``; return exit code.

    ``draw`` writes the options' ``out`` and returns a line to print.
    """
    name = f"python -m ms_slam_docs.{Path(inspect.getfile(options)).stem}"

    def run() -> int:
        args: Any = parse(options, arguments, name, check_out)
        print(f"{args.out}: {draw(args)}")
        return 0

    return exit_code(run, name)


def save_image(path: Path, image: Image) -> Path:
    """Write an RGB image (H, W, 3) atomically, as WebP if the name says so, otherwise as PNG."""
    kind = ".webp" if path.suffix == ".webp" else ".png"
    how = {".webp": [cv2.IMWRITE_WEBP_QUALITY, 85], ".png": [cv2.IMWRITE_PNG_COMPRESSION, 9]}
    _, data = cv2.imencode(kind, image[..., ::-1], how[kind])
    write_bytes(path, data.tobytes())
    return path


def titled_row(images: Iterable[Image], title: str) -> Image:
    """RGB images of equal height side by side, with white borders, below a title."""
    framed = [
        cv2.copyMakeBorder(i, 0, BORDER, 0, BORDER, cv2.BORDER_CONSTANT, value=(255,) * 3)
        for i in images
    ]
    strip = np.concatenate(framed, 1)
    head = np.full((TITLE, strip.shape[1], 3), 255, np.uint8)
    at = (2, TITLE - 5)
    cv2.putText(head, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (30, 30, 30), 1, cv2.LINE_AA)
    return np.concatenate([head, strip], 0)


def shrunk(image: Image, width: int) -> Image:
    """An image with aspect ratio 4:3, scaled to another width."""
    size = (width, 3 * width // 4)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


_SCENES = ("living_room", "corridor", "window", "table", "wall", "carpet")
_FAR_M = 4.0  # largest depth drawn
_SHEET_WIDTH = 200  # width of an image, pixels
_STARTS_TRIED = 12


def scenes_picture() -> Image:
    """All procedural scenes, two seeds of each side by side."""

    def row(name: str, seed: int) -> Image:
        images = [shrunk(image, _SHEET_WIDTH) for image in _kinds_of(scenes.make(name, seed))]
        return titled_row(images, f"{name}, seed {seed}: colour, depth, normals")

    return np.concatenate([np.concatenate([row(name, k) for k in (0, 1)], 1) for name in _SCENES])


def _kinds_of(scene: Scene) -> tuple[Image, Image, Image]:
    """Colour, depth and normals (H, W, 3) from the start pose that shows the most objects."""
    sensor = RGBDSensor(scene, xtion("640x480"), noise="none")
    rng = np.random.default_rng(scene.seed)
    seen = [sensor.ground_truth(scene.sample_start(rng)) for _ in range(_STARTS_TRIED)]
    view = max(seen, key=lambda v: len(np.unique(v.labels[::4, ::4])))
    near = 1.0 - np.clip(view.depth / _FAR_M, 0.0, 1.0)
    depth = matplotlib.colormaps["viridis"](near)[..., :3] * 255
    depth[view.depth == 0] = 0
    normals = np.where(view.normals.any(-1, keepdims=True), 0.5 - 0.5 * view.normals, 0.0) * 255
    return view.color, depth.astype(np.uint8), normals.astype(np.uint8)


_HOMES = (2000, 2002)  # seeds
_VIEWS, _VIEW_WIDTH = 6, 180  # views of each home; their width in pixels
_EYE_M = 80.0  # height of the eye above a plan, for a nearly parallel projection
_MARGIN_M = 0.25
_ABOVE = ("ceiling", "lamp")  # last words of the labels that a plan leaves out
_CANDIDATES = 4


def homes_picture() -> Image:
    """Floor plans of homes, each beside two rows of views."""
    rows = []
    columns, height = -(-_VIEWS // 2), 3 * _VIEW_WIDTH // 2
    for seed in _HOMES:
        scene = scenes.make("home", seed)
        assert isinstance(scene, HomeScene)
        small = [shrunk(image, _VIEW_WIDTH) for image in _views_of(scene)]
        lines = [np.concatenate(small[k : k + columns], 1) for k in (0, columns)]
        images = [floor_plan(scene, height * 4 // 3, height), np.concatenate(lines)]
        plan = scene.plan
        title = f"home, seed {seed}: {len(plan.rooms) - 1} rooms and a hall, {plan.area:.0f} m2"
        rows.append(titled_row(images, title))
    return np.concatenate(rows)


def floor_plan(scene: HomeScene, width: int, height: int) -> Image:
    """The rooms from above with their names, (height, width, 3) RGB, y up or to the left."""
    low = np.min([room.low for room in scene.plan.rooms], axis=0) - _MARGIN_M
    high = np.max([room.high for room in scene.plan.rooms], axis=0) + _MARGIN_M
    is_turned = (high - low)[0] < (high - low)[1]
    extent = (high - low)[::-1] if is_turned else high - low
    scale = min(width / extent[0], height / extent[1])  # pixels per metre
    eye = np.eye(4)
    eye[:3, :3] = np.diag([1.0, -1.0, -1.0])
    if is_turned:
        eye[:3, :3] = [[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    eye[:3, 3] = [*(low + high) / 2, _EYE_M]
    focal = scale * _EYE_M
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
    """The scene without ceilings, to look into it from above."""
    mesh = scene.mesh
    above = [k for k, name in enumerate(mesh.labels) if name.split(" ")[-1] in _ABOVE]
    kept = ~np.isin(mesh.face_label, above)
    names = ("faces", "uv", "face_texture", "face_label", "irradiance")
    open_scene = copy.copy(scene)
    fields = {name: getattr(mesh, name)[kept] for name in names}
    open_scene.mesh = replace(mesh, **fields)
    return open_scene


def _views_of(scene: HomeScene) -> list[Image]:
    """Colour images (H, W, 3) from start poses that show many objects, first one per room."""
    sensor = RGBDSensor(scene, xtion("640x480"), noise="none")
    rng = np.random.default_rng(scene.seed)
    by_room: dict[str, list[tuple[int, Image]]] = {}
    for _ in range(_CANDIDATES * _VIEWS):
        pose = scene.sample_start(rng)
        view = sensor.ground_truth(pose)
        shown = len(np.unique(view.labels[::4, ::4]))
        by_room.setdefault(_room_at(scene, pose[:2, 3]), []).append((shown, view.color))
    ranked = [sorted(found, key=lambda one: -one[0]) for found in by_room.values()]
    turns = [(rank, -shown, image) for found in ranked for rank, (shown, image) in enumerate(found)]
    return [image for _, _, image in sorted(turns, key=lambda one: one[:2])[:_VIEWS]]


def _room_at(scene: HomeScene, place: Float64) -> str:
    inside = [r.name for r in scene.plan.rooms if (place > r.low).all() and (place < r.high).all()]
    return inside[0] if inside else ""


_TILES_A_ROW = 4


def usme_picture(seed: int = 2000) -> Image:
    """Two frames, one above the other, of each of the eight USME sequences."""
    made: dict[str, Scene] = {}
    tiles = []
    for entry in SUITE:
        if entry.scene not in made:
            made[entry.scene] = scenes.make(entry.scene, seed)
        frames = render(entry, made[entry.scene], "320x240").frames
        shown = [frames[k].color for k in (len(frames) // 3, int(0.52 * len(frames)))]
        below = [cv2.copyMakeBorder(i, 0, BORDER, 0, 0, cv2.BORDER_CONSTANT, value=(255,) * 3)
                 for i in shown]  # fmt: skip
        tiles.append(titled_row([np.concatenate(below)], entry.name))
    parts = range(0, len(tiles), _TILES_A_ROW)
    return np.concatenate([np.concatenate(tiles[k : k + _TILES_A_ROW], 1) for k in parts])


_ARM_SEEDS = {"table": 1003, "wall": 1002, "carpet": 1004, "living_room": 1000}
"""Scenes and seeds for which the camera sees more than one flat colour."""
_ARM_MOVES, _ARM_WIDTH = 3, 320  # random motions from the start; width of an image in pixels
_FILL = 1.25  # distance of the close view, in diagonals of the box around the arm
_FARTHER_M = 0.9  # additional distance of the far view
_AZIMUTHS, _HEIGHTS = 24, (0.15, 0.45, 0.75)  # viewpoints tried; heights relative to distance
_WALL_GAP_M = 0.15  # distance of a viewpoint from everything
_SMOOTH = 2  # rendered pixels per shown pixel, in each direction
_GAZE_M = 1.0  # the far view includes the point the camera looks at, up to this distance
_HIDDEN_M = 0.1  # a point at most this far behind a surface still counts as visible

LABEL = "arm"
_AMBIENT, _DIRECT, _SECOND = 0.35, 0.65, 0.25
_TO_LIGHT = np.array([0.35, -0.3, 0.89])  # direction to a ceiling lamp, slightly to the side
_TO_SECOND = np.array([-0.8, 0.55, 0.25])  # direction to light from the walls
_BRIGHTNESS = 0.9  # of a white surface facing the light, in units of the sensor's white


def arm_picture(
    seeds: dict[str, int] = _ARM_SEEDS, moves: int = _ARM_MOVES, width: int = _ARM_WIDTH
) -> Image:
    """The arm in each scene and its camera's view, one row per scene."""
    rows = []
    for name, seed in seeds.items():
        scene, rng = scenes.make(name, seed), np.random.default_rng(seed)
        steps = EnvConfig.step_m, EnvConfig.step_rad
        arm = start_arm(KinematicArm(scene, ArmConfig(), *steps, Timings()), rng)
        for _ in range(moves):
            arm.move(int(rng.choice(np.flatnonzero(arm.action_masks()))))
        title = f"{name}, seed {seed}: from afar, from near, what the arm's camera sees"
        rows.append(titled_row(arm_views(scene, arm, width), title))
    return np.concatenate(rows)


def arm_views(scene: Scene, arm: KinematicArm, width: int) -> tuple[Image, Image, Image]:
    """Far and close view of the arm, and its camera's view, each (3/4 width, width, 3)."""
    base = arm.T_world_base[:3, 3]
    parts = arm_parts(arm.model, arm.q, arm.T_world_base)
    shown = scene_with(scene, parts + column_parts(base, floor_below(scene, base)))
    corners = np.concatenate([part.corners.reshape(-1, 3) for part in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    near = _FILL * float(np.linalg.norm(high - low))
    camera = RGBDSensor(scene, xtion("640x480"), noise="none").ground_truth(arm.T_world_camera)
    ahead = float(camera.depth[camera.depth.shape[0] // 2, camera.depth.shape[1] // 2])
    ahead = min(ahead, _GAZE_M) if ahead > 0 else _GAZE_M
    gaze = transform_points(arm.T_world_camera, np.array([[0, 0, ahead]]))[0]
    middle = 0.5 * (low + high)
    afar = 0.5 * (np.minimum(low, gaze) + np.maximum(high, gaze))
    return (
        _view(scene, shown, afar, near + _FARTHER_M, width, gaze),
        _view(scene, shown, middle, near, width, None),
        shrunk(camera.color, width),
    )


def _view(
    scene: Scene, shown: Scene, target: Float64, distance: float, width: int, also: Float64 | None
) -> Image:
    """View of ``target`` (3,) from the side that shows most of the arm, and the point ``also``."""
    angles = np.linspace(0, 2 * np.pi, _AZIMUTHS, endpoint=False)
    offsets = np.array([(np.cos(a), np.sin(a), h) for h in _HEIGHTS for a in angles])
    offsets *= distance / np.linalg.norm(offsets, axis=1, keepdims=True)
    places = target + offsets
    places = places[scene.clearance(places) > _WALL_GAP_M]
    if len(places) == 0:
        raise InputError(f"scene {scene.name!r} has no room to look at the arm from outside")
    poses = [look_at(place, target) for place in places]
    sensor = RGBDSensor(shown, _outside_camera(80), noise="none")
    arm = shown.mesh.labels.index(LABEL)

    def shows(pose: Float64) -> tuple[bool, int]:
        view = sensor.ground_truth(pose)
        other = also is not None and _is_seen(also, pose, sensor.intrinsics, view.depth)
        return other, int((view.labels == arm).sum())

    best = max(poses, key=shows)
    large = RGBDSensor(shown, _outside_camera(_SMOOTH * width), noise="none").ground_truth(best)
    return shrunk(large.color, width)


def _is_seen(point: Float64, pose: Float64, camera: Intrinsics, depth: NDArray[Any]) -> bool:
    """Whether a camera at ``pose`` sees a point (3,) unoccluded and well inside the picture."""
    local = transform_points(invert(pose), point[None])
    if local[0, 2] <= 0:
        return False
    u, v = np.rint(camera.project(local)[0]).astype(int)
    height, width = camera.shape
    inside = width // 8 <= u < width - width // 8 and height // 8 <= v < height - height // 8
    return bool(inside and depth[v, u] > local[0, 2] - _HIDDEN_M)


def _outside_camera(width: int) -> Intrinsics:
    height = 3 * width // 4
    return Intrinsics(width, width, (width - 1) / 2, (height - 1) / 2, width, height)


def scene_with(scene: Scene, parts: list[Part]) -> Scene:
    """A copy of ``scene`` that also shows ``parts``, which cast no shadow.

    Their light is synthetic: a lamp above, light from the side, and ambient light.
    """
    corners = np.concatenate([part.corners for part in parts])
    normals = np.concatenate([part.normals for part in parts])
    counts = [len(part.corners) for part in parts]
    light = _AMBIENT + sum(
        strength * np.clip(normals @ (to / np.linalg.norm(to)), 0, None)
        for strength, to in ((_DIRECT, _TO_LIGHT), (_SECOND, _TO_SECOND))
    )
    mesh = scene.mesh
    count = len(corners)
    faces = np.arange(3 * count, dtype=np.int32).reshape(count, 3) + len(mesh.vertices)
    light = np.repeat(np.asarray(light)[..., None], 3, axis=2) * _BRIGHTNESS / scene.exposure
    textures = [
        np.full((4, 4, 3), np.rint(255 * np.array(part.rgb)), dtype=np.uint8) for part in parts
    ]
    seen = copy.copy(scene)
    seen.mesh = TexturedMesh(
        vertices=np.concatenate([mesh.vertices, corners.reshape(-1, 3).astype(np.float32)]),
        faces=np.concatenate([mesh.faces, faces]),
        uv=np.concatenate([mesh.uv, np.full((count, 3, 2), 0.5, np.float32)]),
        face_texture=np.concatenate(
            [
                mesh.face_texture,
                np.repeat(len(mesh.textures) + np.arange(len(parts)), counts).astype(np.int32),
            ]
        ),
        face_label=np.concatenate(
            [mesh.face_label, np.full(count, len(mesh.labels), dtype=np.int32)]
        ),
        irradiance=np.concatenate([mesh.irradiance, light.astype(np.float32)]),
        textures=(*mesh.textures, *textures),
        labels=(*mesh.labels, LABEL),
    )
    return seen


PICTURES: dict[str, Callable[[], Image]] = {
    "scenes": scenes_picture, "homes": homes_picture, "usme": usme_picture, "arm": arm_picture,
}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Draw the pictures of the pages."""

    names: tyro.conf.Positional[tuple[str, ...]] = tuple(PICTURES)
    """Pictures to draw: scenes, homes, usme, arm."""
    out: Path = Path("docs/pictures")
    """Folder for NAME.webp."""

    def __post_init__(self) -> None:
        """Refuse unknown names of pictures."""
        for name in self.names:
            if name not in PICTURES:
                raise unknown("picture", name, PICTURES)


def save(options: Options) -> str:
    """Write the pictures; return a line that describes them."""
    for name in options.names:
        save_image(options.out / f"{name}.webp", PICTURES[name]())
    return ", ".join(options.names)


if __name__ == "__main__":
    sys.exit(run_script(Options, save, check_out_folder))
