"""A study that somebody wrote into is refused in one line, before anything is changed."""

import errno
import json
import os
import sqlite3

import pytest
from fake_evaluation import fake_space

from ms_slam_env import output_files
from ms_slam_env.command_line import exit_code
from ms_slam_env.errors import InputError
from ms_slam_env.exploration import ExplorationSettings
from ms_slam_env.exploration.study_storage import StudyStorage


def open_study(folder):
    return StudyStorage(folder, fake_space(), ExplorationSettings(sampler="random"))


def write_into(folder, statement, *values):
    connection = sqlite3.connect(folder / "study.db")
    connection.execute(statement, values)
    connection.commit()
    connection.close()


@pytest.fixture
def study(tmp_path):
    """A study of three finished trials and one that waits."""
    storage = open_study(tmp_path)
    for k in range(3):
        measured = {"ate_m": 0.1 + 0.01 * k, "ext_ms": 5.0 - k, "M_I": 0.1, "frames": 90}
        storage.tell(storage.ask(9), measured)
    storage.study.enqueue_trial(storage.space.defaults())
    storage.study._storage.remove_session()
    assert len(open_study(tmp_path).finished()) == 3
    return tmp_path


def text_of(key):
    """SQL that sets the attribute ``key`` of the second trial."""
    return f"UPDATE trial_user_attributes SET value_json = ? WHERE key = '{key}' AND trial_id = 2"


MEASURED = text_of("measured")


@pytest.mark.parametrize(
    ("statement", "complaint"),
    [
        (("UPDATE trial_values SET value = 'x' WHERE trial_value_id = 3",), "trial 1: its values"),
        (("UPDATE trial_values SET value = 9e999",), "trial 0: its values"),
        (("DELETE FROM trial_values WHERE trial_value_id = 4",), "trial 1: its values"),
        (("DELETE FROM trial_user_attributes WHERE key = 'measured'",), "trial 0: what was"),
        ((MEASURED, '{"ate_m": "x"}'), "trial 1: what was measured"),
        ((MEASURED, '{"ate_m": true}'), "trial 1: what was measured"),
        ((MEASURED, json.dumps({"ext_ms": 10**400})), "trial 1: what was measured"),
        ((MEASURED, '{"failure": 3}'), "trial 1: what was measured"),
        ((MEASURED, "[1]"), "trial 1: what was measured"),
        ((MEASURED, "{"), "Expecting property name"),
        ((text_of("owner"), '"x"'), "trial 1: owner is not the name of a process"),
        (("UPDATE trial_params SET param_value = 1e9",), "trial 0: a parameter"),
        (("UPDATE trial_params SET distribution_json = '[[]]'",), "list indices"),
        (("DELETE FROM trial_params",), "trial 0: it is finished, and parameters are missing"),
        (("DELETE FROM trials WHERE trial_id = 2",), "has a row of a trial that is not there"),
        (("UPDATE trial_values SET trial_id = 99 WHERE trial_value_id = 3",),
         "trial_values has a row of a trial that is not there"),
        (("UPDATE trials SET datetime_start = 'x'",), "Invalid isoformat string"),
        (("UPDATE study_directions SET direction = 'MAXIMIZE'",), "other directions"),
        (("DELETE FROM study_user_attributes WHERE key = 'reference'",), "has no reference"),
        (("UPDATE study_user_attributes SET value_json = '{\"ate_m\": 0}' "
          "WHERE key = 'reference'",), "reference is not a positive number"),
        (("UPDATE study_user_attributes SET value_json = '[1]' WHERE key = 'settings'",),
         "not a study"),
    ],
)  # fmt: skip
def test_what_no_exploration_wrote_is_refused(study, statement, complaint):
    write_into(study, *statement)
    before = (study / "study.db").read_bytes()
    with pytest.raises(InputError, match=rf"study\.db: .*{complaint}") as caught:
        open_study(study)
    assert "\n" not in str(caught.value)
    assert (study / "study.db").read_bytes() == before


def test_a_table_that_goes_missing_meanwhile_is_one_line(study):
    storage = open_study(study)
    write_into(study, "DROP TABLE trial_user_attributes")
    with pytest.raises(InputError, match=r"study\.db: no such table: trial_user_attributes"):
        storage.ask(9)


@pytest.mark.parametrize("name", ["ENOSPC", "EDQUOT", "EIO", "EROFS"])
@pytest.mark.parametrize("file", ["study.lock", "study.db"])
def test_a_disk_that_takes_no_file_is_one_line(tmp_path, monkeypatch, capsys, file, name):
    number, opened = getattr(errno, name), os.open

    def broken(path, *arguments):
        if str(path).endswith(file):
            raise OSError(number, os.strerror(number))
        return opened(path, *arguments)

    monkeypatch.setattr(output_files.os, "open", broken)
    assert exit_code(lambda: open_study(tmp_path) and 0) == 1
    said = capsys.readouterr().err
    assert said == f"ms-slam: error: {tmp_path / file}: {os.strerror(number)}\n"
