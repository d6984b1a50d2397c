"""Every command on a disk that fills up, and with a place for its results that cannot be one."""

from __future__ import annotations

import errno
import json
import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from subprocess import PIPE
from typing import Any

import numpy as np
import pytest

from ms_slam_env._runtime import output_files
from ms_slam_env._runtime.command_line import exit_code
from ms_slam_env.benchmark import Experiment
from ms_slam_env.camera import xtion
from ms_slam_env.cli import COMMANDS, experiment, main
from ms_slam_env.geometry import look_at
from ms_slam_env.report.records import RecordFile, Row
from ms_slam_env.report.tables import Table, make_table
from ms_slam_env.sequences import render_sequence
from ms_slam_env.sequences.writing import write_sequence
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.tuning import ExplorationSettings, make_space
from ms_slam_env.tuning.study_storage import StudyStorage

WRITE = os.write
MARKERS = {"metrics.json", "evaluation.json", "divergence.json", "results.json", "sequence.json",
           "explore.json", "report.html"}  # fmt: skip
SMALL = ["--scene", "table", "--image-size", "80x60", "--path.frames", "2"]


@pytest.fixture(scope="module")
def work(box_scene: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short sequence, a run over it, and a page with a table of a result."""
    folder = tmp_path_factory.mktemp("work")
    eye = box_scene.sample_start(np.random.default_rng(0))[:3, 3]
    middle = box_scene.mesh.vertices.mean(axis=0)
    poses = [look_at(eye + 0.01 * k * np.eye(3)[0], middle) for k in range(4)]
    rendered = render_sequence(box_scene, np.stack(poses), xtion("80x60"))
    write_sequence(rendered, folder / "sequence", {})
    assert main(["run", str(folder / "sequence"), "--out", str(folder / "run")]) == 0
    assert run_tiny(["--out", str(folder / "docs" / "results" / "tiny")]) == 0
    page = "<!-- results: tiny -->\n" + "| old |\n" * 100 + "<!-- end -->\n"
    (folder / "README.md").write_text(page)
    return folder


@dataclass(frozen=True)
class Tiny(Experiment):
    """One row."""

    @staticmethod
    def run(spec: Tiny) -> dict[str, Any]:
        return {"ate_m": 0.5}

    def specs(self) -> list[Tiny]:
        return [self]

    def tables(self, rows: Any) -> list[Table]:
        return [make_table(("ate_m",), [row["result"] for row in rows])]


def run_here(specs: Any, run: Any, out: Path, *_: Any, **options: Any) -> list[Row]:
    """As `run_all`, in this process, whose disk is full."""
    rows = [{"key": "a", "spec": {}, "result": run(specs[0]), "error": None, "commit": None}]
    RecordFile(out / "rows.jsonl").append(rows[0])
    return rows


def run_tiny(arguments: list[str]) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ms_slam_env.benchmark.rows.run_all", run_here)
        return exit_code(lambda: experiment.run(Tiny, arguments, "ms-slam experiment", Path("x")))


Run = Callable[[Path, Path], int]  # of a command, with the folder above and that of the results
RUNS: dict[str, Run] = {
    "run": lambda work, out: main(["run", f"{work}/sequence", "--out", str(out)]),
    "divergence": lambda work, out: main(["divergence", f"{work}/sequence", "--out", str(out)]),
    "evaluate": lambda work, out: main(
        ["evaluate", f"{work}/run/trajectory.txt", f"{work}/run/groundtruth.txt", "--map",
         f"{work}/run/map.ply", "--true-map", f"{work}/run/map.ply", "--out", str(out)]
    ),
    "report": lambda work, out: main(["report", f"{work}/run", "--out", f"{out}/report.html"]),
    "generate": lambda work, out: main(["generate", *SMALL, "--out", str(out)]),
    "docs": lambda work, out: main(["docs", "--root", str(work)]),
    "experiment": lambda work, out: run_tiny(["--out", str(out)]),
}  # fmt: skip


@pytest.fixture
def limit(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """Let files grow to so many bytes, and after the first that does not fit, none at all."""
    sizes: dict[str, int] = {}
    most, number = 0, errno.ENOSPC

    def write(descriptor: int, data: bytes) -> int:
        name = os.readlink(f"/proc/self/fd/{descriptor}")
        if not name.startswith("/") or name.startswith("/dev/"):
            return WRITE(descriptor, data)
        taken = data[: max(0, most - sizes.get(name, 0))]
        if not taken:
            raise OSError(number, os.strerror(number))
        sizes[name] = sizes.get(name, 0) + len(taken)
        return WRITE(descriptor, taken)

    def begin(size: int) -> None:
        nonlocal most
        most = size

    monkeypatch.setattr(output_files.os, "write", write)
    return begin


@pytest.mark.parametrize("size", [0, 300])
@pytest.mark.parametrize("command", RUNS)
def test_a_full_disk_is_one_line_and_leaves_nothing_that_looks_finished(
    command: str,
    size: int,
    work: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    limit: Callable[[int], None],
) -> None:
    page = (work / "README.md").read_text()
    limit(size)
    assert RUNS[command](work, tmp_path / "out") == (0 if (command, size) == ("docs", 300) else 1)
    if (command, size) == ("docs", 300):
        return
    last = capsys.readouterr().err.strip().splitlines()[-1]
    place = str(work if command == "docs" else tmp_path)
    assert last.startswith(f"ms-slam: error: {place}"), last
    assert last.endswith(": No space left on device")
    left = {path.name for path in tmp_path.rglob("*")}
    assert not left & MARKERS
    assert not [name for name in left if name.endswith(".png.partial") or name[0] == "."]
    assert (work / "README.md").read_text() == page


def test_a_run_whose_map_does_not_fit_says_that_it_is_not_complete(
    work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], limit: Callable[[int], None]
) -> None:
    limit(30_000)
    assert RUNS["run"](work, tmp_path) == 1
    assert capsys.readouterr().err.splitlines()[-1].endswith("map.ply: No space left on device")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "frames.csv",
        "metrics.json",
        "trajectory.incomplete.txt",
    ]
    written = json.loads((tmp_path / "metrics.json").read_text())
    assert (written["complete"], written["interrupted"], written["frames"]) == (False, False, 4)
    assert "map.ply" in written["error"]


def test_a_study_says_that_the_disk_is_full(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """SQLite's limit of pages is to it what a full disk is."""
    pages = [10**6]
    connect = StudyStorage._connect

    def connect_to_full_disk(storage: StudyStorage) -> sqlite3.Connection:
        connection = connect(storage)
        connection.execute(f"PRAGMA max_page_count={pages[0]}")
        return connection

    monkeypatch.setattr(StudyStorage, "_connect", connect_to_full_disk)

    def work_on(folder: Path, trials: int) -> int:
        space = make_space(["keyframe_deg=0:10"], SlamConfiguration(slam="odometry"))
        storage = StudyStorage(folder, space, ExplorationSettings())
        while len(storage.finished()) < trials:
            trial = storage.ask(trials)
            assert trial is not None
            storage.tell(trial, {"ate_m": 0.1, "ext_ms": 1.0, "text": "x" * 20_000})
        return 0

    assert exit_code(lambda: work_on(tmp_path / "a", 2)) == 0
    for folder, most in (("new", 3), ("a", 60)):  # at the beginning, and in the middle
        pages[0] = most
        assert exit_code(lambda folder=folder: work_on(tmp_path / folder, 30)) == 1
        assert capsys.readouterr().err == (
            f"ms-slam: error: {tmp_path / folder / 'study.db'}: No space left on device "
            "(database or disk is full)\n"
        )
    pages[0] = 10**6
    assert exit_code(lambda: work_on(tmp_path / "a", 3)) == 0  # what was finished is kept


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("letters", [10, 100_000])
def test_an_output_that_takes_nothing_is_one_line(letters: int) -> None:
    """In a process of its own, whose standard output is written when it ends, or is much."""
    code = """import sys
from ms_slam_env._runtime.command_line import exit_code
sys.exit(exit_code(lambda: print("x" * int(sys.argv[1])) or 0))"""
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code, str(letters)],
            stdout=full,
            stderr=PIPE,
            text=True,
            env={k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"},
        )
    assert done.returncode == 1
    assert done.stderr == "ms-slam: error: standard output: No space left on device\n"


