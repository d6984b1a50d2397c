"""Check a study's file before resuming it, since it may come from an untrusted source."""

from __future__ import annotations

import contextlib
import math
import re
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_slam_env.tuning.objectives import FAILURE, METRICS, OTHERS
from ms_slam_env.tuning.space import SearchSpace

if TYPE_CHECKING:
    from optuna import Study
    from optuna.trial import FrozenTrial

DEFAULT, OWNER, RETRY_OF, RETRIES = "default", "owner", "retry_of", "retries"
"""User attributes of a trial: whether its values are the defaults, which process works on it, the
number of the trial that it repeats, and how often that trial has been repeated."""
MEASURED = "measured"
"""User attribute of a finished trial: everything that its evaluation returned."""
REFERENCE = "reference"
"""User attribute of a study: largest value of each objective that still counts."""

_NUMBERS = {*METRICS, *OTHERS} - {FAILURE}
_PROCESS = re.compile(r"[^/]*/[0-9]{1,10}/([0-9]{0,20}|ended)")


Schema = frozenset[tuple[str, str, str, str]]
"""Type, name and table of every object in a database, and the SQL that creates it."""


def check_schema(path: Path) -> None:
    """Refuse a database with other objects than Optuna's tables and indices, before using it.

    A trigger, a view or a constraint would run whenever Optuna reads or writes.

    Raises:
        ValueError: foreign, missing or broken objects; the message says which.
        sqlite3.Error: not a database.
    """
    file = f"{path.absolute().as_uri()}?mode=ro"
    with contextlib.closing(sqlite3.connect(file, uri=True)) as connection:
        connection.execute("PRAGMA trusted_schema=OFF")
        found, expected = _schema(connection), _made_by_optuna()[1]
        names = {name for _, name, *_ in expected}
        for kind, name, *_ in sorted(found - expected):
            wrong = "is not as Optuna makes it" if name in names else "is not Optuna's"
            raise ValueError(f"{kind} {name} {wrong}")
        for kind, name, *_ in sorted(expected - found):
            raise ValueError(f"{kind} {name} is missing")
        (complaint,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        if complaint != "ok":
            raise ValueError(" ".join(complaint.split()))


def empty_study() -> bytes:
    """Content of a database with Optuna's tables, no study, and a write-ahead log."""
    return _made_by_optuna()[0]


@cache
def _made_by_optuna() -> tuple[bytes, Schema]:
    from optuna.storages import RDBStorage

    with tempfile.TemporaryDirectory(prefix="ms-slam-study-") as folder:
        path = Path(folder) / "study.db"
        with contextlib.closing(sqlite3.connect(path, check_same_thread=False)) as connection:
            connection.execute("PRAGMA synchronous=OFF")
            RDBStorage("sqlite://", engine_kwargs={"creator": lambda: connection})
            connection.commit()
            schema = _schema(connection)
        data = path.read_bytes()
    return data[:18] + b"\2\2" + data[20:], schema


def _schema(connection: sqlite3.Connection) -> Schema:
    rows = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_master")
    return frozenset(
        (kind, name, table, " ".join((sql or "").split())) for kind, name, table, sql in rows
    )


def check_study(study: Study, space: SearchSpace, objectives: Iterable[str]) -> None:
    """Refuse a study that no exploration with these parameters and objectives wrote.

    Raises:
        ValueError: a fault; the message names it and the trial.
    """
    from optuna.study import StudyDirection

    names = list(objectives)
    if study.directions != [StudyDirection.MINIMIZE] * len(names):
        raise ValueError("other directions than to minimise each objective")
    reference: Any = study.user_attrs.get(REFERENCE)
    is_known = _is_numbers(reference, names) and min(reference.values()) > 0
    if reference is not None and not is_known:
        raise ValueError(f"{REFERENCE} is not a positive number for each of {', '.join(names)}")
    for number, trial in enumerate(study.get_trials(deepcopy=False)):
        if trial.number != number:
            raise ValueError(f"trial {number} is missing")
        complaint = next(_complaints(trial, space, names, is_known), None)
        if complaint is not None:
            raise ValueError(f"trial {number}: {complaint}")


def _complaints(
    trial: FrozenTrial, space: SearchSpace, names: list[str], has_reference: bool
) -> Iterator[str]:
    """Faults of a trial."""
    from optuna.trial import TrialState

    own = trial.user_attrs
    queued = trial.system_attrs.get("fixed_params", {})
    if any(not _is_in(space, params) for params in (trial.params, queued)):
        yield "a parameter that is not explored, or a value out of its range"
    owner, retries, repeated = own.get(OWNER), own.get(RETRIES, 0), own.get(RETRY_OF, 0)
    if owner is not None and not (isinstance(owner, str) and _PROCESS.fullmatch(owner)):
        yield f"{OWNER} is not the name of a process"
    if not (_is_count(retries) and _is_count(repeated)):
        yield f"{RETRIES} or {RETRY_OF} is not a number of trials"
    if trial.state == TrialState.COMPLETE:
        if not has_reference:
            yield f"it is finished, and the study has no {REFERENCE}"
        if set(trial.params) != set(space.parameters):
            yield "it is finished, and parameters are missing"
        if not _is_numbers(dict(enumerate(trial.values or ())), range(len(names))):
            yield "its values are not a number for each objective"
        if not _is_numbers(trial.constraints, trial.constraints):
            yield "its constraints are not numbers"
        if not is_measured(own.get(MEASURED)):
            yield "what was measured is missing or not numbers"


def _is_in(space: SearchSpace, params: Any) -> bool:
    """Whether ``params`` are valid values of some of the parameters."""
    return isinstance(params, Mapping) and all(
        name in space.parameters and space.parameters[name].contains(value)
        for name, value in params.items()
    )


def is_measured(measured: Any) -> bool:
    """Whether an evaluation can have returned ``measured``."""
    if not isinstance(measured, Mapping) or not isinstance(measured.get(FAILURE, ""), str):
        return False
    return all(
        value is None or _is_number(value) for name, value in measured.items() if name in _NUMBERS
    )


def _is_numbers(values: Any, names: Iterable[Any]) -> bool:
    """Whether ``values`` are finite numbers with these ``names``."""
    return (
        isinstance(values, Mapping)
        and set(values) == set(names)
        and all(_is_number(value) for value in values.values())
    )


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 1e300 and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31
