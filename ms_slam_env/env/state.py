"""A saved state is checked before anything changes: what it holds, of which type, shape and size.

There is no second description of what each part keeps: a part is compared with one that the same
environment made itself, whose arrays and tables are the smallest that there are.
"""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.divergence import Histograms
from ms_slam_env.env.episode import Episode, FrameRecord
from ms_slam_env.errors import InputError
from ms_slam_env.slam.base import TrackResult

PARTS = (
    *("settings", "episode", "slam", "embodiment", "coverage", "camera_feed"),
    *("T_world_kinematic", "random"),
)
"""Keys of a saved state of an environment."""

_TABLES = (  # arrays with a row for each of the same things
    ("position", "normal", "color", "radius", "confidence", "created", "seen"),
    ("bits", "known", "poses", "times"),
    ("dropped", "offsets"),
)
_IDENTITY = np.eye(3)
_RIGID = 1e-4  # as ``check_pose`` has it
_KINDS: tuple[Any, ...] = ((bool, np.bool_), numbers.Integral, (float, np.floating), str, tuple)
_MOST = 2**31  # counts and seeds of noise are below
_COUNTED = dict.fromkeys(("scene_seed", "noise_seed", "action", "steps_lost", "steps_away"), 0)
_MEASURED = dict.fromkeys(("energy_j", "inlier_fraction", "squared_error_sum"), 0.0)
_OF_EPISODE = {"scene": "", "tracking_ok": True, **_COUNTED, **_MEASURED}
_OF_RECORD = {"tracking_ok": True, "processed": True, "submap": 0, "time_s": 0.0, "pose_error": 0.0}
_POSES = ("T_world_camera", "T_world_camera_kinematic", "T_world_camera_estimate")
_COVARIANCE = np.zeros((6, 6))
_ARRAYS_OF_RECORD = {**dict.fromkeys(_POSES, np.zeros((0, 4, 4))), "divergence": np.zeros((0, 2))}
_SUM_ERROR = 1e-6  # of a distribution


def check_parts(state: Any) -> None:
    """Refuse what has not the parts of a saved state.

    Raises:
        InputError: naming what is missing.
    """
    if not isinstance(state, Mapping):
        raise InputError(f"a {type(state).__name__} is no state; give what save_state() returned")
    _check_keys(state, PARTS, "state")


def check_same_settings(saved: Any, own: Mapping[str, Any]) -> None:
    """Refuse a state that an environment with other options saved.

    Raises:
        InputError: naming the first option that differs and both values.
    """
    _check_mapping(saved, "settings")
    for name, value in own.items():
        same_type = type(saved.get(name)) is type(value)
        if not same_type or bool(saved[name] != value):
            raise InputError(
                f"the state was saved with {name} = {saved.get(name)!r}, "
                f"this environment has {value!r}"
            )


def check_like(value: Any, like: Any, where: str) -> None:
    """Refuse a part of a state that is not made like a part of the same environment.

    Where ``like`` is an empty table, list or None there may be more of it; where an array of it
    holds NaN, meaning none, ``value`` may as well. Counts are not negative, numbers are finite,
    poses are rigid motions.

    Raises:
        InputError: naming the place in the state and what is wrong with it.
    """
    if isinstance(like, np.ndarray):
        _check_array(value, like, where)
    elif isinstance(like, Mapping):
        _check_fields(value, like, where)
    elif isinstance(like, list) and like:
        _check_list(value, where, len(like))
        for k, pair in enumerate(zip(value, like, strict=True)):
            check_like(*pair, f"{where}[{k}]")
    elif like is None or isinstance(like, list):
        _check_free(value, where)
    else:
        _check_plain(value, like, where)


def is_open(like: Any) -> bool:
    """Whether something in ``like`` may be replaced by what ``check_like`` knows nothing of."""
    if isinstance(like, Mapping):
        return any(map(is_open, like.values()))
    if isinstance(like, list):
        return not like or any(map(is_open, like))
    return like is None


def _wrong(where: str, what: str) -> InputError:
    return InputError(f"this is no state to go on from: {where} {what}")


def _check_mapping(value: Any, where: str) -> None:
    if not isinstance(value, Mapping):
        raise _wrong(where, f"is a {type(value).__name__}, not a mapping")


def _check_keys(value: Mapping[Any, Any], names: Sequence[str], where: str) -> None:
    if set(value) != set(names):
        missing = [name for name in names if name not in value]
        more = sorted(str(name) for name in set(value) - set(names))
        raise _wrong(where, f"lacks {missing}" if missing else f"has {more} too")


def _check_list(value: Any, where: str, length: int | None = None) -> None:
    if not isinstance(value, list):
        raise _wrong(where, f"is a {type(value).__name__}, not a list")
    if length is not None and len(value) != length:
        raise _wrong(where, f"has {len(value)} elements in place of {length}")


