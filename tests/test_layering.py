"""Imports point only to the left of the data flow, and the package stays light."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "ms_slam_env"
FLOW = (
    "geometry -> camera -> divergence -> scenes, robot -> sensor -> slam -> mapping -> sequences"
    " -> metrics -> report -> evaluation -> env -> exploration -> experiments -> benchmark -> cli"
)
LEVEL = {name: level for level, name in enumerate(re.split(r" -> |, ", FLOW))}
BELOW_ALL = {"errors", "config", "command_line", "timings", "_warp"}
ABOVE_ALL = {"registration", ""}  # "" is ms_slam_env/__init__.py
NEVER = {"baselines", "agents", "ms_slam_baselines", "ms_slam_agents", "evo"}
ONLY_INSIDE_FUNCTIONS = {
    "open3d",
    "optuna",
    "pynvml",
    "plotly",
    "ray",
    "rerun",
    "rliable",
    "sb3_contrib",
    "stable_baselines3",
    "torch",
}
FILES = sorted(PACKAGE.rglob("*.py"))


def stage_of(module: str) -> str:
    """``ms_slam_env.slam.surfel`` -> ``slam``; ``ms_slam_env`` -> ``""``."""
    return [*module.split("."), ""][1]


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(source: str, module: str, is_package: bool) -> list[tuple[str, bool]]:
    """Absolute names imported and whether importing the module imports them too."""
    found: list[tuple[str, bool]] = []

    def visit(node: ast.AST, at_import: bool) -> None:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            at_import = False
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            at_import = False
        if isinstance(node, ast.Import):
            found.extend((alias.name, at_import) for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".") if is_package else module.split(".")[:-1]
                kept = package[: len(package) - node.level + 1]
                base = ".".join([*kept, *([base] if base else [])])
            if base == "ms_slam_env":  # ``from ms_slam_env import slam`` imports the stage
                found.extend((f"{base}.{alias.name}", at_import) for alias in node.names)
            else:
                found.append((base, at_import))
        for child in ast.iter_child_nodes(node):
            visit(child, at_import)

    visit(ast.parse(source), True)
    return found


def violations(source: str, module: str, is_package: bool = False) -> list[str]:
    stage = stage_of(module)
    problems = []
    for name, at_import in imports_of(source, module, is_package):
        top = name.split(".")[0]
        if top in NEVER:
            problems.append(f"{module} imports {name}")
        if top in ONLY_INSIDE_FUNCTIONS and at_import:
            problems.append(f"{module} imports {name} at top level")
        if top != "ms_slam_env" or stage in ABOVE_ALL:
            continue
        target = stage_of(name)
        if target in BELOW_ALL or target == stage:
            continue
        if stage in BELOW_ALL:
            problems.append(f"{module} lies below all stages but imports {name}")
        elif target in LEVEL and LEVEL[target] >= LEVEL[stage]:
            problems.append(f"{module} imports {name}, which lies to its right")
    return problems


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_to_the_left(path: Path) -> None:
    module = module_name(path)
    stage = stage_of(module)
    assert stage in LEVEL or stage in BELOW_ALL | ABOVE_ALL, f"{stage} has no place in the flow"
    assert violations(path.read_text(), module, path.name == "__init__.py") == []


@pytest.mark.parametrize(
    ("source", "module"),
    [
        ("from ms_slam_env.env import EnvConfig", "ms_slam_env.slam.surfel"),
        ("from ms_slam_env import env", "ms_slam_env.metrics.map"),
        ("import ms_slam_env.sensor", "ms_slam_env.scenes.base"),
        ("from ..env import EnvConfig", "ms_slam_env.slam.surfel"),
        ("def f():\n    import ms_slam_baselines", "ms_slam_env.benchmark.episode"),
        ("import torch", "ms_slam_env.cli.train"),
        ("from open3d.core import Tensor", "ms_slam_env.slam.volumetric"),
        ("from ms_slam_env.geometry import hat", "ms_slam_env.errors"),
        ("from ms_slam_env.robot import motions", "ms_slam_env.scenes.base"),
    ],
)
def test_a_wrong_import_is_found(source: str, module: str) -> None:
    assert violations(source, module)


@pytest.mark.parametrize(
    ("source", "module"),
    [
        ("from ms_slam_env.geometry import hat", "ms_slam_env.slam.surfel"),
        ("from ..errors import InputError", "ms_slam_env.slam.surfel"),
        ("def f():\n    import torch", "ms_slam_env.cli.train"),
        ("from ms_slam_env.cli import main", "ms_slam_env"),
    ],
)
def test_a_right_import_passes(source: str, module: str) -> None:
    assert violations(source, module) == []


@pytest.mark.parametrize("module", ["ms_slam_env", "ms_slam_env.cli"])
def test_importing_loads_nothing_heavy(module: str) -> None:
    heavy = sorted(ONLY_INSIDE_FUNCTIONS | {"matplotlib", "scipy", "trimesh", "warp", "cv2"})
    code = f"import sys, {module}; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
