"""Real episodes, short ones."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ms_slam_env.benchmark.episodes import (
    EpisodeSpec,
    make_env,
    parse_options,
    play,
    run_episode,
)
from ms_slam_env.benchmark.planners import DETAILS, HEADLINE
from ms_slam_env.config import parse_named
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.planners import PLANNERS, make_planner
from ms_slam_env.errors import InputError

SPEC = EpisodeSpec("random", "table", seed=2000, steps=4)
CLOCKS = ("decision_ms",)


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return run_episode(SPEC)


def test_result_has_every_reported_metric(result: dict[str, Any]) -> None:
    assert all(np.isfinite(result[key]) for key in (*HEADLINE, *DETAILS))
    assert result["steps"] == 4
    assert len(result["ate_over_steps"]) == len(result["looks_at_steps"])
    assert result["ate_over_steps"][0] == 0
    assert result["ate_over_steps"][-1] == pytest.approx(result["ate_unaligned_m"], abs=1e-6)
    assert result["rcm"] == result["recall_5cm"]


def test_violations_are_the_frames_beyond_the_permitted_maxima() -> None:
    env = make_env(SPEC)
    play(env, make_planner("random", env.unwrapped, SPEC.seed), SPEC.seed)
    met = env.unwrapped.episode.divergences[1:]  # type: ignore[attr-defined]
    M_I, M_D = (float(np.sort(column)[-2]) for column in met.T)  # one frame beyond each
    beyond = {int(np.argmax(column)) for column in met.T}
    limits = {"targets": {"M_I": M_I, "M_D": M_D}}
    assert run_episode(replace(SPEC, options=limits))["violations"] == len(beyond) / len(met)
    nothing = {"targets": {"M_I": 100.0, "M_D": 100.0}}
    assert run_episode(replace(SPEC, options=nothing))["violations"] == 0


def test_same_spec_same_result(result: dict[str, Any]) -> None:
    again = run_episode(SPEC)
    assert {k: v for k, v in again.items() if k not in CLOCKS} == {
        k: v for k, v in result.items() if k not in CLOCKS
    }


def test_stationary_does_not_move_and_maps_less(result: dict[str, Any]) -> None:
    still = run_episode(EpisodeSpec("stationary", "table", seed=2000, steps=4))
    assert still["path_length_m"] == 0
    assert still["rcm"] < result["rcm"]
    assert still["M_I"] < result["M_I"]


@pytest.mark.parametrize("name", ["random", "stationary", "greedy", "max-information"])
def test_planners_are_installed(name: str) -> None:
    assert name in PLANNERS.names()


def test_planner_is_found_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_planners_of_a_test.py").write_text(
        "from ms_slam_baselines import RandomWalk\n\nclass Mine(RandomWalk):\n    pass\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    assert PLANNERS.find("my_planners_of_a_test:Mine").__name__ == "Mine"


def test_a_trained_policy_without_its_extra_says_what_to_install(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr("ms_slam_env._runtime.extension.import_module", missing)
    with pytest.raises(
        InputError, match=r"No module named 'torch'; pip install 'ms-slam-env\[train"
    ):
        PLANNERS.find("policy")


def test_planner_by_module_and_class_takes_options() -> None:
    from ms_slam_env.env.env_config import EnvConfig

    class World:
        config = EnvConfig()
        lookahead = None

    text = "ms_slam_baselines.greedy:GreedyDivergence,rho_I=0.25,depth_weight=2"
    planner: Any = make_planner(text, World())
    assert (planner.targets.rho_I, planner.targets.depth_weight) == (0.25, 2.0)
    assert parse_named("policy,path=runs/a.zip,deterministic=true", "planner")[1] == {
        "path": "runs/a.zip",
        "deterministic": True,
    }


def test_an_episode_moves_as_the_environment_does_by_default() -> None:
    from ms_slam_env.env.env_config import EnvConfig

    assert SPEC.step_m == EnvConfig().step_m
    assert np.radians(SPEC.step_deg) == pytest.approx(EnvConfig().step_rad, abs=1e-12)
    assert EpisodeSpec("random").scene == EnvConfig().scene


def test_options_may_name_the_embodiment() -> None:
    options = parse_options(["embodiment=arm-kinematic", "arm.noise=none"])
    assert options == {"embodiment": "arm-kinematic", "arm": {"noise": "none"}}
    env = make_env(EpisodeSpec("random", "table", 1000, "MSActiveSLAM-v0", options=options))
    assert env.unwrapped.simulation.embodiment_type is EMBODIMENTS["arm-kinematic"]
    for text, message in (
        ("embodiment=boat", "unknown embodiment 'boat'; valid choices: arm, arm-kinematic, free"),
        ("boat=1", "option of the environment 'boat'; valid choices: embodiment, num_scene_seeds"),
        ("render_mode=human", "option 'render_mode' cannot be set: the benchmark sets it"),
        ("max_episode_steps=3", "option 'max_episode_steps' cannot be set: the benchmark sets it"),
    ):
        with pytest.raises(InputError, match=message):
            parse_options([text])
