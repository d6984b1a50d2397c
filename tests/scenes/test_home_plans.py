"""Floor plans and furniture of dwellings, over many seeds: what must hold for every one."""

from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ms_slam_env.scenes.homes import floor_plan
from ms_slam_env.scenes.homes.arrangement import Arrangement, LocalDoor, overlap
from ms_slam_env.scenes.homes.floor_plan import AREA_M2, HALL, ROOMS_M, WALL_M, draw_plan
from ms_slam_env.scenes.homes.home import built
from ms_slam_env.scenes.room import Opening, Room, Window

SEEDS = st.integers(0, 2**31)
_TOLERANCE_M = 0.03  # leaves of plants


def plan_of(seed):
    return draw_plan(np.random.default_rng([seed, 15]))


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_rooms_are_as_many_and_as_large_as_promised(seed):
    plan = plan_of(seed)
    assert ROOMS_M[0] <= len(plan.rooms) - 1 <= ROOMS_M[1]
    assert plan.rooms[-1].kind == HALL
    assert len({room.name for room in plan.rooms}) == len(plan.rooms)
    assert AREA_M2[0] <= plan.area <= AREA_M2[1]
    assert plan.area == pytest.approx(sum(np.prod(np.subtract(r.high, r.low)) for r in plan.rooms))
    assert min(room.size.min() for room in plan.rooms) > 1.5
    kinds = Counter(room.kind for room in plan.rooms)
    assert kinds["living"] == kinds["bathroom"] == 1


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_rooms_lie_a_wall_apart(seed):
    for one, other in combinations(plan_of(seed).rooms, 2):
        apart = np.maximum(np.subtract(other.low, one.high), np.subtract(one.low, other.high))
        assert apart.max() >= WALL_M - 1e-9


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_every_room_is_reached_through_doors(seed):
    plan = plan_of(seed)
    inner = [door.rooms for door in plan.doors if not door.is_entrance]
    a, b = np.array(inner).T
    graph = coo_array((np.ones(len(a)), (a, b)), (len(plan.rooms),) * 2)
    assert connected_components(graph, directed=False)[0] == 1
    assert sum(door.is_entrance for door in plan.doors) == 1


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_doors_are_wide_and_lie_in_the_wall_between_their_rooms(seed):
    plan = plan_of(seed)
    for door in plan.doors:
        assert door.width - (0.04 if door.leaf else 0.0) >= 0.8  # less the leaf at its end
        axis = 0 if door.along_x else 1
        for k, index in enumerate(door.rooms):
            room = plan.rooms[index]
            ends = [room.high[axis], room.low[axis]]
            if door.is_entrance:
                assert min(abs(door.middle[axis] - end) for end in ends) < 1e-9
            else:
                assert abs(door.middle[axis] - ends[k]) == pytest.approx(WALL_M / 2)
            low = door.middle[1 - axis] - door.width / 2 - room.low[1 - axis]
            high = room.high[1 - axis] - door.middle[1 - axis] - door.width / 2
            assert min(low, high) > 0.09, "the casing fits in"


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_windows_are_in_outer_walls_and_clear_of_doors(seed):
    plan = plan_of(seed)
    far = np.max([room.high for room in plan.rooms], axis=0)
    for index, room in enumerate(plan.rooms):
        box = Room((*room.size, plan.height))
        to_outside = (far[1] - room.high[1], far[0] - room.high[0], room.low[1], room.low[0])
        doors = [plan.wall_of(door, index) for door in plan.doors_of(index)]
        assert room.kind == HALL or room.windows
        for wall, window in room.windows:
            assert abs(to_outside[wall]) < 1e-6
            assert abs(window.along) + window.width / 2 < box.length(wall) / 2 - 0.3
            assert wall not in [door_wall for door_wall, _ in doors]


