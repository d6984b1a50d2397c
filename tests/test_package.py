"""What is installed: names, entry points, constraints and the wheel's contents."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from importlib.metadata import (
    PackageNotFoundError,
    distribution,
    entry_points,
    packages_distributions,
)
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from ms_slam_env.cli.experiment import ELSEWHERE

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel built from the tracked sources, without the network."""
    source = tmp_path_factory.mktemp("source")
    out = tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        (source / name).write_bytes((ROOT / name).read_bytes())
    for folder in ("ms_slam_env", "agents", "baselines", "experiments"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".typed"):
                target = source / path.relative_to(ROOT)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(path.read_bytes())
    code = f"from setuptools import build_meta; build_meta.build_wheel({str(out)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True)
    return zipfile.ZipFile(next(out.glob("*.whl")))


def test_wheel_has_every_module_under_its_name(wheel: zipfile.ZipFile) -> None:
    expected = {str(path.relative_to(ROOT)) for path in (ROOT / "ms_slam_env").rglob("*.py")} | {
        "ms_slam_env/py.typed"
    }
    for folder in ("agents", "baselines"):
        expected |= {f"ms_slam_{folder}/{path.name}" for path in (ROOT / folder).glob("*.py")}
    content = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert content == expected


def test_the_wheel_lists_the_experiments_of_the_product(wheel: zipfile.ZipFile, tmp_path) -> None:
    """And one line says where the others are; the wheel itself holds none of them."""
    wheel.extractall(tmp_path)
    code = f"""import sys; sys.path.insert(0, {str(tmp_path)!r})
sys.meta_path[:] = [finder for finder in sys.meta_path if "Editable" not in repr(finder)]
from ms_slam_env.cli import main; main(["experiment", "list"])"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    _, *names, empty, said = done.stdout.splitlines()[1:]
    assert [line.split()[0] for line in names] == ["compare", "planners", "usme"], done.stderr
    assert (empty, said) == ("", ELSEWHERE)


def test_wheel_takes_no_general_names(wheel: zipfile.ZipFile) -> None:
    top = {name.split("/")[0] for name in wheel.namelist()}
    assert {name for name in top if not name.endswith(".dist-info")} == {
        "ms_slam_agents",
        "ms_slam_baselines",
        "ms_slam_env",
    }


def test_wheel_has_the_entry_points(wheel: zipfile.ZipFile) -> None:
    name = next(n for n in wheel.namelist() if n.endswith("entry_points.txt"))
    text = wheel.read(name).decode()
    for line in ("ms-slam = ", "greedy = ms_slam_baselines.", "sb3 = ms_slam_agents."):
        assert line in text


@pytest.mark.parametrize("group", ["ms_slam_env.planners", "ms_slam_env.trainers"])
def test_entry_points_name_files_that_exist(group: str) -> None:
    entries = [e for e in entry_points(group=group) if e.value.startswith("ms_slam_")]
    assert entries
    for entry in entries:
        module, _, attribute = entry.value.partition(":")
        folder, *parts = module.removeprefix("ms_slam_").split(".")
        path = ROOT.joinpath(folder, *parts).with_suffix(".py")
        assert re.search(rf"^(class|def) {attribute}\b", path.read_text(), re.MULTILINE)


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_base_install_needs_neither_torch_nor_open3d() -> None:
    requirements = [Requirement(text) for text in distribution("ms-slam-env").requires or ()]
    base = {r.name.lower() for r in requirements if not (r.marker and "extra" in str(r.marker))}
    assert base.isdisjoint({"torch", "open3d", "stable-baselines3", "sb3-contrib", "evo"})
    assert {"numpy", "gymnasium", "warp-lang", "embreex", "trimesh", "safetensors"} <= base


def of_base_install() -> set[str]:
    """Distributions that ``pip install ms-slam-env`` brings, by their normal names."""
    found: set[str] = set()
    wanted = ["ms-slam-env"]
    while wanted:
        name = wanted.pop()
        if normal(name) in found:
            continue
        found.add(normal(name))
        try:
            texts = distribution(name).requires or ()
        except PackageNotFoundError:
            continue
        needed = [Requirement(text) for text in texts]
        wanted += [r.name for r in needed if not r.marker or r.marker.evaluate({"extra": ""})]
    return found


PLAY_AGENTS = """
import sys
from importlib.abc import MetaPathFinder
from importlib.metadata import packages_distributions

class NotInstalled(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in missing:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, NotInstalled())
import gymnasium as gym
import ms_slam_env
from ms_slam_env.env.planners import PLANNERS, make_planner, planner_observation

for name in sorted(one for one in PLANNERS.names() if one.startswith("agent-")):
    options = {"scene": "table", "scene_seed": 0, "image_size": "64x48"}
    env = gym.make("MSActiveSLAM-FreeCamera-v0", observation=planner_observation(name), **options)
    observation, info = env.reset(seed=0)
    planner = make_planner(name, env.unwrapped)
    planner.reset()
    for _ in range(2):
        observation, *_, info = env.step(planner.act(observation, info))
    print(name)
"""


@pytest.mark.slow
def test_after_a_base_install_the_shipped_agents_run() -> None:
    base = of_base_install()
    missing = {
        module
        for module, owners in packages_distributions().items()
        if not any(normal(owner) in base for owner in owners)
    }
    assert {"torch", "stable_baselines3", "optuna"} - missing == set()
    code = f"missing = {sorted(missing)}{PLAY_AGENTS}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split() == [
        *("agent-home", "agent-paper", "agent-ppo", "agent-room", "agent-sb3")
    ]


def test_constraints_are_versions_only() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    wrong = [line for line in lines if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", line)]
    assert wrong == []
    assert "torch==2.13.0" in lines


def test_constraints_cover_every_declared_dependency() -> None:
    pinned = {
        normal(line.split("==")[0]): line.split("==")[1]
        for line in (ROOT / "constraints.txt").read_text().splitlines()
    }
    for text in distribution("ms-slam-env").requires or ():
        requirement = Requirement(text)
        assert normal(requirement.name) in pinned
        assert requirement.specifier.contains(pinned[normal(requirement.name)])


def test_ci_runs_the_tests() -> None:
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & 0o111
    assert re.search(r"^exec make .*test$", script.read_text(), re.MULTILINE)


def test_the_first_run_says_that_it_compiles(tmp_path: Path) -> None:
    def said() -> str:
        done = subprocess.run(
            [sys.executable, "-c", "import ms_slam_env._runtime.warp"],
            env={**os.environ, "WARP_CACHE_PATH": str(tmp_path / "kernels")},
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stderr

    assert said() == "ms_slam_env compiles its kernels once, which takes a minute or two\n"
    (of_this_warp,) = (tmp_path / "kernels").iterdir()
    (of_this_warp / "wp_a_kernel").mkdir()
    assert said() == ""


def test_kernels_need_no_place_to_be_kept() -> None:
    """As in a home that cannot be written."""
    code = "from ms_slam_env._runtime.warp import wp; print(wp.config.kernel_cache_dir)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "WARP_CACHE_PATH": "/dev/null/nowhere"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "InputWarning: compiled kernels cannot be kept: /dev/null" in done.stderr
    assert not Path(done.stdout.strip()).exists(), "it is removed in the end"
