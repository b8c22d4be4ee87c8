"""The notebooks run from top to bottom, and are kept without what they print."""

from pathlib import Path

import jax
import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_cells(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [output for cell in code_cells(notebook) for output in cell.outputs]


@pytest.fixture
def kernel_cache(monkeypatch):
    """The kernel is a process of its own: it keeps compiled programs where the tests do."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", jax.config.jax_compilation_cache_dir)
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


def test_there_are_notebooks():
    assert NOTEBOOKS


@every_notebook
def test_is_kept_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert not outputs(notebook)
    assert all(cell.execution_count is None for cell in code_cells(notebook))


@every_notebook
def test_cells_have_the_ids_that_stripping_leaves(path):
    # nbstripout numbers them: other ids would change with the next commit.
    ids = [cell.id for cell in nbformat.read(path, as_version=4).cells]
    assert ids == [str(i) for i in range(len(ids))]


@pytest.mark.slow
@pytest.mark.usefixtures("kernel_cache")
@every_notebook
def test_runs(path):
    notebook = nbformat.read(path, as_version=4)
    # The folder that a notebook is opened in. A cell that raises ends the run with its traceback.
    place = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=600, resources=place).execute()
    assert all(cell.execution_count for cell in code_cells(notebook))
    kinds = [output.output_type for output in outputs(notebook)]
    assert "error" not in kinds
    assert "display_data" in kinds  # it draws
    told = [output.text for output in outputs(notebook) if output.get("name") == "stderr"]
    assert not told  # no warnings