@pytest.mark.parametrize(
    "command",
    [
        *(["benchmark"], ["compare"], ["divergence", "x"], ["evaluate", "x", "y"]),
        *(["experiment", "step_size"], ["explore"], ["generate"], ["report", "x"], ["run", "x"]),
        *(["train"], ["usme", "make"], ["usme", "run"]),
    ],
    ids=" ".join,
)
def test_results_go_into_no_special_file(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if command == ["train"]:
        pytest.importorskip("sb3_contrib")
    is_file = command[0] == "report"
    fifo, wrong = tmp_path / "fifo", tmp_path / "wrong"
    os.mkfifo(fifo)
    wrong.mkdir() if is_file else wrong.touch()
    for out, what in (
        (fifo, "is a FIFO"),
        (Path(os.devnull), "is a character device"),
        (wrong, "is a folder" if is_file else "is a file"),
    ):
        assert main([*command, "--out", str(out)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"error: {out} {what}; a {'file' if is_file else 'folder'} is needed" in line
    assert fifo.is_fifo()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fifo", "wrong"]


LIMITED = {
    "record --planner random --scenes table --episodes 1 --steps 2": 100,
    "view --planner random --scene table --steps 2 --options image_size=80x60": 2000,
    "compare --sequences table:0:none --frames 10 --backends odometry --image-sizes 80x60": 2000,
    "usme make --frames-scale 0.02 --sequences room-fast --image-size 80x60": 2000,
    "train sb3 --scenes table --scene-seeds 1 --episode-steps 2 --total-timesteps 4 --num-envs 1 "
    "--n-steps 2 --batch-size 2 --eval-episodes 1 --eval-every 0 --no-references": 20_000,
}


def limited(size: int, command: str, out: Path) -> subprocess.CompletedProcess[str]:
    """Run a command whose every file may have so many bytes."""
    code = (
        "import resource, sys; from ms_slam_env.cli import main; size = int(sys.argv[1]); "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)); sys.exit(main(sys.argv[2:]))"
    )
    place = ["--save", f"{out}/a.rrd"] if command.startswith("view") else ["--out", str(out)]
    words = [sys.executable, "-c", code, str(size), *command.split(), *place]
    return subprocess.run(words, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("command", LIMITED, ids=lambda command: command[:9].strip())
def test_a_limit_of_the_system_is_one_line(command: str, tmp_path: Path) -> None:
    """Processes of their own, whose every file may have so many bytes, those of libraries too."""
    for start, library in {"train": "sb3_contrib", "record": "minari", "view": "rerun"}.items():
        if command.startswith(start):
            pytest.importorskip(library)
    done = limited(LIMITED[command], command, tmp_path)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "error: " in line]
    assert f"error: {tmp_path}" in line
    assert line.endswith(": File too large")
    left = {path.name for path in tmp_path.rglob("*")}
    assert not left & (MARKERS | {"latest.safetensors", "best.safetensors", "a.rrd"})


@pytest.mark.slow
def test_a_library_that_dies_of_a_full_disk_takes_nothing_with_it(tmp_path: Path) -> None:
    """HDF5 crashes the process that closes a file which could not be written."""
    pytest.importorskip("minari")
    done = limited(5000, "record --planner random --scenes table --episodes 1 --steps 2", tmp_path)
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if "error: " in line[:30]]
    assert f"error: {tmp_path}/random-v0: " in line
    assert line.endswith(("the process that wrote it died", "File too large"))
    assert not list(tmp_path.iterdir())


def test_every_command_is_attacked() -> None:
    """Those not run here write by the same pieces: rows and results as `compare`, and a study."""
    run_here = {command.split()[0] for command in LIMITED}
    assert set(COMMANDS) <= set(RUNS) | run_here | {"benchmark", "explore"}
