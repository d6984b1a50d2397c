"""Extension points: find an object by a built-in name, an entry point, or ``module:Class``.

SLAM backends, observations, rewards, scenes, perturbations, metrics, experiments, planners and
trainers are found here, in the same way in Python, on the command line and in worker processes. In
Python, the class or function itself may be passed instead of a name.
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
    """One kind of named object that can be extended.

    Attributes:
        kind: name of the kind in error messages, such as ``SLAM backend``.
        group: group of entry points, such as ``ms_slam_env.slam``.
        base: base class of the classes found, or class of the instances that a function returns;
            None for any callable.
        own: built-in names to objects; a text ``module:name`` is imported on first use.
        form: form of names that users may give.
        takes: names of the arguments that the object is called with, in order; None if they vary.
        elsewhere: patterns of names that are valid only elsewhere, and the hint to show for each.
    """

    kind: str
    group: str
    base: type | None = None
    own: Mapping[str, Any] = field(default_factory=dict)
    form: str = "module:Class"
    takes: tuple[str, ...] | None = None
    elsewhere: Mapping[str, str] = field(default_factory=dict)

    def names(self) -> tuple[str, ...]:
        """The built-in names, and those of installed entry points."""
        installed = sorted({entry.name for entry in entry_points(group=self.group)})
        return tuple(dict.fromkeys([*self.own, *installed]))

    def find(self, name: Any) -> Any:
        """Find the object named ``name``; a class or function is returned unchanged.

        Raises:
            InputError: an unknown name (the message lists the choices), a module or an entry point
                that cannot be loaded, or an object of another kind.
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
            # A console script, unlike ``python -m``, does not search the current folder. The entry
            # stays, since worker processes inherit it to import the module, too. It comes last, so
            # that a ``random.py`` there does not replace a library's module imported later.
            if os.getcwd() not in sys.path:
                sys.path.append(os.getcwd())
            return self._checked(self._load(name, name, ""), name)
        found = [entry for entry in entry_points(group=self.group) if entry.name == name]
        if not found:
            raise self.unknown(name)
        return self._checked(self._of_entry(found[0]), name)

    def unknown(self, name: object, more: Iterable[str] = ()) -> InputError:
        """The error for an unknown name; ``more`` lists further valid choices."""
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
        """Return ``found`` if it is of this kind, otherwise raise."""
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
    """Import the object named by ``module:attribute``."""
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
    """Refuse an object that cannot be called with arguments ``takes`` and the named ``options``.

    Raises:
        InputError: the message names the object and the call.
    """
    try:
        signature = inspect.signature(make)
    except (TypeError, ValueError):  # built into the interpreter, without a signature
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
    """Refuse options that are not parameters of ``make``, except those ``given`` by the caller.

    The options in ``common`` are valid for all objects of the kind.

    Raises:
        InputError: unknown option; the message names it and lists the valid ones.
    """
    names = _parameter_names(make)
    if names is None:
        return
    taken = [*(name for name in names if name not in given), *common]
    for option in options:
        if option not in taken:
            raise unknown(f"option of {kind}", option, taken or ("(none)",))


def _parameter_names(make: Callable[..., Any]) -> list[str] | None:
    """Names of the parameters of ``make``; None if it accepts any.

    The ``**options`` of a class are those of its base class.
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
