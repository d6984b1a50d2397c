# mypy: disable-error-code="attr-defined"
# Warp's stubs do not name the fields of a ray query.
"""First hits of rays with a mesh by Warp, where embreex is not to be had."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.warp import kernel_wp as wp


@wp.kernel
def first_hits(
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],  # (N,)
    directions: wp.array[wp.vec3],  # (N,)
    t: wp.array[wp.float32],  # (N,) in units of the direction's length; 0 without a hit
    face: wp.array[wp.int32],  # (N,) -1 without a hit
) -> None:
    """Find the first hit of each ray."""
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], 1.0e9)
    face[i] = -1
    if query.result:
        t[i] = query.t
        face[i] = query.face


class WarpScene:
    """A mesh with the part of the interface of embreex's scenes that is used here."""

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
        """Build the hierarchy of ``vertices`` (V, 3) and ``faces`` (F, 3)."""
        self._mesh = wp.Mesh(
            points=wp.array(vertices, dtype=wp.vec3, device="cpu"),
            indices=wp.array(faces.ravel(), dtype=wp.int32, device="cpu"),
        )

    def run(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32], output: int = 1
    ) -> dict[str, NDArray[np.generic]]:
        """Return ``tfar`` and ``primID`` (N,) of rays (N, 3); ``primID`` is -1 without a hit."""
        rays: list[Any] = [
            wp.array(rows, dtype=wp.vec3, device="cpu") for rows in (origins, directions)
        ]
        t = wp.zeros(len(origins), dtype=wp.float32, device="cpu")
        face = wp.zeros(len(origins), dtype=wp.int32, device="cpu")
        inputs = [self._mesh.id, *rays, t, face]
        wp.launch(first_hits, dim=len(origins), inputs=inputs, device="cpu")
        return {"tfar": t.numpy(), "primID": face.numpy()}
