"""The pages name files, commands and anchors that exist; the site builds without a warning."""

from __future__ import annotations

import ast
import importlib.util
import json
import lzma
import re
import subprocess
import sys
from pathlib import Path

import pytest

from ms_slam_env.benchmark import EXPERIMENTS, experiment_class
from ms_slam_env.cli import COMMANDS
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import metric

ROOT = Path(__file__).resolve().parents[2]
AT_ROOT = [ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING")]
PAGES = [
    *AT_ROOT,
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "results").glob("*.md")),
]
FILE = re.compile(r"`((?:ms_slam_env|baselines|agents|tests|docs|notebooks)/[\w./-]*)`")
WORDS = {
    word
    for folder in ("ms_slam_env", "agents", "baselines")
    for path in sorted((ROOT / folder).rglob("*.py"))
    for word in re.findall(r"\w+", path.read_text(encoding="utf-8"))
}
LINK = re.compile(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]*))?\)")


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """Of the headings, as GitHub and MkDocs name them."""
    headings = re.findall(r"^#+ (.*)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_and_links_of_a_page_exist(page: Path) -> None:
    text = text_of(page)
    missing = [name for name in FILE.findall(text) if not (ROOT / name).exists()]
    for target, anchor in LINK.findall(text):
        path = page.parent / target if target else page
        if not path.exists() or (anchor and anchor not in anchors(path)):
            missing.append(f"{target}#{anchor}")
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_a_page_exist(page: Path) -> None:
    text = text_of(page)
    used = set(re.findall(r"\bms-slam ([a-z]+)\b", text))
    assert used <= set(COMMANDS)
    named = re.findall(r"ms-slam experiment (\w+)(?![\w:])", text)
    experiments = {name.replace("-", "_") for name in named}
    assert experiments <= {*EXPERIMENTS.own, "list", "check", "NAME"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_of_a_page_is_python(page: Path) -> None:
    for source in re.findall(r"^```python\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL):
        ast.parse(source)


def test_the_form_of_results_is_as_the_page_says() -> None:
    page = text_of(ROOT / "docs" / "experiments.md")
    (said,) = re.findall(r"`results.json` of every experiment has one form.*?\n\n", page, re.DOTALL)
    form, _, where = said.partition("They stand under")
    named = set(re.findall(r"`(\w+)`", form))
    assert named >= {"kind", "config", "tables", "spec", "result"}
    for folder in ("room_task", "compare160"):
        path = ROOT / "docs" / "results" / folder / "results.json.xz"
        content = json.loads(lzma.decompress(path.read_bytes()))
        key = content["rows_key"]
        assert named <= {*content, *content[key][0]}
        assert f"`{key}`" in where
    for name in EXPERIMENTS.own:
        key = experiment_class(name).rows_key
        assert f"`{key}`" in where
        of_own = re.findall(rf"`{key}` of ([^:]*?)(?:, `\w+` of|\. )", where, re.DOTALL)
        assert key == "rows" or name == "planners" or f"`{name}`" in of_own[0]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_measures_that_a_page_names_are_measured(page: Path) -> None:
    """A name with a unit is a metric, or at least stands somewhere in the code."""
    names = set(re.findall(r"`([a-z]\w*_(?:m|mm|ms|s|rad|deg|j|mb|share|\d+cm))`", text_of(page)))
    assert [name for name in sorted(names) if not is_metric(name) and name not in WORDS] == []


def is_metric(name: str) -> bool:
    try:
        metric(name)
    except InputError:
        return False
    return True


def test_readme_is_short() -> None:
    lines = text_of(ROOT / "README.md").splitlines()
    assert len(lines) <= 200
    assert [line for line in lines if len(line) > 100] == []


def test_the_drawing_shows_the_rooms() -> None:
    spec = importlib.util.spec_from_file_location("rooms", ROOT / "docs" / "site" / "rooms.py")
    assert spec is not None
    assert spec.loader is not None
    rooms = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(rooms)
    shown = re.findall(r'class="name">(\w+)<', text_of(rooms.OUT))
    assert set(shown) == set(rooms.uses()), "run python docs/site/rooms.py"


def test_asking_the_drawing_for_help_draws_nothing(tmp_path: Path) -> None:
    drawing = ROOT / "docs" / "pictures" / "rooms.svg"
    before = drawing.stat().st_mtime_ns
    command = [sys.executable, str(ROOT / "docs" / "site" / "rooms.py")]
    subprocess.run([*command, "--help"], check=True, capture_output=True)
    subprocess.run([*command, "--out", str(tmp_path / "rooms.svg")], check=True)
    assert drawing.stat().st_mtime_ns == before
    assert text_of(tmp_path / "rooms.svg").startswith("<svg")


@pytest.mark.slow
def test_the_site_builds_and_loads_nothing_from_the_network(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    loads = re.compile(r"<(?:script|img|link|iframe)\b[^>]*(?:src|href)=\"?(https?:[^\" >]*)")
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 50
    for page in pages:
        assert [url for url in loads.findall(text_of(page)) if "canonical" not in url] == []
