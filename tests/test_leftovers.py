"""Tests leave nothing in the temporary folder: what is put there is put into one of the session, which goes with it."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path


def test_the_temporary_folder_is_that_of_the_session_for_child_processes_too(tmp_path: Path) -> None:
    here = tempfile.gettempdir()
    assert Path(here).name.startswith("crashkit-tests-")
    program = "import tempfile; print(tempfile.gettempdir())"
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.strip()
    assert told == here
    assert Path(here) not in tmp_path.parents


def test_a_session_leaves_nothing_behind(tmp_path: Path) -> None:
    """A session of its own, whose one test leaves a file in the temporary folder."""
    (tmp_path / "conftest.py").write_text((Path(__file__).parent / "conftest.py").read_text(encoding="utf-8"))
    (tmp_path / "test_litter.py").write_text(
        "import tempfile\ndef test_litter(tmp_path):\n    open(tempfile.mkstemp()[1], 'w').write('left')\n"
    )
    home = tmp_path / "temporary"
    home.mkdir()
    environment = {k: v for k, v in os.environ.items() if k != "PYTEST_DEBUG_TEMPROOT"} | {"TMPDIR": str(home)}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-c",
        os.devnull,
        "--rootdir=.",
        "test_litter.py",
    ]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert [p.name.partition("-of-")[0] for p in home.iterdir()] == ["pytest"], "pytest's own folders alone"
