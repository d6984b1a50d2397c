"""Build frozen-dataclass configurations from nested mappings or text; refuse misspelt keys."""

from __future__ import annotations

import dataclasses
import inspect
import numbers
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeGuard, TypeVar, get_args, get_origin, get_type_hints

import yaml

from ms_slam_env.errors import InputError, unknown

T = TypeVar("T")

_RANGE = "range"
_CHOICES = "choices"
_SHOWN = 80  # characters of a bad value in a message


def bounded(default: T, low: float, high: float) -> T:
    """Declare a field of a :class:`Checked` dataclass that takes numbers in [low, high].

    A field declared ``int`` takes no fractions; None passes where the field permits it.
    """
    return dataclasses.field(default=default, metadata={_RANGE: (low, high)})


def chosen(default: T, *choices: T) -> T:
    """Declare a field of a :class:`Checked` dataclass that takes one of ``choices``."""
    return dataclasses.field(default=default, metadata={_CHOICES: choices})


class Checked:
    """A dataclass that refuses values its fields do not permit.

    A subclass with further conditions calls ``super().__post_init__()`` before it checks them.
    """

    def __post_init__(self) -> None:
        """Check values against :func:`bounded` and :func:`chosen`, and that booleans are booleans.

        Raises:
            InputError: naming class, field, value, and the permitted range or choices.
        """
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            if field.type in (bool, "bool"):
                _check_bool(self, field.name)
            may_be_none = "None" in str(field.type) and getattr(self, field.name) is None
            limits = limits_of(type(self), field.name)
            if _RANGE in limits and not may_be_none:
                check_range(self, field.name, *limits[_RANGE])
            if _CHOICES in limits and not may_be_none:
                check_choice(self, field.name, limits[_CHOICES])


def limits_of(cls: type, name: str) -> Mapping[Any, Any]:
    """Range or choices of a field; an override that changes only the default inherits them."""
    stated = (getattr(base, "__dataclass_fields__", {}).get(name) for base in cls.__mro__)
    return next((field.metadata for field in stated if field and field.metadata), {})


class Named(ABC):
    """A dataclass with named presets; a preset's name can be given in place of a value."""

    @classmethod
    @abstractmethod
    def named(cls) -> Mapping[str, Named]:
        """The presets by name."""


class Family:
    """An abstract dataclass whose variants, its concrete subclasses, are chosen by key ``name``."""

    name: str

    @classmethod
    def variants(cls) -> dict[str, type]:
        """The variants by name; only those in modules already imported."""
        found: dict[str, type] = {}
        for variant in cls.__subclasses__():
            is_abstract = inspect.isabstract(variant)
            found |= variant.variants() if is_abstract else {variant.name: variant}
        return found


def from_dict(cls: type[T], values: Mapping[str, Any], path: str = "") -> T:
    """Build dataclass ``cls`` from a nested mapping.

    Args:
        cls: a dataclass; fields that are themselves dataclasses take nested mappings. For a
            :class:`Family`, key ``name`` selects the variant.
        values: field name to value; missing fields keep their default, a :class:`Named` or
            :class:`Family` field may be given by name, a path as text. ``{"a.b": 1}`` is
            ``{"a": {"b": 1}}``.
        path: dotted prefix used in error messages.

    Raises:
        InputError: an unknown key at any depth (the message lists the valid ones), a value that
            the dataclass refuses, or a value that should be a mapping and is not.
    """
    if issubclass(cls, Family) and inspect.isabstract(cls):
        cls, values = _variant(cls, values, path)
    values = _nested(values, path)
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    fixed = {name: field.default for name, field in fields.items() if not field.init}
    fields = {name: field for name, field in fields.items() if field.init}
    # asdict also writes fixed fields, such as the name of a variant.
    values = {key: v for key, v in values.items() if key not in fixed or v != fixed[key]}
    hints = get_type_hints(cls)
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        where = f"{path}.{key}" if path else str(key)
        if key not in fields:
            raise unknown(f"option of {cls.__name__}", where, fields)
        hint = hints[key]
        nested = isinstance(hint, type) and dataclasses.is_dataclass(hint)
        names = _names(hint) if nested else {}
        if nested and issubclass(hint, Family) and isinstance(value, str):
            value = {"name": value}
        if nested and isinstance(value, Mapping):
            value = from_dict(hint, value, where)
        elif isinstance(value, str) and value in names:
            value = names[value]
        elif isinstance(value, str) and Path in (hint, *get_args(hint)):
            value = Path(value)
        elif (nested and not isinstance(value, hint)) or (
            get_origin(hint) is dict and not is_options(value)
        ):
            raise _no_mapping(where, value, hint, names)
        arguments[key] = value
    missing = [name for name, field in fields.items() if _is_needed(field) and name not in values]
    if missing:
        raise InputError(f"{path or cls.__name__} lacks {', '.join(missing)}")
    return cls(**arguments)


