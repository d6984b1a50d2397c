import numpy as np
import pytest

from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.lighting import Lamp, Lighting, Panel, Sun, light_mesh
from ms_slam_env.scenes.mesh_queries import RayCaster

_UP = np.array([[0.0, 0.0, 1.0]])
_DARK = {"ambient": (0.0, 0.0, 0.0), "bounce_gain": 0.0}


def _far_away() -> RayCaster:
    vertices = np.array([[50.0, 50, 50], [51, 50, 50], [50, 51, 50]])
    return RayCaster(vertices, np.array([[0, 1, 2]]))


def test_lamp_falls_off_with_cosine_and_square_of_distance():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 2.0, 0]])
    lamp = Lamp((0.0, 0.0, 2.0), (3.0, 2.0, 1.0))
    found = lamp.irradiance(points, np.repeat(_UP, 3, 0), _far_away())
    r2 = np.array([4.0, 5.0, 8.0])
    expected = (2.0 / np.sqrt(r2) / r2)[:, None] * [3.0, 2.0, 1.0]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_light_from_behind_gives_nothing():
    lamp = Lamp((0.0, 0.0, -1.0), (1.0, 1.0, 1.0))
    assert not lamp.irradiance(np.zeros((1, 3)), _UP, _far_away()).any()


def test_panel_agrees_with_the_disc_formula():
    """Irradiance / pi on the axis of a disc of radius R at height h: L R^2 / (R^2 + h^2)."""
    half = 0.5
    panel = Panel((-half, half, 1.0), (1.0, 0, 0), (0, -1.0, 0), (2.0, 2.0, 2.0), (60, 60))
    found = panel.irradiance(np.zeros((1, 3)), _UP, _far_away())[0, 0]
    grid = (np.arange(400) + 0.5) / 400 - 0.5
    x, y = np.meshgrid(grid, grid)
    exact = 2.0 / np.pi * np.mean(1.0 / (x * x + y * y + 1.0) ** 2)
    assert found == pytest.approx(exact, rel=1e-3)
    radius2 = 1.0 / np.pi  # the disc of the same area is close
    assert found == pytest.approx(2.0 * radius2 / (radius2 + 1.0), rel=0.02)


def test_occluder_casts_a_shadow_where_geometry_says():
    build = MeshBuilder(0.05)
    white = build.plain((255, 255, 255))
    with build.object("floor"):
        build.quad((-2, -2, 0), (4, 0, 0), (0, 4, 0), white)
    with build.object("board"):
        build.box((-0.25, -0.25, 1.0), (0.25, 0.25, 1.02), white)
    lighting = Lighting((Lamp((0.0, 0.0, 2.0), (1.0, 1.0, 1.0)),), **_DARK)
    mesh = light_mesh(build.build(), lighting)
    on_floor = mesh.face_label == mesh.labels.index("floor")
    place = mesh.vertices[mesh.faces[on_floor]]
    light = mesh.irradiance[on_floor][..., 0]
    reach = np.abs(place[..., :2]).max(-1)
    # Lamp at 2 m over a board at 1 m: the shadow is twice the board's half width.
    assert (light[reach < 0.45] == 0.0).all()
    assert (light[reach > 0.56] > 0.0).all()
    square = (place[..., :2] ** 2).sum(-1) + 4.0
    lit = reach > 0.56
    np.testing.assert_allclose(light[lit], (2.0 / square**1.5)[lit], rtol=0.03)


def test_sun_needs_a_clear_way():
    build = MeshBuilder(0.1)
    white = build.plain((255, 255, 255))
    build.quad((-1, -1, 1), (2, 0, 0), (0, 2, 0), white)
    geometry = build.build()
    rays = RayCaster(geometry.vertices, geometry.faces)
    sun = Sun((0.0, 1.0, 1.0), (2.0, 2.0, 2.0))
    points = np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    found = sun.irradiance(points, np.repeat(_UP, 2, 0), rays)
    np.testing.assert_allclose(found[:, 0], [0.0, 2.0 / np.sqrt(2)], atol=1e-5)


def test_clear_labels_cast_no_shadow_and_glow_is_constant():
    build = MeshBuilder(0.1)
    white = build.plain((255, 255, 255))
    with build.object("floor"):
        build.quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), white)
    with build.object("pane"):
        build.quad((-1, -1, 1), (2, 0, 0), (0, 2, 0), white)
    lamp = Lamp((0.0, 0.0, 2.0), (1.0, 1.0, 1.0))
    glow = {"pane": (5.0, 4.0, 3.0)}
    shut = light_mesh(build.build(), Lighting((lamp,), glow, **_DARK))
    open_ = light_mesh(build.build(), Lighting((lamp,), glow, frozenset({"pane"}), **_DARK))
    floor = open_.face_label == 0
    assert not shut.irradiance[floor].any()
    assert (open_.irradiance[floor] > 0).all()
    np.testing.assert_allclose(open_.irradiance[~floor], np.broadcast_to([5, 4, 3], (800, 3, 3)))


def test_a_red_wall_colours_its_neighbour():
    build = MeshBuilder(0.1)
    with build.object("floor"):
        build.quad((0, -1, 0), (2, 0, 0), (0, 2, 0), build.plain((255, 255, 255)))
    with build.object("red"):
        build.quad((0, -1, 0), (0, 2, 0), (0, 0, 2), build.plain((255, 0, 0)))
    lamp = Lamp((1.5, 0.0, 1.0), (1.0, 1.0, 1.0))
    mesh = light_mesh(build.build(), Lighting((lamp,), ambient=(0.0, 0.0, 0.0)))
    floor = mesh.face_label == 0
    near = mesh.vertices[mesh.faces[floor]].mean(1)[:, 0] < 0.3
    red, green = mesh.irradiance[floor][near].mean((0, 1))[:2]
    assert red > 1.05 * green
