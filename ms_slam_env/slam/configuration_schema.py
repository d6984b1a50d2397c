"""JSON schema of configuration files, from the dataclasses that read them.

``python -m ms_slam_env.slam.configuration_schema > slam.schema.json`` writes it, for editors.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from ms_slam_env.config import Family, Named, limits_of
from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.slam.machine import CompilerOptions
from ms_slam_env.slam.registry import POINT

_PLAIN = {bool: "boolean", int: "integer", float: "number", str: "string", dict: "object"}


def configuration_schema() -> dict[str, Any]:
    """The JSON schema (2020-12) of a file that `configuration.read_configuration` reads.

    ``slam_config`` is that of the backend ``slam``; of backends whose packages are not installed,
    and of those of other packages, it is any mapping.
    """
    schema = schema_of(SlamConfiguration)
    schema["properties"]["compiler"] = schema_of(CompilerOptions)
    schema["allOf"] = []
    for name, entry in POINT.own.items():
        try:
            config = schema_of(entry.load(entry.config))
        except InputError:  # its package is not installed
            continue
        if entry.has_devices:
            config["properties"]["device"] = {"type": "string", "default": "cpu"}
        chosen: dict[str, Any] = {"properties": {"slam": {"const": name}}}
        if name != SlamConfiguration.slam:  # a file without the key is of the default backend
            chosen["required"] = ["slam"]
        schema["allOf"].append({"if": chosen, "then": {"properties": {"slam_config": config}}})
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def schema_of(cls: type[Any]) -> dict[str, Any]:
    """The JSON schema of the mappings that `config.from_dict` takes for a dataclass.

    Dotted names (``a.b: 1``) are not part of it.
    """
    hints, properties = get_type_hints(cls), {}
    for field in dataclasses.fields(cls):
        about = _type(hints[field.name], limits_of(cls, field.name))
        default = field.default
        has_one = isinstance(default, (bool, int, float, str))
        properties[field.name] = {**about, "default": default} if has_one else about
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _type(hint: Any, limits: Mapping[str, Any]) -> dict[str, Any]:
    """Schema of one value; ``limits`` are those of its field."""
    form, parts = get_origin(hint), get_args(hint)
    if form in (Union, UnionType):
        return {"anyOf": [_type(part, limits) for part in parts]}
    if hint is type(None):
        return {"type": "null"}
    if "choices" in limits:
        return {"enum": list(limits["choices"])}
    if form in (tuple, list):
        return {"type": "array", "items": _type(parts[0], limits)}
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        if issubclass(hint, Family):
            return {"anyOf": [{"enum": list(hint.variants())}, {"type": "object"}]}
        names = [{"enum": list(hint.named())}] if issubclass(hint, Named) else []
        return {"anyOf": [*names, schema_of(hint)]} if names else schema_of(hint)
    kind = _PLAIN.get(form or hint)
    if kind in ("integer", "number") and "range" in limits:
        low, high = limits["range"]
        return {"type": kind, "minimum": low, "maximum": high}
    return {} if kind is None else {"type": kind}


if __name__ == "__main__":
    print(json.dumps(configuration_schema(), indent=2))
