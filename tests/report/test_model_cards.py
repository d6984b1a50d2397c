"""A card says what is in the policy file and in the results about it, and nothing else."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from policy_files import METADATA, as_bytes

from ms_slam_env.cli import main
from ms_slam_env.report.results import write_results
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import Column, make_table

OPTIONS = {"out": "runs/a", "seed": 3, "scenes": ["table"], "scene_seeds": 2, "episode_steps": 40}
SCENES = ("table", "wall")
NAMES = ("greedy", "agent-hand", "random")


def scores(
    folder: Path,
    chance: Interval,
    planner: str = "agent-hand",
    episodes: int = 10,
    options: tuple[str, ...] = (),
    names: tuple[str, ...] = ("nbv", "random"),
    by_return: Interval | None = None,
    task: str = "",
    seeds: str = "test",
) -> None:
    """A planner benchmark in which ``planner`` is that much better than ``nbv``."""
    names = (names[0], planner, *names[1:])
    areas = {"nbv": 0.3, planner: 0.5, "random": 0.4}
    lines = [
        {
            "planner": name,
            "episodes": episodes,
            "f_score_5cm": 0.9 - 0.2 * k,
            "f_score_5cm_area": Interval(areas[name], 0.1, 0.6),
        }
        for k, name in enumerate(names)
    ]
    better, sooner = (
        make_table(
            ["planner", Column(other, "improvement", other)],
            [{"planner": planner, other: value}],
            task + title,
        )
        for title, other, value in (
            ("Share of pairs, by final F-score", "nbv", chance),
            ("Share of pairs, by area under the F-score", "random", Interval(0.7, 0.55, 0.8)),
        )
    )
    rewarded = make_table(
        ["planner", *(Column(name, "improvement", name) for name in ("random", "nbv"))],
        [{"planner": "random"}, {"planner": planner, "random": by_return}, {"planner": "nbv"}],
        "Share of pairs, by return",
    )
    rows = [
        {"spec": {"planner": name, "scene": scene}, "result": {}, "error": None}
        for name in names
        for scene in SCENES
    ]
    columns = ["planner", "episodes", "f_score_5cm", "f_score_5cm_area"]
    write_results(
        folder / "results.json",
        "planners",
        "Planners",
        "About.",
        [
            make_table(columns, lines, f"{task}over all scenes" if task else ""),
            better,
            sooner,
            *([rewarded] if by_return else []),
        ],
        rows=rows,
        content={"config": {"task": "kitchen", "seeds": seeds, "options": options}},
    )


def training(folder: Path, steps: int = 100, **changed: object) -> None:
    """A training run with a point after ``steps``."""
    lines = [{"timesteps": steps, "return": 12.5}]
    rows = [{"spec": {"planner": "policy"}, "result": lines[0], "error": None}]
    config = {**OPTIONS, "out": "elsewhere", **changed}
    tables = [make_table(["timesteps", "return"], lines, "The policy")]
    content = {"config": config}
    write_results(
        folder / "results.json", "train", "T", "About.", tables, rows=rows, content=content
    )


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A clone with one policy, a page for it, and its training among others."""
    made = {"command": "ms-slam train ppo --seed 3", "cpu": "a chip", "versions": {"torch": "2"}}
    known = replace(METADATA, options=OPTIONS, provenance=made)
    policy = tmp_path / "agents/policies/hand.safetensors"
    policy.parent.mkdir(parents=True)
    policy.write_bytes(as_bytes(json.dumps(asdict(known)), **dict.fromkeys(["optimizer.step"])))
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/agents.md").write_text("<!-- agents: agents/policies -->\n<!-- end -->\n")
    training(tmp_path / "docs/results/own")
    training(tmp_path / "docs/results/other_steps", steps=64)
    training(tmp_path / "docs/results/other_scene", scenes=["wall"])
    return tmp_path


def card(clone: Path) -> str:
    assert main(["docs", "--root", str(clone)]) == 0
    return (clone / "docs/agents.md").read_text()


