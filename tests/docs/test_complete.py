"""Nothing is entered in fewer places than it needs: the steps of ``CONTRIBUTING.md``."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable
from pathlib import Path

import pytest

from ms_slam_env import scenes, slam, tasks
from ms_slam_env.benchmark import EXPERIMENTS, experiment_class
from ms_slam_env.cli import COMMANDS
from ms_slam_env.cli.train import TRAINERS
from ms_slam_env.env.registry import OBSERVATIONS
from ms_slam_env.report.discovery import find_results
from ms_slam_env.report.records import to_plain
from ms_slam_env.report.results import read_results
from ms_slam_env.sequences.perturbations import PERTURBATIONS

ROOT = Path(__file__).resolve().parents[2]
_PYPROJECT = (ROOT / "pyproject.toml").read_text()
_SECTION = re.search(r'entry-points\."ms_slam_env.planners"\]\n(.*?)\n\n', _PYPROJECT, re.DOTALL)
assert _SECTION
PLANNERS = re.findall(r"^([\w-]+) = ", _SECTION[1], re.MULTILINE)
ALL_RECORDS = [one.path for one in find_results(ROOT / "docs" / "results")[0]]
COMMITTED = [
    one.path
    for one in find_results(ROOT / "docs" / "results")[0]
    if one.results.kind in EXPERIMENTS.own and one.results.rows
]


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("slam", slam.BACKENDS),
        ("environments", OBSERVATIONS),
        ("scenes", scenes.SCENES),
        ("sequences", PERTURBATIONS),
        ("planners", PLANNERS),
        ("environments", tasks.OWN),
    ],
)
def test_the_page_of_a_kind_names_everything_of_it(page: str, names: Iterable[str]) -> None:
    text = (ROOT / "docs" / f"{page}.md").read_text()
    assert [name for name in names if not re.search(rf"`{re.escape(name)}[`,]", text)] == []


def test_the_page_on_training_says_which_trainers_no_record_compares() -> None:
    commands = [str(read_results(path).provenance.get("command")) for path in ALL_RECORDS]
    judged = {name for text in commands for name in re.findall(r"^ms-slam train (\w+) --", text)}
    text = (ROOT / "docs" / "training.md").read_text()
    (said,) = re.findall(r"judge policies of (.*?) alone: no record\scompares\s(.*?) with", text)
    named, others = (set(re.findall(r"`(\w+)`", part)) for part in said)
    assert judged == named  # "rllib scaling" counts steps a second
    assert others == set(TRAINERS.names()) - named


def test_every_command_has_a_file_and_every_file_a_command() -> None:
    files = {path.stem for path in (ROOT / "ms_slam_env" / "cli").glob("*.py")} - {"__init__"}
    assert set(COMMANDS) == files


def test_a_new_room_does_not_widen_published_commands() -> None:
    """Their results were made with these; ``ms-slam experiment NAME --check`` repeats them."""
    expected = ("living_room", "corridor", "window", "table", "wall", "carpet")
    for name in ("lookahead_ranking", "relocalization"):
        assert experiment_class(name)().scenes == expected  # type: ignore[attr-defined]
    compared = experiment_class("compare")().sequences  # type: ignore[attr-defined]
    assert tuple(text[:-5] for text in compared if text.endswith(":2000")) == expected


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.parent.name)
def test_tables_of_today_can_be_made_from_committed_rows(path: Path) -> None:
    """A column that came later has no value there, and must not be an error; charts as well."""
    results = read_results(path)
    experiment, rows = experiment_class(results.kind)(), [dict(row) for row in results.rows]
    assert all(table.as_markdown() for table in experiment.tables(rows))
    assert all(chart.panels for chart in experiment.charts(rows))
    to_plain(experiment.content(rows))


def test_units_of_columns_come_from_the_registry_alone() -> None:
    """A heading of an experiment's own is text without a unit."""
    found = []
    for path in sorted((ROOT / "ms_slam_env").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "Column":
                texts = [n.value for n in ast.walk(node) if isinstance(n, ast.Constant)]
                found += [(path.name, text) for text in texts if "[" in str(text)]
    assert found == []
