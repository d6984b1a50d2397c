"""Imports point only to the left of the data flow, and the package stays light."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path

import pytest

from ms_slam_env.cli import COMMANDS
from ms_slam_env.cli.train import TRAINERS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "ms_slam_env"
FLOW = (
    "geometry -> camera -> divergence -> scenes, robot -> sensor -> slam -> planning -> sequences"
    " -> metrics -> report -> evaluation -> env -> tuning -> benchmark -> cli"
)
LEVEL = {name: level for level, name in enumerate(re.split(r" -> |, ", FLOW))}
BELOW_ALL = {"_runtime", "native", "errors", "config", "tasks"}
ABOVE_ALL = {"gym_ids", ""}  # "" is ms_slam_env/__init__.py
NEVER = {
    *("baselines", "agents", "experiments", "evo"),
    *("ms_slam_baselines", "ms_slam_agents", "ms_slam_experiments"),
    "ms_slam_docs",
}
ONLY_INSIDE_FUNCTIONS = {
    "kiss_icp",
    "open3d",
    "optuna",
    "pynvml",
    "plotly",
    "ray",
    "rerun",
    "sb3_contrib",
    "sklearn",
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


def nodes_of(tree: ast.AST, at_import: bool = True) -> Iterator[tuple[ast.AST, bool]]:
    """Every node and whether importing the module runs it."""
    yield tree, at_import
    if isinstance(tree, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
        at_import = False
    if isinstance(tree, ast.If) and "TYPE_CHECKING" in ast.unparse(tree.test):
        at_import = False
    for child in ast.iter_child_nodes(tree):
        yield from nodes_of(child, at_import)


def base_of(node: ast.ImportFrom, module: str, is_package: bool) -> str:
    """Absolute name of the module that names are imported from."""
    if not node.level:
        return node.module or ""
    package = module.split(".") if is_package else module.split(".")[:-1]
    kept = package[: len(package) - node.level + 1]
    return ".".join([*kept, *([node.module] if node.module else [])])


def imports_of(source: str, module: str, is_package: bool) -> list[tuple[str, bool]]:
    """Absolute names imported and whether importing the module imports them too."""
    found: list[tuple[str, bool]] = []
    for node, at_import in nodes_of(ast.parse(source)):
        if isinstance(node, ast.Import):
            found.extend((alias.name, at_import) for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            base = base_of(node, module, is_package)
            if base == "ms_slam_env":  # ``from ms_slam_env import slam`` imports the stage
                found.extend((f"{base}.{alias.name}", at_import) for alias in node.names)
            else:
                found.append((base, at_import))
    return found


def edges_of(source: str, module: str, is_package: bool, modules: Collection[str]) -> set[str]:
    """Those of ``modules`` that a module imports anywhere, in a function or for types alone too.

    A name imported from a package leads to its submodule of that name, if there is one, or else
    to the package itself, which defines it.
    """
    found: set[str] = set()
    for node, _ in nodes_of(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            base = base_of(node, module, is_package)
            inner = {f"{base}.{alias.name}" for alias in node.names}
            found |= inner if inner <= set(modules) else {base, *inner}
    return (found & set(modules)) - {module}


def reached(starts: Iterable[str], edges: Mapping[str, set[str]]) -> set[str]:
    """The modules that some import, by way of others too."""
    seen: set[str] = set()
    open_ = [module for start in starts for module in edges[start]]
    while open_:
        module = open_.pop()
        if module not in seen:
            seen.add(module)
            open_.extend(edges[module])
    return seen


def in_circles(edges: Mapping[str, set[str]]) -> set[str]:
    """The modules that import themselves by way of others."""
    return {module for module in edges if module in reached([module], edges)}


def edges_of_all() -> dict[str, set[str]]:
    """What each module of the package imports of it."""
    names = {module_name(path): path for path in FILES}
    return {
        name: edges_of(path.read_text(), name, path.name == "__init__.py", names)
        for name, path in names.items()
    }


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
        ("import ms_slam_env.sensor", "ms_slam_env.scenes.scene"),
        ("from ..env import EnvConfig", "ms_slam_env.slam.surfel"),
        ("def f():\n    import ms_slam_baselines", "ms_slam_env.benchmark.episodes"),
        ("import torch", "ms_slam_env.cli.train"),
        ("from open3d.core import Tensor", "ms_slam_env.slam.volumetric"),
        ("from ms_slam_env.geometry import hat", "ms_slam_env.errors"),
        ("from ms_slam_env.robot import action_primitives", "ms_slam_env.scenes.scene"),
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


def test_no_imports_go_in_a_circle() -> None:
    assert sorted(in_circles(edges_of_all())) == []


ENTRY = "ms_slam_env.env.make"
"""What Gymnasium imports for every id."""
DEFAULTS = {
    "ms_slam_env.slam.surfel",
    "ms_slam_env.scenes.living_room",
    "ms_slam_env.robot.arm.dynamic_arm",
}
"""What the names stand for that `MSActiveSLAM-v0` has if nobody gives others."""


@pytest.mark.parametrize(
    ("starts", "most"), [({ENTRY}, 30_000), ({ENTRY, *DEFAULTS}, 34_500)], ids=["entry", "defaults"]
)
def test_what_gym_make_needs_fits_in_a_head(starts: set[str], most: int) -> None:
    """Lines of all modules that are imported on the way, also in functions and for types alone.

    What is chosen by name is left out: it is a text, imported where it is asked for.
    """
    lines = {module_name(path): len(path.read_text().splitlines()) for path in FILES}
    needed = starts | reached(starts, edges_of_all())
    assert "ms_slam_env.slam.slam_backend" in needed
    assert "ms_slam_env.slam.sparse" not in needed
    assert sum(lines[module] for module in needed) <= most


def test_a_circle_is_found_and_what_only_looks_like_one_is_not() -> None:
    sources = {
        "p": "from p.a import x",
        "p.a": "from p import b",
        "p.b": "def f():\n    from .c import y",
        "p.c": "if TYPE_CHECKING:\n    import p.a",
        "p.d": "from p import x, a",
        "p.e": "from p import a\nfrom p.d import z",
    }
    edges = {name: edges_of(text, name, name == "p", sources) for name, text in sources.items()}
    assert edges["p.d"] == {"p", "p.a"}
    assert in_circles(edges) == {"p.a", "p.b", "p.c"}


HEAVY = ONLY_INSIDE_FUNCTIONS | {
    *("cv2", "embreex", "imageio", "matplotlib", "mink", "mujoco", "pandas", "PIL", "scipy"),
    *("tensorboard", "trimesh", "warp"),
}
LOADED = f"print([m for m in {sorted(HEAVY)!r} if m in sys.modules])"


@pytest.mark.parametrize("module", ["ms_slam_env", "ms_slam_env.cli"])
def test_importing_loads_nothing_heavy(module: str) -> None:
    code = f"import sys, {module}; {LOADED}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


LIGHT_EXPERIMENTS = [
    "compare",
    "moving_objects",
    "orbit",
    "paper_table2",
    "planners",
    "pose_covariance",
    "pose_sources",
    "relocalization",
    "reward_shares",
    "soak",
    "step_size",
    "usme",
]


TYPOS = [
    *(f"{name} --no-such-option" for name in sorted(COMMANDS)),
    *(f"{name} --no-such-option" for name in ("usme make", "usme run")),
    *(f"experiment {name} --no-such-option" for name in LIGHT_EXPERIMENTS),
    "benchmark --planners gredy",
    "benchmark --scenes kitchn",
    "compare --backends surfl",
    "experiment compar",
    "record --planner gredy",
    "run living_room:0 --backend surfl",
    *(f"train {name} --no-such-option" for name in TRAINERS.names()),
    "train rllib scaling --no-such-option",
    "train sb3 --task romm",
    "train ppo --observation hled",
    "usme make --sequences room",
    "view --planner gredy",
]


def test_a_typo_is_answered_before_anything_heavy_is_loaded() -> None:
    """That takes half a second; with everything loaded it took 7 to 10 s on a busy machine."""
    code = f"""import sys; from ms_slam_env.cli import main
for line in {TYPOS!r}:
    print(line, main(line.split()), end=" ")
    {LOADED}"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines() == [f"{line} 2 []" for line in TYPOS], done.stderr
    said = done.stderr.splitlines()
    assert len(said) == len(TYPOS)
    assert all(re.match("ms-slam[a-z0-9 ]*: error: ", line) for line in said)


def test_what_a_package_offers_is_imported_when_it_is_asked_for() -> None:
    packages = [name for name in (module_name(path) for path in FILES if path.name == "__init__.py")
                if "lazy_names" in vars(import_module(name))]  # fmt: skip
    assert len(packages) > 5
    for name in packages:
        package = import_module(name)
        for offered in package.__all__:
            # A submodule of that name would be found in its place, once it is imported.
            assert not (Path(str(package.__file__)).parent / f"{offered}.py").exists()
            assert getattr(package, offered) is not None
        with pytest.raises(AttributeError, match=f"module '{name}' has no attribute 'nothing'"):
            _ = package.nothing
