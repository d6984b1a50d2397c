"""A 4 x 4 x 2.5 m textured room with two boxes in it: small, analytic, good for tests."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import zoom

from ms_slam_env._runtime.arrays import Float64, Int32
from ms_slam_env.geometry import look_at
from ms_slam_env.scenes.scene import Scene, TexturedMesh

ROOM_LOW = np.array([-2.0, -2.0, 0.0])
ROOM_HIGH = np.array([2.0, 2.0, 2.5])
BOXES = (
    (np.array([0.9, -0.4, 0.0]), np.array([1.6, 0.5, 0.8])),
    (np.array([-0.6, 1.2, 0.0]), np.array([0.3, 1.8, 1.1])),
)
LAMP = np.array([-0.3, -0.5, 2.3])
TEXTURE_SIZE = 512
CELL_M = 0.25  # size of the quads that carry irradiance


def _texture(rng: np.random.Generator, base: np.ndarray) -> np.ndarray:
    """Octaves of smooth noise with a few hard-edged patches, (512, 512, 3) uint8."""
    image = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE, 3))
    for cells, amplitude in ((4, 30.0), (16, 25.0), (64, 20.0), (256, 10.0)):
        coarse, tint = rng.normal(0.0, amplitude, (cells, cells)), 1 + rng.normal(0, 0.2, 3)
        image += zoom(coarse, TEXTURE_SIZE // cells, order=1)[..., None] * tint
    for _ in range(12):
        low = rng.integers(0, TEXTURE_SIZE - 40, 2)
        size = rng.integers(20, 120, 2)
        image[low[0] : low[0] + size[0], low[1] : low[1] + size[1]] += rng.normal(0, 50, 3)
    return np.clip(base + image, 8, 247).astype(np.uint8)


class BoxScene(Scene):
    """Inward-facing room and two outward-facing boxes; every rectangle has its own texture."""

    def __init__(self, seed: int = 0) -> None:
        """Build the mesh; ``seed`` draws the textures."""
        self.name = "box"
        self.seed = seed
        self.exposure = 1.0
        rng = np.random.default_rng(seed)
        vertices: list[np.ndarray] = []
        faces: list[np.ndarray] = []
        uvs: list[np.ndarray] = []
        texture_ids: list[int] = []
        labels: list[int] = []
        textures: list[np.ndarray] = []
        solids = [(ROOM_LOW, ROOM_HIGH, True), *((low, high, False) for low, high in BOXES)]
        for label, (low, high, inward) in enumerate(solids):
            for axis in range(3):
                for side in (0, 1):
                    if not inward and axis == 2 and side == 0:
                        continue  # a box stands on the floor
                    self._add_rectangle(low, high, axis, side, inward, vertices, faces, uvs)
                    count = len(faces[-1])
                    texture_ids += [len(textures)] * count
                    labels += [label] * count
                    textures.append(_texture(rng, rng.uniform(90, 170, 3)))
        offsets = np.cumsum([0] + [len(v) for v in vertices[:-1]])
        all_vertices = np.concatenate(vertices).astype(np.float32)
        all_faces = np.concatenate([f + o for f, o in zip(faces, offsets, strict=True)])
        corners = all_vertices[all_faces].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        to_lamp = LAMP - corners
        distance = np.linalg.norm(to_lamp, axis=2)
        cosine = np.einsum("fcd,fd->fc", to_lamp, normals) / distance
        light = 0.35 + 1.6 * np.clip(cosine, 0, None) / (1 + distance**2)
        self.mesh = TexturedMesh(
            vertices=all_vertices,
            faces=all_faces.astype(np.int32),
            uv=np.concatenate(uvs).astype(np.float32),
            face_texture=np.array(texture_ids, dtype=np.int32),
            face_label=np.array(labels, dtype=np.int32),
            irradiance=np.repeat(light[:, :, None], 3, axis=2).astype(np.float32),
            textures=tuple(textures),
            labels=("room", "box_0", "box_1"),
        )

    @staticmethod
    def _add_rectangle(low, high, axis, side, inward, vertices, faces, uvs) -> None:
        """Append the grid of one axis-aligned side, its normal inwards or outwards."""
        u_axis, v_axis = (axis + 1) % 3, (axis + 2) % 3
        extent_u, extent_v = high[u_axis] - low[u_axis], high[v_axis] - low[v_axis]
        nu = max(1, round(extent_u / CELL_M))
        nv = max(1, round(extent_v / CELL_M))
        v, u = np.meshgrid(np.linspace(0, 1, nv + 1), np.linspace(0, 1, nu + 1), indexing="ij")
        points = np.empty((nv + 1, nu + 1, 3))
        points[..., axis] = (low, high)[side][axis]
        points[..., u_axis] = low[u_axis] + u * extent_u
        points[..., v_axis] = low[v_axis] + v * extent_v
        index = np.arange((nv + 1) * (nu + 1)).reshape(nv + 1, nu + 1)
        a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
        c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
        triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        faces_plus_axis = not ((side == 1) ^ (not inward))  # (u, v) grid turns about +axis
        if not faces_plus_axis:
            triangles = triangles[:, ::-1]
        vertices.append(points.reshape(-1, 3))
        faces.append(triangles)
        uvs.append(np.stack([u.ravel(), v.ravel()], 1)[triangles])

    def clearance(self, points: Float64) -> Float64:
        """Exact signed-distance style clearance, clipped at 0."""
        p = np.asarray(points, dtype=np.float64)
        result = np.minimum(p - ROOM_LOW, ROOM_HIGH - p).min(axis=1)
        for low, high in BOXES:
            outside = np.maximum(np.maximum(low - p, p - high), 0.0)
            result = np.minimum(result, np.linalg.norm(outside, axis=1))
        return np.maximum(result, 0.0)

    def segment_is_free(self, start: Float64, end: Float64, radius_m: float) -> bool:
        """March along the segment in steps that the clearance allows."""
        start, end = np.asarray(start, float), np.asarray(end, float)
        length = float(np.linalg.norm(end - start))
        travelled = 0.0
        while True:
            point = start if length == 0 else start + (end - start) * min(travelled / length, 1.0)
            clearance = float(self.clearance(point[None])[0])
            if clearance < radius_m:
                return False
            if travelled >= length:
                return True
            travelled += max(clearance - radius_m, 1e-3)

    def sample_start(self, rng: np.random.Generator) -> Float64:
        """Draw a pose about the middle of the room looking at one of the boxes."""
        low, high = BOXES[rng.integers(len(BOXES))]
        while True:
            eye = rng.uniform([-1.2, -1.2, 0.9], [0.6, 0.8, 1.6])
            if self.clearance(eye[None])[0] > 0.4:
                return look_at(eye, (low + high) / 2 + rng.normal(0, 0.1, 3))

    def surface_points(self, spacing_m: float = 0.01) -> tuple[Float64, Int32]:
        """Regular samples of each face."""
        mesh = self.mesh
        steps = max(1, int(np.ceil(CELL_M / spacing_m)))
        i, j = np.meshgrid(np.arange(steps), np.arange(steps), indexing="ij")
        keep = i + j < steps
        a, b = (i[keep] + 1 / 3) / steps, (j[keep] + 1 / 3) / steps
        weights = np.stack([1 - a - b, a, b], axis=1)
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        points = np.einsum("sc,fcd->fsd", weights, corners)
        return points.reshape(-1, 3), np.repeat(mesh.face_label, len(weights))