def _check_fields(value: Any, like: Mapping[str, Any], where: str) -> None:
    _check_mapping(value, where)
    _check_keys(value, list(like), where)
    if "bit_generator" in like:
        _check_random(value, like, where)
        return
    for name, own in like.items():
        check_like(value[name], own, f"{where}.{name}")
    if "prediction" in like:  # frame selection, whose last result is None in the beginning
        _check_last_result(value["last"], f"{where}.last")
    for table in _TABLES:
        rows = {len(value[name]) for name in table if name in value}
        if len(rows) > 1 and all(name in value for name in table):
            raise _wrong(where, f"has tables of {sorted(rows)} rows")
    if {"counters", "surfels"} <= set(like):
        _check_counts(value, where)


def _check_counts(value: Mapping[str, Any], where: str) -> None:
    """The counters of surfel maps say how many surfels there are."""
    used = np.array([len(arrays["radius"]) for arrays in value["surfels"]])
    counters = value["counters"]
    if (counters["count"] != used).any() or (counters["dead"] > used).any():
        raise _wrong(f"{where}.counters", f"do not count the {used.tolist()} surfels")


def _check_random(value: Mapping[str, Any], like: Mapping[str, Any], where: str) -> None:
    """The state of a random number generator is one that a generator of its kind takes."""
    generator = getattr(np.random, str(like["bit_generator"]))(0)
    try:
        generator.state = value
        is_taken = _is_same(generator.state, value)
    except (TypeError, ValueError, KeyError, OverflowError):
        is_taken = False
    if not is_taken:
        raise _wrong(where, f"is no state of {like['bit_generator']}")


def _is_same(a: Any, b: Any) -> bool:
    if isinstance(a, Mapping):
        return isinstance(b, Mapping) and all(_is_same(a[name], b[name]) for name in a)
    return type(a) is type(b) and a == b


def _check_array(value: Any, like: NDArray[Any], where: str) -> None:
    if not isinstance(value, np.ndarray) or value.dtype != like.dtype:
        found = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise _wrong(where, f"is of {found}, not an array of {like.dtype}")
    grows = like.ndim > 0 and len(like) == 0
    rest = slice(int(grows), None)
    if value.ndim != like.ndim or value.shape[rest] != like.shape[rest]:
        raise _wrong(where, f"has shape {value.shape} in place of {like.shape}")
    may_be_nan = like.dtype.kind == "f" and not grows and bool(np.isnan(like).any())
    check_values(value, where, may_be_nan)


def check_values(value: NDArray[Any], where: str, may_be_nan: bool = False) -> None:
    """Refuse numbers that are not finite, and (..., 4, 4) that are no rigid motions.

    Raises:
        InputError: naming the place in the state.
    """
    if value.dtype.names:
        for name in value.dtype.names:
            check_values(value[name], f"{where}.{name}")
    if value.dtype.kind == "O":
        raise _wrong(where, "is an array of objects")
    if value.dtype.kind != "f":
        return
    if value.shape[-2:] == (4, 4):
        stack = value.reshape(-1, 4, 4)
        _check_rigid(stack[~np.isnan(stack).all(axis=(1, 2))] if may_be_nan else stack, where)
    elif not _is_finite(value) and not (may_be_nan and not np.isinf(value).any()):
        raise _wrong(where, "holds a value that is not finite")


def _is_finite(value: NDArray[Any]) -> bool:
    flat = value.reshape(-1)
    # The sum of squares, a fifth of the time, is finite unless a value is not, or very large.
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(np.dot(flat, flat)) or np.isfinite(flat).all())


def _check_rigid(stack: NDArray[Any], where: str) -> None:
    R = stack[:, :3, :3]
    is_rigid = (
        _is_finite(stack)
        and (np.abs(R @ R.swapaxes(1, 2) - _IDENTITY) < _RIGID).all()
        and (np.linalg.det(R) > 0).all()
        and (stack[:, 3] == (0, 0, 0, 1)).all()
    )
    if not is_rigid:
        raise _wrong(where, "holds a pose that is no rigid motion")


def _check_plain(value: Any, like: Any, where: str) -> None:
    kind = next(kind for kind in _KINDS if isinstance(like, kind))
    if not isinstance(value, kind) or (kind is not _KINDS[0] and isinstance(value, _KINDS[0])):
        raise _wrong(where, f"is a {type(value).__name__}, not a {type(like).__name__}")
    if kind is numbers.Integral and not 0 <= value < _MOST:
        raise _wrong(where, f"is {value}, outside [0, {_MOST})")
    if kind is _KINDS[2] and not np.isfinite(value):
        raise _wrong(where, f"is {value}, not finite")


def _check_free(value: Any, where: str) -> None:
    """What a part that is still empty has no example of: plain values and arrays of numbers."""
    if isinstance(value, np.ndarray):
        check_values(value, where)
    elif isinstance(value, Mapping):
        for name, one in value.items():
            _check_free(one, f"{where}.{name}")
    elif isinstance(value, (list, tuple)):
        for k, one in enumerate(value):
            _check_free(one, f"{where}[{k}]")
    elif value is not None and not isinstance(value, (bool, int, float, str, np.generic)):
        raise _wrong(where, f"is a {type(value).__name__}")
    elif isinstance(value, (float, np.floating)) and not np.isfinite(value):
        raise _wrong(where, f"is {value}, not finite")


