"""Entry points that read what this package wrote, or a stranger: policies, studies, reports."""

from __future__ import annotations

import contextlib
import json
import re
import sqlite3
import struct
import tempfile
from collections.abc import Callable
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from unittest.mock import patch

import file_entries
import numpy as np
from fuzzing import Entry
from ms_slam_agents.policy import Policy
from mutations import (
    PLAIN,
    Files,
    Rng,
    Special,
    mutated_bytes,
    mutated_folder,
    mutated_json,
    write_files,
)
from optuna.storages._rdb.storage import _VersionManager
from policy_files import as_bytes

from ms_slam_env._runtime.output_files import append_line, growing_file, write_bytes
from ms_slam_env._runtime.result_folders import alone_in, own_folder, result_folder
from ms_slam_env.errors import InputError
from ms_slam_env.report import page
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.records import RecordFile
from ms_slam_env.report.results import write_results
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import make_table
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.tuning import ExplorationSettings, explore, make_space
from ms_slam_env.tuning.choices import choose
from ms_slam_env.tuning.front import hypervolume_history, importances, points_of
from ms_slam_env.tuning.space import SearchSpace
from ms_slam_env.tuning.study_storage import StudyStorage

# --- policies ----------------------------------------------------------------------------------


def mutated_policy(data: bytes, rng: Rng) -> bytes:
    """Its bytes, its header, or the text within the header."""
    if rng.random() < 0.3:
        return mutated_bytes(data, rng)
    (length,) = struct.unpack("<Q", data[:8])
    header, rest = data[8 : 8 + length], data[8 + length :]
    if rng.random() < 0.3:
        header = mutated_json(header, rng)
    else:
        content = json.loads(header)
        text = content["__metadata__"]["ms_slam_policy"].encode()
        content["__metadata__"]["ms_slam_policy"] = mutated_json(text, rng).decode(errors="replace")
        header = json.dumps(content).encode()
    return struct.pack("<Q", len(header)) + header + rest


def call_policy(data: bytes, folder: Path) -> None:
    """Load a policy and ask it."""
    (folder / "p.safetensors").write_bytes(data)
    loaded = Policy.load(folder / "p.safetensors")
    inputs, actions = loaded.metadata.inputs, loaded.num_actions
    found = loaded.probabilities(np.ones((2, inputs)), np.ones((2, actions), bool))
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found.sum(axis=1), len(loaded.parts))


# --- studies -----------------------------------------------------------------------------------

PARAMETERS = ("depth_cutoff_m=1:9", "keyframe_deg=0:10", "keyframe_m=0:1")
SETTINGS = ExplorationSettings(sampler="random")


def evaluate(configuration: SlamConfiguration) -> dict[str, Any]:
    """Something smooth."""
    cutoff, angle, reach = (configuration.slam_config[p.split("=")[0]] for p in PARAMETERS)
    error = 0.01 + 0.01 * (reach - 0.3) ** 2 + 0.05 / cutoff
    return {"ate_m": error, "ext_ms": 2.0 + cutoff + 3 / (1 + angle), "M_I": 0.01, "M_D": 0.02}


@cache
def space() -> SearchSpace:
    """What is explored."""
    return make_space(PARAMETERS, SlamConfiguration("odometry"))


@cache
def study() -> bytes:
    """A study of three trials."""
    with tempfile.TemporaryDirectory() as folder:
        storage = explore(Path(folder), space(), SETTINGS, evaluate, 3)
        storage.study._storage.remove_session()
        with contextlib.closing(sqlite3.connect(Path(folder) / "study.db")) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            data = connection.serialize()
            return data[:18] + b"\1\1" + data[20:]  # no write-ahead log, which memory has not


