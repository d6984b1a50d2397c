"""Bodies that move: depth in closed form, occlusion, labels, light, and nothing else changed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env.camera import xtion
from ms_slam_env.geometry import invert, look_at, make_pose, so3_exp
from ms_slam_env.scenes.mesh_queries import LightProbe
from ms_slam_env.scenes.movers import make_mover
from ms_slam_env.scenes.movers.shape import box
from ms_slam_env.sensor import Body, ChangingLight, RGBDSensor, WarpRayCaster

K = xtion("80x60")
SIZE = (0.5, 0.3, 0.4)
EYE = look_at(np.array([-1.2, -1.2, 1.4]), np.array([0.2, 0.0, 0.6]))


def pose_at(times_s):
    """Drives along x at 0.6 m/s and turns at 1 rad/s."""
    times = np.asarray(times_s, dtype=np.float64)
    poses = [make_pose(so3_exp([0.1, 0.2, t]), [-0.4 + 0.6 * t, 0.1, 0.7]) for t in times.ravel()]
    return np.stack(poses).reshape(*times.shape, 4, 4)


def bright(time_s):
    """White light from everywhere."""
    return np.concatenate([np.ones((1, 3)), np.zeros((3, 3))])


@pytest.fixture(scope="module")
def parcel() -> Body:
    shape = box(np.random.default_rng(3), SIZE)
    return Body("parcel", shape.parts[0].mesh, pose_at, bright)


@pytest.fixture(scope="module")
def sensor(box_scene: BoxScene, parcel: Body) -> RGBDSensor:
    return RGBDSensor(box_scene, K, noise="none", bodies=[parcel])


def slab_depth(T_world_camera, T_world_body):
    """Depth (H, W) of a box of SIZE by intersecting slabs, inf where a ray misses it."""
    T = invert(T_world_body) @ T_world_camera
    rays = K.rays() @ T[:3, :3].T
    half = 0.5 * np.array(SIZE)
    with np.errstate(divide="ignore"):
        a, b = (-half - T[:3, 3]) / rays, (half - T[:3, 3]) / rays
    near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where((near <= far) & (near > 0), near, np.inf)


@pytest.mark.parametrize("time", [0.0, 0.5, 1.1])
def test_depth_and_labels_of_a_moving_box(box_scene, sensor, time) -> None:
    room = RGBDSensor(box_scene, K, noise="none").ground_truth(EYE)
    truth = sensor.ground_truth(EYE, time)
    body = slab_depth(EYE, pose_at(time))
    expected = np.minimum(np.where(room.depth > 0, room.depth, np.inf), body)
    is_body = body < room.depth
    assert 50 < is_body.sum() < 0.5 * K.width * K.height
    edge = np.zeros(K.shape, dtype=bool)  # a ray along an edge may go either way
    for axis in (0, 1):
        for turn in (1, -1):
            edge |= is_body != np.roll(is_body, turn, axis)
    np.testing.assert_allclose(truth.depth[~edge], expected[~edge], rtol=1e-4)
    labels = np.where(is_body, sensor.labels.index("parcel"), room.labels)
    np.testing.assert_array_equal(truth.labels[~edge], labels[~edge])
    frame = sensor.capture(EYE, 0, time)
    np.testing.assert_array_equal(frame.depth, truth.depth)
    np.testing.assert_array_equal(sensor.last_true_depth(), truth.depth)
    points = truth.points[is_body & ~edge] - pose_at(time)[:3, 3]
    local = np.abs(points @ pose_at(time)[:3, :3])
    np.testing.assert_allclose(np.max(local - 0.5 * np.array(SIZE), axis=1), 0, atol=1e-3)


def test_the_scene_hides_what_is_behind_it(box_scene: BoxScene, parcel: Body) -> None:
    behind = make_pose(np.eye(3), [2.6, 0.0, 0.7])  # behind the wall at x = 2
    hidden = dataclasses.replace(
        parcel, pose=lambda t: np.broadcast_to(behind, (*np.shape(t), 4, 4))
    )
    sensor = RGBDSensor(box_scene, K, bodies=[hidden])
    plain = RGBDSensor(box_scene, K).capture(EYE, 3)
    frame = sensor.capture(EYE, 3)
    np.testing.assert_array_equal(frame.color, plain.color)
    np.testing.assert_array_equal(frame.depth, plain.depth)


def test_where_no_body_is_the_frame_is_what_it_was(box_scene, parcel) -> None:
    plain = RGBDSensor(box_scene, K).capture(EYE, 3, 0.5)
    frame = RGBDSensor(box_scene, K, bodies=[parcel]).capture(EYE, 3, 0.5)
    body = np.isfinite(slab_depth(EYE, pose_at(0.5)))
    columns = np.flatnonzero(body.any(0))
    far = np.ones(K.shape, dtype=bool)
    far[:, columns.min() - 12 : columns.max() + 3] = False  # its shadow falls to the left
    np.testing.assert_array_equal(frame.color[far], plain.color[far])
    np.testing.assert_array_equal(frame.depth[far], plain.depth[far])


def test_the_order_and_the_batch_do_not_matter(box_scene, parcel) -> None:
    first = RGBDSensor(box_scene, K, bodies=[parcel])
    second = RGBDSensor(box_scene, K, bodies=[parcel])
    poses = np.stack([EYE, EYE])
    a, b = first.capture_batch(poses, [0, 1], timestamps=[0.0, 0.9])
    for frame, index, time in ((b, 1, 0.9), (a, 0, 0.0)):
        again = second.capture(EYE, index, time)
        np.testing.assert_array_equal(frame.color, again.color)
        np.testing.assert_array_equal(frame.depth, again.depth)


def test_every_row_sees_the_body_where_it_is_at_its_time(sensor, parcel, box_scene) -> None:
    count = sensor.rolling_poses
    times = 0.5 + 0.2 * np.linspace(-0.5, 0.5, count)
    frame = sensor.capture_rolling(np.stack([EYE] * count), 0, 0.5, row_times_s=times)
    for p in (count // 3, count // 2, count - 5):
        still = sensor.capture(EYE, 0, times[p])
        np.testing.assert_array_equal(
            frame.depth[2 * p : 2 * p + 2], still.depth[2 * p : 2 * p + 2]
        )


def test_noise_of_a_rolling_image_fits_the_moving_surface(box_scene, parcel) -> None:
    """Jittered rays meet the plane of the face where it was at the time of the row."""
    count = -(-K.height // 2)
    times = 0.5 + 0.2 * np.linspace(-0.5, 0.5, count)
    noisy = RGBDSensor(box_scene, K, bodies=[parcel])
    rolling = noisy.capture_rolling(np.stack([EYE] * count), 7, 0.5, row_times_s=times)
    for p in (count // 2, count // 2 + 2, count // 2 + 4):
        still = noisy.capture(EYE, 7, times[p])
        inside = np.isfinite(slab_depth(EYE, pose_at(times[p])))[2 * p]
        both = inside & (rolling.depth[2 * p] > 0) & (still.depth[2 * p] > 0)
        same = rolling.depth[2 * p, both] == still.depth[2 * p, both]
        assert both.sum() > 5
        assert same.mean() > 0.7  # jitter may reach into another row


def test_the_general_caster_sees_the_same(box_scene, parcel) -> None:
    general = RGBDSensor(
        box_scene, K, noise="none", bodies=[parcel], caster=WarpRayCaster(box_scene.mesh, "cpu")
    )
    fast = RGBDSensor(box_scene, K, noise="none", bodies=[parcel])
    a, b = general.capture(EYE, 0, 0.4), fast.capture(EYE, 0, 0.4)
    assert (np.abs(a.depth - b.depth) > 1e-4).mean() < 0.01


class Halved(ChangingLight):
    """Half the light, and as much again from everywhere where asked for."""

    def __init__(self, extra: float) -> None:
        self.extra = extra

    def level(self, time_s):
        return 0.5

    def added(self, points, normals, time_s):
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
        return np.full((len(points), 3), self.extra, np.float32) if self.extra else None


def test_half_the_light_is_half_the_exposure(box_scene) -> None:
    class Darker:
        mesh, name, seed, exposure = box_scene.mesh, "box", 0, 0.5 * box_scene.exposure

    dim = RGBDSensor(box_scene, K, light=Halved(0.0))
    expected = RGBDSensor(Darker(), K).capture(EYE, 2)  # type: ignore[arg-type]
    frame = dim.capture(EYE, 2)
    np.testing.assert_array_equal(frame.color, expected.color)
    np.testing.assert_array_equal(frame.depth, RGBDSensor(box_scene, K).capture(EYE, 2).depth)


def test_added_light_adds_to_the_irradiance(box_scene, parcel) -> None:
    mesh = dataclasses.replace(
        box_scene.mesh, irradiance=(0.5 * box_scene.mesh.irradiance + 0.25).astype(np.float32)
    )

    class Lit:
        name, seed, exposure = "box", 0, box_scene.exposure

    Lit.mesh = mesh
    lit = RGBDSensor(box_scene, K, noise="none", light=Halved(0.25))
    other = look_at(np.array([0.5, -1.0, 1.4]), np.array([-1.0, 1.0, 0.6]))
    expected = RGBDSensor(Lit(), K, noise="none")  # type: ignore[arg-type]
    for T in (EYE, other, EYE):
        difference = lit.capture(T, 0).color.astype(int) - expected.capture(T, 0).color
        assert np.abs(difference).max() <= 1


def test_the_probe_recovers_light_that_is_linear_in_the_normal(box_scene) -> None:
    mesh = box_scene.mesh
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    slope = np.array([0.1, -0.05, 0.2])
    light = 0.8 + normal @ slope
    irradiance = np.repeat(np.repeat(light[:, None, None], 3, 1), 3, 2).astype(np.float32)
    probe = LightProbe(dataclasses.replace(mesh, irradiance=irradiance))
    c, *d = probe.around(np.array([0.0, 0.0, 1.2]))
    np.testing.assert_allclose(c, 0.8, atol=0.05)
    np.testing.assert_allclose(np.stack(d)[:, 0], slope, atol=0.06)


@pytest.mark.parametrize("kind", ["box", "person", "car"])
def test_movers_fit_their_measures_and_repeat(kind) -> None:
    a, b = (make_mover(kind, np.random.default_rng(8)) for _ in range(2))
    points = np.concatenate([part.mesh.vertices for part in a.parts])
    assert np.linalg.norm(points[:, 0]) > 0
    assert (np.abs(points[:, 1]) <= 0.5 * a.width_m + 0.1).all()
    assert points[:, 2].max() == pytest.approx(a.height_m, abs=0.06)
    assert points[:, 2].min() == pytest.approx(-a.depth_m, abs=0.06)
    for one, other in zip(a.parts, b.parts, strict=True):
        np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
        np.testing.assert_array_equal(one.mesh.irradiance, other.mesh.irradiance)
        assert all(
            np.array_equal(x, y)
            for x, y in zip(one.mesh.textures, other.mesh.textures, strict=True)
        )
