"""Check the parts and the episode of a saved state before anything changes.

The remaining parts are compared with fresh ones in ``slam.shared.state_check``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from itertools import pairwise, takewhile
from math import isclose
from typing import Any

import numpy as np

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.divergence import Histograms
from ms_slam_env.env.episode import Episode, FrameRecord
from ms_slam_env.errors import InputError
from ms_slam_env.planning import OccupancyGrid
from ms_slam_env.slam.shared.state_check import (
    MOST,
    SEED,
    ArrayOf,
    Depending,
    OrNone,
    Real,
    WholeNumber,
    check_array,
    check_keys,
    check_like,
    check_list,
    check_mapping,
    check_plain,
    stacked,
    wrong,
)

PARTS = (
    *("settings", "episode", "slam", "embodiment", "coverage", "camera_feed"),
    *("T_world_kinematic", "random"),
)
"""Keys of a saved state of an environment."""

_MAY_DIFFER = ("observation", "mask")
"""Settings that are compared where the two disagree on keeping an occupancy grid."""

_STEPS = WholeNumber(most="steps")
_TWIST = ArrayOf(np.float64, (6,), least=-1, most=1)
_OF_EPISODE = {
    "scene": "",
    "scene_seed": SEED,
    "noise_seed": SEED,
    "energy_j": Real(0, MOST),
    "action": Depending(
        lambda action: _TWIST if isinstance(action, np.ndarray) else WholeNumber(index_of="motions")
    ),
    "steps_lost": _STEPS,
    "steps_away": _STEPS,
    "tracking_ok": True,
    "inlier_fraction": Real(0, 1),
    "squared_error_sum": Real(0),
    "pose_covariance": OrNone(np.zeros((6, 6))),
    "predicted_divergences": OrNone(ArrayOf(np.float64, ("motions", 2))),
}
_OF_RECORD = {
    "tracking_ok": True,
    "processed": True,
    "submap": WholeNumber(index_of="frames"),
    "time_s": Real(0, MOST),
    "pose_error": Real(0),
}
_POSES = ("T_world_camera", "T_world_camera_kinematic", "T_world_camera_estimate")
_ARRAYS_OF_RECORD = {**dict.fromkeys(_POSES, np.zeros((0, 4, 4))), "divergence": np.zeros((0, 2))}
_ROUNDING = 1e-6  # of distances and their squares, metres
_FARTHEST_CELL = 1_000_000  # of an occupancy grid; far below overflow


def check_parts(state: Any) -> None:
    """Refuse a state that lacks parts.

    Raises:
        InputError: naming the missing parts.
    """
    if not isinstance(state, Mapping):
        raise InputError(
            f"a {type(state).__name__} is not a saved state; pass what save_state() returned"
        )
    check_keys(state, PARTS, "state")


def check_same_settings(saved: Any, own: Mapping[str, Any]) -> None:
    """Refuse a state that an environment with other options saved.

    Raises:
        InputError: naming the first option that differs and both values.
    """
    check_mapping(saved, "settings")
    check_keys(saved, list(own), "settings")
    for name, value in own.items():
        is_same = type(saved[name]) is type(value)
        if not is_same or not (name in _MAY_DIFFER or _is_equal(saved[name], value)):
            raise InputError(
                f"the state was saved with {name} = {saved[name]!r}, this environment has {value!r}"
            )


def check_same_grid(
    saved: Mapping[str, Any], own: Mapping[str, Any], episode: Any, carves: bool
) -> None:
    """Refuse a state whose observation and mask need an occupancy grid where one's own do not.

    Args:
        saved: settings of the state, as `check_same_settings` takes them.
        own: settings of the environment.
        episode: of the state.
        carves: whether the environment keeps an occupancy grid.

    Raises:
        InputError: naming observation and mask of both, or the other way about.
    """
    differ = [name for name in _MAY_DIFFER if saved[name] != own[name]]
    if not differ or (getattr(episode, "occupancy", None) is not None) == carves:
        return
    theirs, ours = (
        " and ".join(f"{name} = {settings[name]!r}" for name in differ) for settings in (saved, own)
    )
    which = "needs an occupancy grid, which the state lacks" if carves else "keeps no such grid"
    with_grid = "" if carves else ", which keeps an occupancy grid"
    raise InputError(
        f"the state was saved with {theirs}{with_grid}; this environment has {ours}, which {which}"
    )


def _is_equal(saved: Any, own: Any) -> bool:
    try:
        return bool(saved == own)
    except (ValueError, TypeError):  # an unexpected array
        return False


def check_episode(
    episode: Any,
    own: Episode | None,
    histograms: Histograms,
    shape: tuple[int, int],
    motions: int,
    carves: bool,
) -> None:
    """Refuse an episode that such an environment cannot have recorded.

    Records shared with the current episode ``own`` are not checked again.

    Args:
        episode: of the state.
        own: the current episode, if there is one.
        histograms: of any frame.
        shape: (H, W) of the images.
        motions: number of motions.
        carves: whether the environment keeps an occupancy grid.

    Raises:
        InputError: naming the field and its fault.
    """
    if type(episode) is not Episode:
        raise wrong("episode", f"is a {type(episode).__name__}, not an Episode")
    _check_all_fields(episode, "episode")
    _check_steps(episode.divergences_of_steps)
    _check_records(episode.frames, own.frames if own else [])
    lengths = {"motions": motions, "steps": len(episode.divergences_of_steps)}
    given = {name: getattr(episode, name) for name in _OF_EPISODE}
    check_like(given, _OF_EPISODE, "episode", lengths)
    _check_errors(episode)
    _check_terms(episode.reward_terms)
    _check_frame(episode.frame, shape)
    for one in (episode.histograms, episode.step_histograms):
        _check_histograms(one, histograms)
    if carves != (episode.occupancy is not None):
        raise wrong("episode.occupancy", "is missing" if carves else "is one too many")
    if carves:
        _check_occupancy(episode.occupancy)


def _check_all_fields(value: Any, where: str) -> None:
    """Refuse missing or extra fields, which a dataclass read from a file may have."""
    check_keys(vars(value), [field.name for field in fields(value)], where)


def _check_terms(terms: Any) -> None:
    check_mapping(terms, "episode.reward_terms")
    for name, value in terms.items():
        check_plain(name, "", "a name of episode.reward_terms")
        check_plain(value, 0.0, f"episode.reward_terms.{name}")


def _check_frame(frame: Any, shape: tuple[int, int]) -> None:
    if not isinstance(frame, RGBDFrame):
        raise wrong("episode.frame", f"is a {type(frame).__name__}, not an RGBDFrame")
    _check_all_fields(frame, "episode.frame")
    check_array(frame.color, np.zeros((*shape, 3), np.uint8), "episode.frame.color")
    check_array(frame.depth, np.zeros(shape, np.float32), "episode.frame.depth")
    check_plain(frame.timestamp, 0.0, "episode.frame.timestamp")
    replace(frame)  # checks the values


def _check_histograms(one: Any, like: Histograms) -> None:
    where = "episode.histograms"
    if not isinstance(one, Histograms):
        raise wrong(where, f"is a {type(one).__name__}, not Histograms")
    _check_all_fields(one, where)
    for name in ("intensity", "normals"):
        rows = getattr(like, name)
        distribution = ArrayOf(rows.dtype, rows.shape, least=0, is_distribution=True)
        check_like(getattr(one, name), distribution, f"{where}.{name}")


def _check_occupancy(grid: Any) -> None:
    where = "episode.occupancy"
    if not isinstance(grid, OccupancyGrid):
        raise wrong(where, f"is a {type(grid).__name__}, not an OccupancyGrid")
    fresh = OccupancyGrid()
    check_keys(vars(grid), list(vars(fresh)), where)
    for name in ("cell_m", "reach_m"):
        if getattr(grid, name) != getattr(fresh, name):
            raise wrong(f"{where}.{name}", f"is {getattr(grid, name)}")
    check_array(grid.first, fresh.first, f"{where}.first")
    like = np.zeros(np.shape(grid.log_odds), np.int8)
    if like.ndim != 3 or (np.abs(grid.first) > _FARTHEST_CELL).any():
        raise wrong(where, "is of another space")
    for name in ("log_odds", "blanks"):
        check_array(getattr(grid, name), like, f"{where}.{name}")


def _check_steps(divergences: Any) -> None:
    where = "episode.divergences_of_steps"
    check_list(divergences, where)
    if not divergences:
        raise wrong(where, "has no step")
    check_array(stacked(divergences, where), np.zeros((0, 2)), where)


def _check_errors(episode: Episode) -> None:
    """Check that the error sum matches the frames, and that time never decreases."""
    total = sum(record.pose_error**2 for record in episode.frames)
    if not isclose(episode.squared_error_sum, total, rel_tol=_ROUNDING, abs_tol=_ROUNDING):
        raise wrong("episode.squared_error_sum", "is not that of its frames")
    if any(now.time_s < last.time_s for last, now in pairwise(episode.frames)):
        raise wrong("episode.frames", "goes back in time")


def _check_records(records: Any, own: Sequence[FrameRecord]) -> None:
    where = "episode.frames"
    check_list(records, where)
    if not records:
        raise wrong(where, "has no frame")
    same = sum(1 for _ in takewhile(lambda pair: pair[0] is pair[1], zip(records, own)))  # noqa: B905
    new = records[same:]
    for record in new:
        if not isinstance(record, FrameRecord):
            raise wrong(where, f"holds a {type(record).__name__}, not a FrameRecord")
        _check_all_fields(record, where)
        given = {name: getattr(record, name) for name in _OF_RECORD}
        check_like(given, _OF_RECORD, where, {"frames": len(records)})
    if not new:
        return
    arrays = {
        name: stacked([getattr(one, name) for one in new], where) for name in _ARRAYS_OF_RECORD
    }
    for name, empty in _ARRAYS_OF_RECORD.items():
        check_array(arrays[name], empty, where)
    off = arrays["T_world_camera_estimate"] - arrays["T_world_camera"]
    errors = np.linalg.norm(off[:, :3, 3], axis=1)
    if not np.allclose([one.pose_error for one in new], errors, rtol=_ROUNDING, atol=_ROUNDING):
        raise wrong(where, "has a pose_error that its poses do not have")
