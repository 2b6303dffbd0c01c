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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("train {data} -o m --model foo", "model 'foo' is not known"),
        ("train nope.zarr -o m", "nope.zarr: no such dataset"),
        ("train {data} -o m --model pod-gpr --coarse nope.zarr", "nope.zarr: no such dataset"),
        ("train {data} -o m --model podnn --coarse {data}", "coarse runs go beneath mh and pod-gpr"),
        ("train {data} -o m --preset paper --coarse {data}", "level.regression=network has none"),
        ("train {data} -o there", "there: exists and is no model folder"),
        ("train {data} -o done --resume", "done: holds a finished training, so there is nothing to resume"),
        ("train {data} -o m --device gpu", "device 'gpu' is not known"),
        ("train {data} -o m --model pod-gpr --test 99:", "'99:' does not fit 36 runs"),
        ("train {data} -o m --model pod-gpr --odd yield_stress", "physics.odd names yield_stress, which is 1"),
        ("evaluate {data} nope -o r", "nope: no such model folder"),
        ("evaluate nope.zarr there -o r", "nope.zarr: no such dataset"),
        ("evaluate {data} nope -o there", "there: exists and holds no report.json"),
        ("explore nope -o page.html", "nope: no such model folder"),
        ("explore nope -o there/file.html", "there/file.html: is there already"),
        ("export nope -o model.onnx", "nope: no such model folder"),
        ("predict nope -p impact_speed=20", "nope: no such model folder"),
        ("predict there -p impact_speed=20", "there: holds no model.json"),
        ("predict {data} -p impact_speed=20", "is a dataset; expected a model folder made by crashkit train"),
        ("predict there -p impact_speed=20 --band 90", "'90'; expected a share between 0 and 1, such as 0.9, or 90%"),
        ("optimise there --minimise impact_speed --confidence x", "'x'; expected a share between 0 and 1, such as 0.9"),
        ("scatter there --confidence 95", "'95'; expected a share between 0 and 1, such as 0.9, or 95%"),
        ("campaign nope.yaml --confidence 95", "'95'; expected a share between 0 and 1, such as 0.9, or 95%"),
    ],
)
def test_what_can_be_refused_at_once_is_refused_before_torch_is_imported(
    demo_dataset: Path, tmp_path: Path, arguments: str, message: str
) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file.html").write_text("mine")
    (tmp_path / "done").mkdir()
    (tmp_path / "done" / "model.json").write_text("{}")
    line = ["crashkit", *(word.format(data=demo_dataset) for word in arguments.split())]
    code = f"""
import os, sys, crashkit.cli as c
os.chdir({str(tmp_path)!r}); sys.argv = {line!r}
try:
    c.app(standalone_mode=False)
finally:
    print([m for m in ("torch", "vtkmodules", "matplotlib") if m in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert message in " ".join(done.stderr.split())
    assert done.stdout.strip() == "[]"
