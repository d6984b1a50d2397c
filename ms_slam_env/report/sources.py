"""Digests of the code that makes results, by part, so that a record knows when it is older.

A digest covers what a part's Python files say to the interpreter and its C++ headers to the
compiler: comments, docstrings, layout, types of local variables and the wording of errors do not
count. It does not depend on the version of Python.
"""

from __future__ import annotations

import ast
import gc
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]

PARTS: Mapping[str, tuple[str, ...]] = {
    "geometry": ("geometry", "camera"),
    "divergence": ("divergence",),
    "scenes": ("scenes",),
    "sensor": ("sensor",),
    "robot": ("robot",),
    "SLAM": ("slam/*.py", "slam/shared"),
    "surfel": ("slam/surfel",),
    "sparse": ("slam/sparse",),
    "odometry": ("slam/odometry",),
    "volumetric": ("slam/volumetric",),
    "frame selection": ("slam/frame_selection", "slam/adaptation"),
    "teams": ("slam/team", "metrics/multi_robot.py"),
    "planning": ("planning",),
    "sequences": ("sequences",),
    "metrics": ("metrics", "evaluation", "benchmark/episode_scores.py"),
    "environment": ("env", "tasks.py", "benchmark/episodes.py"),
    "tuning": ("tuning",),
    "agents": ("ms_slam_agents:",),
}
"""Part to its files and folders in this package, or ``PACKAGE:`` for those of another one.

Besides, every planner and every trained agent that a result names is a part, and its experiment.
"""

PARTS_OF_SEQUENCES = (
    *("geometry", "divergence", "scenes", "sensor", "SLAM", "surfel", "sequences", "metrics"),
)
"""What an experiment uses that runs SLAM over sequences."""

_ONLY_IF_NAMED = {
    "sparse": r"\bsparse\b",
    "odometry": r"odometry|gicp|kiss_icp|semi.dense",
    "volumetric": r"volumetric|kinectfusion|open3d",
    "frame selection": r"frame_selection|frame.management|adapt",
    "teams": r"team|robots",
    "tuning": r"explore|adaptation",
    "agents": r"\bagent-|\bpolicy,|\btrain\b|\bpolicy\b",
}
"""Part to what names it in the kind, options or rows of a result; other parts always count."""

_OF_KINDS = {
    "run": ("geometry", "divergence", "SLAM", "surfel", "sequences", "metrics"),
    "evaluate": ("geometry", "metrics"),
    "divergence": ("geometry", "divergence", "sequences", "metrics"),
}
"""Results of commands that use few parts."""

_OUTPUT = ("tables", "charts", "about", "title")
"""Methods of an experiment that only present its rows."""

_DATA = (".xml", ".yaml")
_TEXTS = ("registry.yaml",)  # definitions of metrics


def sources_of(kind: str, text: str, declared: Sequence[str] = ()) -> dict[str, str]:
    """Digests of the parts that make a result.

    Args:
        kind: kind of the result; the module of an experiment of this name is a part.
        text: its options and the specifications of its rows, which name backends and agents.
        declared: parts that the experiment uses; none: all.

    Returns:
        part to 12 hexadecimal digits.
    """
    known = declared or _OF_KINDS.get(kind, tuple(PARTS))
    named = f"{kind} {text}"
    used = [
        part
        for part in PARTS
        if (part in known or part in _ONLY_IF_NAMED)
        and re.search(_ONLY_IF_NAMED.get(part, ""), named)
    ]
    names = [name for name in _players() if re.search(rf"(?<![\w-]){name}(?![\w-])", named)]
    digests = {part: digest_of(part, kind) for part in (*used, *names, "experiment")}
    return {part: digest for part, digest in digests.items() if digest}


def changed_parts(recorded: Mapping[str, str], kind: str) -> list[str]:
    """Parts whose code differs from that of a record; what is not installed counts as the same."""
    now = {part: digest_of(part, kind) for part in recorded}
    return [part for part, digest in recorded.items() if now[part] and digest != now[part]]