def test_a_card_says_what_the_file_and_the_results_say(clone: Path) -> None:
    scores(clone / "docs/results/judged", Interval(0.1, 0.02, 0.3))
    text = card(clone)
    assert "## `agent-hand`" in text
    assert "- Observation: `features`, 5 numbers; 7 actions" in text
    assert "- Environment: `MSActiveSLAM-FreeCamera-v0`, step_m 0.1" in text
    assert "100 steps in 2 minutes, seed 3" in text
    assert "ms-slam train ppo --seed 3\n" in text
    assert "### In `kitchen`" in text
    assert "| nbv | 10 | 90 | 30 [10, 60] |" in text
    assert "| random |" not in text  # the best classical planner alone
    assert "By area under F-score: it beats `random`" in text
    assert "better in 70 [55, 80] % of pairs" in text
    assert "By F-score: it loses to `nbv`, the best classical planner (better in" in text
    assert "10 [2.0, 30] % of pairs" in text
    assert "not trained in: wall." in text
    assert text.count("| 100 | 12 |") == 1
    assert "| 64 |" not in text
    assert main(["docs", "--root", str(clone), "--check"]) == 0


@pytest.mark.parametrize(
    ("chance", "verdict"),
    [
        (Interval(0.8, 0.6, 0.9), "it beats `nbv`, the best classical planner (better in 80"),
        (
            Interval(0.6, 0.4, 0.8),
            "no difference from `nbv`, the best classical planner, is shown (better in 60",
        ),
    ],
)
def test_the_interval_decides(clone: Path, chance: Interval, verdict: str) -> None:
    scores(clone / "docs/results/judged", chance)
    assert verdict in card(clone)


@pytest.mark.parametrize("seeds", ["test", "validation"])
def test_a_score_on_other_seeds_than_those_of_tests_says_so(clone: Path, seeds: str) -> None:
    scores(clone / "docs/results/judged", Interval(0.8, 0.6, 0.9), seeds=seeds)
    assert ("On validation seeds:\n" in card(clone)) == (seeds == "validation")


@pytest.mark.parametrize(("seeds", "is_new"), [("7000-7003", True), ("7000,12", False)])
def test_a_score_on_ones_own_seeds_says_which(clone: Path, seeds: str, is_new: bool) -> None:
    scores(clone / "docs/results/judged", Interval(0.8, 0.6, 0.9), seeds=seeds)
    assert f"On the seeds {seeds}:\n" in card(clone)
    assert ("All scores are on seeds that it was not trained on" in card(clone)) == is_new


def test_one_rival_is_not_called_the_best(clone: Path) -> None:
    scores(clone / "docs/results/judged", Interval(0.8, 0.6, 0.9), names=("nbv",))
    text = card(clone)
    assert "it beats `nbv`, the only classical planner judged (better in 80" in text
    assert "the best classical planner" not in text


def test_scores_of_another_agent_are_not_its_own(clone: Path) -> None:
    scores(clone / "docs/results/judged", Interval(0.8, 0.6, 0.9), "agent-handsome")
    text = card(clone)
    assert "It has not been benchmarked yet." in text
    assert "kitchen" not in text


def test_of_two_benchmarks_of_a_task_the_one_with_more_episodes_counts(clone: Path) -> None:
    scores(clone / "docs/results/few", Interval(0.1, 0.02, 0.3), episodes=4)
    scores(clone / "docs/results/many", Interval(0.8, 0.6, 0.9), episodes=40)
    scores(clone / "docs/results/some", Interval(0.2, 0.02, 0.3), episodes=8)
    text = card(clone)
    assert text.count("### In `kitchen`") == 1
    assert "80 [60, 90] % of pairs" in text


def test_a_task_with_other_options_is_another(clone: Path) -> None:
    scores(clone / "docs/results/usual", Interval(0.1, 0.02, 0.3))
    scores(clone / "docs/results/paper", Interval(0.8, 0.6, 0.9), options=("reward=paper",))
    text = card(clone)
    assert "### In `kitchen`\n" in text
    assert "### In `kitchen, reward=paper`\n" in text


def test_of_several_tasks_with_options_each_has_its_verdict(clone: Path) -> None:
    chance = Interval(0.8, 0.6, 0.9)
    scores(clone / "docs/results/x", chance, options=("reward=paper",), task="kitchen: ")
    text = card(clone)
    assert "### In `kitchen, reward=paper`\n" in text
    assert "80 [60, 90] % of pairs" in text


