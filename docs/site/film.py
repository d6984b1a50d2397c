"""``python -m ms_slam_docs.film``: show an episode of a planner as an animation.

Without options, it makes the picture at the top of the README: a planner explores a home. With
``--gallery``, it makes the films of the gallery, one episode of each id.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import cv2
import gymnasium
import numpy as np
from ms_slam_docs.stills import Image, run_script
from numpy.typing import NDArray
from PIL import Image as Pillow

from ms_slam_env import ENV_IDS, PERTURBED_ENV_IDS
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env._runtime.progress import Bar
from ms_slam_env.config import Checked, bounded, chosen, free_options
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.planners import Planner, goal_of, make_planner, planner_observation
from ms_slam_env.env.rendering import PANEL, caption, draw_color, draw_depth
from ms_slam_env.env.third_person_view import (
    ESTIMATE_COLOR,
    TRUE_COLOR,
    arm_dots,
    camera_of,
    draw_from,
    is_low,
    point_of_view,
)
from ms_slam_env.errors import InputError
from ms_slam_env.planning.occupancy_grid import OccupancyGrid
from ms_slam_env.scenes.scene import Scene, floor_height

_SIZE = (560, 480)  # width and height of the map
_MARGIN_M = 0.2
_BETWEEN_M = (0.3, 1.8)  # heights above the floor that are drawn in the plan
_UNKNOWN, _FREE, _OCCUPIED = (216, 218, 222), (255, 255, 255), (60, 66, 82)
_GOAL_COLOR = (40, 90, 220)


class EpisodeView:
    """Draws the moments of an episode, in this class like ``render()``.

    Args:
        env: the unwrapped environment, after its reset.
        planner: planner that plays the episode.
    """

    def __init__(self, env: ActiveSlamEnv, planner: Planner) -> None:
        self.env, self.planner = env, planner

    def see(self) -> None:
        """Update the view; call it once after each step."""

    def draw(self) -> Image:
        """The current moment, (H, W, 3) RGB."""
        return np.asarray(self.env.render(), dtype=np.uint8)


class CameraView(EpisodeView):
    """The newest colour and depth image."""

    def draw(self) -> Image:
        """Both side by side, (240, 640, 3) RGB."""
        episode = self.env.episode
        return np.hstack([draw_color(episode, self.env.scene), draw_depth(episode)])


class ExplorationView(EpisodeView):
    """The camera's view, the known space, and the growing map, seen from a fixed place.

    The longer side of the scene lies across the picture. The plan is carved from the depth images
    at their estimated poses, independently of the planner's own map.
    """

    def __init__(self, env: ActiveSlamEnv, planner: Planner) -> None:
        super().__init__(env, planner)
        self.grid = OccupancyGrid()
        low, high = bounds_of_inside(env.scene)
        is_long = high[0] - low[0] >= high[1] - low[1]
        ahead = np.array([0.0, 1.0, 0.0] if is_long else [-1.0, 0.0, 0.0])
        box = np.stack(np.meshgrid(*np.array([low, high]).T), axis=-1).reshape(-1, 3)
        self.camera = camera_of(*_SIZE)
        self.pose = point_of_view(ahead, np.zeros((0, 3)), box, self.camera)
        self.plan = Plan(box, ahead, low[2])
        self.see()

    def see(self) -> None:
        """Add the newest frame to the known space."""
        episode = self.env.episode
        if episode.tracking_ok:
            pose = episode.T_world_camera_estimate
            self.grid.integrate(episode.last_frame.depth, pose, self.env.intrinsics)

    def draw(self) -> Image:
        """All three, (480, 880, 3) RGB."""
        env, episode = self.env, self.env.episode
        plan = self.plan.draw(self.grid)
        for path, color, width in (
            (episode.trajectory_truth, TRUE_COLOR, 4),
            (episode.trajectory_estimate, ESTIMATE_COLOR, 1),
        ):
            line = self.plan.pixels(path[:, :3, 3])
            cv2.polylines(plan, [line], False, color, width, cv2.LINE_AA)
        cv2.circle(plan, line[-1].tolist(), 4, ESTIMATE_COLOR, -1, cv2.LINE_AA)
        goal = goal_of(self.planner)
        if goal is not None:
            (at,) = self.plan.pixels(goal[None, :3, 3]).tolist()
            cv2.circle(plan, at, 5, _GOAL_COLOR, 2, cv2.LINE_AA)
        caption(plan, "space known to be free or occupied; blue: its goal")
        left = np.vstack([draw_color(episode, env.scene), plan])
        mapped = f"{100 * env.coverage.mapped_share:.0f} % of the surface mapped"
        text = f"{mapped}, ATE {100 * episode.ate:.1f} cm; path: true green, estimated red"
        return np.hstack([left, caption(self._map(), text)])

    def _map(self) -> Image:
        """The map without surfaces seen from behind, so that walls and ceilings hide no room."""
        slam, episode = self.env.slam, self.env.episode
        points = slam.surface_points()
        shown = is_low(points, episode)
        normals = slam.map_attributes().get("normal")
        if normals is not None:
            shown &= ((self.pose[:3, 3] - points) * normals).sum(axis=1) > 0
        arm = arm_dots(self.env.embodiment, self.env.scene)
        colors = slam.surface_colors()[shown]
        return draw_from(self.camera, self.pose, episode, points[shown], colors, arm)


class Plan:
    """Draws the cells of a grid within a box from above.

    Args:
        box: (8, 3) corners of the box, metres.
        ahead: (3,) horizontal direction that points up in the picture.
        floor_m: height of the floor.
    """

    def __init__(self, box: Float64, ahead: Float64, floor_m: float) -> None:
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        self.axes = np.stack([right, -ahead])  # of the picture: across, down
        self.floor_m = floor_m
        spread = box @ self.axes.T
        self.low, high = spread.min(axis=0) - _MARGIN_M, spread.max(axis=0) + _MARGIN_M
        height, width = PANEL
        extent = high - self.low
        self.m_per_pixel = float(max(extent / [width, height - 20]))  # below the caption
        self.low -= ([width, height + 20] * np.array(self.m_per_pixel) - extent) / 2

    def pixels(self, points: Float64) -> NDArray[np.int32]:
        """Pixels (N, 2) of points (N, 3)."""
        return np.rint((points @ self.axes.T - self.low) / self.m_per_pixel).astype(np.int32)

    def draw(self, grid: OccupancyGrid) -> Image:
        """Picture of free, occupied and unknown space, (240, 320, 3) RGB."""
        height, width = PANEL
        down, across = np.mgrid[:height, :width]
        level = (np.stack([across, down], axis=-1) * self.m_per_pixel + self.low) @ self.axes
        heights = np.arange(*_BETWEEN_M, grid.cell_m) + self.floor_m
        states = np.zeros((3, height, width), dtype=bool)
        for z in heights:
            level[..., 2] = z
            found = grid.states_of(level.reshape(-1, 3)).reshape(height, width)
            states |= found == np.arange(3)[:, None, None]
        image = np.full((height, width, 3), _UNKNOWN, np.uint8)
        image[states[1]] = _FREE
        image[states[2]] = _OCCUPIED
        return image


def bounds_of_inside(scene: Scene) -> tuple[Float64, Float64]:
    """Corners (3,) of the box around a scene, from its floor to the height of a camera."""
    low, high = scene.bounds()
    low[2] = floor_height(scene)
    high[2] = min(high[2], low[2] + _BETWEEN_M[1])
    return low, high


VIEWS = {"exploration": ExplorationView, "moment": EpisodeView, "camera": CameraView}
"""Name to view."""


_FORMATS = (".webp", ".gif")
_QUALITIES = (80, 65, 50, 40, 30, 20)  # of WebP, tried until the file is small enough
_LAST_MS = 2500  # how long the last picture is shown


@dataclass(frozen=True)
class Options(Checked):
    """Show an episode of a planner as an animated WebP or GIF."""

    out: Path = Path("docs/pictures/home.webp")
    """File to write, .webp or .gif."""
    planner: str = "nbv"
    """NAME or module:Class, options appended as in agent-room,deterministic=true."""
    env_id: str = "MSActiveSLAM-Home-v0"
    """Id of the environment or task."""
    view: str = chosen("exploration", *VIEWS)
    """exploration: the map from a fixed place, and the known space; moment: what render() draws;
    camera: its colour and depth images."""
    scene: str | None = None
    """Scene; by default the id's own."""
    scene_seed: int = bounded(2000, 0, 2**31)
    """Seed of the scene."""
    seed: int = bounded(2000, 0, 2**31)
    """Seed of start pose, noise and planner."""
    steps: int = bounded(300, 1, 100_000)
    """Largest number of steps of the episode."""
    every: int = bounded(5, 1, 1000)
    """Number of steps between pictures."""
    options: tuple[str, ...] = ()
    """Further options of the environment, as name=value."""
    width: int = bounded(800, 64, 4096)
    """Width of the picture in pixels."""
    picture_ms: int = bounded(150, 20, 10_000)
    """Time in milliseconds that each picture is shown."""
    most_kb: int = bounded(600, 10, 100_000)
    """Largest file size in kB; the quality of a WebP is reduced to reach it."""
    gallery: bool = False
    """Film an episode of each id, into environments/ID.webp beside OUT."""

    def __post_init__(self) -> None:
        """Refuse values out of range and other formats."""
        super().__post_init__()
        if self.out.suffix not in _FORMATS:
            raise InputError(f"{self.out} is neither {' nor '.join(_FORMATS)}")


