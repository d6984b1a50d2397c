"""A record names the parts of the code that have changed since, and no others."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from ms_slam_docs.markdown_pages import with_tables

from ms_slam_env.benchmark.rows import run_all
from ms_slam_env.errors import InputError
from ms_slam_env.report import sources
from ms_slam_env.report.results import read_results, write_results
from ms_slam_env.report.sources import PARTS, changed_parts, digest_of, joined, sources_of
from ms_slam_env.report.tables import make_table

PACKAGE = Path(sources.__file__).parents[1]
CODE = '''"""A module."""
LIMIT = 0.5  # metres
"""Of what."""


def clip(value: float) -> float:
    """Clip a value."""
    if value < 0:
        raise ValueError(f"value = {value} is negative")
    return min(value, LIMIT)
'''


def same(code: str) -> bool:
    return sources.normalised(code.encode()) == sources.normalised(CODE.encode())


def test_text_about_code_is_not_code() -> None:
    assert same(CODE.replace("# metres", "# m").replace("Of what.", "Of all."))
    assert same(CODE.replace('    """Clip a value."""\n', "").replace('"""A module."""', ""))
    assert same(CODE.replace("min(value, LIMIT)", "min(\n        value,\n        LIMIT,\n    )"))
    typed = (
        "    return min(value, LIMIT)",
        "    found: float = min(value, LIMIT)\n    return found",
    )
    plain = ("    return min(value, LIMIT)", "    found = min(value, LIMIT)\n    return found")
    one, other = (sources.normalised(CODE.replace(*pair).encode()) for pair in (typed, plain))
    assert one == other
    assert not same(CODE.replace("LIMIT = 0.5", "LIMIT: float = 0.5"))  # may be a field
    assert same(CODE.replace("is negative", "must be at least 0"))
    for old, new in (
        ("0.5", "0.25"),
        ("< 0", "<= 0"),
        ("min", "max"),
        ("value, LIMIT", "LIMIT, value"),
    ):
        assert not same(CODE.replace(old, new)), new
    assert not same(CODE.replace("ValueError", "TypeError"))
    assert not same(CODE.replace('"""Of what."""', 'NAME = "Of what."'))


def test_text_about_a_header_is_not_code() -> None:
    header = (PACKAGE / "native" / "eigen.h").read_text()
    normal = sources.normalised_header
    changed = "/* new\n */ // newer\n" + header.replace("\n", "\n\n").replace(" = ", "=")
    assert normal(changed) == normal(header)
    number = re.search(r"\b[1-9]\b", re.sub(r"//.*", lambda m: "/" * len(m[0]), header))
    assert number is not None
    assert normal(f"{header[: number.start()]}17{header[number.end() :]}") != normal(header)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the package that may be edited; its digests are taken."""
    copy = tmp_path / "ms_slam_env"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(sources, "_PACKAGE", copy)
    digest_of.cache_clear()
    yield copy
    digest_of.cache_clear()


def edit(path: Path, change: Callable[[str], str]) -> None:
    text = path.read_text()
    assert change(text) != text
    path.write_text(change(text))
    digest_of.cache_clear()


def test_a_change_is_found_in_its_part(package: Path) -> None:
    made = sources_of("planners", "greedy sparse agent-room")
    assert {"surfel", "sparse", "greedy", "agents", "agent-room", "experiment"} <= set(made)
    assert {"odometry", "nbv", "tuning", "teams"}.isdisjoint(made)
    changed = lambda: changed_parts(made, "planners")  # noqa: E731
    assert changed() == []
    edit(package / "divergence/measures.py", lambda text: text + "# a remark\n")
    edit(package / "native/splatting.h", lambda text: text + "// a remark\n")
    edit(package / "cli/run.py", lambda text: text + "X = 1\n")  # makes no results
    assert changed() == []
    edit(package / "divergence/measures.py", lambda text: text + "X = 1\n")
    assert changed() == ["divergence"]
    edit(package / "native/splatting.h", lambda text: text + "int x;\n")
    edit(package / "native/checked.h", lambda text: text + "int x;\n")  # included by others
    assert {"divergence", "surfel", "sensor"} <= set(changed())
    edit(package / "slam/odometry/odometry.py", lambda text: text + "X = 1\n")
    assert "odometry" not in changed()
    edit(package / "benchmark/planners.py", lambda text: text.replace("Make the charts", "Do"))
    assert "experiment" not in changed()
    edit(package / "benchmark/planners.py", lambda text: text + "X = 1\n")
    assert "experiment" in changed()


