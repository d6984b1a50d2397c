"""A study may be killed at any moment: no finished trial is lost or counted twice."""

import multiprocessing
import sqlite3

import numpy as np
import optuna
import pytest
from fake_evaluation import FakeEvaluation, fake_space, run, values
from optuna.trial import TrialState

from ms_slam_env._runtime.output_files import is_alive, process_name
from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.tuning import ExplorationSettings, explore, make_space
from ms_slam_env.tuning.study_storage import StudyStorage

BUDGET = 12


@pytest.fixture(scope="module")
def processes():
    """Quick and clean processes: forked from one that has the libraries loaded and nothing else."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        [
            "ms_slam_env.tuning",
            "ms_slam_env.slam.odometry.odometry",
            "optuna.storages",
            "alembic.command",
            "sqlalchemy.dialects.sqlite",
        ]
    )
    return context


def all_trials(folder):
    storage = f"sqlite:///{folder / 'study.db'}"
    return optuna.load_study(study_name="exploration", storage=storage).trials


def finished_of(folder):
    if not (folder / "study.db").exists():
        return {}
    try:
        found = all_trials(folder)
    except (KeyError, sqlite3.OperationalError):  # killed before the study was in the file
        return {}
    return {t.number: (t.params, t.values) for t in found if t.state == TrialState.COMPLETE}


def test_killed_at_random_times(processes, tmp_path):
    rng = np.random.default_rng(0)
    evaluation = FakeEvaluation(seconds=0.02)
    seen = {}
    kills, latest_s = 0, 1.0
    while True:
        arguments = (str(tmp_path), "random", BUDGET, evaluation)
        running = [processes.Process(target=run, args=arguments) for _ in range(2)]
        for process in running:
            process.start()
        running[0].join(timeout=float(rng.uniform(0.0, latest_s)))
        if running[0].exitcode == 0:
            break
        assert running[0].exitcode is None  # it never ends by itself before all is done
        for process in running:
            process.kill()  # SIGKILL: nothing is tidied up
            process.join()
        kills += 1
        now = finished_of(tmp_path)
        if len(now) == len(seen):
            latest_s *= 1.5  # a slow machine needs longer to get anywhere
        assert all(now[number] == before for number, before in seen.items())  # none lost
        seen = now
    for process in running:
        process.join()
        assert process.exitcode == 0
    assert kills >= 3
    found = all_trials(tmp_path)
    complete = [t for t in found if t.state == TrialState.COMPLETE]
    assert len(complete) == BUDGET  # none counted twice, none missing
    assert not any(t.state == TrialState.RUNNING for t in found)
    for trial in complete:
        expected = values(trial.params)
        assert trial.user_attrs["measured"]["ext_ms"] == pytest.approx(expected["ext_ms"])
        assert (trial.user_attrs["M_I"], trial.user_attrs["M_D"]) == (0.01, 0.02)
    params = [tuple(trial.params.values()) for trial in complete]
    assert len(set(params)) == BUDGET  # what was redone finished once
    assert sum(tuple(fake_space().defaults().values()) == p for p in params) == 1


def test_an_interrupted_study_draws_what_it_would_have_drawn(tmp_path):
    space, settings = fake_space(), ExplorationSettings(sampler="tpe", seed=3)
    whole = explore(tmp_path / "whole", space, settings, FakeEvaluation(), 12)
    for budget in (5, 12):
        parts = explore(tmp_path / "parts", space, settings, FakeEvaluation(), budget)
    assert [t.params for t in parts.finished()] == [t.params for t in whole.finished()]
    other = ExplorationSettings(sampler="tpe", seed=4)
    other_ledger = explore(tmp_path / "other", space, other, FakeEvaluation(), 2)
    assert other_ledger.finished()[1].params != whole.finished()[1].params


def test_a_trial_that_was_given_up_is_redone(tmp_path):
    storage = StudyStorage(tmp_path, fake_space(), ExplorationSettings(sampler="random"))
    storage.tell(storage.ask(5), values(fake_space().defaults()))
    lost = storage.ask(5)
    storage.give_up(lost, "its process died")
    again = storage.ask(5)
    assert again.params == lost.params
    storage.give_up(again, "its process died")
    third = storage.ask(5)
    assert third.params == lost.params
    storage.give_up(third, "its process died")
    assert storage.ask(5).params != lost.params  # it may be what kills processes


def test_trials_from_before_a_restart_are_taken_back(tmp_path):
    old = StudyStorage(tmp_path, fake_space(), ExplorationSettings(sampler="random"))
    old.tell(old.ask(2), values(fake_space().defaults()))
    old.owner = "old-name-of-the-container/1/2"
    forgotten = old.ask(2)
    new = StudyStorage(tmp_path, fake_space(), ExplorationSettings(sampler="random"))
    again = new.ask(2)
    assert again.params == forgotten.params
    old.tell(forgotten, {"ate_m": 9.9})  # too late: it counts as failed
    new.tell(again, values(again.params))
    assert [trial.number for trial in new.finished()] == [0, again.number]
    assert new.finished()[1].user_attrs["measured"]["ate_m"] < 1


def test_results_wait_for_the_default(tmp_path):
    storage = StudyStorage(tmp_path, fake_space(), ExplorationSettings())
    first = storage.ask(9)
    assert first.params == fake_space().defaults()
    assert storage.ask(9) is None
    storage.tell(first, {"ate_m": 0.02, "ext_ms": 5.0})
    assert storage.reference() == {"ate_m": pytest.approx(0.06), "ext_ms": pytest.approx(15.0)}
    second, third = storage.ask(3), storage.ask(3)
    assert storage.ask(3) is None  # three are finished or in living hands
    storage.tell(second, {"ate_m": float("nan"), "ext_ms": 99.0, "failure": "lost"})
    storage.tell(third, {"ate_m": 0.01})
    lost, partial = storage.finished()[1:]
    assert lost.values == [pytest.approx(0.06), pytest.approx(15.0)]
    assert partial.values == [0.01, pytest.approx(15.0)]


def test_a_failed_default_leaves_absolute_references(tmp_path):
    storage = StudyStorage(tmp_path, fake_space(), ExplorationSettings())
    storage.tell(storage.ask(9), {"ate_m": 0.5, "ext_ms": 4.0, "failure": "lost"})
    assert storage.reference() == {"ate_m": 1.0, "ext_ms": 12.0}


def test_another_exploration_in_the_folder_is_refused(tmp_path):
    StudyStorage(tmp_path, fake_space(), ExplorationSettings())
    StudyStorage(tmp_path, fake_space(), ExplorationSettings())
    with pytest.raises(InputError, match="other settings: seed was 0 and is 1"):
        StudyStorage(tmp_path, fake_space(), ExplorationSettings(seed=1))
    smaller = make_space(["keyframe_deg=0:10"], SlamConfiguration(slam="odometry"))
    with pytest.raises(InputError, match="other settings: parameters was"):
        StudyStorage(tmp_path, smaller, ExplorationSettings())


def test_a_file_that_is_no_study_is_one_clear_line(tmp_path):
    (tmp_path / "study.db").write_text("no database at all, but long enough to be read as one" * 9)
    with pytest.raises(InputError, match=r"study\.db: file is not a database") as caught:
        StudyStorage(tmp_path, fake_space(), ExplorationSettings())
    assert "\n" not in str(caught.value)


def test_a_lock_that_cannot_be_taken_is_one_clear_line(tmp_path):
    (tmp_path / "study.lock").mkdir()
    with pytest.raises(InputError, match=r"study\.lock is a folder; a file is needed"):
        StudyStorage(tmp_path, fake_space(), ExplorationSettings())


def test_processes_have_names(processes):
    assert is_alive(process_name())
    process = processes.Process(target=int)
    process.start()
    name = process_name(process.pid)
    process.join()
    assert not is_alive(name)
    assert not is_alive("another-host/1/2")