_WITHOUT_END = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x FROM c"
_RUNNING = (
    "CREATE TRIGGER x{k} AFTER {event} ON {table} BEGIN DELETE FROM trials; END",
    f"CREATE TRIGGER x{{k}} BEFORE {{event}} ON {{table}} BEGIN {_WITHOUT_END}; END",
    "CREATE VIEW x{k} AS SELECT * FROM {table}",
    f"ALTER TABLE {{table}} RENAME TO y{{k}}; CREATE VIEW {{table}} AS {_WITHOUT_END}",
    "CREATE VIRTUAL TABLE x{k} USING fts5(a)",
    "CREATE TABLE x{k}(a)",
    "CREATE INDEX x{k} ON {table}(length(randomblob(100000000)))",
    "ALTER TABLE {table} ADD COLUMN x{k} DEFAULT (random())",
    "ALTER TABLE {table} ADD COLUMN x{k} AS (length(randomblob(100000000)))",
    "PRAGMA writable_schema=ON; UPDATE sqlite_master SET sql = replace(sql, 'NOT NULL', "
    "'CHECK (length(randomblob(100000000)))') WHERE name = '{table}'",
    "PRAGMA writable_schema=ON; UPDATE sqlite_master SET rootpage = {k} WHERE name = '{table}'",
)
"""SQL that makes a database do more than hold rows, or hold them elsewhere."""


def mutated_study(data: bytes, rng: Rng) -> bytes:
    """The bytes of the file, some cells of its tables, or what its tables are."""
    if rng.random() < 0.2:
        return mutated_bytes(data, rng)
    with contextlib.closing(sqlite3.connect(":memory:")) as connection:
        connection.deserialize(data)
        names = "SELECT name FROM sqlite_master WHERE type='table'"
        tables = [name for (name,) in connection.execute(names)]
        for k in range(rng.integers(1, 4)):
            table = tables[rng.integers(len(tables))]
            with contextlib.suppress(sqlite3.Error, UnicodeEncodeError, OverflowError):
                if rng.random() < 0.15:
                    event = ("INSERT", "UPDATE", "DELETE")[rng.integers(3)]
                    statement = _RUNNING[rng.integers(len(_RUNNING))]
                    connection.executescript(statement.format(k=k, event=event, table=table))
                else:
                    _mutate_table(connection, table, rng)
        connection.commit()
        return connection.serialize()


def _mutate_table(connection: sqlite3.Connection, table: str, rng: Rng) -> None:
    columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
    if not columns:  # dropped by a mutation before
        return
    column = columns[rng.integers(len(columns))]
    draw = rng.random()
    if draw < 0.05:
        connection.execute(f"DROP TABLE {table}")
    elif draw < 0.2:
        connection.execute(f"DELETE FROM {table} WHERE rowid % 2 = {rng.integers(2)}")
    else:
        value = PLAIN[rng.integers(len(PLAIN))]
        is_plain = isinstance(value, (str, int, float)) and rng.random() < 0.6
        text = value if is_plain else json.dumps(value)
        where = f"rowid = (SELECT rowid FROM {table} ORDER BY rowid LIMIT 1 OFFSET ?)"
        offset = int(rng.integers(3))
        connection.execute(f"UPDATE {table} SET {column} = ? WHERE {where}", (text, offset))


@cache
def migrations() -> Any:
    """Those of Optuna's tables, which it imports anew whenever it opens a study."""
    manager = object.__new__(_VersionManager)
    manager.url = "sqlite://"
    return manager._create_alembic_script()


def call_study(data: bytes, folder: Path) -> None:
    """Go on with a study, and look at its front."""
    (folder / "study.db").write_bytes(data)
    known = migrations()
    with patch.object(_VersionManager, "_create_alembic_script", lambda manager: known):
        storage = explore(folder, space(), SETTINGS, evaluate, 4)
    points = points_of(storage)
    reference = storage.reference()
    assert reference is not None
    assert len(points) >= 4
    history = hypervolume_history(points, reference, SETTINGS.objectives)
    assert np.isfinite(history).all()
    choose(points, SETTINGS.objectives)
    importances(storage)


