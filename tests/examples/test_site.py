"""The documentation builds without a warning, and the site works from disk: search, pages, no network."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as `make docs` builds it; a dead link is an error."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_search_works_from_disk(site: Path) -> None:
    assert (site / "search" / "search_index.js").read_text().startswith("var __index = ")
    assert 'src="assets/iframe-worker.js"' in (site / "index.html").read_text()


def test_pages_load_nothing_from_the_network(site: Path) -> None:
    loads = re.compile(
        r"""<(?:script|img|iframe)[^>]*src=["']https?:|<link[^>]*href=["']https?:|import[^;<]*["']https?:"""
    )
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 25
    assert [page.name for page in pages if loads.search(page.read_text())] == []


def test_the_reference_knows_parameters_and_errors(site: Path) -> None:
    text = (site / "reference.html").read_text()
    for name in ("ingest", "open_dataset", "coarsen", "train", "predict", "evaluate", "CrashAccessor", "Settings"):
        assert f">{name}<" in text.replace("</span>", "<"), name
    assert text.count("Parameters:") >= 5
    assert text.count("Raises:") >= 5


def test_every_picture_of_the_readme_is_there() -> None:
    for file in re.findall(r"\]\(((?:docs/)?[^)#:]+)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / file).exists(), file
