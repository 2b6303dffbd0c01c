"""The notebooks of the documentation run as they stand, one after the other in one folder."""

from __future__ import annotations

import runpy
from pathlib import Path

import nbformat
import pytest

DOCS = Path(__file__).parents[2] / "docs"
notebooks = runpy.run_path(str(DOCS / "make_notebooks.py"))
pytestmark = pytest.mark.xdist_group("notebooks")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where they run: the last reads the report that the first writes."""
    return tmp_path_factory.mktemp("notebooks")


@pytest.mark.parametrize("name", notebooks["ORDER"])
def test_notebook_runs(name: str, folder: Path) -> None:
    executed = notebooks["execute"](name, folder)
    kept = nbformat.read(DOCS / "notebooks" / f"{name}.ipynb", as_version=4)
    assert [len(c.get("outputs", [])) > 0 for c in kept.cells if c.cell_type == "code"] == [
        len([o for o in c.outputs if o.get("name") != "stderr"]) > 0 for c in executed.cells if c.cell_type == "code"
    ], "the outputs kept in the file are those of an older notebook: python docs/make_notebooks.py"
