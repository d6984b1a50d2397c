"""Objects that move through the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import check_choice, check_range
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.base import Scene
from ms_slam_env.scenes.movers import MOVERS, make_mover
from ms_slam_env.sequences.perturbations.base import WorldPerturbation, random_numbers
from ms_slam_env.sequences.perturbations.moving.mover import Mover
from ms_slam_env.sequences.perturbations.moving.places import Places
from ms_slam_env.sequences.pose_interpolation import PoseInterpolation

Float64 = NDArray[np.float64]

_TRIES = 4000
_CANDIDATES = 8  # free ways among which the one that is seen most is taken
_PHASES = 3  # starts on each
_INSTANTS = 40  # of the camera's path at which is checked who sees what and who is near whom
_NEAREST_CAMERA_M = 0.35  # between the camera and the object's outline
_NEAREST_OTHER_M = 0.15
_SPIN_RAD_S = 0.5


@dataclass(frozen=True)
class MovingObjects(WorldPerturbation):
    """Parcels, people or cars on the move, seen in colour and depth and in the labels.

    Boxes float through free space and turn; people walk on the ground; both go there and back on a
    rounded way. Cars drive along a lane of the scene, or along a straight free way on the ground,
    and again from its beginning. The ways keep clear of the scene, of the camera and of each
    other; among those drawn the one is taken on which the camera sees most of the object.

    Attributes:
        kind: box, person or car.
        count: of the objects; 0 = none.
        speed_m_s: largest speed; people slow down to turn.
        seed: of looks and ways, beside the sequence's.

    Raises:
        InputError: unknown kind, or a value out of range.
    """

    kind: str = "box"
    count: int = 2
    speed_m_s: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse unknown kinds and values out of range."""
        check_choice(self, "kind", tuple(MOVERS))
        check_range(self, "count", 0, 100)
        check_range(self, "speed_m_s", 1e-3, 100.0)
        check_range(self, "seed", 0, 2**32)

    def populate(
        self,
        scene: Scene,
        camera: PoseInterpolation,
        intrinsics: Intrinsics,
        seed: int,
        others: Sequence[Mover] = (),
    ) -> tuple[Mover, ...]:
        """See the base class.

        Raises:
            InputError: no free way for one of them.
        """
        times = _instants(camera)
        poses = camera(times)
        movers: list[Mover] = []
        for k in range(self.count):
            rng = random_numbers(seed, self.seed, k, name=f"moving-{self.kind}")
            movers.append(self._mover(k, scene, times, poses, intrinsics, rng, [*others, *movers]))
        return tuple(movers)

    def _mover(
        self,
        number: int,
        scene: Scene,
        times: Float64,
        poses: Float64,
        intrinsics: Intrinsics,
        rng: np.random.Generator,
        others: list[Mover],
    ) -> Mover:
        shape = make_mover(self.kind, rng)
        spin = rng.uniform(-_SPIN_RAD_S, _SPIN_RAD_S) if self.kind == "box" else 0.0
        places = Places(scene, poses, intrinsics, rng)
        best, best_score, found = None, -1.0, 0
        for track in places.tracks(shape, self.speed_m_s, _TRIES):
            for _ in range(_PHASES):
                phase = rng.uniform(0.0, track.period_s)
                mover = Mover(f"{self.kind} {number}", shape, track, phase, spin)
                if not _keeps_clear(mover, times, poses, others):
                    continue
                score = _seen(mover, scene, times, poses, intrinsics)
                found += 1
                if score > best_score:
                    best, best_score = mover, score
            if found >= _CANDIDATES * _PHASES:
                break
        if best is None:
            raise InputError(
                f"moving-objects: found no free way for {self.kind} {number} in scene "
                f"{scene.name!r}, seed {scene.seed}; try fewer, another kind or another seed"
            )
        return best


def _instants(camera: PoseInterpolation) -> Float64:
    times = camera.times_s
    return np.linspace(times[0], times[-1], min(_INSTANTS, len(times)))


def _keeps_clear(mover: Mover, times: Float64, poses: Float64, others: list[Mover]) -> bool:
    """Whether it never comes too near to the camera or another object."""
    if (mover.distance(poses[:, :3, 3], times) < _NEAREST_CAMERA_M).any():
        return False
    # A minute beyond the path: where time goes on, objects go on.
    more = np.concatenate([times, times[-1] + np.arange(0.2, 60.0, 0.2)])
    return all(_are_apart(mover, other, more) for other in others)


def _are_apart(a: Mover, b: Mover, times: Float64) -> bool:
    """Whether two objects never come too near to each other."""
    gap = np.linalg.norm(a.middle(times) - b.middle(times), axis=1)
    if gap.min() < 0.5 * (a.shape.width_m + b.shape.width_m):
        return False
    near = times[gap < a.reach_m + b.reach_m + _NEAREST_OTHER_M]
    return not len(near) or not any(
        (one.distance(points, near) < _NEAREST_OTHER_M).any()
        for one, other in ((a, b), (b, a))
        for points in other.outline(near)
    )


def _seen(
    mover: Mover, scene: Scene, times: Float64, poses: Float64, intrinsics: Intrinsics
) -> float:
    """Share of the instants at which the camera has the middle of it in view, unhidden."""
    middle = mover.middle(times)
    offsets = np.einsum("kji,kj->ki", poses[:, :3, :3], middle - poses[:, :3, 3])
    u, v = intrinsics.project(offsets).T
    is_inside = (offsets[:, 2] > 0.1) & (u > 0) & (u < intrinsics.width - 1)
    is_inside &= (v > 0) & (v < intrinsics.height - 1)
    count = 0
    for k in np.flatnonzero(is_inside):
        eye = poses[k, :3, 3]
        count += scene.segment_is_free(eye, middle[k], 0.0)
    return count / len(times)
