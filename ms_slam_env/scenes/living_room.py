"""A furnished living room."""

from __future__ import annotations

import numpy as np
from scipy import fft

from ms_slam_env.scenes.base import Float64, TexturedMesh
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.mesh_scene import MeshScene


def _pink(rng: np.random.Generator, size: int, rgb: tuple[int, int, int]) -> np.ndarray:
    f = np.hypot(fft.fftfreq(size)[:, None], fft.rfftfreq(size)[None]) + 1 / size
    noise = fft.irfft2(fft.rfft2(rng.standard_normal((size, size))) / f)
    noise /= noise.std()
    return np.clip(np.array(rgb) + 22.0 * noise[..., None], 0, 255).astype(np.uint8)


def living_room(seed: int) -> MeshScene:
    """Build the living room of ``seed``."""
    rng = np.random.default_rng(seed)
    size = np.array([5.0, 4.0, 2.6])
    build = MeshBuilder()
    x, y, z = np.diag(size)
    o = np.zeros(3)
    for name, quad in {
        "floor": (o, x, y),
        "ceiling": (y + z, x, -y),
        "wall 0": (x, -x, z),
        "wall 1": (x + y, -y, z),
        "wall 2": (y, x, z),
        "wall 3": (o, y, z),
    }.items():
        tint = rng.integers(90, 200, 3)
        with build.object(name):
            build.quad(*quad, build.material(_pink(rng, 512, tuple(tint)), (1.5, 1.5)))
    for k in range(10):
        side = rng.uniform(0.3, 0.9, 3)
        at = rng.uniform(0, 1, 2) * (size[:2] - side[:2])
        if np.linalg.norm(at + side[:2] / 2 - size[:2] / 2) < 1.3:
            continue
        low = np.array([*at, 0.0])
        with build.object(f"box {k}"):
            tint = rng.integers(40, 220, 3)
            build.box(low, low + side, build.material(_pink(rng, 256, tuple(tint)), (0.6, 0.6)))
    g = build.build()
    light = 0.55 + 0.35 * np.clip(g.normals @ np.array([0.3, 0.5, 0.8]), 0, 1)
    mesh = TexturedMesh(
        g.vertices.astype(np.float32),
        g.faces,
        g.uv,
        g.face_texture,
        g.face_label,
        np.repeat(light[g.faces][..., None], 3, -1).astype(np.float32),
        g.textures,
        g.labels,
    )

    def start(draw: np.random.Generator) -> tuple[Float64, Float64]:
        eye = np.array([*draw.uniform(0.5, size[:2] - 0.5), draw.uniform(1.0, 1.6)])
        return eye, np.array([*draw.uniform(0.5, size[:2] - 0.5), draw.uniform(0.4, 1.2)])

    return MeshScene("living_room", seed, mesh, np.array([2.5, 2.0, 1.8]), start)
