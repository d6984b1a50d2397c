"""What a film shows of an episode: the moment, the camera's images, or how it explores."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from ms_slam_experiments.pictures.drawing import Image
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.env.planners import Planner, goal_of
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
from ms_slam_env.planning.occupancy_grid import OccupancyGrid
from ms_slam_env.scenes.base import Scene, floor_height

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv


_SIZE = (560, 480)  # width and height of the map
_MARGIN_M = 0.2
_BETWEEN_M = (0.3, 1.8)  # above the floor: what stands there is drawn in the plan
_UNKNOWN, _FREE, _OCCUPIED = (216, 218, 222), (255, 255, 255), (60, 66, 82)
_GOAL_COLOR = (40, 90, 220)


class EpisodeView:
    """Draws the moments of an episode, here as ``render()`` does.

    Args:
        env: the unwrapped environment, after its reset.
        planner: whose episode it is.
    """

    def __init__(self, env: ActiveSlamEnv, planner: Planner) -> None:
        self.env, self.planner = env, planner

    def see(self) -> None:
        """Take note of a step; once after each."""

    def draw(self) -> Image:
        """The present moment, (H, W, 3) RGB."""
        return np.asarray(self.env.render(), dtype=np.uint8)


class CameraView(EpisodeView):
    """The newest colour and depth image."""

    def draw(self) -> Image:
        """Both side by side, (240, 640, 3) RGB."""
        episode = self.env.episode
        return np.hstack([draw_color(episode, self.env.scene), draw_depth(episode)])


class ExplorationView(EpisodeView):
    """What the camera sees, the space that is known, and the map growing, all from one place.

    The longer side of the scene lies across the picture. The plan is carved from the depth images
    where SLAM believes that they were taken, whatever the planner keeps itself.
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
        """Add the newest frame to the space that is known."""
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
        """The map without what is seen from behind, so that walls and ceilings hide no room."""
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
    """The cells of a grid from above, in the picture of a box.

    Args:
        box: (8, 3) its corners, metres.
        ahead: (3,) level direction that is up in the picture.
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
        """Where points (N, 3) are in the picture, (N, 2)."""
        return np.rint((points @ self.axes.T - self.low) / self.m_per_pixel).astype(np.int32)

    def draw(self, grid: OccupancyGrid) -> Image:
        """What is free, occupied and unknown, (240, 320, 3) RGB."""
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
