"""The checks of the project for those who use nox: `nox` runs them all, `nox -l` lists them.

`make test` does the same in one environment that is kept; these sessions make one each, as a service would.
"""

from __future__ import annotations

import nox

PROJECT = nox.project.load_toml("pyproject.toml")
nox.needs_version = ">=2024.4.15"
nox.options.sessions = ["lint", "tests", "docs"]
nox.options.reuse_existing_virtualenvs = True
CONSTRAINTS = ("-c", "constraints.txt")


@nox.session
def lint(session: nox.Session) -> None:
    """Style, format, types and import contracts."""
    session.install(*CONSTRAINTS, "-e", ".[all]", *nox.project.dependency_groups(PROJECT, "test", "lint", "docs"))
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("mypy")
    session.run("lint-imports", "--no-cache")


@nox.session(python=["3.11", "3.12", "3.13"])
def tests(session: nox.Session) -> None:
    """All tests; further arguments go to pytest."""
    session.install(*CONSTRAINTS, "-e", ".[all]", *nox.project.dependency_groups(PROJECT, "test", "docs"))
    session.run("pytest", *(session.posargs or ["-n", "2"]))


@nox.session
def docs(session: nox.Session) -> None:
    """The site in `site/`; dead links are errors."""
    session.install(*CONSTRAINTS, "-e", ".[all]", *nox.project.dependency_groups(PROJECT, "docs"))
    session.run("mkdocs", "build", "--strict", env={"NO_MKDOCS_2_WARNING": "1"})


@nox.session
def build(session: nox.Session) -> None:
    """Wheel and source archive in `dist/`."""
    session.install("build")
    session.run("python", "-m", "build")


@nox.session
def repo_review(session: nox.Session) -> None:
    """The Scientific Python checks of a repository."""
    session.install("sp-repo-review[cli]")
    session.run("repo-review", ".")