def test_a_score_by_return_alone_has_its_own_columns_and_verdict(clone: Path) -> None:
    lines = [{"planner": n, "return": -1.0 * k, "return_ate": -0.5} for k, n in enumerate(NAMES)]
    won = [{"planner": "agent-hand", "greedy": Interval(0.8, 0.6, 0.9)}]
    pairs = make_table(
        ["planner", Column("greedy", "richer_share", "greedy")], won, "Share of starts, by return"
    )
    write_results(
        clone / "docs/results/shares/results.json",
        "reward_shares",
        "Shares",
        "About.",
        [make_table(["planner", "return", "return_ate"], lines), pairs],
        rows=[
            {"spec": {"planner": n, "scene": "table"}, "result": {}, "error": None} for n in NAMES
        ],
        content={"config": {"task": "kitchen", "seeds": "7000-7003", "options": ("reward=x",)}},
    )
    text = card(clone)
    assert "### In `kitchen, reward=x`\n\nOn the seeds 7000-7003:\n" in text
    assert "| agent-hand | -1.0 | -0.50 |" in text
    assert "By return: it beats `greedy`, the best classical planner (better in 80" in text


def test_training_seeds_are_counted(clone: Path) -> None:
    assert "One training run" in card(clone)
    training(clone / "docs/results/second", seed=4)
    training(clone / "docs/results/third", seed=5, rounds=4, eval_episodes=2)
    training(clone / "docs/results/other_way", seed=6, scenes=["wall"])
    text = card(clone)
    assert "Trained with 3 seeds" in text
    assert text.count("### Training curve") == 1


def test_a_policy_taken_before_its_run_went_on_has_the_curve_of_the_run(clone: Path) -> None:
    (policy,) = (clone / "agents/policies").iterdir()
    known = replace(METADATA, options={**OPTIONS, "rounds": 4})
    policy.write_bytes(as_bytes(json.dumps(asdict(known)), **dict.fromkeys(["optimizer.step"])))
    training(clone / "docs/results/own", rounds=7)
    training(clone / "docs/results/not_so_far", rounds=2, steps=50)
    text = card(clone)
    assert text.count("### Training curve") == 1
    assert "Its training curve is not" not in text


def test_a_policy_trained_in_further_tasks_names_them_and_no_scene_that_it_missed(
    clone: Path,
) -> None:
    (policy,) = (clone / "agents/policies").iterdir()
    scores(clone / "docs/results/judged", Interval(0.1, 0.02, 0.3))
    assert "not trained in" in card(clone)
    known = replace(METADATA, options={**OPTIONS, "also": ["arm-kinematic", "x.yaml"]})
    policy.write_bytes(as_bytes(json.dumps(asdict(known)), **dict.fromkeys(["optimizer.step"])))
    text = card(clone)
    assert (
        "- Also trained in: `arm-kinematic`, `x.yaml`; the parallel environments take turns\n"
        in text
    )
    assert "not trained in" not in text


def test_of_equally_many_episodes_those_among_more_rivals_count(clone: Path) -> None:
    seed = "agent-hand,path=runs/seed1.safetensors"
    scores(clone / "docs/results/seeds", Interval(0.1, 0.02, 0.3), seed)
    assert "It has not been benchmarked yet." in card(clone)  # that was another policy
    scores(clone / "docs/results/few_rivals", Interval(0.8, 0.6, 0.9), names=("nbv",))
    scores(clone / "docs/results/rivals", Interval(0.1, 0.02, 0.3))
    assert "10 [2.0, 30] % of pairs" in card(clone)


def test_by_return_the_rival_is_the_first_of_the_ranked(clone: Path) -> None:
    scores(
        clone / "docs/results/judged", Interval(0.1, 0.02, 0.3), by_return=Interval(0.3, 0.2, 0.4)
    )
    text = card(clone)
    assert "By return: it loses to `random`" in text
    assert "better in 30 [20, 40] % of pairs" in text


@pytest.mark.parametrize("content", [b"", b"\xff" * 64, as_bytes("[]"), b"{}"])
def test_what_is_no_policy_is_refused(
    clone: Path, content: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (clone / "agents/policies/other.safetensors").write_bytes(content)
    assert main(["docs", "--root", str(clone)]) == 2
    error = capsys.readouterr().err
    assert "other.safetensors is not a policy file" in error
    assert error.count("\n") == 1
