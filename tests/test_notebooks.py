"""Every notebook runs from top to bottom, and shows what it promises to."""

import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
PICTURES = {
    "1_quickstart": 2,
    "2_costs_and_smoothing": 4,
    "3_after_megapose_bop": 1,
    "4_table_from_two_views": 2,
    "5_training_regulariser": 1,
    "6_robot_camera": 2,
}


def pictures(notebook):
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", ())]
    assert not [o for o in outputs if o.output_type == "error"]
    return sum(any(kind.startswith("image/") for kind in o.get("data", ())) for o in outputs)


def test_all_are_known():
    assert [path.stem for path in NOTEBOOKS] == sorted(PICTURES)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_comes_with_its_pictures(path):
    """Whoever looks at it without running it sees them, and the repository stays small."""
    assert pictures(nbformat.read(path, as_version=4)) >= PICTURES[path.stem]
    assert path.stat().st_size < 600_000


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs(path, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    client = NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}})
    client.create_kernel_manager()
    # the interpreter of the tests, whatever kernels the machine has
    client.km.kernel_spec.argv[0] = sys.executable
    client.execute()
    assert pictures(notebook) >= PICTURES[path.stem]
