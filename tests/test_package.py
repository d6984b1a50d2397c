"""What is installed: names, entry points, constraints and the wheel's contents."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from importlib.metadata import (
    Distribution,
    PackageNotFoundError,
    distribution,
    entry_points,
    packages_distributions,
)
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import ms_slam_env
from ms_slam_env.cli.experiment import ELSEWHERE

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a wheel is built from."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        (source / name).write_bytes((ROOT / name).read_bytes())
    for folder in ("ms_slam_env", "agents", "baselines", "experiments", "docs/site"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".typed"):
                target = source / path.relative_to(ROOT)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(path.read_bytes())
    return source


@pytest.fixture(scope="module")
def wheel(source: Path, tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel built from the tracked sources, without the network."""
    out = tmp_path_factory.mktemp("wheel")
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
    usage, listed = done.stdout.split("\n\n", 1)
    assert usage.startswith("usage: ms-slam experiment NAME")
    *names, empty, said = listed.splitlines()
    assert [line.split()[0] for line in names] == ["compare", "planners", "usme"], done.stderr
    assert (empty, said) == ("", ELSEWHERE)


REPOSITORY = "https://forge.test/owner/name"


@pytest.mark.parametrize("url", ["", REPOSITORY, f"{REPOSITORY}/"])
def test_an_index_page_has_no_dead_links(source: Path, tmp_path: Path, url: str) -> None:
    """Those of README.md lead to files of the repository, or are text where it has no address."""
    code = f"""from setuptools import build_meta
print(build_meta.prepare_metadata_for_build_wheel({str(tmp_path)!r}))"""
    env = {**os.environ, "MS_SLAM_ENV_URL": url}
    subprocess.run([sys.executable, "-c", code], cwd=source, env=env, check=True)
    (folder,) = tmp_path.glob("*.dist-info")
    shown = Distribution.at(folder).metadata
    assert shown["Description-Content-Type"] == "text/markdown"
    assert {"Typing :: Typed", "Operating System :: POSIX :: Linux"} <= set(
        shown.get_all("Classifier")
    )
    text = str(shown.get_payload())
    readme = (ROOT / "README.md").read_text()
    own = re.findall(r"\]\((?!https?:)([^)#]+)", readme)
    assert len(own) > 20
    targets = re.findall(r"\]\(([^)#]+)", text)
    assert [target for target in targets if not target.startswith("https://")] == []
    there = [target for target in targets if target.startswith(REPOSITORY)]
    places = dict(line.split(", ") for line in shown.get_all("Project-URL") or ())
    if not url:
        assert (there, places) == ([], {})
        assert "[SLAM]" not in text
        return
    assert [re.sub(rf"{REPOSITORY}/(raw|blob)/HEAD/", "", target) for target in there] == own
    assert f"({REPOSITORY}/raw/HEAD/docs/pictures/home.webp)" in text
    assert places["Homepage"] == REPOSITORY
    files = [place.partition("/blob/HEAD/")[2] for place in places.values() if "/blob/" in place]
    assert files
    assert [name for name in (*own, *files) if not (ROOT / name).is_file()] == []


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


@pytest.mark.parametrize(
    ("system", "machine", "wanted"),
    [
        ("linux", "x86_64", True),
        ("linux", "aarch64", False),
        ("darwin", "arm64", True),
        ("win32", "AMD64", True),
    ],
)
def test_embreex_is_asked_for_where_it_has_a_wheel(
    wheel: zipfile.ZipFile, system: str, machine: str, wanted: bool
) -> None:
    name = next(name for name in wheel.namelist() if name.endswith("METADATA"))
    asked = re.findall(r"^Requires-Dist: (embreex.*)$", wheel.read(name).decode(), re.MULTILINE)
    (embreex,) = map(Requirement, asked)
    assert embreex.marker is not None
    here = {"sys_platform": system, "platform_machine": machine, "extra": ""}
    assert embreex.marker.evaluate(here) == wanted


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


def test_there_is_one_version() -> None:
    files = ("pyproject.toml", "ms_slam_env/__init__.py", "CITATION.cff", "CHANGELOG.md")
    forms = (r'^version = "(.*)"$', r'^__version__ = "(.*)"$', r"^version: (.*)$", r"^## \[(.*)\]")
    found = [
        re.findall(form, (ROOT / name).read_text(), re.MULTILINE)[0]
        for name, form in zip(files, forms, strict=True)
    ]
    assert set(found) == {ms_slam_env.__version__}


def test_an_id_after_the_packages_name_needs_no_import() -> None:
    """As scripts make them that know nothing of the package; `register_envs` asks for no more."""
    code = """import sys, gymnasium as gym
assert "ms_slam_env" not in sys.modules
env_id, options = "MSActiveSLAM-FreeCamera-v0", {"scene": "table", "image_size": "80x60"}
env = gym.make(f"ms_slam_env:{env_id}", **options)
envs = gym.make_vec(f"ms_slam_env:{env_id}", num_envs=1, vectorization_mode="async", **options)
import ms_slam_env
before = dict(gym.registry)
gym.register_envs(ms_slam_env)
assert gym.registry == before
print(env.spec.id, env.reset(seed=0)[0].shape, envs.reset(seed=0)[0].shape)
envs.close()"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    said = "MSActiveSLAM-FreeCamera-v0 (189,) (1, 189)\n"
    assert (done.stdout, done.returncode) == (said, 0), done.stderr[-2000:]


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
