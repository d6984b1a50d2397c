"""Run a notebook's cells in order, without Jupyter; ``--write`` stores their outputs in the file.

python notebooks/run.py notebooks/quickstart.ipynb --write
"""

from __future__ import annotations

import argparse
import ast
import base64
import contextlib
import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt


def run_notebook(path: Path) -> dict[str, Any]:
    """Run all code cells in one namespace; return the notebook with their outputs.

    An exception of a cell passes through: a notebook that fails, fails.
    """
    notebook: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    namespace: dict[str, Any] = {"__name__": "__main__"}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for count, cell in enumerate(cells, start=1):
        cell["execution_count"] = count
        cell["outputs"] = list(run_cell("".join(cell["source"]), namespace, count))
    return notebook


def run_cell(source: str, namespace: dict[str, Any], count: int) -> Iterator[dict[str, Any]]:
    """Run one cell; yield what it prints, the value of its last line, and its figures."""
    body = ast.parse(source).body
    last = body.pop() if body and isinstance(body[-1], ast.Expr) else None
    printed, value = io.StringIO(), None
    with contextlib.redirect_stdout(printed):
        exec(compile(ast.Module(body, []), f"<cell {count}>", "exec"), namespace)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), f"<cell {count}>", "eval"), namespace)
    if printed.getvalue():
        yield {"output_type": "stream", "name": "stdout", "text": lines(printed.getvalue())}
    for number in plt.get_fignums():
        picture = io.BytesIO()
        plt.figure(number).savefig(picture, format="png", dpi=60)
        encoded = base64.b64encode(picture.getvalue()).decode()
        yield {"output_type": "display_data", "metadata": {}, "data": {"image/png": encoded}}
    plt.close("all")
    if value is not None:
        yield {
            "output_type": "execute_result",
            "execution_count": count,
            "metadata": {},
            "data": {"text/plain": lines(repr(value))},
        }


def lines(text: str) -> list[str]:
    """Text as the notebook format stores it."""
    return text.splitlines(keepends=True)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("notebook", type=Path)
    parser.add_argument("--write", action="store_true", help="store the outputs in the file")
    arguments = parser.parse_args()
    notebook = run_notebook(arguments.notebook)
    if arguments.write:
        text = json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
        arguments.notebook.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
