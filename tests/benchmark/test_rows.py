"""Parallel runs lose and repeat nothing, whenever they are interrupted."""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import fake_work
import pytest
from fake_work import Named, Square, square
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env.benchmark import rows as rows_module
from ms_slam_env.benchmark.episodes import EpisodeSpec
from ms_slam_env.benchmark.rows import RECORDS, failures, file_hashes, names, run_all
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.metrics.registry import RESULTS_VERSION
from ms_slam_env.report.records import RecordFile, spec_key, write_json


def test_rows_come_in_the_order_of_the_specs(tmp_path: Path) -> None:
    specs = [Square(3, 0.2), Square(1), Square(2)]
    rows = run_all(specs, square, tmp_path, workers=2)
    assert [row["result"]["square"] for row in rows] == [9, 1, 4]
    assert [row["spec"]["number"] for row in rows] == [3, 1, 2]
    assert {row["result"]["threads"] for row in rows} == {"1"}


def test_finished_work_is_not_done_again(tmp_path: Path) -> None:
    log = tmp_path / "log"
    specs = [Square(i, log=str(log)) for i in range(4)]
    run_all(specs[:2], square, tmp_path / "out", workers=1)
    rows = run_all(specs, square, tmp_path / "out", workers=1)
    assert sorted(log.read_text().split()) == ["0", "1", "2", "3"]
    assert [row["result"]["square"] for row in rows] == [0, 1, 4, 9]


def test_what_is_given_twice_counts_once(tmp_path: Path) -> None:
    rows = run_all([Square(2), Square(3), Square(2)], square, tmp_path, workers=1)
    assert [row["result"]["square"] for row in rows] == [4, 9]


def test_rows_of_an_older_algorithm_are_made_again(tmp_path, monkeypatch, capsys) -> None:
    log, specs = tmp_path / "log", [Square(1, log=str(tmp_path / "log"))]
    given = {"workers": 1, "kind": "planners"}
    run_all(specs, square, tmp_path / "out", **given)
    monkeypatch.setattr(rows_module, "git_commit", lambda: "another")
    run_all(specs, square, tmp_path / "out", **given)
    assert log.read_text().split() == ["1"]
    assert "1 of 1 already in" in capsys.readouterr().err
    known = {RESULTS_VERSION + 1: ("planners",)}
    since = lambda version, kind: {n: "" for n, of in known.items() if n > version and kind in of}  # noqa: E731
    monkeypatch.setattr(rows_module, "versions_since", since)
    run_all(specs, square, tmp_path / "out", workers=1, kind="compare")
    assert log.read_text().split() == ["1"]
    run_all(specs, square, tmp_path / "out", **given)
    assert log.read_text().split() == ["1", "1"]


