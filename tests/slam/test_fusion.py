"""Fusion and rendering of surfels against slow, obvious versions."""

from __future__ import annotations

import numpy as np
import pytest
from surfel_scenes import (
    SMALL,
    WALL_NORMAL,
    WALL_POINT,
    build_map,
    device_poses,
    fuse,
    live_frame,
    ray_cast,
)

from ms_slam_env.geometry import invert, make_pose, so3_exp, transform_points
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap

NEARBY = np.stack(
    [
        make_pose(so3_exp([0.01 * k, -0.02 * k, 0.015 * k]), [0.02 * k, -0.01 * k, 0.01 * k])
        for k in range(6)
    ]
)


def radial_weight(u: float, v: float) -> float:
    x, y = u - (SMALL.width - 1) / 2, v - (SMALL.height - 1) / 2
    gamma = np.hypot(x, y) / (np.hypot(SMALL.width, SMALL.height) / 2)
    return float(np.exp(-(gamma**2) / (2 * 0.6**2)))


def new_radius(z: float, normal: np.ndarray, point: np.ndarray, config: SurfelConfig) -> float:
    cosine = -normal @ point / np.linalg.norm(point)
    return config.surfel_radius_px * z / (SMALL.fx * max(cosine, 0.3))


def slow_fuse(
    surfels: dict[str, np.ndarray], frame: tuple[np.ndarray, ...], T: np.ndarray, time: int
) -> dict[str, np.ndarray]:
    """One frame fused surfel by surfel, then pixel by pixel; without compaction."""
    config = SurfelConfig()
    vertices, normals, colors = frame
    height, width = SMALL.shape
    covered = np.zeros((height, width), dtype=bool)
    out = {name: [np.array(x) for x in values] for name, values in surfels.items()}
    R = T[:3, :3]
    for i in range(len(out["radius"])):
        p = transform_points(invert(T), out["position"][i])
        n = out["normal"][i] @ R
        if not 0.05 < p[2] < 12 or n @ p >= 0 or out["confidence"][i] <= 0:
            continue
        u, v = SMALL.project(p)
        if not (-0.5 < u < width - 0.5 and -0.5 < v < height - 0.5):
            continue
        u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
        u0, v0 = min(int(u), width - 2), min(int(v), height - 2)
        tolerance = config.fusion_distance_m * (0.7 + 0.3 * p[2] ** 2)
        weights, shifts, tints, behind = [], [], [], 0
        for y in (v0, v0 + 1):
            for x in (u0, u0 + 1):
                if vertices[y, x, 2] <= 0:
                    continue
                d = vertices[y, x] - p
                if abs(n @ d) < tolerance and abs(d[2]) < 3 * tolerance:
                    weights.append((1 - abs(x - u)) * (1 - abs(y - v)))
                    shifts.append(n @ d)
                    tints.append(colors[y, x])
                    covered[y, x] |= np.hypot(x - u, y - v) < config.coverage_px
                elif d[2] > 3 * tolerance:
                    behind += 1
        c = out["confidence"][i]
        if behind == 4:
            c = 0.5 * c - 0.5
        elif sum(weights) > 0.25:
            out["seen"][i] = time
            nearest = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
            live = normals[nearest[1], nearest[0]]
            alpha = radial_weight(*nearest)
            if live @ n > np.cos(np.radians(config.fusion_angle_deg)):
                radius = new_radius(p[2], live, p, config)
                if radius < 1.5 * out["radius"][i]:
                    a, b = c / (c + alpha), alpha / (c + alpha)
                    moved = p + b * np.average(shifts, weights=weights) * n
                    turned = a * n + b * live
                    out["position"][i] = transform_points(T, moved)
                    out["normal"][i] = R @ turned / np.linalg.norm(turned)
                    out["color"][i] = a * out["color"][i] + b * np.average(
                        tints, axis=0, weights=weights
                    )
                    out["radius"][i] = a * out["radius"][i] + b * radius
                c = min(c + alpha, config.max_confidence)
            elif live @ live > 0:
                c -= 0.5 * alpha
        out["confidence"][i] = max(c, 0.0)
    for v in range(height):
        for u in range(width):
            p, n = vertices[v, u], normals[v, u]
            if not covered[v, u] and p[2] > 0 and n @ p < 0:
                out["position"].append(transform_points(T, p))
                out["normal"].append(R @ n)
                out["color"].append(colors[v, u])
                out["radius"].append(new_radius(p[2], n, p, config))
                out["confidence"].append(radial_weight(u, v))
                out["created"].append(time)
                out["seen"].append(time)
    return {name: np.array(values) for name, values in out.items()}


