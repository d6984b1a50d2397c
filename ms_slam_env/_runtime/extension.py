"""Extension points: what stands behind a name of ours, of an entry point, or ``module:Class``.

SLAM backends, observations, rewards, scenes, perturbations, metrics, experiments, planners and
trainers are found here, alike in Python, on the command line and in worker processes. Where a name
is taken, the class or function itself may be given in Python.
"""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from ms_slam_env.errors import InputError, unknown

_EXTRAS = {
    "torch": "train",
    "stable_baselines3": "train",
    "sb3_contrib": "train",
    "ray": "rllib",
    "tree": "rllib",
    "ormsgpack": "rllib",
}


@dataclass(frozen=True)
class ExtensionPoint:
    """One kind of thing that has names.

    Attributes:
        kind: in error messages, such as ``SLAM backend``.
        group: of entry points, such as ``ms_slam_env.slam``.
        base: class of which what is found is a subclass, or instance of a function's result; None
            for anything that can be called.
        own: our names and what they stand for; a text ``module:name`` is imported when it is asked
            for.
        form: of the names that a user makes up.
        takes: names of what it is called with, in order; None where that differs.
        elsewhere: patterns of names that mean something in another place alone, and what to say.
    """

    kind: str
    group: str
    base: type | None = None
    own: Mapping[str, Any] = field(default_factory=dict)
    form: str = "module:Class"
    takes: tuple[str, ...] | None = None
    elsewhere: Mapping[str, str] = field(default_factory=dict)

    def names(self) -> tuple[str, ...]:
        """Our names, and those of the installed entry points."""
        installed = sorted({entry.name for entry in entry_points(group=self.group)})
        return tuple(dict.fromkeys([*self.own, *installed]))

    def find(self, name: Any) -> Any:
        """What ``name`` stands for; a class or function stands for itself.

        Raises:
            InputError: an unknown name (the message lists the choices), a module or an entry point
                that cannot be loaded, or something of another kind.
        """
        if not isinstance(name, str):
            if self.base is not None and isinstance(name, self.base):
                raise InputError(
                    f"{self.kind} {name!r} is an object; give its class, {type(name).__name__}"
                )
            if not callable(name):
                raise self.unknown(name)
            return self._checked(name, name)
        if name in self.own:
            own = self.own[name]
            return self._load(name, own, "") if isinstance(own, str) and ":" in own else own
        for pattern, hint in self.elsewhere.items():
            if re.match(pattern, name):
                raise InputError(f"{self.kind} {name!r}: {hint}")
        if ":" in name:
            # A console script, unlike ``python -m``, leaves the current folder out. It stays, since
            # worker processes, which get this path, import the module too; and it comes last, so
            # that no ``random.py`` there stands in for a library's that is imported later.
            if os.getcwd() not in sys.path:
                sys.path.append(os.getcwd())
            return self._checked(self._load(name, name, ""), name)
        found = [entry for entry in entry_points(group=self.group) if entry.name == name]
        if not found:
            raise self.unknown(name)
        return self._checked(self._of_entry(found[0]), name)

    def unknown(self, name: object, more: Iterable[str] = ()) -> InputError:
        """The error for a name that stands for nothing; ``more`` may be named besides."""
        error = unknown(self.kind, name, (*self.names(), *more, self.form))
        hint = f"an entry point ({self.group}) is found once its package is installed again"
        return InputError(f"{error}; {hint}")

    def _of_entry(self, entry: EntryPoint) -> Any:
        package = entry.dist.name if entry.dist else "its package"
        again = f" (entry point {entry.value}; if that has changed, install {package} again)"
        return self._load(entry.name, entry.value, again)

    def _load(self, name: str, value: str, hint: str) -> Any:
        try:
            found = load_reference(value)
        except ModuleNotFoundError as error:
            extra = _EXTRAS.get(error.name or "")
            hint = f"; pip install 'ms-slam-env[{extra}]'" if extra else hint
            raise InputError(f"{self.kind} {name!r} cannot be loaded: {error}{hint}") from error
        except (ImportError, AttributeError, ValueError) as error:  # ValueError: no module named
            raise InputError(f"{self.kind} {name!r} cannot be loaded: {error}{hint}") from error
        return found

    def _checked(self, found: Any, name: Any) -> Any:
        """``found``, if it is of this kind."""
        if self.base is None:
            if not callable(found):
                raise InputError(f"{self.kind} {name!r} is not callable")
        elif not (inspect.isclass(found) and issubclass(found, self.base)):
            module = self.base.__module__.rpartition(".")[0]
            raise InputError(
                f"{self.kind} {name!r} is not a subclass of {module}.{self.base.__name__}"
            )
        if inspect.isabstract(found):
            missing = ", ".join(sorted(found.__abstractmethods__))
            raise InputError(f"{self.kind} {name!r} does not define {missing}")
        if self.takes is not None:
            check_call(f"{self.kind} {name!r}", found, self.takes)
        return found


def load_reference(value: str) -> Any:
    """What a text ``module:attribute`` stands for; its module is imported now."""
    module, _, path = value.partition(":")
    found: Any = import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    return found


def is_reference(name: str) -> bool:
    """Whether ``name`` has the form ``module:attribute``."""
    module, _, path = name.partition(":")
    return all(part.isidentifier() for part in (*module.split("."), *path.split(".")))


def check_call(
    kind: str, make: Callable[..., Any], takes: tuple[str, ...], options: Collection[str] = ()
) -> None:
    """Refuse what cannot be called with arguments ``takes`` and the named ``options``.

    Raises:
        InputError: naming the thing and what it is called with.
    """
    try:
        signature = inspect.signature(make)
    except (TypeError, ValueError):  # a part of the interpreter, which does not say
        return
    try:
        signature.bind(*takes, **dict.fromkeys(options))
    except TypeError as error:
        name = getattr(make, "__name__", type(make).__name__)
        call = f"{name}({', '.join((*takes, *options))})"
        raise InputError(f"{kind} must be callable as {call}: {error}") from None


def check_options(
    kind: str,
    make: Callable[..., Any],
    options: Iterable[str],
    given: Collection[str],
    common: Collection[str] = (),
) -> None:
    """Refuse options that are no parameters of ``make`` beside those ``given`` anyway.

    All things of the kind have the options ``common`` besides.

    Raises:
        InputError: naming the option and listing the valid ones.
    """
    names = _parameter_names(make)
    if names is None:
        return
    taken = [*(name for name in names if name not in given), *common]
    for option in options:
        if option not in taken:
            raise unknown(f"option of {kind}", option, taken or ("(none)",))


def _parameter_names(make: Callable[..., Any]) -> list[str] | None:
    """What ``make`` takes by name; None for anything.

    What a class takes as ``**options`` is for the class before it in the order of inheritance.
    """
    layers: list[Any] = [make]
    if isinstance(make, type):
        layers += [vars(base)["__init__"] for base in make.__mro__[1:] if "__init__" in vars(base)]
    names: list[str] = []
    for layer in layers:
        parameters = inspect.signature(layer).parameters.values()
        own = [p.name for p in parameters if p.kind is not inspect.Parameter.VAR_KEYWORD]
        names += [name for name in own if name not in ("self", *names)]
        if len(own) == len(parameters):
            return names
    return None
