"""Where embreex is missing, as on Linux on ARM, Warp finds the same hits."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata

import numpy as np
from box_scene import BoxScene

from ms_slam_env import scenes
from ms_slam_env.report import provenance
from ms_slam_env.scenes.mesh_queries import RayCaster

EPISODE = """
import sys
if sys.argv[1] == "hidden":
    sys.modules["embreex"] = None  # to import it is an ImportError
import gymnasium as gym
import numpy as np
import ms_slam_env

options = {"scene": "table", "scene_seed": 0, "noise": "none", "observation": "rgbd"}
env = gym.make("MSActiveSLAM-FreeCamera-v0", image_size="80x60", **options)
seen, info = env.reset(seed=0)
frames = [(seen["depth"], seen["color"], info["T_world_camera"], info["mapped_share"])]
for action in (35, 6, 13, 29):
    seen, *_, info = env.step(action)
    frames.append((seen["depth"], seen["color"], info["T_world_camera"], info["mapped_share"]))
depth, color, poses, shares = map(np.array, zip(*frames))
caster = type(env.unwrapped.sensor.caster).__name__
np.savez(sys.argv[2], depth=depth, color=color, poses=poses, shares=shares, caster=caster)
"""


def test_an_episode_without_it_is_the_same(tmp_path) -> None:
    found = {}
    for how in ("hidden", "there"):
        out = tmp_path / f"{how}.npz"
        subprocess.run([sys.executable, "-c", EPISODE, how, str(out)], check=True)
        found[how] = np.load(out)
    warp, embree = found["hidden"], found["there"]
    assert (str(warp["caster"]), str(embree["caster"])) == ("WarpRayCaster", "EmbreeRayCaster")
    np.testing.assert_allclose(warp["poses"], embree["poses"], atol=1e-5)
    apart = np.abs(warp["depth"] - embree["depth"]) / np.maximum(embree["depth"], 0.1)
    assert (apart < 1e-4).mean() > 0.999
    assert np.abs(warp["color"].astype(int) - embree["color"]).mean() < 0.5  # of 255 levels
    np.testing.assert_allclose(warp["shares"], embree["shares"], atol=1e-3)


def hits_of(mesh, monkeypatch, count=20_000):
    """First hits of random rays, of any length, by Embree and by Warp."""
    rng = np.random.default_rng(0)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    rays = rng.uniform(low - 1, high + 1, (count, 3)), rng.normal(size=(count, 3))
    embree = RayCaster(mesh.vertices, mesh.faces)
    monkeypatch.setitem(sys.modules, "embreex", None)
    warp = RayCaster(mesh.vertices, mesh.faces)
    assert type(warp._scene).__name__ == "WarpScene"
    return embree.first_hit(*rays), warp.first_hit(*rays)


def compare(embree, warp, least):
    (distances, faces), (other_distances, other_faces) = embree, warp
    assert {faces.dtype, other_faces.dtype} == {np.dtype(np.int32)}
    assert ((faces < 0) == (other_faces < 0)).mean() > least
    both = (faces >= 0) & (other_faces >= 0)
    assert 0.3 < both.mean() < 1
    assert (faces == other_faces)[both].mean() > 0.995  # at an edge either face is right
    near = np.isclose(distances[both], other_distances[both], rtol=1e-4, atol=1e-5)
    assert near.mean() > least
    assert np.isinf(other_distances[other_faces < 0]).all()


def test_first_hits_in_a_box(box_scene: BoxScene, monkeypatch) -> None:
    compare(*hits_of(box_scene.mesh, monkeypatch), least=0.9999)


def test_first_hits_in_a_room(monkeypatch) -> None:
    compare(*hits_of(scenes.make("living_room", 3).mesh, monkeypatch), least=0.999)


def test_a_record_names_only_what_is_installed(monkeypatch) -> None:
    version = metadata.version

    def without(name: str) -> str:
        if name == "embreex":
            raise metadata.PackageNotFoundError(name)
        return version(name)

    assert "embreex" in provenance.provenance()["versions"]
    monkeypatch.setattr(metadata, "version", without)
    assert "embreex" not in provenance.provenance()["versions"]
    assert provenance.provenance()["versions"]["warp-lang"] == version("warp-lang")