def save_film(options: Options) -> str:
    """Play the episode and write the file; return a line that describes it."""
    scene: dict[str, Any] = {} if options.scene is None else {"scene": options.scene}
    env = gymnasium.make(
        options.env_id,
        max_episode_steps=options.steps,
        scene_seed=options.scene_seed,
        render_mode="rgb_array",
        observation=planner_observation(options.planner),
        **scene,
        **free_options(options.options, ("scene", "scene_seed", "observation", "render_mode")),
    )
    try:
        pictures = [narrowed(picture, options.width) for picture in play(env, options)]
        ate_m = cast(ActiveSlamEnv, env.unwrapped).episode.ate
    finally:
        env.close()
    data = encoded(pictures, options)
    write_bytes(options.out, data)
    return f"{len(pictures)} pictures, {len(data) / 1000:.0f} kB, ATE {1e3 * ate_m:.1f} mm"


def play(env: gymnasium.Env[Any, Any], options: Options) -> Iterator[Image]:
    """Pictures of the start, of every ``options.every``-th step, and of the end."""
    world = cast(ActiveSlamEnv, env.unwrapped)
    observation, info = env.reset(seed=options.seed)
    planner = make_planner(options.planner, world, seed=options.seed)
    planner.reset()
    view = VIEWS[options.view](world, planner)
    yield view.draw()
    for step in Bar(range(1, options.steps + 1), options.planner, unit="step"):
        action = planner.act(observation, planner.known(info))
        observation, _, terminated, truncated, info = env.step(action)
        view.see()
        is_over = terminated or truncated
        if is_over or step % options.every == 0:
            yield view.draw()
        if is_over:
            return


