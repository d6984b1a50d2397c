"""C++ code for Warp kernels: functions in headers, which ``native_source`` reads.

Warp takes the body of a native function as text, without headers. These headers contain whole
functions that an editor and a compiler understand (C++20: parameter types are ``auto``). Their
bodies are inserted into Warp's source, together with the headers that they include. ``#line`` keeps
compiler messages at the right line.

``MS_SLAM_ENV_CHECKED=1`` checks array bounds in ``VIEW`` and ``ELEMENT`` of ``checked.h``, and
enables Warp's debug mode, which checks Warp's own indexing. The kernels are the same but slower; an
index out of bounds ends the process with the array's name.
"""

from __future__ import annotations

import os
import re
from functools import lru_cache
from pathlib import Path

from ms_slam_env._runtime.warp import wp

CHECKED = os.environ.get("MS_SLAM_ENV_CHECKED", "") not in ("", "0")
"""Whether kernels check the bounds of arrays."""

_HERE = Path(__file__).parent

if CHECKED:
    wp.config.mode = "debug"


@lru_cache
def read_header(name: str) -> str:
    """Return the text of a header; an included header must not include others."""
    return (_HERE / f"{name}.h").read_text(encoding="utf-8")


def native_source(header: str, function: str, **given: int | float) -> str:
    """Source for ``wp.func_native``: the body of a function in a header.

    Args:
        header: name without ``.h``.
        function: name of the function; its parameters are those of the Python stub, in that order.
        given: values for all constants that the header declares with ``GIVEN``.

    Raises:
        KeyError: the header has no such function, or declares other constants.
    """
    text = read_header(header)
    names = re.findall(r"^GIVEN\(\w+, (\w+)\);", text, re.MULTILINE)
    if set(names) != set(given):
        raise KeyError(f"{header}.h asks for {sorted(names)}, given are {sorted(given)}")
    found = re.search(rf"^\w[\w ]* {function}\([^{{]*\{{\n", text, re.MULTILINE)
    if found is None:
        raise KeyError(f"{header}.h has no function {function}")
    body = text[found.end() : text.index("\n}", found.end()) + 1]
    included = re.findall(r'^#include "(\w+)\.h"', text, re.MULTILINE)
    line = text.count("\n", 0, found.end()) + 1
    return "\n".join(
        [
            "",
            *(["#define MS_SLAM_CHECKED"] if CHECKED else []),
            *(f'#line 1 "{name}.h"\n{_without_guard(name)}' for name in included),
            *(_constant(name, value) for name, value in given.items()),
            "{",  # a Clang pragma at the start of the body stays first
            f'#line {line} "{header}.h"',
            f"{body}}}",
        ]
    )


def _without_guard(header: str) -> str:
    return read_header(header).replace("#pragma once", "")


def _constant(name: str, value: int | float) -> str:
    kind, text = ("float", f"{value!r}f") if isinstance(value, float) else ("int", f"{value}")
    return f"constexpr {kind} {name} = {text};"
