"""Pages of the site that are made, not written: gallery, API, results, metrics; and their links.

MkDocs calls the functions ``on_...`` while it builds (``make docs``).
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
ROOT_TEXTS = ("CHANGELOG", "CONTRIBUTING", "SECURITY")

API = {
    "ms_slam_env": "registration of the environments",
    "ms_slam_env.env": "environment, configuration, planners' interface",
    "ms_slam_env.env.wrappers": "wrappers",
    "ms_slam_env.camera": "intrinsics, frames, images",
    "ms_slam_env.geometry": "rigid motions",
    "ms_slam_env.divergence": "information divergence",
    "ms_slam_env.scenes": "scenes",
    "ms_slam_env.sensor": "RGB-D sensor",
    "ms_slam_env.robot": "motions and embodiments",
    "ms_slam_env.robot.arm": "the arm",
    "ms_slam_env.slam": "backends",
    "ms_slam_env.slam.surfel": "surfel SLAM",
    "ms_slam_env.sequences": "sequences",
    "ms_slam_env.sequences.perturbations": "perturbations",
    "ms_slam_env.metrics": "metrics",
    "ms_slam_env.metrics.registry": "what a key of a result means",
    "ms_slam_env.evaluation.run_sequence": "run a sequence",
    "ms_slam_env.evaluation.map_quality": "judge a map",
    "ms_slam_env.tuning": "design-space exploration",
    "ms_slam_env.benchmark": "experiments",
    "ms_slam_env.report.results": "result files",
    "ms_slam_env.report.tables": "tables",
    "ms_slam_env.report.charts": "charts",
    "ms_slam_baselines": "baseline planners",
}
"""Modules with public names, and what is in them."""


def on_config(config: Any) -> Any:
    """Put the version into the title, and the made pages into their places of the navigation."""
    config.site_name = f"{config.site_name} {metadata.version('ms-slam-env')}"
    made = {"Gallery": _gallery(), "API": _api(), "Records": _results()}
    for group in (config.nav, *(next(iter(entry.values())) for entry in config.nav)):
        for entry in group if isinstance(group, list) else ():
            for title in made.keys() & entry.keys():
                entry[title] = [_nav_entry(name) for name, _ in made[title]]
    return config


def _nav_entry(name: str) -> str | dict[str, str]:
    """A page by its name; records by their folder, since several have one title."""
    folder, *rest = name.removesuffix("/index.md").split("/")
    return {"/".join(rest): name} if folder == "results" and rest else name


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made, the pages of the root and the notebooks."""
    pages = dict(_root_pages()) | dict(_api()) | dict(_results()) | dict(_gallery())
    pages["metrics.md"] = _metrics()
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links that hold in a clone to the pages of the site; let search find guides first."""
    if re.match("api/|gallery/|results/.*/", page.file.src_uri):
        page.meta.setdefault("search", {"boost": 1e-3})
    up = "../" * page.file.src_uri.count("/")
    for here, there in (
        *((rf"\((\.\./)?{name}\.md", f"({up}{name.lower()}.md") for name in ROOT_TEXTS),
        (r"\((\.\./)?README\.md", f"({up}index.md"),
        (r"\(\.\./notebooks/", f"({up}notebooks/"),
        (r"\((results/\w+)/?\)", r"(\1/index.md)"),
    ):
        markdown = re.sub(here, there, markdown)
    return markdown


def on_page_content(html: str, **_: Any) -> str:
    """Show the roles of docstrings (:class:`x`) as code alone."""
    return re.sub(r":(?:class|func|meth|mod|attr|data):(<code)", r"\1", html)


def _root_pages() -> Iterator[tuple[str, str]]:
    """CHANGELOG.md and other texts of the root as pages beside those of docs/."""
    for name in ROOT_TEXTS:
        text = (ROOT / f"{name}.md").read_text(encoding="utf-8")
        yield f"{name.lower()}.md", text.replace("(docs/", "(")


def _table(headings: list[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _api() -> Iterator[tuple[str, str]]:
    """A page for each module with public names, and one that lists them."""
    rows = [(f"[`{module}`]({module}.md)", what) for module, what in API.items()]
    listing = _table(["module", "what is in it"], rows)
    yield "api/index.md", f"# API\n\nEvery public name, by module.\n\n{listing}"
    for module in API:
        yield f"api/{module}.md", f"# `{module}`\n\n::: {module}\n"


def _results() -> Iterator[tuple[str, str]]:
    """A page for each folder of committed results, and one that lists them."""
    from ms_slam_env.benchmark.planner_tables import with_privilege
    from ms_slam_env.metrics.registry import RESULTS_VERSION
    from ms_slam_env.report.discovery import find_results

    rows, pages = [], []
    for found in find_results(RESULTS)[0]:
        folder, result = found.path.parent, found.results
        result = replace(result, tables=[with_privilege(table) for table in result.tables])
        name = folder.name
        figures = "".join(f"![{p.stem}]({p.name})\n\n" for p in sorted(folder.glob("*.png")))
        page = f"# {result.title}\n\n{result.about}\n\n{result.as_markdown()}\n\n{figures}"
        pages.append((f"results/{name}/index.md", page))
        age = "today"
        if result.stale:
            older = f"version {result.version} of {RESULTS_VERSION}"
            age = f"before {', '.join(result.changed)}" if result.changed else older
        rows.append((f"[{name}](results/{name}/index.md)", result.title, age))
    listing = _table(["record", "what it shows", "made by the algorithms of"], rows)
    about = "What the experiments wrote, as it is committed in `docs/results`."
    yield "records.md", f"# Records\n\n{about}\n\n{listing}"
    yield from pages


def _metrics() -> str:
    """The registry of metrics as one table."""
    from ms_slam_env.metrics.registry import registry

    rows = [(f"`{key}`", m.label, m.explanation) for key, m in registry().items()]
    about = "What every key of a result means: one heading, unit and definition."
    return f"# Metrics\n\n{about}\n\n{_table(['key', 'heading', 'meaning'], rows)}"


NUM_CONFIGURATIONS = 3  # of the default ladder of MSActiveSLAM-Adaptive-v0

HOLDERS = {
    "MSActiveSLAM-v0": "A simulated 6-DOF arm (Kinova Mico, MuJoCo) holds the camera; motions that "
    "it cannot make are masked. See [the arm](../arm.md).",
    "MSActiveSLAM-FreeCamera-v0": "The camera flies; motions into furniture are masked.",
    "MSActiveSLAM-FixedTranslation-v0": "The camera moves on a straight line by itself; the agent "
    "chooses the rotation, as in the paper's second experiment.",
    "MSActiveSLAM-Adaptive-v0": "The arm holds the camera; with each motion the agent also chooses "
    "which SLAM configuration, from fast to robust, its frames are processed under.",
}

ENVIRONMENT = """# {env_id}

