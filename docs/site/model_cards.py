"""Model cards: description, training, scores and limits of a trained policy.

A card is made from the metadata in a policy file and the results about the policy. Only the
metadata is read, so neither the trainer's libraries nor the agents are needed. Results are about a
policy if they come from its training (the same options, and a point after as many steps) or contain
the planner ``agent-NAME`` for the file ``NAME.safetensors``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark.planner_tables import PAIRS
from ms_slam_env.errors import InputError
from ms_slam_env.report.discovery import FoundResult, find_results
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import Table, format_value
from ms_slam_env.scenes import SEED_SPLITS, seeds_of, split_of

SUFFIX = ".safetensors"
_TEXT = "ms_slam_policy"
_LARGEST_HEADER = 1_000_000  # bytes
_NO_MATTER = ("out", "resume", "num_envs", "eval_episodes")  # do not change the training
_MORE_OF_IT = ("rounds", "total_timesteps", "minutes")  # a policy may be saved before the end
_SCORES = (
    *("planner", "episodes", "f_score_5cm", "f_score_5cm_area", "ate_m", "lost"),
    *("not_recovered_share", "violations", "decision_ms"),
)
_JUDGED: Mapping[str, Callable[[str], bool]] = {
    "planners": _SCORES.__contains__,
    "reward_shares": lambda column: True,
}
"""Kinds of results that judge planners, and which columns of their tables a card shows."""
_ACROSS = "over all scenes"
_VERDICTS = (
    (PAIRS["f_score_5cm"], "f_score_5cm", "F-score"),
    (PAIRS["f_score_5cm_area"], "f_score_5cm_area", "area under F-score"),
    (PAIRS["return"], "return", "return"),
    ("Share of starts, by return", "return", "return"),
)
"""Title of a table of probabilities, metric that selects the best classical planner, its name."""
_NO_RIVALS = (
    "agent-",
    "policy",
    "oracle",
    "foresight",
)  # trained planners, or those that know the scene


@dataclass(frozen=True)
class Policy:
    """A policy file and its metadata.

    Attributes:
        path: the file.
        known: its metadata, which ``agents/policy_file.py`` describes.
    """

    path: Path
    known: Mapping[str, Any]

    @property
    def planner(self) -> str:
        """Name of the policy in benchmarks."""
        return f"agent-{self.path.stem}"

    @property
    def options(self) -> Mapping[str, Any]:
        """Options of its training."""
        return dict(self.known.get("options") or {})

    def is_trained_as(self, one: FoundResult, but_for: Sequence[str] = ()) -> bool:
        """Whether a result comes from a training with the same options, except ``but_for``."""
        config = _config(one)
        own = {k: v for k, v in self.options.items() if k not in (*_NO_MATTER, *but_for)}
        same = all(config.get(key) == value for key, value in own.items())
        return one.results.kind == "train" and bool(own) and same

    def is_trained_in(self, one: FoundResult) -> bool:
        """Whether a result is the training run that produced this policy."""
        steps = [(row["result"] or {}).get("timesteps") for row in one.results.rows]
        return self.is_trained_as(one, _MORE_OF_IT) and self.known["timesteps"] in steps


def read_policy_text(path: Path) -> Policy:
    """Read the metadata of a policy file, without its weights.

    Raises:
        InputError: not a policy file.
    """
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            if length > _LARGEST_HEADER:
                raise ValueError("its head is too long")
            text = json.loads(file.read(length))["__metadata__"][_TEXT]
        known = json.loads(text)
        return Policy(path, {**known, "timesteps": int(known["timesteps"])})
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is not a policy file: {error!r}") from None


def model_cards(paths: Sequence[Path], results: Path, page: Path) -> str:
    """A card for each policy, in Markdown with headings of the second level.

    Args:
        paths: policy files, or folders of them.
        results: folder that contains the folders of results.
        page: page with the cards, which links are relative to.

    Raises:
        InputError: a path that is not a policy file, or a folder without one.
    """
    found, _ = find_results(results)
    policies = map(read_policy_text, _files(paths))
    return "\n".join(_card(policy, found, page, results.parent) for policy in policies)


def _files(paths: Sequence[Path]) -> Iterator[Path]:
    for path in paths:
        inside = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
        if not inside:
            raise InputError(f"{path} holds no policy (*{SUFFIX})")
        yield from inside


def _config(one: FoundResult) -> Mapping[str, Any]:
    config = one.results.content.get("config")
    return config if isinstance(config, dict) else {}


def _card(policy: Policy, found: Sequence[FoundResult], page: Path, docs: Path) -> str:
    trainings = [one for one in found if policy.is_trained_in(one)]
    benchmarks = [one for one in found if one.results.kind in _JUDGED and _scores(one, policy)]
    parts = [f"## `{policy.planner}`\n", _facts(policy), _command(policy.known)]
    scores: dict[str, _Score] = {}  # by task, those with the most evidence
    for score in (score for one in benchmarks for score in _scores(one, policy)):
        known = scores.get(score.task)
        if known is None or score.weight > known.weight:
            scores[score.task] = score
    for score in scores.values():
        parts += list(_score_text(score, policy, page, docs))
    if not benchmarks:
        parts.append("It has not been benchmarked yet.\n")
    like = {
        _config(one).get("seed")
        for one in found
        if policy.is_trained_as(one, ("seed", *_MORE_OF_IT))
    }
    parts += ["### Limits\n", *_limits(policy, benchmarks, trainings, len(like))]
    for one in trainings:
        parts += list(_training(one, page))
    return "\n".join(parts)


# -- Description -----------------------------------------------------------------------------------


def _facts(policy: Policy) -> str:
    known, options = policy.known, policy.options
    layers = " and ".join(map(str, known["hidden"]))
    network = f"tanh layers of {layers}"
    if known.get("candidates"):
        network += f", one encoder for all candidates ({known['candidates']} numbers each)"
    if known.get("image"):
        network += f", convolutions for an image of {' x '.join(map(str, known['image']))}"
    if known.get("memory"):
        network += f", a gated recurrent unit of {known['memory']}"
    changed = "".join(f", {key} {value}" for key, value in known.get("env_options", {}).items())
    where = options.get("scenes") or ()
    scenes = ", ".join(f"`{name}`" for name in where)
    actions = " x ".join(map(str, known["actions"]))
    lines = {
        "Run": f"`ms-slam benchmark --planners {policy.planner}`",
        "File": f"`{policy.path.name}`, {policy.path.stat().st_size / 1e3:.0f} kB",
        "Environment": f"`{known['env_id']}`{changed}",
        "Observation": f"`{known['observation']}`, {known['inputs']} numbers; {actions} actions",
        "Network": network,
        "Trained by": f"`{known['algorithm']}`, {known['timesteps']:,} steps in "
        f"{known['minutes']:.0f} minutes, seed {options.get('seed', 'unknown')}",
    }
    if scenes:
        seeds, steps = options.get("scene_seeds", "?"), options.get("episode_steps", "?")
        lines["Trained in"] = f"{scenes}, {seeds} training seeds each, episodes of {steps} steps"
    if options.get("also"):
        tasks = ", ".join(f"`{name}`" for name in options["also"])
        lines["Also trained in"] = f"{tasks}; the parallel environments take turns"
    if options.get("init"):
        lines["Started from"] = f"`{options['init']}`"
    return "".join(f"- {what}: {value}\n" for what, value in lines.items())


def _command(known: Mapping[str, Any]) -> str:
    made = known.get("provenance") or {}
    versions = ", ".join(f"{name} {version}" for name, version in made.get("versions", {}).items())
    where = f"On {made.get('cpu', 'an unknown machine')}, {versions}."
    return f"```sh\n{made.get('command', '')}\n```\n\n{where}\n"


# -- Scores ----------------------------------------------------------------------------------------


def _is_of(policy: Policy, planner: Any) -> bool:
    name, _, options = str(planner).partition(",")
    is_named = name == policy.planner and "path=" not in options
    return is_named or (name == "policy" and f"/{policy.path.name}" in options)


@dataclass(frozen=True)
class _Score:
    """Scores of a policy in one task: its table row, and those of classical planners."""

    one: FoundResult
    table: Table
    own: Mapping[str, Any]
    others: Sequence[Mapping[str, Any]]

    @property
    def task(self) -> str:
        return _task(self.one, self.table)

    @property
    def weight(self) -> tuple[int, int]:
        """Number of episodes, and number of rivals."""
        return int(self.own.get("episodes", 0)), len(self.others)


def _scores(one: FoundResult, policy: Policy) -> list[_Score]:
    """Tables over all scenes that contain the policy; benchmarks rank their rows, best first."""
    scores = []
    for k, table in enumerate(one.results.tables):
        own = [row for row in table.rows if _is_of(policy, row.get("planner"))]
        others = [r for r in table.rows if not str(r.get("planner")).startswith(_NO_RIVALS)]
        if own and others and (_ACROSS in table.title or (k == 0 and not table.title)):
            scores.append(_Score(one, table, own[0], others))
    return scores


def _score_text(score: _Score, policy: Policy, page: Path, docs: Path) -> Iterator[str]:
    others, results = score.others, score.one.results
    yield f"### In `{score.task}`\n"
    caveats = results.short_caveats(page, docs)
    if caveats:
        yield f"*{caveats}*\n"
    seeds = _config(score.one).get("seeds", "test")
    if seeds != "test":
        yield f"On {seeds} seeds:\n" if seeds in SEED_SPLITS else f"On the seeds {seeds}:\n"
    is_shown = _JUDGED[results.kind]
    columns = tuple(c for c in score.table.columns if is_shown(c.name))
    which = "the best classical planner" if others[1:] else "the only classical planner judged"
    rows = (score.own, others[0])
    yield replace(score.table, title="", columns=columns, rows=rows).as_markdown()
    for title, metric, what in _VERDICTS:
        of_task = f"{score.table.title.partition(':')[0]}: {title}"
        for table in (t for t in results.tables if t.title in (title, of_task)):
            best = _best_rival(score, metric, table)
            chance = _chance(table, policy, best)
            if chance is not None:
                shown = format_value(chance, "improvement")
                verdict = _verdict(chance, f"`{best}`, {which}")
                yield f"By {what}: {verdict} (better in {shown} % of pairs).\n"


def _task(one: FoundResult, table: Table) -> str:
    title, _, _ = table.title.partition(":")
    changed = "".join(f", {option}" for option in _config(one).get("options") or ())
    return (title if table.title else str(_config(one).get("task", one.title))) + changed


def _best_rival(score: _Score, metric: str, table: Table) -> Any:
    """The classical planner with the largest value; if none is known, the table's first one."""
    known = [line for line in score.others if isinstance(line.get(metric), Interval)]
    if known:
        return max(known, key=lambda line: line[metric].value)["planner"]
    names = [line["planner"] for line in score.others]
    return next((row["planner"] for row in table.rows if row["planner"] in names), names[0])


