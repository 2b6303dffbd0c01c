"""What every start of the command line has in common."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = ("torch", "vtkmodules", "pyvista", "dask", "numba", "matplotlib", "pandas", "sklearn", "xarray", "h5py")


def _python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip()


@pytest.mark.parametrize("module", ["crashkit", "crashkit.cli"])
def test_start_imports_nothing_heavy(module: str) -> None:
    loaded = _python(f"import sys, {module}; print(*[m for m in {HEAVY!r} if m in sys.modules])")
    assert loaded == ""


def test_help_lists_every_command() -> None:
    from crashkit.cli import COMMANDS

    text = subprocess.run(
        [sys.executable, "-m", "crashkit", "--help"], check=True, capture_output=True, text=True
    ).stdout
    missing = [name for name in COMMANDS if f" {name} " not in text]
    assert missing == []


def test_unknown_option_is_bad_usage() -> None:
    done = subprocess.run([sys.executable, "-m", "crashkit", "info", "--nonsense"], capture_output=True, text=True)
    assert done.returncode == 2


def test_failure_is_one_line_and_code_one(tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "crashkit", "info", str(tmp_path / "nothing.zarr")], capture_output=True, text=True
    )
    assert done.returncode == 1
    assert done.stdout == ""
    # A slow machine says what it is doing first: "reading .. 2 s".
    (said,) = [line for line in done.stderr.splitlines() if not line.startswith("reading ")]
    assert said.startswith("error: ")
    assert "nothing.zarr: no such dataset" in said


def test_public_functions_stay_functions_after_their_modules_are_imported() -> None:
    assert _python("import crashkit, crashkit.ingestion; print(callable(crashkit.ingest))") == "True"


def test_a_dataset_is_described_without_the_libraries_that_only_other_work_needs(demo_dataset: Path) -> None:
    code = f"import sys, crashkit.cli as c; sys.argv = ['crashkit', 'info', '--json', {str(demo_dataset)!r}]; c.app(standalone_mode=False)"
    loaded = _python(
        code + "; print([m for m in ('dask.base', 'distributed', 'pint', 'torch', 'vtkmodules') if m in sys.modules])"
    )
    assert loaded.endswith("[]")
