"""The interface of an experiment (specifications, measurement, tables, charts) and its registry."""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import itertools
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from ms_slam_env._runtime.extension import ExtensionPoint
from ms_slam_env._runtime.threads import one_thread_unless_set
from ms_slam_env.config import parse_named
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.report.charts import Chart
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Table

S = TypeVar("S")


class Experiment(ABC):
    """A frozen dataclass whose fields are the options of its command line.

    The first line of its docstring is the title of its results; the rest says what they show.

    Attributes:
        unit: plural noun for a row, shown in the progress bar.
        rows_key: key of the rows in ``results.json``.
        workers: default number of processes; None: one per core. 1 where times are measured.
        fresh_process: run each row in a new process, because peak memory is measured over the life
            of a process.
        tracks: whether rows are runs of a backend over a sequence; a run that is lost throughout is
            reported as a failure.
        check_rows: number of rows that ``--check`` runs again.
        parts: parts of the code that the rows use (names of ``report.sources.PARTS``), if not all;
            backends, planners and agents that a row names are added.
    """

    unit: ClassVar[str] = "runs"
    rows_key: ClassVar[str] = "rows"
    workers: ClassVar[int | None] = None
    fresh_process: ClassVar[bool] = False
    tracks: ClassVar[bool] = False
    check_rows: ClassVar[int] = 2
    parts: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def specs(self) -> Sequence[Any]:
        """List one frozen dataclass per row, with everything that the row depends on.

        Raises:
            InputError: options with which no row could run.
        """

    @staticmethod
    @abstractmethod
    def run(spec: Any) -> dict[str, Any]:
        """Measure one row; return numbers, flags, texts or lists of them by registry key.

        Runs in a worker process and must depend on ``spec`` alone.
        """

    @abstractmethod
    def tables(self, rows: Sequence[Row]) -> Sequence[Table]:
        """Make the tables, the most important first; some of the rows may have failed."""

    def charts(self, rows: Sequence[Row]) -> Sequence[Chart]:
        """Make the charts; none by default."""
        return ()

    def content(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """Return further entries of ``results.json``; none by default."""
        return {}

    def placed(self, out: Path) -> Experiment:
        """Return the experiment as it runs for folder ``out``, where rows may leave files."""
        return self

    def spec(self, kind: type[S], **own: Any) -> S:
        """Make one spec from the fields ``own`` and, for the others, options of the same name."""
        options = {field.name for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        names = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
        shared = {name: getattr(self, name) for name in names if name in options - own.keys()}
        return kind(**shared, **own)

    def each(self, kind: type[S], **axes: Sequence[Any]) -> list[S]:
        """Make a `spec` for every combination of the values in ``axes``; the last varies fastest.

        Raises:
            InputError: an unknown scene, sequence, backend, image size or noise; see `check_names`.
        """
        check_names(self)
        values = itertools.product(*axes.values())
        return [self.spec(kind, **dict(zip(axes, of, strict=True))) for of in values]

    def prepare(self) -> None:  # noqa: B027
        """Refuse, within seconds, options that would make every row fail; no check by default.

        Raises:
            InputError: says what is wrong.
        """

    def environment(self) -> Mapping[str, str]:
        """Environment variables of the worker processes: one thread each, unless already set."""
        return one_thread_unless_set()

    @classmethod
    def title(cls) -> str:
        """Return the first line of the docstring."""
        return _paragraphs(cls)[0]

    @classmethod
    def about(cls) -> str:
        """Return the docstring without its first paragraph."""
        return " ".join(_paragraphs(cls)[1:])


def check_names(experiment: Experiment) -> None:
    """Refuse unknown scenes, sequences, backends, image sizes and noise.

    Options are recognised by their names, so an experiment need not check them itself.

    Raises:
        InputError: lists the valid choices.
    """
    from ms_slam_env import slam
    from ms_slam_env.camera import parse_image_size
    from ms_slam_env.scenes.registry import check_name
    from ms_slam_env.sensor.noise import noise_config
    from ms_slam_env.sequences import check_sequence

    def check_backend(text: str) -> None:
        slam.check_parameters(*parse_named(text, "backend"))

    checks: Mapping[str, Callable[[str], object]] = {
        **dict.fromkeys(("scene", "scenes"), check_name),
        **dict.fromkeys(("image_size", "size", "sizes"), parse_image_size),
        **{"sequences": check_sequence, "backends": check_backend, "noise": noise_config},
    }
    for name, check in checks.items():
        given = getattr(experiment, name, ())
        for one in given if isinstance(given, tuple) else (given,):
            if isinstance(one, str):
                check(one)


def check_each(kind: str, given: Sequence[str], valid: Iterable[str]) -> None:
    """Refuse a list that is empty, repeats an entry or has an unknown one; ``kind`` names an entry.

    Raises:
        InputError: names the entry; for an unknown one, lists the valid choices.
    """
    if not given or len(set(given)) < len(given):
        raise InputError(f"{kind}s {', '.join(given)!r} must be different, at least one")
    valid = tuple(valid)
    for one in given:
        if one not in valid:
            raise unknown(kind, one, valid)


def _paragraphs(cls: type) -> list[str]:
    """Split a class's docstring into paragraphs, each on one line."""
    text = cls.__doc__ or cls.__name__
    return [" ".join(part.split()) for part in text.strip().split("\n\n")]


IN_A_CLONE = "clone the project and pip install -e ."
"""How to get what a wheel leaves out."""
_RESEARCH = importlib.util.find_spec("ms_slam_experiments")
HAS_RESEARCH = _RESEARCH is not None
"""Whether this is a checkout, which also has the project's research experiments."""


def _own() -> dict[str, str]:
    """Return the modules of the project's experiments by name."""
    own = {name: f"ms_slam_env.benchmark.{name}" for name in ("compare", "planners", "usme")}
    if _RESEARCH and _RESEARCH.submodule_search_locations:
        modules = pkgutil.iter_modules(_RESEARCH.submodule_search_locations)
        own |= {m.name: f"{_RESEARCH.name}.{m.name}" for m in modules if not m.ispkg}
    return dict(sorted(own.items()))


EXPERIMENTS = ExtensionPoint("experiment", "ms_slam_env.experiments", Experiment, own=_own())
"""Registry of experiments; the project's own are modules that are imported on first use."""


def experiment_class(name: str) -> type[Experiment]:
    """Return the experiment with this name; ``step-size`` and ``step_size`` are the same.

    Raises:
        InputError: an unknown name; the message lists the valid ones.
    """
    module_name = name.replace("-", "_")
    found: Any = EXPERIMENTS.find(module_name if module_name in EXPERIMENTS.own else name)
    if not isinstance(found, str):
        return found
    module = import_module(found)
    (own,) = [
        cls
        for _, cls in inspect.getmembers(module, inspect.isclass)
        if issubclass(cls, Experiment) and cls.__module__ == module.__name__
    ]
    return own
