"""Teams of robots, each with its own SLAM."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Figure
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import Record, flatten
from ms_slam_env.benchmark.report.kinds.base import Kind

_MEASURES = ("ate_m", "rpe_m", "map_f_score_2cm", "map_f_score_5cm", "map_rcm", "path_m")
_OF_TEAM = {"ate_m": "team_ate_m", "rpe_m": "team_rpe_m", "path_m": "mean_path_m"}


class Teams(Kind):
    """Two and three robots whose maps are merged."""

    name = "teams of robots"
    about = (
        "Every robot runs a SLAM of its own; where two maps overlap they are merged into one "
        "frame, and the team is judged as one (USME 14 to 20)."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """Teams with robots and an error of the whole."""
        teams = content.get("teams")
        return (
            isinstance(teams, list)
            and bool(teams)
            and all(
                isinstance(team, dict) and isinstance(team.get("robots"), list) for team in teams
            )
        )

    def figures(self, result: Result) -> list[Figure]:
        """The team beside each robot alone; pairs of maps by setting."""
        rows: list[Record] = []
        for team in result.content["teams"]:
            name = f"{team.get('scene')}, {team.get('seed')}, {team.get('setting')}"
            rows.append({"team": name, "who": "team, merged", **_measures(team, _OF_TEAM)})
            for number, robot in enumerate(team["robots"], start=1):
                rows.append({"team": name, "who": f"robot {number} alone", **_measures(robot, {})})
        summary = [flatten(row) for row in result.content.get("summary") or ()]
        found = [
            bar_figure(rows, "Teams beside their robots alone", ["team", "who"], _MEASURES),
            bar_figure(summary, "Pairs of maps", ["setting", "robots"]),
        ]
        return [figure for figure in found if figure is not None]


def _measures(row: Mapping[str, Any], names: Mapping[str, str]) -> Record:
    flat = flatten(row)
    return {key: flat.get(names.get(key, key)) for key in _MEASURES}