def test_same_seed_same_plan_and_all_kinds_of_sizes_come():
    assert plan_of(5) == plan_of(5) != plan_of(6)
    plans = [plan_of(seed) for seed in range(60)]
    assert {len(plan.rooms) - 1 for plan in plans} == set(range(3, 8))
    assert {plan.rooms[-1].size.argmax() for plan in plans} == {0, 1}
    kinds = {room.kind for plan in plans for room in plan.rooms}
    assert kinds == set(floor_plan.KINDS)


@pytest.fixture(scope="module", params=[0, 1, 2])
def furnished(request):
    return built(request.param)


def test_nothing_stands_in_doorways_swings_or_other_things(furnished):
    plan, _, rooms, _ = furnished
    for own, of in zip(plan.rooms, rooms, strict=True):
        arrangement = of.arrangement
        for one, other in combinations(arrangement.standing, 2):
            assert not overlap(one, other)
        for box in arrangement.standing:
            assert not any(overlap(box, doorstep) for doorstep in arrangement.doorsteps)
            assert min(box[:2]) >= -0.01
            assert (np.array(box[2:]) <= own.size + 0.01).all()
        assert len(arrangement.standing) >= 2


def test_what_is_built_stays_where_it_was_arranged(furnished):
    """No vertex of furniture lies in a doorstep below the height of a door."""
    plan, build, _, _ = furnished
    geometry = build.build()
    names = np.array(geometry.labels)[geometry.face_label]
    flat = (
        "wall",
        "floor",
        "ceiling",
        "skirting",
        "casing",
        "threshold",
        "rug",
        "lamp",
        "picture",
        "switch",
    )
    corners = geometry.vertices[geometry.faces]
    for index, (room, of) in enumerate(zip(plan.rooms, furnished[2], strict=True)):
        own = np.char.startswith(names, f"{room.name} ")
        own &= ~np.array([any(word in name.split() for word in flat) for name in names])
        points = corners[own].reshape(-1, 3) - [*room.low, 0.0]
        points = points[points[:, 2] < 2.0]
        for door, (a, b, c, d) in zip(plan.doors_of(index), of.arrangement.doorsteps, strict=True):
            low, high = np.add((a, b), _TOLERANCE_M), np.subtract((c, d), _TOLERANCE_M)
            inside = ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)
            assert not inside.any(), (room.name, door.rooms)


ROOM = Room((4.0, 3.0, 2.5))


def test_a_leaf_takes_the_floor_on_the_side_where_it_hangs():
    for hinge in (-1, 1):
        door = LocalDoor(0, Opening(0.0, 0.9, 2.05), hinge)
        (a, _, c, _) = Arrangement(ROOM, [door], {}).doorsteps[0]
        beyond = (2.0 - a, c - 2.0)
        assert (beyond[0] > beyond[1]) == (hinge < 0)


def test_the_tall_stands_beside_the_window_and_the_low_below_it():
    window = {0: Window(0.0, 0.9, 2.4, 1.2)}
    rng = np.random.default_rng(0)
    assert Arrangement(ROOM, [], window).stand(rng, (1.0, 0.5, 2.0), [0]) is None
    assert Arrangement(ROOM, [], window).stand(rng, (1.0, 0.5, 0.7), [0]) is not None


def test_what_would_close_the_way_between_two_doors_is_refused():
    doors = [LocalDoor(wall, Opening(0.0, 0.9, 2.05)) for wall in (1, 3)]
    arrangement = Arrangement(ROOM, doors, {})
    assert not arrangement.take(np.array([2.0, 1.5]), (0.5, 2.8))
    assert arrangement.take(np.array([2.0, 1.0]), (0.5, 1.2))


def test_one_wall_takes_only_what_fits_beside_one_another():
    arrangement, rng = Arrangement(ROOM, [], {}), np.random.default_rng(1)
    spots = [arrangement.stand(rng, (1.2, 0.4, 1.0), [0]) for _ in range(6)]
    alongs = sorted(spot.along for spot in spots if spot is not None)
    assert 2 <= len(alongs) <= 3
    assert min(np.diff(alongs)) >= 1.2
    assert arrangement.hang(rng, (1.0, 0.5), 0.6, [0]) is None or len(alongs) < 3