# --- reports -----------------------------------------------------------------------------------

SECRET = "this lies outside of the folder"


@cache
def results() -> Files:
    """A folder of two results with what lies beside them."""
    table = make_table(
        ["planner", "ate_m", "f_score_5cm"],
        [
            {"planner": "greedy", "ate_m": Interval(0.0123, 0.01, 0.02), "f_score_5cm": 0.5},
            {"planner": "random", "ate_m": float("inf"), "f_score_5cm": None},
        ],
        "By planner",
        "A note.",
    )
    steps = [1, 2, 3]
    line = Series("greedy", steps, [0.1, 0.2, 0.3], [0.1, 0.1, 0.2], [0.2, 0.3, 0.4], "lines")
    bars = Series("random", [0.1, 0.2], ["a", "b"], mode="bars")
    charts = [Chart("c", "Errors", "Lines.", [Panel("ate_m", "steps", [line])])]
    charts.append(Chart("d", "Bars", "Bars.", [Panel("ate_m", "", [bars])]))
    rows = [
        {"key": "1", "spec": {"planner": "greedy", "seed": 1}, "result": {"ate_m": 0.1}},
        {"key": "2", "spec": {"planner": "random", "seed": 2}, "result": None, "error": "broken"},
    ]
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "results.json"
        rows = [{"error": None, **row} for row in rows]
        write_results(path, "planners", "Planners", "About.", [table], charts, rows)
        data = path.read_bytes()
    return {
        "a/results.json": data,
        "b/metrics.json": data,
        "a/picture.png": file_entries.image("color", 0),
        "a/evaluation.json": json.dumps({"kind": "x", "tables": [], "truth": "../x"}).encode(),
        "b/trajectory.txt": file_entries.trajectory(),
        "b/frames.csv": b"timestamp,tracking_ok\n0,1\n",
    }


def mutated_results(files: Files, rng: Rng) -> Files:
    """As any folder, or with a link that leads out of it."""
    made = dict(mutated_folder(files, rng))
    if rng.random() < 0.2 and made:
        name = sorted(made)[rng.integers(len(made))]
        made[name] = Special("link", "../../outside/secret.txt")
    return made


class Reader(HTMLParser):
    """Remembers the tags that load something."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Look for attributes with an address."""
        own = {key: value or "" for key, value in attrs}
        for key in ("src", "href", "data", "action"):
            if not own.get(key, "#").startswith(("#", "data:")):
                self.loads.append(f"{tag} {key}={own[key]}")
        self.loads += [f"{tag} {key}" for key in own if key.startswith("on")]


