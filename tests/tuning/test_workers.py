"""Trials in several processes, on this machine and on a Ray cluster."""

from pathlib import Path

import pytest
from fake_evaluation import FakeEvaluation, fake_space, values

from ms_slam_env.errors import InputError
from ms_slam_env.tuning import ExplorationSettings, explore
from ms_slam_env.tuning.front import points_of

SETTINGS = ExplorationSettings(sampler="random")


def check(storage, budget):
    points = points_of(storage)
    assert len(points) == budget
    assert len({tuple(point.params.values()) for point in points}) == budget
    for point in points:
        assert point.measured["ext_ms"] == pytest.approx(values(point.params)["ext_ms"])


def test_processes_share_a_study_and_one_may_die(tmp_path):
    seen = []
    evaluation = FakeEvaluation(die=str(tmp_path))
    storage = explore(
        tmp_path / "study", fake_space(), SETTINGS, evaluation, 8, workers=2, progress=seen.append
    )
    check(storage, 8)
    assert (tmp_path / "died").exists()
    assert seen[-1] == 8
    # Going on in this process takes up what is there.
    check(explore(tmp_path / "study", fake_space(), SETTINGS, FakeEvaluation(), 10), 10)


def test_what_an_evaluation_raises_ends_the_exploration(tmp_path):
    for complaint, kind in (("input", InputError), ("type", TypeError)):
        with pytest.raises(kind, match="no such sequence"):
            explore(
                tmp_path / complaint, fake_space(), SETTINGS, FakeEvaluation(complain=complaint), 9
            )
    with pytest.raises(InputError, match="no such sequence"):
        explore(tmp_path / "apart", fake_space(), SETTINGS, FakeEvaluation(complain="input"), 9, 2)


def test_a_local_ray_cluster(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # where the evaluation is
    pytest.importorskip("ray", reason="needs the extra ray")
    evaluation = FakeEvaluation(die=str(tmp_path))
    storage = explore(
        tmp_path / "study", fake_space(), SETTINGS, evaluation, 8, workers=2, ray_address="local"
    )
    check(storage, 8)
    assert (tmp_path / "died").exists()  # one process died and its trial was redone


def test_no_cluster_at_the_address(tmp_path):
    pytest.importorskip("ray", reason="needs the extra ray")
    with pytest.raises(InputError, match="--ray nowhere://x: no Ray cluster there"):
        explore(tmp_path, fake_space(), SETTINGS, FakeEvaluation(), 1, ray_address="nowhere://x")


def test_bad_numbers(tmp_path):
    for budget, workers in ((0, 1), (1, 0), (True, 1)):
        with pytest.raises(InputError, match="must be at least 1"):
            explore(tmp_path, fake_space(), SETTINGS, FakeEvaluation(), budget, workers)
