"""A study that somebody wrote into is refused in one line, before anything is changed."""

import errno
import json
import os
import socket
import sqlite3

import pytest
from fake_evaluation import fake_space

from ms_slam_env._runtime import output_files
from ms_slam_env._runtime.command_line import exit_code
from ms_slam_env._runtime.output_files import is_alive
from ms_slam_env.errors import InputError
from ms_slam_env.tuning import ExplorationSettings
from ms_slam_env.tuning.study_storage import StudyStorage


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


FOR_EVER = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x FROM c"


@pytest.mark.parametrize(
    ("statements", "complaint"),
    [
        (["CREATE TRIGGER t AFTER INSERT ON trial_values BEGIN UPDATE trial_values SET value = -1; "
          "END"], "trigger t is not Optuna's"),
        (["CREATE TRIGGER t AFTER INSERT ON trials BEGIN INSERT INTO trial_user_attributes"
          f"(trial_id) SELECT * FROM ({FOR_EVER}); END"], "trigger t is not Optuna's"),
        (["ALTER TABLE trial_params RENAME TO other", f"CREATE VIEW trial_params AS {FOR_EVER}"],
         "is not Optuna's|trial_params is not as"),
        (["DROP TABLE trial_heartbeats",
          "CREATE VIRTUAL TABLE trial_heartbeats USING fts5(trial_id)"],
         "trial_heartbeats"),
        (["CREATE TABLE passwords(a)"], "table passwords is not Optuna's"),
        (["CREATE INDEX mine ON trials(abs(number))"], "index mine is not Optuna's"),
        (["ALTER TABLE trials ADD COLUMN x DEFAULT 3"], "table trials is not as Optuna makes it"),
        (["DROP TABLE trial_heartbeats"], "trial_heartbeats_1 is missing"),
        (["PRAGMA writable_schema=ON", "UPDATE sqlite_master SET sql = replace(sql, 'NOT NULL', "
          "'NOT NULL CHECK (length(randomblob(100000000)))') WHERE name = 'trials'"],
         "table trials is not as Optuna makes it"),
        (["PRAGMA writable_schema=ON", "UPDATE sqlite_master SET rootpage = (SELECT rootpage FROM "
          "sqlite_master WHERE name = 'trials') WHERE name = 'trial_values'"], "2nd reference"),
    ],
)  # fmt: skip
def test_a_study_has_optunas_tables_and_nothing_else(study, statements, complaint):
    connection = sqlite3.connect(study / "study.db")
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()
    before = (study / "study.db").read_bytes()
    with pytest.raises(InputError, match=rf"study\.db: .*({complaint})") as caught:
        open_study(study)
    assert "\n" not in str(caught.value)
    assert (study / "study.db").read_bytes() == before


def test_what_a_log_adds_to_the_tables_is_seen(study):
    """A write-ahead log is part of the database, as the one of an exploration that was killed."""
    connection = sqlite3.connect(study / "study.db")
    connection.execute("CREATE VIEW v AS SELECT 1")
    connection.commit()
    kept = {name: (study / name).read_bytes() for name in ("study.db", "study.db-wal")}
    connection.close()
    for name, data in kept.items():
        (study / name).write_bytes(data)
    with pytest.raises(InputError, match="view v is not Optuna's"):
        open_study(study)


def foreign(path):
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE passwords(a)")
    connection.commit()
    connection.close()


@pytest.mark.parametrize("name", ["study.db", "study.db-wal", "study.db-shm", "study.lock"])
@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_no_link_leads_to_another_file(tmp_path, name, link):
    victim, folder = tmp_path / "other.sqlite", tmp_path / "study"
    foreign(victim)
    before = victim.read_bytes()
    folder.mkdir()
    link(victim, folder / name)
    with pytest.raises(InputError, match=rf"{name} (is a link to another file|has other names)"):
        open_study(folder)
    assert victim.read_bytes() == before


def test_a_database_of_another_is_left_as_it_is(tmp_path):
    foreign(tmp_path / "study.db")
    before = (tmp_path / "study.db").read_bytes()
    with pytest.raises(InputError, match="table passwords is not Optuna's"):
        open_study(tmp_path)
    assert (tmp_path / "study.db").read_bytes() == before


def test_a_journal_which_may_name_a_file_to_delete_is_refused(study):
    (study / "study.db-journal").write_bytes(b"x" * 1024)
    with pytest.raises(InputError, match=r"study\.db-journal does not belong to an exploration"):
        open_study(study)


def test_an_owner_that_is_no_process_does_not_live_for_ever():
    for number in (0, 2**31, 10**9 * 9):
        assert not is_alive(f"{socket.gethostname()}/{number}/")


def test_a_table_that_goes_missing_meanwhile_is_one_line(study):
    storage = open_study(study)
    write_into(study, "DROP TABLE trial_user_attributes")
    with pytest.raises(InputError, match=r"study\.db: no such table: trial_user_attributes"):
        storage.ask(9)


@pytest.mark.parametrize("name", ["ENOSPC", "EDQUOT", "EIO", "EROFS"])
@pytest.mark.parametrize("file", ["study.lock", "study.db"])
def test_a_disk_that_takes_no_file_is_one_line(tmp_path, monkeypatch, capsys, file, name):
    number, opened, replace = getattr(errno, name), os.open, os.replace

    def broken(path, *arguments):
        if str(path).endswith(file):
            raise OSError(number, os.strerror(number))
        return opened(path, *arguments)

    def not_moved(source, target):
        if str(target).endswith(file):
            raise OSError(number, os.strerror(number))
        replace(source, target)

    monkeypatch.setattr(output_files.os, "open", broken)
    monkeypatch.setattr(output_files.os, "replace", not_moved)
    assert exit_code(lambda: open_study(tmp_path) and 0) == 1
    said = capsys.readouterr().err
    assert said == f"ms-slam: error: {tmp_path / file}: {os.strerror(number)}\n"
