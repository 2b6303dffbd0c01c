"""What is not installed is named in one line, and what needs nothing more works without it."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

import crashkit
from crashkit.cli import app
from crashkit.dataset import demo_data
from crashkit.extras import MODULES, MissingExtraError, explained, need

ROOT = Path(__file__).parents[2]

# A process in which nothing of an extra can be imported, as after `pip install crashkit`.
WITHOUT = """
import sys
from importlib.machinery import PathFinder

class Without(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.split(".")[0] in {modules!r} else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Without
from crashkit.cli import main
sys.argv = ["crashkit", *{arguments!r}]
main()
"""
# Packages of the core bring these themselves.
BROUGHT = {"matplotlib", "sklearn", "threadpoolctl"}


def without_extras(*arguments: object) -> subprocess.CompletedProcess[str]:
    modules = {m for modules in MODULES.values() for m in modules} - BROUGHT
    script = WITHOUT.format(modules=modules, arguments=[str(a) for a in arguments])
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120)


def hide(monkeypatch: pytest.MonkeyPatch, *modules: str) -> None:
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)


def test_a_missing_extra_is_one_line_that_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, "torch", "meshio")
    with pytest.raises(MissingExtraError) as told:
        need("training a model", "train", "formats", "report")
    assert str(told.value) == (
        "training a model needs torch, meshio, which are not installed: pip install 'crashkit[train,formats]'"
    )


def test_python_and_the_command_say_the_same(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    hide(monkeypatch, "torch")
    with pytest.raises(MissingExtraError, match=r"pip install 'crashkit\[train\]'"):
        crashkit.load_model(tmp_path)
    result = CliRunner().invoke(app, ["train", str(tmp_path / "crash.zarr"), "-o", str(tmp_path / "model")])
    assert result.exit_code == 1
    assert result.stderr.strip().endswith("pip install 'crashkit[train]'")
    assert len(result.stderr.strip().splitlines()) == 1


def test_an_import_that_fails_inside_is_explained() -> None:
    assert explained(ModuleNotFoundError("", name="onnx.helper")) == (
        "this needs onnx, which is not installed: pip install 'crashkit[export]'"
    )
    assert explained(ModuleNotFoundError("", name="elsewhere")) is None


@pytest.mark.parametrize("name", ["train", "report", "formats", "viewer", "distributed", "tracking", "export"])
def test_every_extra_is_one_that_can_be_installed(name: str) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(MODULES) | {"all"} == set(extras)
    assert name in extras["all"][0]


def test_ingest_meshes_and_paraview_files_need_no_extra(tmp_path: Path) -> None:
    data = tmp_path / "kart.zarr"
    source = demo_data()
    for arguments in (
        ("ingest", source, "-o", data),
        ("coarsen", data, "--nodes", "300,75", "--vtp", tmp_path / "levels"),
        ("info", data),
        ("validate", data),
    ):
        result = without_extras(*arguments)
        assert result.returncode == 0, result.stderr
    refused = without_extras("train", data, "-o", tmp_path / "model")
    assert refused.returncode == 1
    assert "pip install 'crashkit[train]'" in refused.stderr


@pytest.mark.parametrize("command", ["train", "evaluate", "predict", "export", "coarsen"])
def test_help_needs_no_extra(command: str) -> None:
    result = without_extras(command, "--help")
    assert result.returncode == 0, result.stderr


def test_a_data_card_that_needs_an_extra_does_not_blame_the_dataset(
    demo_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hide(monkeypatch, "jinja2")
    result = CliRunner().invoke(app, ["info", str(demo_dataset), "--report", str(tmp_path / "card")])
    assert result.exit_code == 1
    assert result.stderr.strip().endswith(
        "a data card needs jinja2, which is not installed: pip install 'crashkit[report]'"
    )
    assert not (tmp_path / "card").exists()
