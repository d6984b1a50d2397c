"""The cache of lit meshes: the same scene to the bit, whatever lies in the folder."""

import os

import numpy as np
import pytest
import trimesh

from ms_slam_env import scenes
from ms_slam_env.scenes import mesh_cache, mesh_file

FIELDS = ("vertices", "faces", "uv", "face_texture", "face_label", "irradiance")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setenv("MS_SLAM_ENV_CACHE", str(folder))
    return folder


@pytest.fixture
def room(tmp_path):
    shell = trimesh.creation.box(extents=(3.0, 2.4, 2.0))
    shell.invert()
    shell.export(tmp_path / "room.ply")
    return tmp_path / "room.ply"


@pytest.fixture
def lit(monkeypatch):
    """How often a mesh was lit."""
    calls = []
    light = mesh_file.light_mesh
    monkeypatch.setattr(mesh_file, "light_mesh", lambda *a: calls.append(1) or light(*a))
    return calls


def check_same(one, other):
    for name in FIELDS:
        a, b = getattr(one.mesh, name), getattr(other.mesh, name)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    assert one.exposure == other.exposure
    points = np.random.default_rng(0).uniform(-2, 2, (500, 3))
    np.testing.assert_array_equal(one.clearance(points), other.clearance(points))
    rngs = np.random.default_rng(1), np.random.default_rng(1)
    np.testing.assert_array_equal(*map(lambda s, r: s.sample_start(r), (one, other), rngs))


def test_the_second_time_nothing_is_lit_and_the_scene_is_the_same(cache, room, lit):
    first, second = scenes.make(room), scenes.make(room)
    assert len(lit) == 1
    check_same(first, second)


def test_another_seed_or_another_content_is_another_entry(cache, room, lit):
    scenes.make(room)
    scenes.make(room, seed=1)
    mesh = trimesh.load_mesh(room)
    mesh.vertices[:, 0] *= 1.1
    mesh.export(room)
    scenes.make(room)
    assert len(lit) == len(list(cache.iterdir())) == 3


def arrays_of(number):
    return {"a": np.arange(1000.0) + number, "b": np.eye(4, dtype=np.float32)}


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text", "folder"])
def test_a_corrupt_entry_is_worked_out_anew(cache, damage):
    mesh_cache.remembered("one", lambda: arrays_of(0))
    (path,) = cache.iterdir()
    content = path.read_bytes()
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :]
    broken = {"cut": content[:middle], "flipped": flipped, "empty": b"", "text": b"no arrays"}
    if damage == "folder":
        path.unlink()
        path.mkdir()
    else:
        path.write_bytes(broken[damage])
    for name, array in mesh_cache.remembered("one", lambda: arrays_of(1)).items():
        np.testing.assert_array_equal(array, arrays_of(1)[name])
    again = mesh_cache.remembered("one", lambda: arrays_of(2))
    assert again["a"][0] == (2 if damage == "folder" else 1)
    assert len(list(cache.iterdir())) == 1


def test_no_cache_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("MS_SLAM_ENV_CACHE", str(tmp_path / "file" / "cache"))
    for number in range(2):
        assert mesh_cache.remembered("one", lambda n=number: arrays_of(n))["a"][0] == number


def test_the_longest_unused_entries_go(cache, monkeypatch):
    arrays = {"a": np.zeros(1000)}
    for age, name in enumerate(("new", "old", "older")):
        mesh_cache.remembered(name, lambda: arrays)
        os.utime(cache / f"mesh-{name}.npz", (10_000 - age, 10_000 - age))
    mesh_cache.remembered("old", lambda: pytest.fail("it is there"))  # used again
    monkeypatch.setattr(mesh_cache, "MOST_BYTES", 20_000)
    mesh_cache.remembered("newest", lambda: arrays)
    assert {path.name for path in cache.iterdir()} == {"mesh-newest.npz", "mesh-old.npz"}
    assert mesh_cache.folder() == cache