def test_rows_are_made_again_where_a_file_that_they_name_has_changed(
    tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    policy, module, log = Path("runs/best.safetensors"), Path("rowplanners.py"), Path("log")
    policy.parent.mkdir()
    policy.write_bytes(b"one")
    module.write_text("class Mine: ...\n")
    names = (f"policy,path={policy},deterministic=true", "rowplanners:Mine", "greedy")
    specs = [Named(k, log=str(log), planner=name) for k, name in enumerate(names)]
    run_all(specs, square, Path("out"), workers=1)
    run_all(specs, square, Path("out"), workers=1)
    assert log.read_text().split() == ["0", "1", "2"]
    policy.write_bytes(b"another")
    capsys.readouterr()
    run_all(specs, square, Path("out"), workers=1)
    assert log.read_text().split() == ["0", "1", "2", "0"]
    assert "1 of 3 are made again: a file that they name has changed" in capsys.readouterr().err
    module.write_text("class Mine: pass\n")
    run_all(specs, square, Path("out"), workers=1)
    assert log.read_text().split() == ["0", "1", "2", "0", "1"]
    run_all(specs, square, Path("out"), workers=1)
    assert log.read_text().split() == ["0", "1", "2", "0", "1"]


def test_files_that_a_spec_names(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("greedy").write_text("no file is meant")
    Path("house.glb").write_text("mesh")
    Path("tracker").write_text("program")
    assert file_hashes(EpisodeSpec("greedy", "house.glb")) == {"house.glb": hash_of("mesh")}
    options = file_hashes(EpisodeSpec("greedy", "house.glb,up=z"))
    assert options == {"house.glb": hash_of("mesh")}
    command = Backend("command:./tracker --in {sequence} --out {trajectory}")
    assert file_hashes(command) == {"./tracker": hash_of("program")}
    for text in (
        "",
        "a,b=c",
        "no_such_module:Class",
        "os.path:x:y",
        "x" * 5000 + "/",
        "a/\0",
        "./",
    ):
        assert file_hashes(Backend(text)) == {}
    assert list(file_hashes(Backend("ms_slam_env.tasks:room"))) == ["ms_slam_env.tasks:room"]
    assert file_hashes(Square(1, log="house.glb")) == {}


def hash_of(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Backend:
    """A piece of work that names a SLAM."""

    backend: str


def test_a_changed_spec_is_other_work(tmp_path: Path) -> None:
    run_all([Square(2)], square, tmp_path, workers=1)
    rows = run_all([Square(2, seconds=0.001)], square, tmp_path, workers=1)
    assert len((tmp_path / RECORDS).read_text().splitlines()) == 2
    assert rows[0]["spec"]["seconds"] == 0.001


def test_failures_are_rows_and_are_tried_again(tmp_path: Path) -> None:
    rows = run_all([Square(-1), Square(2)], square, tmp_path, workers=1)
    assert rows[0]["error"] == "ValueError: no square of -1"
    assert rows[0]["result"] is None
    assert "fake_work.py" in rows[0]["traceback"]
    assert rows[1]["result"]["square"] == 4
    assert failures(rows) == ["number -1: ValueError: no square of -1"]
    run_all([Square(-1), Square(2)], square, tmp_path, workers=1)
    lines = [json.loads(line) for line in (tmp_path / RECORDS).read_text().splitlines()]
    assert [line["spec"]["number"] for line in lines].count(-1) == 2
    assert [line["spec"]["number"] for line in lines].count(2) == 1


def test_work_is_named_by_what_a_person_calls_it() -> None:
    specs = {
        "a1": EpisodeSpec("greedy", "table", 2000),
        "b2": EpisodeSpec("greedy", "table", 2001, step_m=0.1),
    }
    named = names({key: asdict(spec) for key, spec in specs.items()})
    assert named == {
        "a1": "planner greedy, scene table, seed 2000, step_m 0.12",
        "b2": "planner greedy, scene table, seed 2001, step_m 0.1",
    }
    assert names({"a1": asdict(Square(3))}) == {"a1": "a1"}


def test_a_worker_that_dies_costs_only_its_own_work(tmp_path: Path) -> None:
    rows = run_all([Square(1), Square(1313), Square(2)], square, tmp_path, workers=1)
    assert rows[1]["error"] == "the process died, exit code 3"
    assert [rows[i]["result"]["square"] for i in (0, 2)] == [1, 4]


def test_a_folder_that_cannot_be_made_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="file is a file; a folder is needed"):
            run_all([Square(1)], square, out, workers=1)


@pytest.mark.parametrize("workers", [0, -1])
def test_workers_must_be_positive(tmp_path: Path, workers: int) -> None:
    with pytest.raises(InputError, match="workers"):
        run_all([Square(1)], square, tmp_path, workers=workers)


def heed_interrupts() -> None:
    """Undo what a shell does to its background jobs: a child inherits that SIGINT is ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_interruption_loses_and_repeats_nothing(tmp_path: Path, how: signal.Signals) -> None:
    out, log, count = tmp_path / "out", tmp_path / "log", 24
    command = [sys.executable, fake_work.__file__, str(out), str(count), "0.2", str(log)]
    process = subprocess.Popen(
        command, stderr=subprocess.DEVNULL, start_new_session=True, preexec_fn=heed_interrupts
    )
    while not (out / RECORDS).exists() and process.poll() is None:
        time.sleep(0.01)
    time.sleep(random.Random().uniform(0, 0.4))
    process.send_signal(how)
    process.wait()
    kept = RecordFile(out / RECORDS).load()
    assert 0 < len(kept) < count, "the interruption came too early or too late to test anything"
    _wait_for_workers_to_end(process.pid)
    ran_before = log.read_text().split()

    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    lines = [json.loads(line) for line in (out / RECORDS).read_text().splitlines()]
    assert sorted(line["spec"]["number"] for line in lines) == list(range(count))
    assert all(line["result"]["square"] == line["spec"]["number"] ** 2 for line in lines)
    # Only what was on its way at the interruption (at most one piece a worker) ran twice.
    assert len(log.read_text().split()) <= count + 2
    assert len(ran_before) - len(kept) <= 2


def _wait_for_workers_to_end(session: int) -> None:
    """The workers of a killed parent end by themselves; fail if they do not."""
    for _ in range(200):
        if not [pid for pid in _processes() if _session(pid) == session]:
            return
        time.sleep(0.05)
    pytest.fail("workers outlived their parent")


def _processes() -> list[int]:
    return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]


def _session(pid: int) -> int | None:
    try:
        return os.getsid(pid)
    except ProcessLookupError:
        return None


@given(st.binary(min_size=1, max_size=40).filter(lambda data: b"\n" not in data))
def test_a_line_cut_short_is_dropped(tmp_path_factory: pytest.TempPathFactory, tail: bytes) -> None:
    path = tmp_path_factory.mktemp("records") / "a.jsonl"
    records = RecordFile(path)
    records.append({"key": "a", "value": 1})
    with path.open("ab") as file:
        file.write(tail)
    with pytest.warns(InputWarning, match=r"a\.jsonl: the last line was cut short and is dropped"):
        assert list(records.load()) == ["a"]
    assert path.read_bytes().endswith(b"\n" + tail)  # reading changes nothing
    records.append({"key": "b", "value": 2})
    assert [row["value"] for row in records.load().values()] == [1, 2]


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    path.write_text('{"key": "a"}\nnot json\n')
    with pytest.raises(InputError, match="line 2"):
        RecordFile(path).load()


def test_records_that_are_no_file_are_refused(tmp_path: Path) -> None:
    """A pipe would be read for ever, a device has no end, and nesting has one."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "lost").symlink_to(tmp_path / "nowhere")
    for name in ("pipe", "zero", "lost"):
        with pytest.raises(InputError, match="cannot read results"):
            RecordFile(tmp_path / name).load()
    (tmp_path / "deep").write_text("[" * 100_000 + "\n")
    with pytest.raises(InputError, match="line 1, is not a result"):
        RecordFile(tmp_path / "deep").load()


def test_a_row_without_word_of_an_error_is_made_again(tmp_path: Path) -> None:
    RecordFile(tmp_path / RECORDS).append({"key": spec_key(Square(3))})
    (row,) = run_all([Square(3)], square, tmp_path, workers=1)
    assert row["error"] is None
    assert row["result"] is not None


def test_the_last_row_of_a_key_counts(tmp_path: Path) -> None:
    records = RecordFile(tmp_path / "a.jsonl")
    for value in (1, 2):
        records.append({"key": "a", "value": value})
    assert records.load()["a"]["value"] == 2


def test_every_field_is_in_the_key() -> None:
    spec = Square(1)
    others = [replace(spec, number=2), replace(spec, seconds=1.0), replace(spec, log="x")]
    assert len({spec_key(s) for s in [spec, *others]}) == 4
    assert spec_key(Square(1)) == spec_key(spec)


def test_write_json_replaces_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert json.loads(path.read_text()) == {"a": 1}


def test_write_json_writes_json(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"a": [float("nan"), 1.5], "b": ({"c": float("inf")}, "NaN", None, True)})

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(path.read_text(), parse_constant=refuse)
    assert content == {"a": [None, 1.5], "b": [{"c": "Infinity"}, "NaN", None, True]}
