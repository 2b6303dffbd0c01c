"""Files and folders of the user's that have the names of our packages: everything works, or one line names the file."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from crashkit.dataset import demo_data
from crashkit.siblings import HOME, NAMES

MINE = "raise SystemExit('the file of the user was run')\n"


def in_folder(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Python in that folder, which finds crashkit as an installed one: behind what lies in the folder."""
    return subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=folder, env={**os.environ, "PYTHONPATH": HOME},
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip


def as_file(folder: Path, name: str) -> Path:
    (folder / f"{name}.py").write_text(MINE, encoding="utf-8")
    return folder / f"{name}.py"


def as_package(folder: Path, name: str) -> Path:
    (folder / name).mkdir()
    (folder / name / "__init__.py").write_text(MINE, encoding="utf-8")
    return folder / name / "__init__.py"


def as_folder(folder: Path, name: str) -> Path:
    (folder / name).mkdir()
    return folder / name


@pytest.fixture(params=[as_file, as_package, as_folder])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """With all three names in it."""
    for name in NAMES:
        request.param(tmp_path, name)
    return tmp_path


SCRIPT = """
import crashkit
for name in crashkit.__all__:
    getattr(crashkit, name)
import data_schema, evaluation, surrogates
print(*sorted({module.__file__.rsplit(module.__name__)[0] for module in (data_schema, evaluation, surrogates)}))
"""


def test_a_script_gets_our_packages(folder: Path) -> None:
    (folder / "script.py").write_text(SCRIPT, encoding="utf-8")
    done = in_folder(folder, "script.py")
    assert (done.returncode, done.stdout.strip()) == (0, HOME + os.sep), done.stderr


def test_commands_work_there_and_say_nothing_of_it(folder: Path, demo_dataset: Path) -> None:
    done = in_folder(folder, "-m", "crashkit", "info", "--json", demo_dataset)  # --json: no progress
    assert (done.returncode, done.stderr) == (0, "")
    assert "impact_speed" in done.stdout


def test_the_steps_of_demo_and_run_work_there(tmp_path: Path, demo_dataset: Path) -> None:
    for name in (*NAMES, "xarray", "typer"):  # those of the libraries we use, too
        as_file(tmp_path, name)
    code = "import sys; del sys.path[0]; from crashkit.api.steps import _run; _run(1, ['info', '--json', sys.argv[1]])"
    done = in_folder(tmp_path, "-c", code, demo_dataset)
    assert (done.returncode, done.stderr) == (0, "")


def test_workers_of_a_script_work_there(tmp_path: Path) -> None:
    for name in NAMES:
        as_file(tmp_path, name)
    (tmp_path / "script.py").write_text(
        "import sys, crashkit\n"
        "if __name__ == '__main__':\n"
        "    print(len(crashkit.ingest(sys.argv[1], 'runs.zarr', workers=2).runs))\n",
        encoding="utf-8",
    )
    done = in_folder(tmp_path, "-W", "ignore", "script.py", demo_data())
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "36", "")


def test_a_worker_knows_crashkit_before_anything_is_sent_to_it(tmp_path: Path) -> None:
    """Without a script to import, as behind a notebook: a class of surrogates is the first that a worker meets."""
    as_file(tmp_path, "surrogates")
    work = (
        "from crashkit.parallel import as_finished; from surrogates.errors import SurrogateError as E\n"
        "print(sorted(r for _, r in as_finished(isinstance, [E(), 1], E, workers=2)))"
    )
    done = in_folder(tmp_path, "-W", "ignore", "-c", work)
    assert (done.returncode, done.stdout.strip()) == (0, "[False, True]"), done.stderr


@pytest.mark.parametrize("put", [as_file, as_package])
def test_a_file_that_is_not_imported_is_named(put, tmp_path: Path) -> None:
    mine = put(tmp_path, "evaluation")
    (tmp_path / "script.py").write_text("import crashkit\nprint(crashkit.Evaluation.__name__)\n", encoding="utf-8")
    done = in_folder(tmp_path, "script.py")
    assert done.stdout.strip() == "Evaluation"
    assert done.stderr.splitlines() == [
        f"{mine}:0: UserWarning: not imported: `import evaluation` gives a package of crashkit's; rename the file if you "
        "need both"
    ]


def test_a_script_that_has_the_name_itself_works(tmp_path: Path) -> None:
    (tmp_path / "evaluation.py").write_text("import crashkit\nprint(crashkit.Evaluation.__name__)\n", encoding="utf-8")
    done = in_folder(tmp_path, "evaluation.py")
    assert (done.stdout.strip(), done.stderr) == ("Evaluation", "")


def test_a_file_imported_before_is_an_error_in_one_line(tmp_path: Path) -> None:
    mine = tmp_path / "surrogates.py"
    mine.write_text("kriging = 1\n", encoding="utf-8")
    (tmp_path / "script.py").write_text("import surrogates\nimport crashkit\n", encoding="utf-8")
    done = in_folder(tmp_path, "script.py")
    assert done.stderr.splitlines()[-1] == (
        f"ImportError: {mine}: was imported as `surrogates`, the name of a package that comes with crashkit; rename it"
    )
