"""Objects that move through the scene, on free routes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.mesh_queries import RayCaster
from ms_slam_env.scenes.movers import MOVERS, Shape, make_mover
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sequences.perturbations.movers import Mover, Track, round_track, straight_track
from ms_slam_env.sequences.perturbations.perturbation import WorldPerturbation, random_numbers
from ms_slam_env.sequences.trajectory import PoseInterpolation

_TRIES = 4000
_CANDIDATES = 8  # free routes to choose from; the one seen most is used
_PHASES = 3  # starting phases on each
_INSTANTS = 40  # of the camera's path at which visibility and distances are checked
_NEAREST_CAMERA_M = 0.35  # least distance between the camera and the object's outline
_NEAREST_OTHER_M = 0.15
_SPIN_RAD_S = 0.5


_MARGIN_M = 0.03  # least distance from the scene's surfaces
_FLAT_M = 0.06  # largest height difference of the ground along a route, including rugs and kerbs
_TURN_RAD_S = np.radians(120.0)
_HALF_WIDTH_M = (0.08, 0.25)
_WAYS_A_PLACE = (4, 40)  # fewest and most routes per place; more if few places are free
_AROUND_M = 6.0  # radius around the camera in which floor and space are searched for
_SOUNDINGS = 400
_LANE_STEP_M = 0.25
_LONGEST_M = {"box": 1.5, "person": 3.0, "car": 40.0}  # from the centre of the route to its end
_SHORTEST_M = {"box": 0.25, "person": 0.25, "car": 2.0}
_DEPTHS_M = {"box": (0.9, 3.0), "person": (1.2, 6.0), "car": (4.0, 25.0)}


@dataclass(frozen=True)
class MovingObjects(Checked, WorldPerturbation):
    """Moving boxes, people or cars, visible in colour, depth and labels.

    Boxes float through free space and spin; people walk on the ground; both move back and forth on
    a rounded route. Cars drive repeatedly along a lane of the scene, or along a straight free route
    on the ground. Routes keep clear of the scene, the camera and each other; among the candidates
    the one is used on which the camera sees most of the object.

    Attributes:
        kind: box, person or car.
        count: number of objects; 0 = none.
        speed_m_s: largest speed; people slow down to turn.
        seed: seed of appearance and routes, in addition to the sequence's.

    Raises:
        InputError: unknown kind, or a value out of range.
    """

    kind: str = chosen("box", *MOVERS)
    count: int = bounded(2, 0, 100)
    speed_m_s: float = bounded(0.5, 1e-3, 100.0)
    seed: int = bounded(0, 0, 2**32)

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
            InputError: no free route for one of them.
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
        # Close to a table or a wall nothing fits in between: then it starts out of view.
        for anywhere in (False, True):
            if best is not None:
                break
            for track in places.tracks(shape, self.speed_m_s, _TRIES, anywhere):
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
    """Whether it never comes too close to the camera or another object."""
    if (mover.distance(poses[:, :3, 3], times) < _NEAREST_CAMERA_M).any():
        return False
    # A minute beyond the path, because objects keep moving as time continues.
    more = np.concatenate([times, times[-1] + np.arange(0.2, 60.0, 0.2)])
    return all(_are_apart(mover, other, more) for other in others)


def _are_apart(a: Mover, b: Mover, times: Float64) -> bool:
    """Whether two objects never come too close to each other."""
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
    """Share of the instants at which the camera sees its centre unoccluded."""
    middle = mover.middle(times)
    offsets = np.einsum("kji,kj->ki", poses[:, :3, :3], middle - poses[:, :3, 3])
    is_ahead = offsets[:, 2] > 0.1
    sideways = offsets[:, :2] / np.where(is_ahead, offsets[:, 2], 1.0)[:, None]
    low, high = intrinsics.field.T
    is_inside = is_ahead & ((sideways > low) & (sideways < high)).all(1)
    count = 0
    for k in np.flatnonzero(is_inside):
        eye = poses[k, :3, 3]
        count += scene.segment_is_free(eye, middle[k], 0.0)
    return count / len(times)


class Places:
    """Free routes for a shape in a scene, drawn where a camera looks."""

    def __init__(
        self, scene: Scene, camera: Float64, intrinsics: Intrinsics, rng: np.random.Generator
    ) -> None:
        """Prepare for the camera's poses (K, 4, 4)."""
        self._scene, self._camera, self._rng = scene, camera, rng
        self._low, high = intrinsics.field.T
        self._span = high - self._low
        self._rays = RayCaster(scene.mesh.vertices, scene.mesh.faces)
        self._ground_z = self._ground()

    def tracks(
        self, shape: Shape, speed_m_s: float, tries: int, anywhere: bool = False
    ) -> Iterator[Track]:
        """Draw ``tries`` routes, in view or ``anywhere`` near the camera; yield the free ones."""
        if shape.kind == "car" and self._scene.lanes:
            for _ in range(tries):
                start, end = self._scene.lanes[int(self._rng.integers(len(self._scene.lanes)))]
                yield straight_track(np.asarray(start), np.asarray(end), speed_m_s)
            return
        draw = self._straight if shape.kind == "car" else self._round
        if anywhere:
            middles = self._rng.uniform(*self._around(), (tries, 3))
        else:
            middles = self._points_in_view(shape.kind, tries)
        free = middles[self._are_free(shape, middles)]
        ways = int(np.clip(tries // max(len(free), 1), *_WAYS_A_PLACE))
        for middle in free:
            for _ in range(ways):
                track = draw(shape, middle, speed_m_s)
                if track is not None:
                    yield track

    def _ground(self) -> float:
        """Height of the floor: nearly the lowest surface beneath free places."""
        near = self._camera[:, :3, 3]
        places = np.concatenate([near, self._rng.uniform(*self._around(), (_SOUNDINGS, 3))])
        free = places[self._scene.clearance(places) > 0.1]
        reach, _ = self._rays.first_hit(free, np.broadcast_to([0.0, 0.0, -1.0], free.shape))
        heights = (free[:, 2] - reach)[np.isfinite(reach)]
        return float(np.percentile(heights, 5)) if len(heights) else 0.0

    def _around(self) -> tuple[Float64, Float64]:
        """Lower and upper corner (3,) of the part of the scene near the camera's path."""
        low, high = self._scene.bounds()
        near = self._camera[:, :2, 3]
        low[:2] = np.maximum(low[:2], near.min(0) - _AROUND_M)
        high[:2] = np.minimum(high[:2], near.max(0) + _AROUND_M)
        return low, high

    def _points_in_view(self, kind: str, count: int) -> Float64:
        """Points (count, 3) in front of the camera's poses; on the ground for people and cars."""
        rng = self._rng
        T = self._camera[rng.integers(len(self._camera), size=count)]
        z = rng.uniform(*_DEPTHS_M[kind], count)
        x = self._low[0] + rng.uniform(0.1, 0.9, count) * self._span[0]
        y = self._low[1] + rng.uniform(0.2, 0.8, count) * self._span[1]
        local = np.stack([x * z, y * z, z], -1)
        points = np.einsum("kij,kj->ki", T[:, :3, :3], local) + T[:, :3, 3]
        if kind != "box":  # in little space it may also start out of view
            anywhere = count // 3
            points[:anywhere] = rng.uniform(*self._around(), (anywhere, 3))
            points[:, 2] = self._ground_z
        return points

    def _direction(self) -> Float64:
        angle = self._rng.uniform(0, 2 * np.pi)
        return np.array([np.cos(angle), np.sin(angle), 0.0])

    def _round(self, shape: Shape, middle: Float64, speed_m_s: float) -> Track | None:
        """Route back and forth along a free line."""
        rng, kind = self._rng, shape.kind
        along = self._direction()
        if kind == "box":
            along[2] = rng.uniform(-0.4, 0.4)
        along *= rng.uniform(_SHORTEST_M[kind], _LONGEST_M[kind])
        line = middle + np.linspace(-1.0, 1.0, 9)[:, None] * along
        if not self._are_free(shape, line).all():
            return None
        turning = np.inf if kind == "box" else _TURN_RAD_S
        half_width = rng.uniform(*_HALF_WIDTH_M)
        track = round_track(middle - along, middle + along, half_width, speed_m_s, turning)
        # Legs reach out ahead and behind, farther than the shape is wide.
        ahead = np.stack([np.cos(track.yaws), np.sin(track.yaws), np.zeros_like(track.yaws)], -1)
        reach = max(0.0, 0.5 * shape.length_m - shape.radius_m) * ahead
        points = np.concatenate([track.points + reach, track.points - reach])
        return track if self._are_free(shape, points[::4]).all() else None

    def _straight(self, shape: Shape, middle: Float64, speed_m_s: float) -> Track | None:
        """Straight route as far as the ground is free and level on both sides of a point."""
        along = self._direction()
        steps = np.arange(0.0, _LONGEST_M[shape.kind], _LANE_STEP_M)
        ends = []
        for sign in (-1.0, 1.0):
            is_free = self._are_free(shape, middle + sign * steps[:, None] * along)
            blocked = np.flatnonzero(~is_free)
            free = steps[: blocked[0]] if len(blocked) else steps
            if not len(free) or free[-1] < 0.5 * shape.length_m:
                return None
            ends.append(middle + sign * (free[-1] - 0.5 * shape.length_m) * along)
        if np.linalg.norm(ends[1] - ends[0]) < 2 * _SHORTEST_M[shape.kind]:
            return None
        return straight_track(ends[0], ends[1], speed_m_s)

    def _are_free(self, shape: Shape, points: Float64) -> NDArray[np.bool_]:
        """Whether (N,) the moving shape fits at points (N, 3)."""
        # A car drives straight, so only its width matters; others may turn.
        radius = (0.5 * shape.width_m if shape.kind == "car" else shape.radius_m) + _MARGIN_M
        if shape.kind == "box":
            return self._scene.clearance(points) > radius
        up = np.array([0.0, 0.0, 1.0])
        reach, _ = self._rays.first_hit(points + 0.3 * up, np.broadcast_to(-up, points.shape))
        is_free = np.abs(reach - 0.3) < _FLAT_M
        lowest = radius + 0.1  # the ground itself must not count
        for z in np.arange(lowest, max(shape.height_m - 0.5 * radius, lowest) + 0.01, 0.25):
            is_free &= self._scene.clearance(points + z * up) > radius
        return is_free