{holder}

![An episode](../pictures/environments/{env_id}.webp)

```python
import gymnasium as gym
import ms_slam_env

env = gym.make("{env_id}", scene="living_room")
observation, info = env.reset(seed=0)
```

## Actions

{space}: {what}

{actions}
Axes are those of the current camera frame. `info["action_mask"]` says what is possible; a masked
action does nothing.

## Observations

{observations}
At the default image size of 160x120. What the numbers are, the reward, `info` and all options:
[environments](../environments.md).
"""

GALLERY = """# Environments

{own}

The pictures are episodes of `nbv`, of `greedy` on the straight line, and of `random` where the SLAM
configuration is chosen too; `python -m ms_slam_docs.film --gallery` makes them.

## Tasks

The same with scenes, a length and a reference ([more](../environments.md#tasks)). `nbv` in a home:

![nbv explores a home](../pictures/home.webp)

{tasks}

## With an imperfect camera

Actions and observations are those of the plain ids; `perturbation={{...}}` sets the strength.

{perturbed}"""

PERTURBED = """### {name}

{what}

{ids}

{film}"""


def _gallery() -> Iterator[tuple[str, str]]:
    """A page for each id, with an episode, spaces and an example, and one that shows them all."""
    from ms_slam_env import ENV_IDS, TASK_IDS
    from ms_slam_env.tasks import OWN

    rows = []
    for env_id in ENV_IDS:
        picture = f"![{env_id}](../pictures/environments/{env_id}.webp)"
        rows.append((picture, f"[`{env_id}`]({env_id}.md)", _space(env_id)))
    tasks = [
        (f"`{task_id}`", f"[`{task().env_id}`]({task().env_id}.md)", _summary(task))
        for task_id, task in zip(TASK_IDS, OWN.values(), strict=True)
    ]
    yield (
        "gallery/index.md",
        GALLERY.format(
            own=_table(["", "id", "actions"], rows),
            tasks=_table(["id", "spaces as", "what"], tasks),
            perturbed="".join(_perturbed()),
        ),
    )
    for env_id in ENV_IDS:
        yield f"gallery/{env_id}.md", _environment(env_id)


def _perturbed() -> Iterator[str]:
    """A section for each imperfection of the camera."""
    import gymnasium as gym

    from ms_slam_env import PERTURBED_ENV_IDS
    from ms_slam_env.sequences.perturbations import POINT

    by_name: dict[str, list[str]] = {}
    for env_id in PERTURBED_ENV_IDS:
        by_name.setdefault(gym.spec(env_id).kwargs["perturbed_by"], []).append(env_id)
    for name, ids in by_name.items():
        film = next(f"environments/{env_id}.webp" for env_id in ids if "-FreeCamera-" in env_id)
        is_filmed = (ROOT / "docs" / "pictures" / film).is_file()
        shown = f"![What the camera takes](../pictures/{film})\n\n" if is_filmed else ""
        listed = ", ".join(f"`{env_id}`" for env_id in ids)
        what = _summary(POINT.find(name))
        yield PERTURBED.format(name=f"`{name}`", what=what, ids=listed, film=shown)


def _summary(thing: Any) -> str:
    """First paragraph of a docstring, its roles as code."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", (inspect.getdoc(thing) or "").split("\n\n")[0])
    return text.replace("``", "`").replace("\n", " ")


def _space(env_id: str) -> str:
    if "Adaptive" in env_id:
        return f"`MultiDiscrete([49, {NUM_CONFIGURATIONS}])`"
    return "`Discrete(7)`" if "FixedTranslation" in env_id else "`Discrete(49)`"


def _environment(env_id: str) -> str:
    """The page of an id."""
    from ms_slam_env.robot.action_primitives import ROTATIONS, TRANSLATIONS

    what, motions, configurations = "`7 * translation + rotation`.", 49, 1
    headings, columns = ["number", "translation", "rotation"], [TRANSLATIONS, ROTATIONS]
    if "FixedTranslation" in env_id:
        what, motions = "the rotation.", 7
        headings, columns = ["number", "rotation"], [ROTATIONS]
    if "Adaptive" in env_id:
        what += " The second part is the number of the SLAM configuration, 0 the fastest."
        configurations = NUM_CONFIGURATIONS
    rows = [(str(k), *words) for k, words in enumerate(zip(*columns, strict=True))]
    return ENVIRONMENT.format(
        env_id=env_id,
        holder=HOLDERS[env_id],
        space=_space(env_id),
        what=what,
        actions=_table(headings, rows),
        observations=_observations(motions, configurations),
    )


def _observations(num_motions: int, num_configurations: int) -> str:
    """The observation spaces by option."""
    from gymnasium.spaces import Dict

    from ms_slam_env.camera import xtion
    from ms_slam_env.env.observations import make_observation
    from ms_slam_env.env.registry import OBSERVATIONS

    rows = []
    for name in OBSERVATIONS:
        space = make_observation(name, xtion("160x120"), num_motions, num_configurations).space
        parts = space.spaces if isinstance(space, Dict) else {"": space}
        for part, box in parts.items():
            shown = f"`{part}`" if part else "the vector"
            rows.append((f"`{name}`", shown, str(tuple(box.shape or ())), str(box.dtype)))
    return _table(["`observation=`", "part", "shape", "type"], rows)
