"""The notebooks of the documentation run as they stand, in one folder."""

from __future__ import annotations

import functools
import runpy
from collections.abc import Callable
from pathlib import Path

import nbformat
import pytest

DOCS = Path(__file__).parents[2] / "docs"
notebooks = runpy.run_path(str(DOCS / "make_notebooks.py"))


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], nbformat.NotebookNode]:
    """Run a notebook in the folder of this module, once, and before it the one whose report it reads."""
    folder = tmp_path_factory.mktemp("notebooks")

    @functools.cache
    def run(name: str) -> nbformat.NotebookNode:
        if name in notebooks["NEEDS"]:
            run(notebooks["NEEDS"][name])
        return notebooks["execute"](name, folder)

    return run


@pytest.mark.parametrize("name", notebooks["ORDER"])
def test_notebook_runs(name: str, executed: Callable[[str], nbformat.NotebookNode]) -> None:
    kept = nbformat.read(DOCS / "notebooks" / f"{name}.ipynb", as_version=4)
    assert [len(c.get("outputs", [])) > 0 for c in kept.cells if c.cell_type == "code"] == [
        len([o for o in c.outputs if o.get("name") != "stderr"]) > 0
        for c in executed(name).cells
        if c.cell_type == "code"
    ], "the outputs kept in the file are those of an older notebook: python docs/make_notebooks.py"