def _is_needed(field: dataclasses.Field[Any]) -> bool:
    none = dataclasses.MISSING
    return field.default is none and field.default_factory is none


def _nested(values: Mapping[str, Any], path: str) -> Mapping[str, Any]:
    """``values`` with dotted names expanded into nested mappings."""
    if not any(isinstance(key, str) and "." in key for key in values):
        return values
    nested: dict[str, Any] = {}
    for key, value in values.items():
        first, dot, rest = key.partition(".") if isinstance(key, str) else (key, "", "")
        more = {rest: value} if dot else value
        known = nested.get(first, {})
        is_joined = isinstance(known, Mapping) and isinstance(more, Mapping)
        if first in nested and not (is_joined and known.keys().isdisjoint(more)):
            raise InputError(f"{path}.{key}: {first} already has a value".lstrip("."))
        nested[first] = {**known, **more} if is_joined else more
    return nested


def is_options(value: object) -> TypeGuard[Mapping[str, Any]]:
    """Whether ``value`` is a mapping whose keys can be option names."""
    return isinstance(value, Mapping) and all(isinstance(key, str) for key in value)


def _names(hint: type) -> Mapping[str, Any]:
    """The names accepted in place of a value of dataclass ``hint``, and what they stand for."""
    if issubclass(hint, Named):
        return hint.named()
    return hint.variants() if issubclass(hint, Family) else {}


def _variant(
    family: type[Any], values: Mapping[str, Any], path: str
) -> tuple[type[Any], dict[str, Any]]:
    """The variant that ``values`` names, and the values for it."""
    variants = family.variants()
    name = values.get("name")
    if not isinstance(name, str) or name not in variants:
        raise unknown(f"{path}.name" if path else "name", name, variants)
    return variants[name], {key: value for key, value in values.items() if key != "name"}


def _no_mapping(where: str, value: Any, hint: Any, names: Mapping[str, Any]) -> InputError:
    choices = " or ".join([*map(repr, names), "a mapping of options"])
    known = ""
    if dataclasses.is_dataclass(hint) and dataclasses.fields(hint):
        known = ": " + ", ".join(field.name for field in dataclasses.fields(hint))
    return InputError(f"{where} = {value!r} must be {choices}{known}")


def check_range(owner: object, name: str, low: float, high: float) -> None:
    """Refuse ``owner.name`` outside [low, high]; NaN is outside every range.

    A field declared ``int`` takes no fractions.

    Raises:
        InputError: naming the class, the field, its value and the permitted range.
    """
    value = getattr(owner, name)
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not is_number or not low <= value <= high:
        raise InputError(
            f"{type(owner).__name__}.{name} = {value!r} is outside [{low:g}, {high:g}]"
        )
    field = getattr(owner, "__dataclass_fields__", {}).get(name)
    if field is not None and field.type in (int, "int", "int | None"):
        check_whole(owner, name)


def check_whole(owner: object, name: str) -> None:
    """Refuse ``owner.name`` unless it is a whole number.

    Raises:
        InputError: naming the class, the field and its value.
    """
    value = getattr(owner, name)
    if not isinstance(value, numbers.Integral):
        raise InputError(f"{type(owner).__name__}.{name} = {value!r} must be an integer")


def _check_bool(owner: object, name: str) -> None:
    value = getattr(owner, name)
    if not isinstance(value, bool):
        raise InputError(f"{type(owner).__name__}.{name} = {value!r} must be true or false")


def check_choice(owner: object, name: str, choices: tuple[str, ...]) -> None:
    """Refuse a value of ``owner.name`` that is not one of ``choices``.

    Raises:
        InputError: listing the valid choices.
    """
    value = getattr(owner, name)
    if not any(isinstance(value, type(choice)) and value == choice for choice in choices):
        raise unknown(f"{type(owner).__name__}.{name}", value, choices)


def check_counts(owner: object, name: str, most: int, highest: int) -> None:
    """Refuse ``owner.name`` unless it is 1 to ``most`` integers in [0, highest]; make it a tuple.

    Raises:
        InputError: naming the class, the field, its value and the expected form.
    """
    value = getattr(owner, name)
    are_counts = isinstance(value, (tuple, list)) and all(
        type(count) is int and 0 <= count <= highest for count in value
    )
    if not are_counts or not 1 <= len(value) <= most:
        form = f"1 to {most} integers in [0, {highest}], such as [4, 5, 10]"
        raise InputError(f"{type(owner).__name__}.{name} = {value!r} must be {form}")
    object.__setattr__(owner, name, tuple(value))  # lists come from YAML


