"""C++ of kernels: its headers stand by themselves, fit their Python stubs, and check bounds."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import ms_slam_env
from ms_slam_env._runtime.warp import wp
from ms_slam_env.native import native_source, read_header

PACKAGE = Path(ms_slam_env.__file__).parent
HEADERS = sorted((PACKAGE / "native").glob("*.h"))


def stubs() -> list[tuple[str, str, list[str]]]:
    """(header, function, parameters) of every Python stub whose names are written out."""
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if "native_source(" not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.FunctionDef):
                continue
            for source in (n for d in node.decorator_list for n in ast.walk(d)):
                if isinstance(source, ast.Call) and getattr(source.func, "id", "") == (
                    "native_source"
                ):
                    header, function, *_ = (getattr(a, "value", None) for a in source.args)
                    if isinstance(function, str):
                        found.append((header, function, [a.arg for a in node.args.args]))
    return found


@pytest.mark.parametrize(("header", "function", "parameters"), stubs())
def test_a_function_has_the_parameters_of_its_stub(header, function, parameters):
    signature = re.search(rf"^\w+ {function}\(([^{{]*)\) \{{", read_header(header), re.MULTILINE)
    assert signature is not None
    assert [re.split(r"[ &]", p.strip())[-1] for p in signature[1].split(",")] == parameters


def test_stubs_were_found():
    assert len(stubs()) >= 16


def test_every_other_source_is_no_text_in_python():
    """C++ that an editor sees as a string is checked by nobody."""
    for file in PACKAGE.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert re.findall(r"func_native\((?!\s*native_source\()", text) == []


@pytest.mark.parametrize("define", ["MS_SLAM_UNCHECKED", "MS_SLAM_CHECKED"])
def test_headers_compile_by_themselves(define, tmp_path):
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("needs a C++ compiler")
    unit = tmp_path / "all.cpp"
    unit.write_text("".join(f'#include "{name}"\n' for name in ["builtin.h", *HEADERS]))
    folders = ["-I", str(Path(wp.__file__).parent / "native")]
    done = subprocess.run(
        [compiler, "-std=c++20", "-fsyntax-only", f"-D{define}", *folders, str(unit)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_what_a_header_does_not_have_is_refused():
    with pytest.raises(KeyError, match="no function walk"):
        native_source("arrays", "walk")
    with pytest.raises(KeyError, match="BLOCK_SIZE"):
        native_source("block_bounds", "bound")
    with pytest.raises(KeyError, match="SIZE"):
        native_source("arrays", "raise_to", SIZE=3)


PROGRAM = """
import sys
import numpy as np
from ms_slam_env._runtime.warp import wp
from ms_slam_env.slam.surfel.device import fetch, put
@wp.kernel
def copy(values: wp.array(dtype={dtype}), out: wp.array(dtype={dtype}), i: int):
    put(out, 0, fetch(values, i))
@wp.kernel
def copy_in_row(values: wp.array2d(dtype={dtype}), out: wp.array2d(dtype={dtype}), i: int):
    put(out, 0, 0, fetch(values, 0, i))
shape = {shape}
values, out = (wp.zeros(shape, dtype={dtype}, device="cpu") for _ in range(2))
kernel = copy if len(shape) == 1 else copy_in_row
wp.launch(kernel, 1, [values, out, int(sys.argv[1])], device="cpu")
print("done")
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "shape"), [("wp.float32", (4,)), ("wp.vec3", (4,)), ("wp.vec3", (2, 4))]
)
def test_a_checked_build_names_the_array_and_the_index(dtype, shape, tmp_path):
    """Index 4 lies in the next row where there are two: inside the memory, and wrong."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(dtype=dtype, shape=shape))
    environment = os.environ | {"MS_SLAM_ENV_CHECKED": "1", "OMP_NUM_THREADS": "1"}
    runs = {
        index: subprocess.run(
            [sys.executable, str(program), str(index)],
            capture_output=True,
            text=True,
            env=environment,
        )
        for index in (3, 4, -1)
    }
    assert runs[3].stdout == "done\n"
    for index in (4, -1):
        assert runs[index].returncode != 0
        assert "done" not in runs[index].stdout
        assert re.search(r"index -?\d+ of (values|a row) is outside \[", runs[index].stdout)
