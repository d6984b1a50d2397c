"""C++ inside Warp's kernels: functions in headers, which ``native_source`` reads.

Warp takes the body of a native function as text and has no place for headers. So here stand whole
functions, which an editor and a compiler understand (C++20: a parameter's type is ``auto``), and
their bodies are spliced into Warp's source together with the headers that theirs includes.
``#line`` keeps a compiler's messages at the right line.

Warp's own indexing is checked in its debug mode, ``VIEW`` and ``ELEMENT`` of ``checked.h`` where
``MS_SLAM_ENV_CHECKED=1``, which also sets that mode: the same kernels, slower; an index outside an
array ends the process with its name.
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
    """Return the text of a header; what functions include must include nothing itself."""
    return (_HERE / f"{name}.h").read_text(encoding="utf-8")


def native_source(header: str, function: str, **given: int | float) -> str:
    """Source for ``wp.func_native``: the body of a function of a header.

    Args:
        header: name without ``.h``.
        function: its name there; its parameters are those of the Python stub, in that order.
        given: values of the constants that the header asks for (``GIVEN``), all of them.

    Raises:
        KeyError: the header has no such function, or asks for other constants.
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
            "{",  # what a body has to say first, as a pragma of Clang, still comes first
            f'#line {line} "{header}.h"',
            f"{body}}}",
        ]
    )


def _without_guard(header: str) -> str:
    return read_header(header).replace("#pragma once", "")


def _constant(name: str, value: int | float) -> str:
    kind, text = ("float", f"{value!r}f") if isinstance(value, float) else ("int", f"{value}")
    return f"constexpr {kind} {name} = {text};"
