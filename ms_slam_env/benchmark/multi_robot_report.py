"""Tables and pictures of teams of robots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.benchmark.figures import caption, colour, new_figure, save
from ms_slam_env.benchmark.multi_robot_run import Team
from ms_slam_env.experiments.pictures.judged_map import overview, overview_pose
from ms_slam_env.geometry import transform_points
from ms_slam_env.geometry.point_clouds import voxel_firsts
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import format_number, markdown_table

Float64 = NDArray[np.float64]

_VOXEL_M = 0.01
_SHADE = 0.65  # of a robot's colour in the picture; the rest is the surface's own


def summarise(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """How many pairs of maps were merged, rightly and wrongly, by setting and number of robots.

    Pairs within one scene and pairs of different scenes are counted apart; ``errors_m`` and so on
    are medians over the merged pairs within one scene.
    """
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["spec"]["setting"], row["spec"]["robots"]), []).append(row)
    found = []
    for (setting, robots), group in groups.items():
        pairs = [pair for row in group for pair in row["result"]["pairs"]]
        same = [pair for pair in pairs if pair["same_scene"]]
        merged = [pair for pair in same if pair["merged"]]
        entry: dict[str, Any] = {
            **{"setting": setting, "robots": robots, "teams": len(group)},
            **{"pairs_same_scene": len(same), "merged_same_scene": len(merged)},
            "pairs_other_scene": len(pairs) - len(same),
            "merged_other_scene": sum(p["merged"] for p in pairs if not p["same_scene"]),
            "wrong": sum(pair["wrong"] for pair in pairs),
        }
        for name in ("error_m", "error_deg"):
            entry[f"median_{name}"] = (
                float(np.median([pair[name] for pair in merged])) if merged else None
            )
        for source in same[0]["alone"] if same else ():
            every = [pair["alone"][source] for pair in pairs]
            right = [one["merged"] and not one["wrong"] for one in every]
            entry[f"right_by_{source}_alone"] = sum(right)
            entry[f"wrong_by_{source}_alone"] = sum(one["wrong"] for one in every)
        found.append(entry)
    return found


def as_markdown(rows: Sequence[Row], summary: Sequence[dict[str, Any]]) -> str:
    """Merges by setting, the teams, and their pairs."""
    parts = ["Pairs of maps\n", _table(summary)]
    parts.append("Teams: merged, and in brackets the mean of the robots alone\n")
    header = ["scene", "seed", "setting", "in one frame", "ATE [mm]", "RPE [mm]"]
    header += ["F 2 cm [%]", "F 5 cm [%]", "task [s]", "mean path [m]"]
    body = []
    for row in rows:
        spec, result = row["spec"], row["result"]
        alone = result["robots"]
        body.append(
            [
                Path(spec["scene"]).stem,
                str(spec["seed"]),
                spec["setting"],
                f"{result['merged_robots']} of {spec['robots']}",
                _beside(result["team_ate_m"], [r["ate_m"] for r in alone], 1000),
                _beside(result["team_rpe_m"], [r["rpe_m"] for r in alone], 1000),
                *(
                    _beside(result[name], [r[name] for r in alone], 100)
                    for name in ("map_f_score_2cm", "map_f_score_5cm")
                ),
                format_number(result["task_time_s"]),
                format_number(result["mean_path_m"], 3),
            ]
        )
    parts.append(markdown_table(header, body))
    parts.append("Pairs: places found and agreeing, fit of the maps, error of T_a_b\n")
    header = ["scene", "seed", "setting", "pair", "result", "found", "agreeing", "consistent [%]"]
    header += ["alike", "error [mm]", "at origin [mm]", "error [deg]"]
    body = []
    for row in rows:
        spec = row["spec"]
        for pair in row["result"]["pairs"]:
            errors = [
                format_number(scale * pair[name]) if pair.get(name) is not None else "-"
                for name, scale in (("error_m", 1e3), ("error_origin_m", 1e3), ("error_deg", 1))
            ]
            verdict = "WRONG" if pair["wrong"] else "merged" if pair["merged"] else pair["reason"]
            fits = [
                "-" if value is None or np.isnan(value) else format_number(scale * value, 3)
                for value, scale in ((pair["consistent"], 100), (pair["alike"], 1))
            ]
            body.append(
                [
                    *(Path(spec["scene"]).stem, str(spec["seed"]), spec["setting"]),
                    *(f"{pair['a']}-{pair['b']}", verdict),
                    *(str(pair["found"]), str(pair["agreeing"])),
                    *fits,
                    *errors,
                ]
            )
    parts.append(markdown_table(header, body))
    return "\n".join(parts)


def save_picture(
    team: Team, placed: dict[int, Float64], found: dict[str, Any], path: Path, title: str
) -> Path:
    """The merged map as seen obliquely from behind the cameras, as it is and coloured by robot.

    Args:
        team: the robots.
        placed: T_0_b (4, 4) by robot.
        found: figures of the team.
        path: of the PNG.
        title: what team this is.
    """
    T_world_first = team.truths[0][0]
    points, shades, tints, cameras = [], [], [], []
    for k, T_first in placed.items():
        robot, T = team.robots[k], T_world_first @ T_first
        own = transform_points(T, robot.backend.surface_points())
        kept = voxel_firsts(own, _VOXEL_M)
        color = robot.backend.surface_colors()[kept].astype(np.float64)
        tint = 255 * np.array(matplotlib.colors.to_rgb(colour(k)))
        grey = color.mean(axis=1, keepdims=True)
        points.append(own[kept])
        shades.append(color)
        tints.append(_SHADE * tint * (0.4 + 0.6 * grey / 255) + (1 - _SHADE) * grey)
        cameras.append((T @ robot.estimates)[:, :3, 3])
    everything = np.concatenate(points)
    pose = overview_pose(everything, np.concatenate(cameras))
    figure = new_figure(2, width=5.0, height=4.3)
    panels = {"the merged map": shades, "coloured by robot": tints}
    for ax, (name, colors) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        values = np.concatenate(colors).clip(0, 255).astype(np.uint8)
        ax.imshow(overview(everything, values, pose))
        ax.set_title(name, fontsize="small")
        ax.axis("off")
    alone = float(np.mean([robot["map_f_score_5cm"] for robot in found["robots"]]))
    caption(
        figure,
        f"{title}: {found['merged_robots']} in one frame, ATE {1e3 * found['team_ate_m']:.1f} mm, "
        f"F-score at 5 cm {100 * found['map_f_score_5cm']:.0f} % (alone {100 * alone:.0f} %)",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    return save(figure, path)


def _beside(value: float, alone: Sequence[float], scale: float) -> str:
    return f"{format_number(scale * value)} ({format_number(scale * float(np.mean(alone)))})"


def _table(entries: Sequence[dict[str, Any]]) -> str:
    if not entries:
        return ""
    body = [
        [
            "-" if v is None else format_number(v) if isinstance(v, float) else str(v)
            for v in entry.values()
        ]
        for entry in entries
    ]
    return markdown_table([name.replace("_", " ") for name in entries[0]], body)