def _check_last_result(value: Any, where: str) -> None:
    """Refuse what is neither None nor the fields of a ``TrackResult``."""
    if value is None:
        return
    _check_mapping(value, where)
    like = vars(TrackResult(np.eye(4), True, covariance=_COVARIANCE))
    without = value.get("covariance") is None
    check_like(value, {**like, "covariance": None} if without else like, where)


def check_episode(
    episode: Any, own: Episode | None, histograms: Histograms, shape: tuple[int, int], motions: int
) -> None:
    """Refuse an episode that no such environment has recorded.

    What ``own``, the episode of now, has recorded itself is not looked at again.

    Args:
        episode: of the state.
        own: the episode of now, if there is one.
        histograms: of any frame.
        shape: (H, W) of the images.
        motions: how many there are.

    Raises:
        InputError: naming the field and what is wrong with it.
    """
    if type(episode) is not Episode:
        raise _wrong("episode", f"is a {type(episode).__name__}, not an Episode")
    _check_all_fields(episode, "episode")
    for name, like in _OF_EPISODE.items():
        _check_plain(getattr(episode, name), like, f"episode.{name}")
    if episode.action >= motions:
        raise _wrong("episode.action", f"is {episode.action}; there are {motions} motions")
    _check_terms(episode.reward_terms)
    _check_frame(episode.frame, shape)
    for one in (episode.histograms, episode.step_histograms):
        _check_histograms(one, histograms)
    _check_steps(episode.divergences_of_steps)
    _check_records(episode.frames, own.frames if own else [])
    if episode.pose_covariance is not None:
        _check_array(episode.pose_covariance, _COVARIANCE, "episode.pose_covariance")
    if episode.predicted_divergences is not None:
        like = np.zeros((motions, 2))
        _check_array(episode.predicted_divergences, like, "episode.predicted_divergences")


def _check_all_fields(value: Any, where: str) -> None:
    """A dataclass may come out of a file without some of its fields, or with more."""
    _check_keys(vars(value), [field.name for field in fields(value)], where)


def _check_terms(terms: Any) -> None:
    _check_mapping(terms, "episode.reward_terms")
    for name, value in terms.items():
        _check_plain(name, "", "a name of episode.reward_terms")
        _check_plain(value, 0.0, f"episode.reward_terms.{name}")


def _check_frame(frame: Any, shape: tuple[int, int]) -> None:
    if not isinstance(frame, RGBDFrame):
        raise _wrong("episode.frame", f"is a {type(frame).__name__}, not an RGBDFrame")
    _check_all_fields(frame, "episode.frame")
    _check_array(frame.color, np.zeros((*shape, 3), np.uint8), "episode.frame.color")
    _check_array(frame.depth, np.zeros(shape, np.float32), "episode.frame.depth")
    _check_plain(frame.timestamp, 0.0, "episode.frame.timestamp")
    replace(frame)  # looks at the values itself


def _check_histograms(one: Any, like: Histograms) -> None:
    where = "episode.histograms"
    if not isinstance(one, Histograms):
        raise _wrong(where, f"is a {type(one).__name__}, not Histograms")
    _check_all_fields(one, where)
    for name in ("intensity", "normals"):
        rows = getattr(one, name)
        _check_array(rows, getattr(like, name), f"{where}.{name}")
        if (rows < 0).any() or (np.abs(rows.sum(axis=-1) - 1) > _SUM_ERROR).any():
            raise _wrong(f"{where}.{name}", "are no distributions")


def _check_steps(divergences: Any) -> None:
    where = "episode.divergences_of_steps"
    _check_list(divergences, where)
    if not divergences:
        raise _wrong(where, "has no step")
    _check_array(_stacked(divergences, where), np.zeros((0, 2)), where)


def _check_records(records: Any, own: Sequence[FrameRecord]) -> None:
    where = "episode.frames"
    _check_list(records, where)
    if not records:
        raise _wrong(where, "has no frame")
    same = sum(1 for _ in takewhile(lambda pair: pair[0] is pair[1], zip(records, own)))  # noqa: B905
    new = records[same:]
    for record in new:
        if not isinstance(record, FrameRecord):
            raise _wrong(where, f"holds a {type(record).__name__}, not a FrameRecord")
        _check_all_fields(record, where)
        for name, like in _OF_RECORD.items():
            _check_plain(getattr(record, name), like, f"{where}.{name}")
    for name, empty in _ARRAYS_OF_RECORD.items():
        if new:
            _check_array(_stacked([getattr(one, name) for one in new], where), empty, where)


def _stacked(arrays: list[Any], where: str) -> NDArray[Any]:
    """Arrays of one shape as one array; what is no array makes none of numbers."""
    if not all(isinstance(array, np.ndarray) for array in arrays):
        raise _wrong(where, "holds something else than arrays")
    if len({array.shape for array in arrays}) > 1:
        raise _wrong(where, "holds arrays of several shapes")
    return np.array(arrays)