def call_report(files: Files, folder: Path) -> None:
    """Make a report, but for Plotly's 4 MB; it shows nothing from elsewhere and loads nothing."""
    write_files({"secret.txt": SECRET.encode()}, folder / "outside")
    write_files(files, folder / "in")
    with patch.object(page, "_plotly_source", lambda: "let Plotly"):
        path = page.write_report(folder / "in", folder / "report.html")
    text = re.sub(r"<script>.*?</script>", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert SECRET not in text
    reader = Reader()
    reader.feed(text)
    assert reader.loads == []


def call_records(files: Files, folder: Path) -> None:
    """Read rows, as a run that goes on does, and add one."""
    write_files(files, folder)
    records = RecordFile(folder / "rows.jsonl")
    before = records.load()
    records.append({"key": "new", "result": {}})
    assert {**before, "new": {"key": "new", "result": {}}} == records.load()


@cache
def rows() -> Files:
    """Some rows."""
    lines = [json.dumps({"key": str(k), "result": {"ate_m": k}, "error": None}) for k in range(5)]
    return {"rows.jsonl": ("\n".join(lines) + "\n").encode()}


# --- places of files ----------------------------------------------------------------------------

FIGURE = "figs/a.png"
OUTPUTS = (
    *("report.html", "trajectory.txt", "rows.jsonl", "results.json", FIGURE, "episodes/1.npz"),
    *("figs", "episodes", ".ms-slam.lock"),
    *("study.db", "study.db-wal", "study.db-shm", "study.db-journal", "study.lock"),
)
OUTSIDE: Files = {"secret.txt": SECRET.encode(), "figs/a.png": b"a", "episodes/1.npz": b"1"}


@cache
def outputs() -> Files:
    """A folder of results, and files outside of it."""
    inside = {name: b"old\n" for name in OUTPUTS if "." in name.strip(".") and "study" not in name}
    inside = {f"in/{name}": data for name, data in inside.items()} | {"in/study.db": study()}
    return {f"outside/{name}": data for name, data in OUTSIDE.items()} | inside


def mutated_outputs(files: Files, rng: Rng) -> Files:
    """With what a stranger may have put in the place of what is to be written."""
    made = dict(files)
    for _ in range(rng.integers(1, 4)):
        name = OUTPUTS[rng.integers(len(OUTPUTS))]
        if rng.random() < 0.2:
            name += ".partial"
        up = "../" * (1 + name.count("/"))
        inner = [other for other in made if other.startswith((f"in/{name}/", f"in/{name}"))]
        outer = [k for k in made if f"in/{name}".startswith(f"{k}/")]
        for other in (*inner, *outer):
            del made[other]
        made[f"in/{name}"] = (
            Special("link", f"{up}outside/secret.txt"),
            Special("hardlink", f"{up}outside/secret.txt"),
            Special("link", f"{up}outside"),
            Special("link", f"{up}outside/{name}"),
            Special("link", f"{up}nowhere"),
            Special("fifo"),
            Special("folder"),
            b"x" * int(rng.integers(2000)),
        )[rng.integers(8)]
    return made


def call_outputs(files: Files, folder: Path) -> None:
    """Write all sorts of results; what lies outside stays as it is, whatever is refused."""
    write_files(files, folder)
    out, outside = folder / "in", folder / "outside"
    refused: list[InputError] = []

    def attempted(write: Callable[[], object]) -> None:
        try:
            write()
        except InputError as error:
            refused.append(error)

    def write_growing() -> None:
        with growing_file(out / "trajectory.txt") as add:
            add("new")
        assert (out / "trajectory.txt").read_bytes() == b"new\n"

    def write_result() -> None:
        with result_folder(out, "results.json") as made:
            write_bytes(made / "results.json", b"new")
            write_bytes(made / FIGURE, b"new")
        assert (out / FIGURE).read_bytes() == (out / "results.json").read_bytes() == b"new"

    def write_page() -> None:
        write_bytes(out / "report.html", b"new", durable=False)
        assert (out / "report.html").read_bytes() == b"new"

    def append() -> None:
        append_line(out / "rows.jsonl", b"new\n")
        assert (out / "rows.jsonl").read_bytes().endswith(b"new\n")

    def hold() -> None:
        with alone_in(out):
            write_bytes(own_folder(out / "episodes") / "1.npz", b"new", durable=False)

    def go_on() -> None:
        known = migrations()
        with patch.object(_VersionManager, "_create_alembic_script", lambda manager: known):
            StudyStorage(out, space(), SETTINGS)

    for write in (write_growing, write_result, write_page, append, hold, go_on):
        attempted(write)
    found = {
        path.relative_to(outside).as_posix(): path.read_bytes()
        for path in outside.rglob("*")
        if path.is_file()
    }
    assert found == OUTSIDE
    if refused:
        raise refused[0]


ENTRIES = [
    Entry("outputs", outputs, mutated_outputs, call_outputs, in_tests=20),
    Entry("policy", as_bytes, mutated_policy, call_policy),
    Entry("study", study, mutated_study, call_study, in_tests=20),
    Entry("report", results, mutated_results, call_report, in_tests=100),
    Entry("records", rows, mutated_folder, call_records),
]
