"""The notebooks of docs/: every cell runs, and shows again what is stored beside it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "docs" / "notebooks").glob("*.ipynb"))
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def executed(path: Path) -> Any:
    """Return a notebook after its cells have run, in the folder it lies in."""
    book = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(path.parent)}}
    NotebookClient(book, timeout=300, kernel_name="python3", resources=resources).execute()
    return book


def _tables(book: Any) -> list[str]:
    cells = [cell for cell in book.cells if cell.cell_type == "code"]
    return [
        str(output["data"]["text/html"])
        for cell in cells
        for output in cell.outputs
        if "text/html" in output.get("data", {})
    ]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_what_is_stored(path):
    stored, fresh = _tables(nbformat.read(path, as_version=4)), _tables(executed(path))
    assert len(stored) == len(fresh) >= 3
    for before, after in zip(stored, fresh, strict=True):
        assert NUMBER.sub("#", before) == NUMBER.sub("#", after)
        for one, other in zip(NUMBER.findall(before), NUMBER.findall(after), strict=True):
            assert float(other) == pytest.approx(float(one), rel=0.05, abs=1e-3)


def test_each_imports_the_public_face():
    for path in NOTEBOOKS:
        assert "import autotune as at" in path.read_text(encoding="utf-8")