def parse_value(text: str, name: str) -> Any:
    """Parse the YAML value of option ``name``; a tuple such as (4, 5, 10) becomes a list.

    Raises:
        InputError: text that is not YAML.
    """
    tuple_form = _TUPLE.fullmatch(text)
    try:
        return load_yaml(f"[{tuple_form[1]}]" if tuple_form else text)
    except ValueError:
        shown = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
        raise InputError(f"option {name!r}: {shown!r} is not a YAML value") from None


_TUPLE = re.compile(r"\s*\(([^()]*,[^()]*)\)\s*")
_BETWEEN_OPTIONS = re.compile(r",(?![^\[(]*[\])])")  # not within [4, 5] or (4, 5)
_NUMBERS = {
    "int": r"[-+]?[0-9][0-9_]*|0o[0-7]+|0x[0-9a-fA-F]+",
    "float": r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
    r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
    "bool": "true|True|TRUE|false|False|FALSE",
}
"""Numbers and booleans as YAML 1.2 spells them (and 1_000, as in Python).

PyYAML reads YAML 1.1, where ``off`` is false, ``1:30`` is 90, ``010`` is 8 and ``1e-3`` is text.
"""


class _Loader(yaml.SafeLoader):
    """A safe YAML loader that refuses aliases and duplicate keys; scalars follow YAML 1.2."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        first: [one for one in known if one[0].rpartition(":")[2] not in _NUMBERS]
        for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Refuse aliases, with which ten lines can expand to a thousand million."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(
                None, None, "aliases (*name) are not read", self.peek_event().start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key given twice, where PyYAML would silently keep the last."""
        seen: set[Any] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                continue
            key = self.construct_object(key_node)
            if key in seen:  # 1, 1.0 and true are the same dict key
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key_node.value!r} is given twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


def _whole_number(loader: _Loader, node: yaml.ScalarNode) -> int:
    """Parse a whole number: base 10 even with leading zeros, or with prefix 0x or 0o."""
    text = node.value.replace("_", "")
    return int(text, 0 if text[:2] in ("0x", "0o") else 10)


for _kind, _pattern in _NUMBERS.items():
    _firsts = "tTfF" if _kind == "bool" else "-+.0123456789"
    _Loader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_kind}", re.compile(f"^(?:{_pattern})$"), list(_firsts)
    )
_Loader.add_constructor("tag:yaml.org,2002:int", _whole_number)


def load_yaml(text: str) -> Any:
    """Parse YAML ``text``: mappings, lists and plain values, without aliases.

    Raises:
        ValueError: with a one-line message: the text is not YAML, gives a key twice, is nested too
            deeply, or has an impossible value (a 13th month, a number of thousands of digits).
    """
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from None


def parse_named(text: str, kind: str) -> tuple[str, dict[str, Any]]:
    """Split ``NAME,option=value,...`` into the name and the options; values are YAML scalars.

    Args:
        text: the text to split.
        kind: what the name stands for, for the error message.

    Raises:
        InputError: an option without ``=``, or a value that is not YAML.
    """
    name, *parts = _BETWEEN_OPTIONS.split(text)
    options = {}
    for part in parts:
        option, equals, value = part.partition("=")
        if not equals or not all(part.isidentifier() for part in option.split(".")):
            raise InputError(f"{kind} {text!r}: {part!r} is not option=value")
        options[option] = parse_value(value, option)
    return name, options


def free_options(texts: Sequence[str], taken: Sequence[str]) -> dict[str, Any]:
    """``nested_options`` for an environment; refuse names that the command sets itself.

    Raises:
        InputError: as for ``nested_options``, or a name in ``taken``.
    """
    found = nested_options(texts)
    for name in found:
        if name in (*taken, "max_episode_steps"):
            raise InputError(f"option {name!r} cannot be set: the command sets it")
    return found


def nested_options(texts: Sequence[str]) -> dict[str, Any]:
    """Build a nested mapping from texts ``name.name=value``; values are YAML.

    Raises:
        InputError: no ``=``, a value that is not YAML, or a name used as both value and mapping.
    """
    result: dict[str, Any] = {}
    for text in texts:
        path, equals, value = text.partition("=")
        *parents, name = path.split(".")
        if not equals:
            raise InputError(f"option {text!r} is not name=value")
        inner = result
        for parent in parents:
            inner = inner.setdefault(parent, {})
            if not isinstance(inner, dict):
                raise InputError(f"option {path!r}: {parent} already has a value")
        inner[name] = parse_value(value, path)
    return result
