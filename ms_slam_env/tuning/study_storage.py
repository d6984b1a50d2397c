"""A study on disk: hand out trials, store their results, and take them back from dead processes.

It is one SQLite file, which survives killed processes: the system releases their locks and SQLite
rolls back incomplete writes. Optuna's journal would keep half a line and a lock file.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ms_slam_env._runtime.input_files import check_file, is_named
from ms_slam_env._runtime.output_files import (
    check_out_folder,
    check_own,
    is_alive,
    process_name,
    write_bytes,
)
from ms_slam_env._runtime.result_folders import alone_in
from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.tuning.objectives import FAILURE, METRICS, Measured, objective_values
from ms_slam_env.tuning.samplers import make_sampler
from ms_slam_env.tuning.settings import ExplorationSettings
from ms_slam_env.tuning.space import SearchSpace
from ms_slam_env.tuning.study_check import (
    DEFAULT,
    MEASURED,
    OWNER,
    REFERENCE,
    RETRIES,
    RETRY_OF,
    check_schema,
    check_study,
    empty_study,
)

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.trial import FrozenTrial

STUDY_FILE, LOCK_FILE = "study.db", "study.lock"
_NAME = "exploration"
_MOST_RETRIES = 2  # of a trial whose process died; after that, its values may be the cause
_LOCK_TIMEOUT_S = 600.0
_MAX_BYTES = 2**30
_DISK_ERRORS = {
    "database or disk is full": errno.ENOSPC,
    "disk I/O error": errno.EIO,
    "attempt to write a readonly database": errno.EROFS,
}  # by SQLite's messages, sqlite3.c


class StudyStorage:
    """The trials of one study; any number of processes may open the same folder.

    Args:
        folder: folder of the study; created if missing.
        space: the parameters.
        settings: settings of the exploration.

    Raises:
        InputError: the folder holds a study with other settings, or its file is not a study.
        OSError: the disk is full, broken or read-only.
    """

    def __init__(self, folder: Path, space: SearchSpace, settings: ExplorationSettings) -> None:
        self.folder, self.space, self.settings = folder, space, settings
        self.owner = process_name()
        check_out_folder(folder)
        with self._alone():
            self.study = self._open()

    # -- Handing out and taking in -----------------------------------------------------------

    def ask(self, budget: int) -> Trial | None:
        """Hand out the next trial; None if ``budget`` trials are finished or running.

        The first trial is the default configuration. No other is handed out until it has finished,
        because results are measured relative to it.
        """
        from optuna.trial import TrialState

        with self._alone():
            self._take_back()
            trials = self.study.get_trials(deepcopy=False)
            states = [trial.state for trial in trials]
            running = states.count(TrialState.RUNNING)
            if states.count(TrialState.COMPLETE) + running >= budget:
                return None
            if self.reference() is None and running:
                return None
            # A new sampler per trial, seeded by the trial's number, so that a resumed study draws
            # the same as one without an interruption.
            seed = np.random.SeedSequence([self.settings.seed, len(trials)]).generate_state(1)[0]
            self.study.sampler = make_sampler(
                self.settings.sampler, int(seed), self.settings.population
            )
            trial = self.study.ask(self.space.distributions())
            trial.set_user_attr(OWNER, self.owner)
            return trial

    def tell(self, trial: Trial, measured: Measured) -> None:
        """Finish ``trial`` with its results, even if it was taken back meanwhile."""
        from optuna.exceptions import UpdateFinishedTrialError

        with self._disk_errors(), contextlib.suppress(UpdateFinishedTrialError):
            self._tell(trial, measured)

    def _tell(self, trial: Trial, measured: Measured) -> None:
        content = {name: _plain(value) for name, value in measured.items()}
        if self.reference() is None:
            self.study.set_user_attr(REFERENCE, self._reference_from(content))
        trial.set_user_attr(MEASURED, content)
        for name in ("M_I", "M_D"):
            trial.set_user_attr(name, content.get(name))
        trial.set_constraint("failed", 1.0 if content.get(FAILURE) else 0.0)
        for constraint in self.settings.parsed_constraints():
            trial.set_constraint(str(constraint), constraint.violation(content))
        reference = self.reference()
        assert reference is not None
        values = objective_values(content, self.settings.objectives, reference)
        self.study.tell(trial, values, skip_if_finished=True)

    def give_up(self, trial: Trial, why: str) -> None:
        """Mark ``trial`` as failed because its process died or could not work; it is repeated."""
        from optuna.trial import TrialState

        with self._disk_errors():
            trial.set_user_attr("given_up", why)
            self.study.tell(trial, state=TrialState.FAIL, skip_if_finished=True)

    def configuration(self, trial: Trial | FrozenTrial) -> SlamConfiguration:
        """The configuration to evaluate for ``trial``."""
        return self.space.configuration(trial.params)

    # -- Looking -----------------------------------------------------------------------------

    def finished(self) -> list[FrozenTrial]:
        """Finished trials, in the order of their numbers."""
        from optuna.trial import TrialState

        with self._disk_errors():
            return self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))

    def reference(self) -> dict[str, float] | None:
        """Largest value of each objective that counts; None until the default has finished."""
        return self.study.user_attrs.get(REFERENCE)

    # -- Inside ------------------------------------------------------------------------------

    def _open(self) -> Study:
        try:
            import optuna
            from optuna.storages import RDBStorage
        except ImportError:
            raise InputError(
                "exploration needs Optuna: pip install 'ms-slam-env[explore]'"
            ) from None
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        path = self.folder / STUDY_FILE
        self._check_files(path)
        with self._checked():
            if not path.exists() or not path.stat().st_size:
                write_bytes(path, empty_study())
            check_schema(path)
            storage = RDBStorage(f"sqlite:///{path}", engine_kwargs={"creator": self._connect})
            study = optuna.create_study(
                storage=storage,
                study_name=_NAME,
                directions=["minimize"] * len(self.settings.objectives),
                load_if_exists=True,
                sampler=optuna.samplers.RandomSampler(),
            )
            self._check_rows()
            self._check_settings(study)
            check_study(study, self.space, self.settings.objectives)
        if not any(trial.user_attrs.get(DEFAULT) for trial in study.get_trials(deepcopy=False)):
            study.enqueue_trial(self.space.defaults(), user_attrs={DEFAULT: True})
        return study

    def _check_files(self, path: Path) -> None:
        """Refuse untrusted files that would lead SQLite to other files."""
        for ending in ("", "-wal", "-shm"):
            check_own(Path(f"{path}{ending}"))
        journal = Path(f"{path}-journal")
        if is_named(journal):  # it may name a file that SQLite deletes
            raise InputError(
                f"{journal} does not belong to an exploration, which writes {path.name}-wal"
            )
        if is_named(path):
            check_file(path, "study", _MAX_BYTES)

    @contextmanager
    def _checked(self) -> Iterator[None]:
        """Turn any error that a file causes in Optuna into one line that names the file."""
        try:
            with self._disk_errors():
                yield
        except Exception as error:
            if isinstance(error, (OSError, MemoryError, InputError)):
                raise
            line = " ".join(str(error).split("\n")[0].split())
            raise InputError(f"{self.folder / STUDY_FILE}: not a study: {line}") from None

    def _check_rows(self) -> None:
        """Refuse rows of missing trials, which a later trial with that number would inherit."""
        with contextlib.closing(self._connect()) as connection:
            orphan = connection.execute("PRAGMA foreign_key_check").fetchone()
        if orphan:
            raise ValueError(f"{orphan[0]} has a row of a {orphan[2][:-1]} that is not there")

    def _check_settings(self, study: Study) -> None:
        mine = self.settings.fingerprint(self.space)
        theirs: Mapping[str, Any] = dict(study.user_attrs.get("settings", {}))
        if not theirs:
            study.set_user_attr("settings", mine)
            study.set_user_attr("objectives", list(self.settings.objectives))
            return
        for name in {**theirs, **mine}:
            if theirs.get(name) != mine.get(name):
                raise InputError(
                    f"{self.folder} holds an exploration with other settings: {name} was "
                    f"{theirs.get(name)} and is {mine.get(name)}; choose another folder"
                )

    def _take_back(self) -> None:
        """Mark trials of dead processes as failed, and queue failed trials again."""
        from optuna.trial import TrialState

        trials = self.study.get_trials(deepcopy=False)
        for trial in trials:
            owner = trial.user_attrs.get(OWNER)
            # A trial without owner: its process died between taking and signing it, both of which
            # happen under the lock held here.
            if trial.state == TrialState.RUNNING and (owner is None or not is_alive(owner)):
                self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)
        trials = self.study.get_trials(deepcopy=False)
        redone = {trial.user_attrs.get(RETRY_OF) for trial in trials}
        for trial in trials:
            retries = trial.user_attrs.get(RETRIES, 0)
            is_default = bool(trial.user_attrs.get(DEFAULT))
            given_up = trial.state == TrialState.FAIL and trial.number not in redone
            if given_up and (retries < _MOST_RETRIES or is_default):
                values = self.space.defaults() if is_default else trial.params
                if set(values) == set(self.space.parameters):
                    attributes = {RETRY_OF: trial.number, RETRIES: retries + 1}
                    if is_default:
                        attributes[DEFAULT] = True
                    self.study.enqueue_trial(values, user_attrs=attributes)

    def _reference_from(self, measured: Mapping[str, Any]) -> dict[str, float]:
        factor = self.settings.reference_factor
        if self.settings.reference:
            return dict(self.settings.reference)
        reference = {}
        for name in self.settings.objectives:
            value, worst = measured.get(name, math.nan), METRICS[name].worst
            failed = METRICS[name].is_error and bool(measured.get(FAILURE))
            unusable = value is None or not math.isfinite(value) or failed
            told = worst if unusable else METRICS[name].told(float(value))
            reference[name] = worst if unusable else (factor * told or worst)
        return reference

    def _connect(self) -> sqlite3.Connection:
        """A connection that survives the death of processes, with few syncs to disk.

        A power failure may lose the last trials, but never the file.
        """
        connection = sqlite3.connect(
            self.folder / STUDY_FILE, timeout=_LOCK_TIMEOUT_S, check_same_thread=False
        )
        connection.execute("PRAGMA trusted_schema=OFF")
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=NORMAL")
        return connection

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Hold the study's lock."""
        with alone_in(self.folder, self.folder / LOCK_FILE, _LOCK_TIMEOUT_S), self._disk_errors():
            yield

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        """Turn SQLite's errors, wrapped by two libraries, into one line that names the file.

        Raises:
            OSError: an error of the disk.
            InputError: any other error, such as no write permission or another kind of file.
        """
        path = self.folder / STUDY_FILE
        try:
            yield
        except Exception as error:
            cause: BaseException | None = error
            while cause is not None and not isinstance(cause, sqlite3.Error):
                cause = cause.__cause__ or cause.__context__
            if cause is None or isinstance(error, InputError):
                raise
            number = _DISK_ERRORS.get(str(cause))
            if number is None:
                raise InputError(f"{path}: {str(cause).splitlines()[0]}") from error
            raise OSError(number, f"{os.strerror(number)} ({cause})", str(path)) from error


def _plain(value: Any) -> Any:
    """``value`` in JSON types: NaN and infinity become None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
