"""Every committed notebook runs and gives outputs of the kinds stored in it."""

import importlib.util
import json
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))

spec = importlib.util.spec_from_file_location("notebooks_run", FOLDER / "run.py")
runner = importlib.util.module_from_spec(spec)
spec.loader.exec_module(runner)


def write(path, *sources):
    cells = [{"cell_type": "code", "source": [source], "outputs": []} for source in sources]
    path.write_text(json.dumps({"cells": cells}))
    return path


def test_the_runner_stores_what_cells_print_and_return(tmp_path):
    path = write(tmp_path / "small.ipynb", "x = 20\nprint('hello')", "x + 1")
    first, second = runner.run_notebook(path)["cells"]
    assert first["outputs"] == [
        {"output_type": "stream", "name": "stdout", "text": ["hello\n"]},
    ]
    assert second["outputs"][0]["data"] == {"text/plain": ["21"]}


def test_a_failing_cell_fails_the_run(tmp_path):
    with pytest.raises(ZeroDivisionError):
        runner.run_notebook(write(tmp_path / "bad.ipynb", "1 / 0"))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_and_gives_the_stored_kinds_of_output(path):
    stored = json.loads(path.read_text(encoding="utf-8"))["cells"]
    fresh = runner.run_notebook(path)["cells"]
    assert [kinds(cell) for cell in stored] == [kinds(cell) for cell in fresh]


def kinds(cell):
    return [output["output_type"] for output in cell.get("outputs", [])]
