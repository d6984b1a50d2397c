"""Rendering of surfels against a slow, obvious version and closed forms."""

from __future__ import annotations

import numpy as np
from surfel_scenes import SMALL, WALL_NORMAL, build_map, device_poses, ray_cast

from ms_slam_env.geometry import invert, make_pose, so3_exp, transform_points
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap

CLOSE = np.stack([make_pose(so3_exp([0, 0.01 * k, 0]), [0.01 * k, 0, 0]) for k in range(5)])
LUMA = np.array([0.299, 0.587, 0.114])
MIN_PX, MAX_PX, MAX_WEIGHT = 0.6, 5.0, 20.0


def tolerance(z: float) -> float:
    return SurfelConfig().fusion_distance_m * (0.7 + 0.3 * z * z)


def slow_render(state: dict[str, np.ndarray], T: np.ndarray) -> dict[str, np.ndarray]:
    """Ray-disc intersections of all pixels with all surfels, front surface averaged."""
    T_camera_world = invert(T)
    positions = transform_points(T_camera_world, state["position"])
    normals = state["normal"] @ T[:3, :3]
    usable = (positions[:, 2] > 0.05) & (np.sum(positions * normals, 1) < 0)
    usable &= state["confidence"] > 0
    positions, normals = positions[usable], normals[usable]
    colors, confidence = state["color"][usable], state["confidence"][usable]
    pixel = positions[:, 2] / SMALL.fx
    radius = np.clip(state["radius"][usable], MIN_PX * pixel, MAX_PX * pixel)
    image = {
        "depth": np.zeros(SMALL.shape),
        "normals": np.zeros((*SMALL.shape, 3)),
        "color": np.zeros((*SMALL.shape, 3)),
    }
    rays = SMALL.rays()
    for v in range(SMALL.height):
        for u in range(SMALL.width):
            slope = normals @ rays[v, u]
            with np.errstate(divide="ignore"):
                z = np.sum(normals * positions, 1) / slope
            offset = np.linalg.norm(z[:, None] * rays[v, u] - positions, axis=1)
            hit = (slope < 0) & (offset <= radius)
            if not hit.any():
                continue
            front = z[hit].min()
            drawn = hit & (z <= front + tolerance(front))
            w = np.minimum(confidence, MAX_WEIGHT) * (1.05 - (offset / radius) ** 2) * drawn
            image["depth"][v, u] = np.sum(w * np.where(drawn, z, 0)) / w.sum()
            n = w @ normals
            image["normals"][v, u] = n / np.linalg.norm(n)
            image["color"][v, u] = w @ colors / w.sum()
    return image


def render(surfel_map: SurfelMap, T: np.ndarray) -> dict[str, np.ndarray]:
    view = surfel_map.render_model(device_poses(T[None]))
    return {
        "depth": view.vertices.numpy()[0, ..., 2],
        "vertices": view.vertices.numpy()[0],
        "normals": view.normals.numpy()[0],
        "color": view.color.numpy()[0],
        "intensity": view.intensity.numpy()[0],
    }


def test_rendering_agrees_with_the_slow_version() -> None:
    surfel_map = build_map(CLOSE, noise_m=0.003)
    T = make_pose(so3_exp([0.05, -0.08, 0.2]), [0.05, -0.1, 0.2])
    expected = slow_render(surfel_map.get_state()["surfels"][0], T)
    result = render(surfel_map, T)
    both = (expected["depth"] > 0) & (result["depth"] > 0)
    # The rims of discs are tested to first order, so single pixels at them may differ.
    assert ((expected["depth"] > 0) == (result["depth"] > 0)).mean() > 0.99
    same = both & (np.abs(expected["depth"] - result["depth"]) < 2e-3)
    assert same.sum() > 0.99 * both.sum()
    close = np.abs(expected["color"] - result["color"])[same]
    assert np.quantile(close, 0.97) < 1.5
    angle = np.sum(expected["normals"] * result["normals"], -1)[same]
    assert np.quantile(angle, 0.01) > 1 - 1e-3


def test_the_view_of_a_clean_map_is_the_scene() -> None:
    surfel_map = build_map(CLOSE)
    T = make_pose(so3_exp([0.0, 0.02, 0.03]), [0.015, 0.01, 0.02])
    depth, normals, color = ray_cast(T, SMALL)
    result = render(surfel_map, T)
    inner = np.zeros(SMALL.shape, dtype=bool)
    inner[3:-3, 3:-3] = True
    assert (result["depth"][inner] > 0).mean() > 0.99  # the rim of the box may show holes
    error = np.abs(result["depth"] - depth)[inner & (result["depth"] > 0)]
    assert np.quantile(error, 0.9) < 1e-4  # planes are rendered exactly
    assert (error < 0.01).mean() > 0.95  # the discs of the box's edge hang over by half a pixel
    wall = inner & (depth > 1.5) & (np.abs(result["depth"] - depth) < 0.01)
    turned = np.abs(result["normals"] - normals)[wall].max(-1)
    assert (turned < 1e-3).mean() > 0.97  # the rest had mixed with the box's edge
    # Averaging neighbours blurs the texture a little.
    assert np.abs(result["intensity"] - color @ LUMA)[wall].mean() < 1.0
    rays = SMALL.rays()
    np.testing.assert_allclose(
        result["vertices"], rays * result["depth"][..., None], rtol=1e-5, atol=1e-5
    )


def test_a_single_disc_covers_its_ellipse_and_lies_in_its_plane() -> None:
    surfel_map = SurfelMap(1, SMALL, SurfelConfig(max_surfels=1000))
    state = surfel_map.get_state()
    state["counters"]["count"][0] = 1
    centre, radius = np.array([0.05, -0.03, 1.5]), 0.12
    state["surfels"][0] = {
        "position": centre[None].astype(np.float32),
        "normal": WALL_NORMAL[None].astype(np.float32),
        "color": np.float32([[10, 200, 30]]),
        "radius": np.float32([radius]),
        "confidence": np.float32([1]),
        "created": np.int32([0]),
        "seen": np.int32([0]),
    }
    surfel_map.set_state(state)
    result = render(surfel_map, np.eye(4))
    rays = SMALL.rays()
    z = (centre @ WALL_NORMAL) / (rays @ WALL_NORMAL)
    offset = np.linalg.norm(z[..., None] * rays - centre, axis=-1)
    assert (result["depth"][offset < 0.95 * radius] > 0).all()
    assert (result["depth"][offset > 1.05 * radius] == 0).all()
    drawn = result["depth"] > 0
    np.testing.assert_allclose(result["depth"][drawn], z[drawn], rtol=1e-5)
    np.testing.assert_allclose(result["color"][drawn], [[10, 200, 30]] * drawn.sum(), rtol=1e-5)


def test_surfels_facing_away_or_behind_are_not_drawn() -> None:
    surfel_map = build_map(CLOSE[:1])
    behind_the_wall = make_pose(so3_exp([0.0, np.pi, 0.0]), [0.0, 0.0, 4.0])
    assert (render(surfel_map, behind_the_wall)["depth"] == 0).all()
    looking_away = make_pose(so3_exp([0.0, np.pi, 0.0]), [0.0, 0.0, 0.0])
    assert (render(surfel_map, looking_away)["depth"] == 0).all()