def test_all_that_makes_results_is_in_a_part() -> None:
    of_parts = {path for part in PARTS for path in sources._files(part, "")}
    folders = {p.relative_to(PACKAGE).parts[0] for p in of_parts if p.is_relative_to(PACKAGE)}
    others = {
        *("_runtime", "cli", "benchmark", "report", "native", "__init__.py", "config.py"),
        *("errors.py", "gym_ids.py"),
    }
    own = {p.name for p in PACKAGE.iterdir() if p.name != "__pycache__" and p.name != "py.typed"}
    assert own - folders <= others
    texts = "".join(path.read_text() for path in of_parts if path.suffix == ".py")
    named = set(re.findall(r'native_source\(\s*"(\w+)"', texts))
    headers = {path.stem for path in (PACKAGE / "native").glob("*.h")}
    assert sources._with_included(named) == headers


def test_a_planner_is_its_file_and_what_that_imports() -> None:
    files = {path.name for path in sources._files("receding-nbv", "")}
    assert {"receding_nbv.py", "goal_planner.py", "view_goals.py"} <= files
    assert "greedy.py" not in files
    assert set(sources_of("planners", "receding-nbv")) >= {"receding-nbv"}
    assert "nbv" not in sources_of("planners", "receding-nbv")
    assert digest_of("experiment", "../../setup") == digest_of("no part") == ""


def test_declared_parts_and_those_of_a_command() -> None:
    assert set(sources_of("x", "odometry", ("divergence",))) == {"divergence", "odometry"}
    assert "environment" not in sources_of("run", "")


TABLE = make_table(["planner"], [{"planner": "greedy"}])
PAGE = "<!-- results: x -->\n<!-- end -->\n"


def test_a_record_and_a_page_name_what_changed(tmp_path: Path) -> None:
    path = tmp_path / "x" / "results.json"
    path.parent.mkdir()
    write_results(path, "planners", "X", "About.", [TABLE], content={"config": {"seed": 1}})
    content = json.loads(path.read_text())
    assert content["provenance"]["sources"]["surfel"] == digest_of("surfel")
    assert read_results(path).stale == ""
    assert "Older" not in with_tables(PAGE, tmp_path)
    content["provenance"]["sources"] |= {"surfel": "0" * 12, "sensor": "1" * 12, "gone": "2"}
    path.write_text(json.dumps(content))
    assert read_results(path).changed == ["sensor", "surfel"]
    assert "older than the code of sensor, surfel." in read_results(path).stale
    assert "*Older than the code of sensor, surfel ([changes](" in with_tables(PAGE, tmp_path)
    content["provenance"]["sources"] = {"surfel": 1}
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="sources"):
        read_results(path)


@dataclass(frozen=True)
class Half:
    number: int


def halve(spec: Half) -> dict[str, float]:
    return {"ate_m": spec.number / 2}


def test_rows_of_different_code_count_as_changed(tmp_path: Path) -> None:
    (row,) = run_all([Half(1)], halve, tmp_path, workers=1, parts=("divergence", "robot"))
    assert set(row["sources"]) == {"divergence", "robot"}
    assert joined([row["sources"], row["sources"]]) == row["sources"]
    mixed = joined([row["sources"], {"robot": "0" * 12}])
    assert changed_parts(mixed, "planners") == ["robot"]
