"""Colour: light, exposure, texture lookup and mip levels against plain NumPy."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.geometry import look_at
from ms_slam_env.scenes.scene import TexturedMesh
from ms_slam_env.sensor import NoiseConfig, NoNoise, RGBDSensor
from ms_slam_env.sensor.textures import (
    linear_to_srgb,
    mip_levels,
    pack_textures,
    srgb_to_linear,
    texel_density,
)

FRONT = look_at([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])


class Wall(BoxScene):
    """One square of ``size_m`` at x = 1, facing the camera; u to the right, v down."""

    def __init__(self, texture: np.ndarray, light: np.ndarray, size_m: float = 4.0) -> None:
        self.name, self.seed, self.exposure = "wall", 0, 1.0
        h = size_m / 2
        vertices = np.array([[1, h, h], [1, -h, h], [1, -h, -h], [1, h, -h]], dtype=np.float32)
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
        faces = np.array([[0, 2, 1], [0, 3, 2]], dtype=np.int32)
        self.mesh = TexturedMesh(
            vertices=vertices,
            faces=faces,
            uv=uv[faces],
            face_texture=np.zeros(2, dtype=np.int32),
            face_label=np.zeros(2, dtype=np.int32),
            irradiance=light.astype(np.float32)[faces],
            textures=(texture,),
            labels=("wall",),
        )


def shot(scene: Wall, intrinsics: Intrinsics, noise: NoiseConfig | None = None) -> np.ndarray:
    return RGBDSensor(scene, intrinsics, noise=noise or NoNoise()).capture(FRONT, 0).color


@pytest.mark.parametrize("exposure", [0.3, 1.0, 3.0])
def test_colour_is_albedo_times_light_times_exposure(exposure: float) -> None:
    albedo = np.array([200, 90, 20], dtype=np.uint8)
    light = np.tile([0.9, 0.5, 1.4], (4, 1))
    scene = Wall(np.tile(albedo, (4, 4, 1)), light)
    scene.exposure = exposure
    linear = srgb_to_linear(albedo / 255.0) * light[0] * exposure
    expected = 255.0 * linear_to_srgb(np.minimum(linear, 1.0))
    color = shot(scene, xtion("80x60"))
    assert np.abs(color - expected).max() <= 0.51


def test_light_is_interpolated_between_the_corners() -> None:
    light = np.array([[1.0] * 3, [0.2] * 3, [0.2] * 3, [1.0] * 3])  # bright left, dark right
    color = shot(Wall(np.full((4, 4, 3), 255, np.uint8), light), xtion("80x60"))
    K = xtion("80x60")
    position = (np.arange(80) - K.cx) / K.fx / 4.0 + 0.5  # 0 at the left edge, 1 at the right
    expected = 255.0 * linear_to_srgb(1.0 - 0.8 * position)
    np.testing.assert_allclose(color[30, :, 0], expected, atol=0.6)


def test_magnified_texture_matches_bilinear_resampling() -> None:
    texture = np.random.default_rng(0).integers(40, 220, (16, 16, 3)).astype(np.uint8)
    scene = Wall(texture, np.ones((4, 3)))
    K = Intrinsics(80.0, 80.0, 39.5, 39.5, 80, 80)
    # Pixel (x, y) sees the texel coordinates below; texel centres lie at integers.
    grid = ((np.arange(80) - 39.5) / 80.0 / 4.0 + 0.5) * 16 - 0.5
    x, y = np.meshgrid(grid.astype(np.float32), grid.astype(np.float32))
    expected = cv2.remap(texture.astype(np.float32), x, y, cv2.INTER_LINEAR)
    assert np.abs(shot(scene, K) - expected).max() <= 1.01


def test_a_far_texture_is_averaged_in_linear_light() -> None:
    checker = (255 * (np.indices((512, 512)).sum(0) % 2)).astype(np.uint8)
    scene = Wall(np.repeat(checker[..., None], 3, axis=2), np.ones((4, 3)))
    color = shot(scene, Intrinsics(16.0, 16.0, 7.5, 7.5, 16, 16))
    grey = 255.0 * linear_to_srgb(np.array(0.5))
    assert np.abs(color - grey).max() <= 1.0


def test_mip_level_follows_the_footprint() -> None:
    """A texture whose levels are told apart by their mean shows which level was read."""
    texture = np.zeros((256, 256, 3), np.uint8)
    scene = Wall(texture, np.ones((4, 3)))
    assert texel_density(scene.mesh) == pytest.approx([64.0, 64.0])
    for focal, level in ((64.0, 0), (32.0, 1), (16.0, 2), (8.0, 3)):
        sensor = RGBDSensor(scene, Intrinsics(focal, focal, 3.5, 3.5, 8, 8), noise="none")
        texels = sensor._surfaces.texels.numpy().copy()
        packed = pack_textures(scene.mesh.textures)
        for k, start in enumerate(packed.offsets[0]):
            texels[start:] = k * 20
        sensor._surfaces.texels.assign(texels)
        red = sensor.ground_truth(FRONT).color[4, 4, 0]
        value = 255.0 * srgb_to_linear(np.array(red / 255.0))
        expected = 255.0 * srgb_to_linear(np.array(level * 20 / 255.0))
        assert value == pytest.approx(expected, abs=1.0)


def test_mip_levels_keep_the_mean_light() -> None:
    texture = np.random.default_rng(1).integers(0, 256, (64, 128, 3)).astype(np.uint8)
    levels = mip_levels(texture)
    assert [level.shape[:2] for level in levels[:3]] == [(64, 128), (32, 64), (16, 32)]
    assert min(levels[-1].shape[:2]) == 1
    means = [srgb_to_linear(level / 255.0).mean() for level in levels]
    np.testing.assert_allclose(means, means[0], rtol=0.02)


def test_intensity_noise_has_the_configured_variance() -> None:
    scene = Wall(np.full((4, 4, 3), 128, np.uint8), np.ones((4, 3)))
    noise = replace(NoNoise(), shot=1e-3, read=0.01)
    color = shot(scene, xtion("320x240"), noise)
    linear = srgb_to_linear(color / 255.0)
    value = srgb_to_linear(np.array(128 / 255.0))
    assert linear.mean() == pytest.approx(value, rel=2e-3)
    assert linear.std() == pytest.approx(np.sqrt(0.01**2 + 1e-3 * value), rel=0.02)
    channels = linear.reshape(-1, 3) - linear.reshape(-1, 3).mean(0)
    correlation = np.corrcoef(channels.T)[np.triu_indices(3, 1)]
    assert np.abs(correlation).max() < 0.02
