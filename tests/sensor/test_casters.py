"""Ray casting: both casters against each other and against closed forms."""

import dataclasses

import numpy as np
import pytest
from box_scene import ROOM_HIGH, ROOM_LOW, BoxScene
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.geometry import look_at, se3_exp
from ms_slam_env.sensor import (
    EmbreeRayCaster,
    RGBDSensor,
    WarpRayCaster,
    casters,
    embree,
)
from ms_slam_env.sensor.embree_single import EmbreeSingleRayCaster
from ms_slam_env.sensor.rays import make_hits, make_pinhole

SMALL = xtion("80x60")


@pytest.fixture(scope="module")
def sensors(box_scene: BoxScene) -> tuple[RGBDSensor, RGBDSensor]:
    return (
        RGBDSensor(box_scene, SMALL, noise="none", caster=EmbreeRayCaster(box_scene.mesh)),
        RGBDSensor(box_scene, SMALL, noise="none", caster=WarpRayCaster(box_scene.mesh, "cpu")),
    )


def analytic_depth(T: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Depth of the empty room, by the slab method: the nearest of the six planes ahead."""
    directions = rays @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        exits = np.maximum((ROOM_LOW - T[:3, 3]) / directions, (ROOM_HIGH - T[:3, 3]) / directions)
    return exits.min(axis=-1)


@settings(max_examples=30, deadline=None)
@given(
    eye=st.tuples(st.floats(-1.5, -0.5), st.floats(-1.5, 0.5), st.floats(0.5, 2.0)),
    yaw=st.floats(0, 6.28),
    pitch=st.floats(-1.2, 1.2),
)
def test_depth_of_the_walls_is_that_of_a_box(sensors, eye, yaw, pitch) -> None:
    direction = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)]
    T = look_at(eye, np.add(eye, direction))
    view = sensors[0].ground_truth(T)
    walls = view.labels == 0
    np.testing.assert_allclose(
        view.depth[walls], analytic_depth(T, SMALL.rays())[walls], rtol=1e-5, atol=1e-5
    )
    # Boxes only come nearer; where one meets the wall, both are equally near.
    assert (view.depth[~walls] < analytic_depth(T, SMALL.rays())[~walls] * (1 + 1e-5)).all()


@pytest.mark.parametrize("seed", range(5))
def test_casters_agree(sensors, box_scene: BoxScene, seed: int) -> None:
    T = box_scene.sample_start(np.random.default_rng(seed))
    embree, warp = (sensor.ground_truth(T) for sensor in sensors)
    same = embree.labels == warp.labels
    assert same.mean() > 0.995  # a ray along an edge may take either side
    np.testing.assert_allclose(embree.depth[same], warp.depth[same], rtol=1e-4)
    difference = np.abs(embree.color[same].astype(int) - warp.color[same])
    assert np.percentile(difference, 99) <= 1


@pytest.mark.parametrize("height", [60, 59])
def test_casters_agree_on_a_rolling_image(box_scene: BoxScene, height: int) -> None:
    """Every two rows have a pose of their own, whoever casts the rays."""
    camera = dataclasses.replace(SMALL, height=height)
    mesh = box_scene.mesh
    kinds = (EmbreeRayCaster(mesh), EmbreeSingleRayCaster(mesh), WarpRayCaster(mesh, "cpu"))
    T = box_scene.sample_start(np.random.default_rng(1))
    twists = np.linspace(-0.02, 0.02, 30)
    poses = np.stack([T @ se3_exp([s, 0, 0, 0, 2 * s, 0]) for s in twists])
    rolling = [
        RGBDSensor(box_scene, camera, noise="none", caster=caster).capture_rolling(poses, 0)
        for caster in kinds
    ]
    plain = RGBDSensor(box_scene, camera, noise="none", caster=kinds[0])
    for row in (0, 1, 28, height - 1):
        expected = plain.capture(poses[row // 2], 0)
        for frame in rolling:
            near = np.abs(frame.depth[row] - expected.depth[row]) < 1e-3 * expected.depth[row]
            assert near.mean() > 0.98  # a ray along an edge may take either side
            difference = np.abs(frame.color[row].astype(int) - expected.color[row])
            assert np.percentile(difference, 98) <= 1


@pytest.mark.parametrize("size", [(80, 60), (37, 23), (3, 1)])
def test_packets_meet_what_single_rays_meet(box_scene: BoxScene, size: tuple[int, int]) -> None:
    """Also where the tiles of a packet stick out of the image."""
    width, height = size
    camera = Intrinsics(70.0, 70.0, width / 2 - 0.5, height / 2 - 0.5, width, height)
    packets = RGBDSensor(box_scene, camera, caster=EmbreeRayCaster(box_scene.mesh))
    single = RGBDSensor(box_scene, camera, caster=EmbreeSingleRayCaster(box_scene.mesh))
    for seed in range(4):
        T = box_scene.sample_start(np.random.default_rng(seed))
        a, b = packets.ground_truth(T), single.ground_truth(T)
        np.testing.assert_allclose(a.depth, b.depth, rtol=1e-6)  # single rays: Embree's own
        assert (a.labels == b.labels).mean() > 0.999  # on a shared edge either face is right
        noisy = packets.capture(T, seed), single.capture(T, seed)
        assert np.isclose(noisy[0].depth, noisy[1].depth, rtol=1e-6).mean() > 0.999


@pytest.mark.parametrize("isa", ["sse2", "avx"])
def test_hits_of_packets_do_not_depend_on_the_processor(
    box_scene: BoxScene, isa: str, monkeypatch
) -> None:
    """Embree with another instruction set: other reciprocals, the same hits to the last bit."""
    hits = []
    for device in (embree.DEVICE, f"threads=1,isa={isa}".encode()):
        monkeypatch.setattr(embree, "DEVICE", device)
        caster = EmbreeRayCaster(box_scene.mesh)
        found = make_hits(SMALL.width * SMALL.height, "cpu")
        T = box_scene.sample_start(np.random.default_rng(2)).astype(np.float32)
        poses = wp.array(T[None], dtype=wp.mat44, device="cpu")
        caster.bind(poses, make_pinhole(SMALL), found, (1, SMALL.height, SMALL.width))()
        hits.append([a.numpy() for a in (found.face, found.t, found.u, found.v)])
    face = hits[0][0]
    same = face == hits[1][0]
    assert same.mean() > 0.999  # on a shared edge either face is right
    for first, second in zip(*hits, strict=True):
        np.testing.assert_array_equal(first[same], second[same])
    corners = box_scene.mesh.vertices[box_scene.mesh.faces[face]].astype(float)
    _, t, u, v = hits[0]
    met = corners[:, 0] + u[:, None] * (corners[:, 1] - corners[:, 0])
    met += v[:, None] * (corners[:, 2] - corners[:, 0])
    ray = SMALL.rays().reshape(-1, 3) @ T[:3, :3].T
    np.testing.assert_allclose(met, T[:3, 3] + t[:, None] * ray, atol=3e-6)


def test_without_packets_single_rays_do(box_scene: BoxScene, monkeypatch) -> None:
    assert isinstance(casters.make_caster(box_scene.mesh, "cpu"), EmbreeRayCaster)
    monkeypatch.setattr(casters, "embree_library", lambda: None)
    assert isinstance(casters.make_caster(box_scene.mesh, "cpu"), EmbreeSingleRayCaster)
    with pytest.raises(OSError, match="ray packets"):
        EmbreeRayCaster(box_scene.mesh)


def test_truth_is_consistent(sensors, box_scene: BoxScene) -> None:
    T = box_scene.sample_start(np.random.default_rng(3))
    view = sensors[0].ground_truth(T)
    in_camera = (view.points - T[:3, 3]) @ T[:3, :3]
    np.testing.assert_allclose(in_camera[..., 2], view.depth, atol=1e-5)
    v, u = np.mgrid[: SMALL.height, : SMALL.width]
    np.testing.assert_allclose(SMALL.project(in_camera), np.stack([u, v], -1), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(view.normals, axis=-1), 1.0, atol=1e-5)
    assert (np.einsum("hwd,hwd->hw", view.normals, in_camera) < 0).all()  # towards the camera
    assert set(np.unique(view.labels)) <= {0, 1, 2}


def test_a_ray_that_meets_nothing_has_no_reading(box_scene: BoxScene) -> None:
    sensor = RGBDSensor(box_scene, SMALL, noise="none")
    T = look_at([10.0, 0.0, 1.0], [20.0, 0.0, 1.0])
    view = sensor.ground_truth(T)
    assert (view.labels == -1).all()
    assert not view.depth.any()
    assert not view.color.any()
    assert not sensor.capture(T, 0).depth.any()