def joined(many: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Digests of several rows as one; where they differ, all of them, which match no code."""
    parts = {part: None for one in many for part in one}
    return {part: "+".join(sorted({one[part] for one in many if part in one})) for part in parts}


@cache
def digest_of(part: str, kind: str = "") -> str:
    """Digest of a part, planner, agent, or the ``experiment`` of this kind; empty if absent."""
    files = sorted(set(_files(part, kind)))
    if not files:
        return ""
    whole = hashlib.sha256()
    headers: set[str] = set()
    collecting = gc.isenabled()
    gc.disable()  # a syntax tree is many small objects, none of them garbage: 3 times faster
    try:
        for path in files:
            data = path.read_bytes()
            if path.suffix != ".py":
                whole.update(data.replace(b"\r\n", b"\n"))
                continue
            whole.update(normalised(data).encode())
            headers |= set(re.findall(r'(?:native_source|read_header)\(\s*"(\w+)"', data.decode()))
        for header in sorted(_with_included(headers)):
            whole.update(normalised_header(_header(header)).encode())
    finally:
        if collecting:
            gc.enable()
    return whole.hexdigest()[:12]


def _files(part: str, kind: str) -> Iterator[Path]:
    """Files of a part."""
    if part == "experiment":
        if not kind.isidentifier():  # it may come from anybody's file
            return
        found = [_PACKAGE / "benchmark" / f"{kind}.py", *_places(f"ms_slam_experiments:{kind}.py")]
        found = [path for path in found if path.is_file()]
        shared = re.findall(r"shared import (\w+)|shared\.(\w+)", "".join(map(_text, found)))
        names = {a or b for a, b in shared}
        yield from found
        for name in names:
            yield from filter(Path.is_file, _places(f"ms_slam_experiments:shared/{name}.py"))
        return
    if part in _players():
        yield from _with_imported(_players()[part])
        return
    for place in PARTS.get(part, ()):
        for path in _places(place):
            inside = path.rglob("*") if path.is_dir() else [path]
            yield from (
                one
                for one in inside
                if one.suffix == ".py" or (one.suffix in _DATA and one.name not in _TEXTS)
            )


@cache
def _players() -> Mapping[str, Path]:
    """Planner or agent to its file, which is a policy for an agent."""
    planners = {
        path.stem.replace("_", "-").removesuffix("-walk"): path
        for path in _places("ms_slam_baselines:*.py")
        if path.stem != "__init__"
    }
    policies = _places("ms_slam_agents:policies/*.safetensors")
    return planners | {f"agent-{path.stem}": path for path in policies}


def _with_imported(path: Path) -> set[Path]:
    """A planner's file, and those that it imports from the same folder; a policy's file alone."""
    found, new = set[Path](), {path}
    while new:
        found |= new
        texts = "".join(_text(one) for one in new if one.suffix == ".py")
        names = re.findall(r"\bms_slam_baselines\.(\w+)", texts)
        new = {path.with_name(f"{name}.py") for name in names} - found
    return found


def _places(place: str) -> list[Path]:
    """Paths that a place in ``PARTS`` names; none if its package is not installed."""
    package, colon, name = place.rpartition(":")
    root: Path | None = _PACKAGE
    if colon:
        spec = find_spec(package)
        locations = spec.submodule_search_locations if spec else None
        root = Path(next(iter(locations))) if locations else None
    if root is None:
        return []
    return sorted(root.glob(name)) if "*" in name else [root / name]


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _header(name: str) -> str:
    return _text(_PACKAGE / "native" / f"{name}.h")


def _with_included(headers: set[str]) -> set[str]:
    """Headers with those that they include."""
    more = {
        name for header in headers for name in re.findall(r'#include "(\w+)\.h"', _header(header))
    }
    return headers if more <= headers else _with_included(headers | more)


def normalised(source: bytes) -> str:
    """The syntax tree of Python code as text, without what does not change results."""
    found: list[str] = []
    _walk(ast.parse(source), found, False, False)
    return "\n".join(found)


def _walk(node: ast.AST, found: list[str], is_local: bool, is_raised: bool) -> None:
    if is_local and isinstance(node, ast.AnnAssign) and node.value:  # its type does nothing
        node = ast.Assign([node.target], node.value)
    found.append(type(node).__name__)
    is_local = is_local or isinstance(node, ast.FunctionDef)
    is_raised = is_raised or isinstance(node, ast.Raise)
    for name in node._fields:
        value = getattr(node, name, None)
        if value is None or value == []:  # fields that some versions of Python lack
            continue
        found.append(name)
        for one in value if isinstance(value, list) else [value]:
            if not isinstance(one, ast.AST):
                found.append(repr(one))
            elif not _is_text(one, is_raised):
                _walk(one, found, is_local, is_raised)
    found.append(".")


def _is_text(node: ast.AST, is_raised: bool) -> bool:
    """Whether it is a docstring, the message of an error, or a method that presents rows."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    if isinstance(node, ast.FunctionDef):
        return node.name in _OUTPUT
    is_string = isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    return is_raised and is_string


def normalised_header(text: str) -> str:
    """C++ code without comments and layout."""
    code = re.sub(r"/\*.*?\*/|//[^\n]*", " ", text, flags=re.DOTALL)
    return re.sub(r" ?([^\w ]) ?", r"\1", re.sub(r"\s+", " ", code)).strip()
