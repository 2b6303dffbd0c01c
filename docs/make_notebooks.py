"""Execute the notebooks again and keep their outputs: `python docs/make_notebooks.py`.

They run one after the other in one empty folder, since the third reads the report that the first writes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parent / "notebooks"
ORDER = ("runs_to_report", "arrays_to_surrogate", "report_numbers")
NEEDS = {"report_numbers": "runs_to_report"}


def execute(name: str, folder: Path) -> nbformat.NotebookNode:
    """The notebook after all its cells have run in `folder`; raises CellExecutionError where one fails."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()
    return notebook


def kept(notebook: nbformat.NotebookNode, folder: Path) -> nbformat.NotebookNode:
    """The notebook without what changes from run to run: times of cells, progress, paths of this machine."""
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [o for o in cell.outputs if o.get("name") != "stderr" and not _is_empty(o)]
            for output in cell.outputs:
                if "text" in output:
                    output.text = output.text.replace(f"{folder}/", "")
    notebook.metadata.pop("widgets", None)
    return notebook


def _is_empty(output: nbformat.NotebookNode) -> bool:
    """A line of progress that has left."""
    return output.output_type == "display_data" and output.data.get("text/html") == ""


def main() -> None:
    """Execute all, or those named on the command line and those before them."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ORDER:
            nbformat.write(kept(execute(name, Path(folder)), Path(folder)), FOLDER / f"{name}.ipynb")
            print(name, flush=True)
            if name in sys.argv[1:]:
                break


if __name__ == "__main__":
    main()
