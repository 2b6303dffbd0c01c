"""What `import crashkit` gives: names that people, editors and type checkers know, and `.crash` on xarray datasets."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

import crashkit

ROOT = Path(crashkit.__file__).parents[1]


def python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip()


def test_type_checkers_see_the_names_that_are_imported_when_used() -> None:
    tree = ast.parse(Path(crashkit.__file__).read_text(encoding="utf-8"))
    guarded = next(n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    typed = {a.asname: n.module for n in guarded.body if isinstance(n, ast.ImportFrom) for a in n.names}
    assert typed == crashkit._LAZY


@pytest.mark.parametrize("name", crashkit.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(crashkit, name) is not None
    assert name in dir(crashkit)


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'crashkit' has no attribute 'nonsense'"):
        _ = crashkit.nonsense  # type: ignore[attr-defined]


@pytest.mark.parametrize("order", ["crashkit, xarray", "xarray, crashkit"])
@pytest.mark.parametrize(
    "dataset", ["xarray.Dataset({'v': ('sim', [1.0], {'role': 'parameter'})})", "xarray.open_dataset('v.nc')"]
)
def test_the_accessor_is_there_whatever_is_imported_first(
    order: str, dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import xarray

    monkeypatch.chdir(tmp_path)
    xarray.Dataset({"v": ("sim", [1.0], {"role": "parameter"})}).to_netcdf("v.nc")
    assert python(f"import {order}; print({dataset}.crash.parameters)") == "['v']"


@pytest.mark.parametrize("first", ["data_schema", "crashkit.dataset", "crashkit.engine", "crashkit.ingestion.ingest"])
def test_whatever_brings_xarray_in_brings_the_accessor_too(first: str) -> None:
    said = python(f"import crashkit, {first}, xarray as xr; print(xr.Dataset.crash.__name__)")
    assert said == "CrashAccessor"


def test_looking_for_xarray_without_importing_it_does_not_lose_the_accessor() -> None:
    code = "import crashkit, importlib.util as u; u.find_spec('xarray'); import xarray; print(xarray.Dataset.crash.__name__)"
    assert python(code) == "CrashAccessor"


SNIPPET = """
import crashkit
reveal_type(crashkit.ingest)
reveal_type(crashkit.from_arrays)
reveal_type(crashkit.coarsen)
reveal_type(crashkit.train)
reveal_type(crashkit.evaluate)
reveal_type(crashkit.predict)
reveal_type(crashkit.validate)
reveal_type(crashkit.open_dataset)
reveal_type(crashkit.open_hierarchy)
reveal_type(crashkit.write_paraview)
crashkit.load_model("x").nonsense()
crashkit.nonsense()
"""
# What other packages say of themselves takes mypy a minute to read and is not asked for here.
CONFIG = """
[mypy]
strict = true
[mypy-torch.*,xarray.*,pandas.*,pydantic.*,scipy.*,yaml.*,pyvista.*,matplotlib.*,vtk.*,vtkmodules.*,sklearn.*,zarr.*]
follow_imports = skip
ignore_missing_imports = true
[mypy-netCDF4.*,numba.*,lasso.*,h5py.*,safetensors.*,threadpoolctl.*,objective_rating_metrics.*,distributed.*,dask.*]
follow_imports = skip
ignore_missing_imports = true
"""


def test_mypy_knows_every_public_function_of_an_installed_crashkit(tmp_path: Path) -> None:
    """As for a user: the packages lie in site-packages, where mypy believes only those that have a py.typed."""
    home = tmp_path / "venv"
    venv.create(home, with_pip=False)
    packages = sysconfig.get_path("purelib", vars={"base": str(home), "platbase": str(home)}, scheme="venv")
    Path(packages, "here.pth").write_text("\n".join([str(ROOT), sysconfig.get_path("purelib")]), encoding="utf-8")
    (tmp_path / "mypy.ini").write_text(CONFIG, encoding="utf-8")
    (tmp_path / "snippet.py").write_text(SNIPPET, encoding="utf-8")
    executable = home / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", "mypy.ini", "--python-executable", str(executable), "snippet.py"],
        cwd=tmp_path, env={k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "MYPYPATH")},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    revealed = re.findall(r'note: Revealed type is "(.*)"', done.stdout)
    assert len(revealed) == SNIPPET.count("reveal_type"), done.stdout + done.stderr
    assert [text for text in revealed if not re.match(r"def \(\w+: .+\) -> .+", text)] == []
    errors = re.findall(r"snippet.py:\d+: error: (.*)", done.stdout)
    assert len(errors) == 2, done.stdout
    assert '"nonsense"' in errors[0]
    assert errors[1].startswith('Module has no attribute "nonsense"')
