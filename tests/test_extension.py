"""Names, ``module:Class`` and entry points, for everything that can be extended.

The extensions are those of ``docs/extending.md``, in a module outside the package.
"""

from __future__ import annotations

import importlib
import json
import os
import pickle
import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from ms_slam_env import scenes, slam
from ms_slam_env._runtime import extension
from ms_slam_env._runtime.extension import ExtensionPoint
from ms_slam_env._runtime.parallel import open_pool, run_each
from ms_slam_env.benchmark import EXPERIMENTS, experiment_class
from ms_slam_env.camera import xtion
from ms_slam_env.cli.train import TRAINERS
from ms_slam_env.env import env_config as config
from ms_slam_env.env import observations
from ms_slam_env.env.observations import PixelsObservation
from ms_slam_env.env.planners import PLANNERS, check_planner
from ms_slam_env.errors import InputError
from ms_slam_env.metrics import registry
from ms_slam_env.scenes import registry as scene_registry
from ms_slam_env.sequences import naming, perturbations
from ms_slam_env.sequences.perturbations.optics import MotionBlur
from ms_slam_env.tasks import TASKS

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"
MODULE = "my_extensions"
POINTS = {
    "PhotometricSlam": slam.POINT,
    "PositionObservation": observations.POINT,
    "explore_reward": config.REWARDS,
    "dim_table": scene_registry.POINT,
    "Fog": perturbations.POINT,
    "brightness_metrics": registry.POINT,
    "Brightness": EXPERIMENTS,
    "AlwaysForward": PLANNERS,
    "two_tables": TASKS,
}
ENV = {
    "id": "MSActiveSLAM-FreeCamera-v0",
    "image_size": "80x60",
    "slam": f"{MODULE}:PhotometricSlam",
    "slam_config": {"weight": 0.3},
    "observation": f"{MODULE}:PositionObservation",
    "reward": f"{MODULE}:explore_reward",
    "scene": f"{MODULE}:dim_table",
    "scene_seed": 1000,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the module of the page is."""
    folder = tmp_path_factory.mktemp("user")
    source = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)[0]
    (folder / f"{MODULE}.py").write_text(source)
    return folder


@pytest.fixture
def module(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module of the page, imported."""
    monkeypatch.syspath_prepend(folder)
    return importlib.import_module(MODULE)


@pytest.fixture
def installed(module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything in it as an entry point ``mine`` of its group."""

    def entries(group: str) -> list[EntryPoint]:
        return [
            EntryPoint("mine", f"{MODULE}:{name}", group)
            for name, point in POINTS.items()
            if point.group == group
        ]

    monkeypatch.setattr(extension, "entry_points", entries)


def play(options: dict[str, Any]) -> tuple[list[float], list[float]]:
    """Rewards and last observation of three steps forward."""
    env = gym.make(**options)
    env.reset(seed=0)
    steps = [env.step(35) for _ in range(3)]
    assert all(set(info["reward_terms"]) == {"new_surface", "lost"} for *_, info in steps)
    return [float(step[1]) for step in steps], steps[-1][0].tolist()


@pytest.mark.parametrize("name", POINTS)
def test_a_module_and_its_name_and_the_thing_itself_are_found(name, module):
    point = POINTS[name]
    assert point.find(f"{MODULE}:{name}") is getattr(module, name)
    assert point.find(getattr(module, name)) is getattr(module, name)
    assert pickle.loads(pickle.dumps(point.find(f"{MODULE}:{name}"))) is getattr(module, name)


@pytest.mark.parametrize("name", POINTS)
def test_an_entry_point_is_found_and_listed(name, module, installed):
    assert POINTS[name].find("mine") is getattr(module, name)
    assert "mine" in POINTS[name].names()


@pytest.mark.parametrize("point", [*POINTS.values(), TRAINERS], ids=lambda point: point.kind)
def test_an_unknown_name_is_answered_with_the_choices(point):
    with pytest.raises(InputError) as caught:
        point.find("no-such-thing")
    line = str(caught.value)
    assert f"unknown {point.kind} 'no-such-thing'; valid choices: " in line
    assert all(name in line for name in (*point.names(), point.form, point.group))
    assert line.endswith("is found once its package is installed again")


@pytest.mark.parametrize("value", ["no_such_module:Thing", "json:NoSuchThing"])
def test_a_stale_entry_point_says_to_install_again(value, monkeypatch):
    entry = EntryPoint("old", value, "some.group")
    monkeypatch.setattr(extension, "entry_points", lambda group: [entry])
    with pytest.raises(InputError, match=f"entry point {value}; if that has changed, install"):
        ExtensionPoint("thing", "some.group").find("old")


@pytest.mark.parametrize("name", ["PhotometricSlam", "PositionObservation", "Fog", "Brightness"])
def test_something_of_another_kind_is_refused(name, module):
    with pytest.raises(InputError, match="is not a subclass of ms_slam_env"):
        POINTS[name].find("json:JSONDecoder")
    with pytest.raises(InputError, match=r"unknown .* valid choices"):
        POINTS[name].find(3)


def test_an_environment_takes_names_and_things_and_workers_too(module):
    by_name = play(ENV)
    assert max(map(abs, by_name[1])) > 0.1  # the camera went somewhere
    things = {
        key: getattr(module, value.partition(":")[2])
        for key, value in ENV.items()
        if str(value).startswith(MODULE)
    }
    assert play({**ENV, **things}) == by_name
    with open_pool(play, workers=1) as pool:
        found = {each.key: each for each in run_each(pool, {"name": ENV, "thing": ENV | things})}
    assert {each.error for each in found.values()} == {None}
    assert found["name"].value == found["thing"].value == by_name


def test_options_of_a_backend_are_checked(module):
    with pytest.raises(InputError, match=r"'wait'; valid choices: weight"):
        slam.make(module.PhotometricSlam, xtion("80x60"), wait=3)
    assert slam.make(ENV["slam"], xtion("80x60"), weight=0.25).config.icp_rgb_weight == 0.25


def test_a_reward_is_a_function_or_weights(module):
    with pytest.raises(InputError, match=r"reward = 3 must be a function .* new_surface"):
        config.make_config({"reward": 3})
    assert config.make_config({"reward": {"lost": 2.0}}).reward == config.RewardConfig(lost=2.0)


class Explore:
    """A reward whose objects are functions of an outcome."""

    def __call__(self, outcome):
        return {"new_surface": outcome.new_surface_m2, "lost": -0.5 * (not outcome.tracking_ok)}


class Weighted(Explore):
    def __init__(self, weight):
        self.weight = weight


class Half(PixelsObservation):
    build = observations.Observation.build  # abstract again


class NoArguments(PixelsObservation):
    def __init__(self):
        pass


class NoSpace(PixelsObservation):
    def __init__(self, intrinsics, num_motions):
        pass


def test_a_reward_may_be_a_class(module):
    """Its object is made; an object and the function are the same reward."""
    by_class = play({**ENV, "reward": Explore})
    assert by_class == play({**ENV, "reward": Explore()}) == play(ENV)
    assert config.make_config({"reward": config.RewardConfig}).reward == config.RewardConfig()
    for reward, said in (
        (Weighted, "is a class that takes arguments; give an object of it"),
        (dict, r"whose objects are not callable; give a function of an Outcome, or a class"),
        (lambda: 1.0, r"must be callable as <lambda>\(outcome\): too many positional arguments"),
        (lambda a, b: 1.0, r"<lambda>\(outcome\): missing a required argument: 'b'"),
    ):
        with pytest.raises(InputError, match=said):
            config.make_config({"reward": reward})


@pytest.mark.parametrize("value", ["much", None, [1, 2], {"a": "much"}])
def test_a_reward_that_is_no_number_is_refused(value):
    env = gym.make(ENV["id"], scene="table", image_size="80x60", reward=lambda outcome: value)
    env.reset(seed=0)
    with pytest.raises(InputError, match=r"reward .* returned .*; it must return a number, or a m"):
        env.step(0)


def test_what_is_called_in_another_way_is_refused_where_it_is_named():
    camera = xtion("80x60")
    of_class = observations.make_observation("pixels", camera, 49)
    for point, thing, said in (
        (observations.POINT, Half, "Half'> does not define build"),
        (observations.POINT, NoArguments, r"callable as NoArguments\(intrinsics, num_motions\)"),
        (observations.POINT, of_class, "is an object; give its class, PixelsObservation"),
        (slam.POINT, slam.make("surfel", camera), "is an object; give its class, SurfelSlam"),
        (scene_registry.POINT, Explore, r"must be callable as Explore\(seed\): too many"),
        (
            TASKS,
            lambda name: None,
            r"callable as <lambda>\(\): missing a required argument: 'name'",
        ),
    ):
        with pytest.raises(InputError, match=said):
            point.find(thing)
    with pytest.raises(InputError, match="has no space; its constructor must set one"):
        observations.make_observation(NoSpace, camera, 49)


def test_a_backend_that_needs_an_option_says_which(module):
    class Needy(module.PhotometricSlam):
        def __init__(self, intrinsics, weight):
            super().__init__(intrinsics, weight)

    with pytest.raises(InputError, match=r"Needy\(intrinsics\): missing a required argument: 'wei"):
        slam.make(Needy, xtion("80x60"))
    assert slam.make(Needy, xtion("80x60"), weight=0.25).config.icp_rgb_weight == 0.25


def test_a_scene_that_is_none_is_refused(module):
    with pytest.raises(InputError, match=r"made list, no ms_slam_env.scenes.Scene"):
        scenes.make(lambda seed: [seed], 0)
    assert scenes.make(module.dim_table, 3).exposure == 0.5 * scenes.make("table", 3).exposure


def test_a_sequence_is_named_with_scene_and_perturbation(module):
    text = f"{MODULE}:dim_table:1000:kinect+{MODULE}:Fog,density=0.25+motion-blur"
    named = naming.parse_sequence(text)
    assert isinstance(named, naming.SequenceName)
    assert (named.scene, named.seed, named.noise) == (f"{MODULE}:dim_table", 1000, "kinect")
    assert named.perturbations[0] == module.Fog(density=0.25)
    assert isinstance(named.perturbations[1], MotionBlur)
    naming.check_sequence(text)


def test_metrics_come_from_a_function_a_file_and_an_entry_point(module, tmp_path, monkeypatch):
    extra = tmp_path / "more.yaml"
    extra.write_text("wobble_m: {heading: wobble, definition: How much., unit: m, shown: mm}\n")
    with pytest.raises(InputError, match="MS_SLAM_METRICS"):
        registry.metric("wobble_m")
    monkeypatch.setenv("MS_SLAM_METRICS", f"{MODULE}:brightness_metrics,{extra}")
    registry.registry.cache_clear()
    assert registry.metric("wobble_m").label == "wobble [mm]"
    assert registry.metric("brightness").heading == "brightness"
    extra.write_text("ate_m: {heading: other, definition: Another.}\n")
    registry.registry.cache_clear()
    with pytest.raises(InputError, match=r"'ate_m' of .*more.yaml is already defined differently"):
        registry.metric("wobble_m")
    monkeypatch.delenv("MS_SLAM_METRICS")
    registry.registry.cache_clear()
    assert "brightness" not in registry.registry()


def test_a_planner_is_checked_by_its_name(module):
    check_planner(f"{MODULE}:AlwaysForward")
    with pytest.raises(InputError, match="option of planner"):
        check_planner(f"{MODULE}:AlwaysForward,speed=3")
    assert experiment_class(f"{MODULE}:Brightness") is module.Brightness


def test_the_current_folder_hides_no_other_module(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    assert check_planner(f"{MODULE}:AlwaysForward") is None
    assert sys.path[-1] == str(folder)


def test_the_command_line_runs_an_experiment_in_workers_with_everything(folder, tmp_path):
    """Module, scene and perturbation are found in the current folder alone."""
    environment = {**os.environ, "MS_SLAM_METRICS": f"{MODULE}:brightness_metrics"}
    sequences = ["table:1000", f"{MODULE}:dim_table:1000:{MODULE}:Fog,density=1"]
    command = [sys.executable, "-c", "import sys; sys.path.remove(''); "
               "from ms_slam_env.cli import main; sys.exit(main())",
               "experiment", f"{MODULE}:Brightness", "--out", str(tmp_path),
               "--sequences", *sequences]  # fmt: skip
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    found = {row["spec"]["sequence"]: row["result"]["brightness"] for row in rows}
    assert 30 < found[sequences[0]] < 180
    assert found[sequences[1]] == pytest.approx(200, abs=1)  # nothing but fog
    assert "brightness" in done.stdout
    assert np.isfinite(list(found.values())).all()
