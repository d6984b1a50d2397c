"""Every committed notebook runs and gives outputs of the kinds stored in it.

``python tests/notebooks/test_notebooks.py`` runs them and stores their outputs.
"""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST_BYTES = 225_000  # of all stored outputs


OPTIONS = [  # of the kernel
    "--log-level=40",  # it is spoken to without encryption, and warns of that
    "--InlineBackend.figure_formats=jpeg",
    "--InlineBackend.print_figure_kwargs={'dpi': 50, 'pil_kwargs': {'quality': 50}}",
]


def executed(notebook):
    """The notebook with the outputs of its cells, run in a kernel of its own in its folder."""
    client = NotebookClient(
        notebook,
        timeout=900,
        resources={"metadata": {"path": str(FOLDER)}},
        kernel_name="python3",
        extra_arguments=OPTIONS,
        coalesce_streams=True,
    )
    return client.execute()


def test_a_failing_cell_fails_the_run():
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("1 / 0")])
    with pytest.raises(CellExecutionError, match="ZeroDivisionError"):
        executed(notebook)


def test_stored_outputs_are_small():
    cells = [cell for path in NOTEBOOKS for cell in nbformat.read(path, 4).cells]
    assert sum(len(str(cell.get("outputs", ""))) for cell in cells) <= LARGEST_BYTES


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_and_gives_the_stored_kinds_of_output(path):
    stored = nbformat.read(path, 4)
    fresh = executed(nbformat.read(path, 4))
    assert list(map(kinds, stored.cells)) == list(map(kinds, fresh.cells))


def kinds(cell):
    return [output["output_type"] for output in cell.get("outputs", [])]


if __name__ == "__main__":
    for path in NOTEBOOKS:
        fresh = executed(nbformat.read(path, 4))
        for cell in fresh.cells:
            cell["metadata"] = {}  # when it ran is nobody's business
        nbformat.write(fresh, path)