def test_one_frame_is_fused_like_the_slow_version_does_it() -> None:
    surfel_map = build_map(NEARBY[:2], noise_m=0.004)
    state = surfel_map.get_state()
    before = state["surfels"][0]
    rng = np.random.default_rng(5)
    # Floating points before the surface and turned normals, so that every branch is taken.
    before["position"][::17, 2] -= 0.5
    before["normal"][5::23] = [0.8, 0.0, -0.6]
    surfel_map.set_state(state)
    T = NEARBY[3]
    live = live_frame(T[None], noise_m=0.004, rng=rng)
    frame = tuple(a.numpy()[0].astype(float) for a in (live.vertices, live.normals, live.color))
    expected = slow_fuse(before, frame, T, 7)
    fuse(surfel_map, live, T[None], 7)
    result = surfel_map.get_state()["surfels"][0]
    assert (expected["confidence"] == 0).any()  # some died
    assert len(expected["radius"]) > len(before["radius"])  # some were added
    for name, values in expected.items():
        np.testing.assert_allclose(result[name], values, rtol=2e-4, atol=2e-4, err_msg=name)
    dead = int((expected["confidence"] == 0).sum())
    assert surfel_map.count() == len(expected["radius"]) - dead


def test_repeated_noisy_frames_keep_the_map_small_and_average_the_noise() -> None:
    noise = 0.006
    counts, errors = [], []
    surfel_map = SurfelMap(1, SMALL, SurfelConfig(max_surfels=20_000))
    rng = np.random.default_rng(0)
    for time in range(20):
        live = live_frame(np.eye(4)[None], noise_m=noise, rng=rng, box=False)
        fuse(surfel_map, live, np.eye(4)[None], time)
        points = surfel_map.points(stable=False)
        errors.append(np.std((points - WALL_POINT) @ WALL_NORMAL))
        counts.append(surfel_map.count())
    assert counts[0] == SMALL.width * SMALL.height
    assert counts[-1] <= 1.01 * counts[0]
    along_normal = noise * abs(WALL_NORMAL[2])
    assert errors[0] == pytest.approx(along_normal, rel=0.15)
    assert errors[-1] == pytest.approx(along_normal / np.sqrt(20), rel=0.3)


def test_a_second_pass_over_a_path_adds_hardly_any_surfel() -> None:
    there_and_back = np.concatenate([NEARBY, NEARBY[::-1]])
    surfel_map = build_map(there_and_back, noise_m=0.005)
    first = surfel_map.count()
    rng = np.random.default_rng(9)
    for time, pose in enumerate(there_and_back, start=len(there_and_back)):
        fuse(surfel_map, live_frame(pose[None], noise_m=0.005, rng=rng), pose[None], time)
    assert surfel_map.count() < 1.05 * first


def test_a_point_floating_in_free_space_disappears() -> None:
    surfel_map = build_map(NEARBY[:1])
    box = ray_cast(NEARBY[0], SMALL)[0] < 1.3
    assert box.sum() > 50
    for time in range(1, 12):
        live = live_frame(np.eye(4)[None], box=False)
        fuse(surfel_map, live, np.eye(4)[None], time)
    distance = np.abs((surfel_map.points(stable=False) - WALL_POINT) @ WALL_NORMAL)
    assert distance.max() < 0.01


def test_a_masked_env_keeps_its_map() -> None:
    surfel_map = SurfelMap(2, SMALL, SurfelConfig(max_surfels=5000))
    poses = np.stack([np.eye(4)] * 2)
    fuse(surfel_map, live_frame(poses), poses, 0)
    before = surfel_map.get_state()
    fuse(surfel_map, live_frame(poses), poses, 1, mask=np.array([0, 1]))
    after = surfel_map.get_state()
    for name, values in before["surfels"][0].items():
        np.testing.assert_array_equal(values, after["surfels"][0][name])
    assert (after["surfels"][1]["seen"] == 1).all()


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