def _chance(table: Table, policy: Policy, best: Any) -> Interval | None:
    """Probability that the policy is better than a planner, from the benchmark's own table."""
    for row in table.rows:
        value = row.get(str(best))
        if _is_of(policy, row.get("planner")) and isinstance(value, Interval):
            return value
    return None


def _verdict(chance: Interval, rival: str) -> str:
    if chance.low > 0.5:
        return f"it beats {rival}"
    if chance.high < 0.5:
        return f"it loses to {rival}"
    return f"no difference from {rival}, is shown"


# -- Limits ----------------------------------------------------------------------------------------


def _may_be_of_training(benchmark: FoundResult) -> bool:
    """Whether a benchmark used a seed that trainings draw from."""
    try:
        seeds = seeds_of(_config(benchmark).get("seeds", "test"))
    except InputError:
        return True
    return any(split_of(seed) == "train" for seed in seeds)


def _limits(
    policy: Policy,
    benchmarks: Sequence[FoundResult],
    trainings: Sequence[FoundResult],
    training_seeds: int,
) -> Iterator[str]:
    known, options = policy.known, policy.options
    sees, actions = known["observation"], " x ".join(map(str, known["actions"]))
    yield f"- It fits only the observation `{sees}` with {actions} actions."
    rows = [row for one in benchmarks for row in one.results.rows]
    met = {row["spec"].get("scene") for row in rows if _is_of(policy, row["spec"].get("planner"))}
    new = sorted(str(name) for name in met - set(options.get("scenes") or ()))
    if options.get("scenes") and new and not options.get("also"):  # its scenes are not recorded
        yield f"- It is scored in scenes that it was not trained in: {', '.join(new)}."
    if benchmarks and not any(map(_may_be_of_training, benchmarks)):
        yield "- All scores are on seeds that it was not trained on."
    if not trainings:
        yield "- Its training curve is not among the results."
    if training_seeds > 1:
        yield f"- Trained with {training_seeds} seeds; this is one of them."
    else:
        yield "- One training run: how much the result varies between runs is not known."
    for one in trainings:
        if one.results.stale:
            version = one.results.version
            yield f"- Its training curve is of results version {version}, older than the code."
        if one.results.uncommitted:
            yield "- It was trained with code that is in no commit."
    yield ""


def _training(one: FoundResult, page: Path) -> Iterator[str]:
    """The training curve as figures, or as a table if there are none."""
    yield "### Training curve\n"
    figures = [(chart, one.path.with_name(f"{chart.name}.png")) for chart in one.results.charts]
    shown = [(chart, figure) for chart, figure in figures if figure.is_file()]
    for chart, figure in shown:
        link = Path(os.path.relpath(figure, page.parent)).as_posix()
        yield f"![{chart.title}]({link})\n\n*{chart.caption}.*\n"
    if not shown:
        yield replace(one.results.tables[0], title="").as_markdown()
