"""The notebook of the documentation, executed."""

from pathlib import Path

import nbclient
import nbformat

NOTEBOOK = Path(__file__).resolve().parents[1] / "examples" / "street.ipynb"


def test_the_notebook_runs_and_shows_a_page(place):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    assert all(not cell.get("outputs") for cell in notebook.cells), "the notebook is kept without results"
    nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(place)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pages = [output.data["text/html"] for output in outputs if "text/html" in output.get("data", {})]
    assert len(pages) == 1 and pages[0].startswith("<iframe srcdoc=")
    text = "".join(output.get("text", "") for output in outputs)
    assert "the same digest" in text and "per cent of the voxels that a camera sees are right" in text