def narrowed(picture: Image, width: int) -> Image:
    """A picture (H, W, 3) scaled to another width."""
    height = round(picture.shape[0] * width / picture.shape[1])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def encoded(pictures: Sequence[Image], options: Options) -> bytes:
    """The film as file content, at the best quality that the size limit allows.

    Raises:
        InputError: it is too large at every quality.
    """
    first, *rest = map(Pillow.fromarray, pictures)
    pauses = [*[options.picture_ms] * len(rest), _LAST_MS]
    kind = options.out.suffix[1:]
    for quality in _QUALITIES if kind == "webp" else _QUALITIES[:1]:
        file = io.BytesIO()
        first.save(file, kind, save_all=True, append_images=rest, duration=pauses, loop=0,
                   quality=quality, method=4)  # fmt: skip
        if file.tell() <= 1000 * options.most_kb:
            return file.getvalue()
    size = f"{file.tell() / 1000:.0f} kB"
    raise InputError(f"{options.out} would have {size}: take fewer steps, --every or --width")


SHOWN_IDS = (*ENV_IDS, *(name for name in PERTURBED_ENV_IDS if "-FreeCamera-" in name))
"""Ids in the gallery; an imperfect camera takes the same pictures with every embodiment."""
_PLANNERS = {"MSActiveSLAM-FixedTranslation-v0": "greedy", "MSActiveSLAM-Adaptive-v0": "random"}
_SCENES = {"MSActiveSLAM-v0": "table"}


def gallery_film(env_id: str, folder: Path) -> Options:
    """Options to film an episode of an id: as in `render()`, or the images of a bad camera."""
    plain = Options(
        out=folder / f"{env_id}.webp",
        planner=_PLANNERS.get(env_id, "nbv"),
        env_id=env_id,
        view="moment",
        scene=_SCENES.get(env_id, "living_room"),
        steps=40,
        every=2,
        width=640,
        picture_ms=300,
        most_kb=200,
    )
    if env_id in ENV_IDS:
        return plain
    camera = replace(plain, view="camera", steps=24, width=400, most_kb=170)
    return replace(camera, every=1, picture_ms=150)


def draw(options: Options) -> str:
    """Write the film, or the films of the gallery; return a line that describes them."""
    if not options.gallery:
        return save_film(options)
    folder = options.out.parent / "environments"
    for env_id in SHOWN_IDS:
        print(f"{env_id}: {save_film(gallery_film(env_id, folder))}")
    return f"{len(SHOWN_IDS)} films in {folder}"


if __name__ == "__main__":
    sys.exit(run_script(Options, draw))
