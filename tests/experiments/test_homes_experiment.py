"""The record of dwellings: its faults are found where they are put in, and nowhere else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from homes import SEED
from ms_slam_experiments import homes
from ms_slam_experiments.homes import Homes, HomeSpec

from ms_slam_env.scenes.homes.home import built


@pytest.fixture(scope="module")
def home():
    plan, build, rooms, _ = built(SEED)
    return plan, build.build(), rooms


def test_a_home_has_no_fault(home):
    plan, geometry, rooms = home
    assert homes.plan_faults(plan) == homes.room_faults(rooms) == []
    assert homes.mesh_faults(plan, geometry) == []


def test_faults_of_a_plan_are_found(home):
    plan = home[0]
    living = next(k for k, room in enumerate(plan.rooms) if room.kind == "living")
    shut = dataclasses.replace(plan, doors=tuple(d for d in plan.doors if living not in d.rooms))
    assert homes.plan_faults(shut) == ["a room without a way to it"]
    door = dataclasses.replace(plan.doors[0], rooms=(0, 1))
    small = dataclasses.replace(plan, rooms=plan.rooms[-2:], doors=(door,))
    assert homes.plan_faults(small)[0] == "1 rooms"


def test_faults_of_furniture_are_found(home):
    of = home[2][0]
    standing = of.arrangement.standing
    for box, words in (
        (standing[0], f"furniture in furniture in the {of.name}"),
        (of.arrangement.doorsteps[0], f"furniture in a doorway of the {of.name}"),
        ((-1.0, -1.0, -0.5, -0.5), f"furniture in a wall of the {of.name}"),
    ):
        standing.append(box)
        assert words in homes.room_faults([of])
        standing.pop()
    assert homes.room_faults([of]) == []


def test_faults_of_a_mesh_are_found(home, monkeypatch):
    plan, geometry, _ = home
    vertices = geometry.vertices.copy()
    vertices[geometry.faces[7]] = vertices[geometry.faces[7][0]]
    flat = dataclasses.replace(geometry, vertices=vertices)
    assert homes.mesh_faults(plan, flat) == ["triangles without area"]
    monkeypatch.setattr(homes, "_TRIANGLES", (0, 1000))
    assert homes.mesh_faults(plan, geometry) == [f"{len(geometry.faces)} triangles"]


def test_a_room_whose_door_is_walled_up_is_found(home):
    plan, geometry, _ = home
    door = next(d for d in plan.doors if not d.is_entrance)
    along = 1 if door.along_x else 0
    corners = np.zeros((4, 3))
    corners[:, :2] = door.middle
    corners[:, along] += np.array([-1, 1, 1, -1]) * door.width
    corners[:, 2] = [0.0, 0.0, plan.height, plan.height]
    count = len(geometry.vertices)
    board = np.array([[0, 1, 2], [0, 2, 3]]) + count
    walled = dataclasses.replace(
        geometry,
        vertices=np.concatenate([geometry.vertices, corners]),
        faces=np.concatenate([geometry.faces, board]),
    )
    inner = plan.rooms[door.rooms[door.into]]
    others = [d for d in plan.doors_of(door.rooms[door.into]) if not d.is_entrance]
    assert (inner.name in homes.shut_rooms(plan, walled)) == (len(others) == 1)
    assert homes.shut_rooms(plan, geometry) == []


def test_specs_and_table():
    experiment = Homes(homes=60, lit_every=50)
    specs = experiment.specs()
    assert [spec.seed for spec in specs[:2]] == [2000, 2001]
    assert [spec.lit for spec in specs].count(True) == 2
    assert len({spec.seed for spec in Homes().specs()}) == 1000
    result = {"rooms": 4, "area_m2": 60.0, "triangles": 10, "build_cpu_s": 1.0, "faults": ["x"]}
    rows = [
        {"spec": vars(HomeSpec(1, False)), "result": result, "error": None},
        {"spec": vars(HomeSpec(2, False)), "result": result | {"faults": []}, "error": None},
        {"spec": vars(HomeSpec(3, False)), "result": None, "error": "broke"},
    ]
    first, _, faults = (table.as_markdown() for table in experiment.tables(rows))
    assert "| 3 | 2 | 1 |" in first
    assert "| 1 | x |" in faults
