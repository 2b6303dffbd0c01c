"""Every script of the gallery draws its picture, on a small version of the folder that `crashkit demo` makes."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import crashkit
from crashkit.cli import app
from crashkit.dataset import demo_data

DOCS = Path(__file__).parents[2] / "docs"
SCRIPTS = Path(__file__).parents[2] / "examples" / "gallery"
gallery = runpy.run_path(str(DOCS / "make_gallery.py"))


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the demo with six states, networks of two epochs and a Gaussian process of four modes."""
    folder = tmp_path_factory.mktemp("demo")
    data = folder / "kart.zarr"
    crashkit.ingest([demo_data()], data, time=np.linspace(0, 0.03, 6))
    crashkit.coarsen(data, nodes=[300, 75])
    for name, settings in (
        ("mh", ("level.epochs=2", "level.regression=network")),
        ("pod-gpr", ("pod.modes=[4]", "pod.inputs=trajectory")),
    ):
        options = [part for setting in settings for part in ("--set", setting)]
        command = ["train", str(data), "-o", str(folder / name), "--model", name, "--test", "27:36", *options]
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
    return folder


def test_the_page_shows_every_script() -> None:
    assert sorted(gallery["ORDER"]) == sorted(script.stem for script in SCRIPTS.glob("*.py"))
    assert len(gallery["ORDER"]) >= 8


@pytest.mark.parametrize("name", gallery["ORDER"])
@pytest.mark.filterwarnings("ignore::UserWarning")  # a test run may lie outside the trained range
def test_script_draws_its_picture(name: str, demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(demo)
    picture = np.asarray(Image.open(gallery["run"](name)).convert("RGB"), float)
    assert min(picture.shape[:2]) >= 400
    drawn = (np.abs(picture - picture[0, 0]).max(axis=2) > 30).mean()
    assert drawn > 0.01, "the picture is empty"


@pytest.mark.parametrize("name", gallery["ORDER"])
def test_script_is_short(name: str) -> None:
    code = (SCRIPTS / f"{name}.py").read_text().split('"""', 2)[2]
    lines = [line for line in code.splitlines() if line.strip() and not line.startswith(("import", "from"))]
    assert len(lines) <= 14
