#!/usr/bin/env -S uv run --script
"""The checks of the project for those who use nox: `nox` runs them all, `nox -l` lists them.

`make test` does the same in one environment that is kept; these sessions make one each, as a service would.
"""

# /// script
# dependencies = ["nox>=2025.2.9"]
# ///

from __future__ import annotations

import nox

nox.needs_version = ">=2025.2.9"
nox.options.default_venv_backend = "uv|virtualenv"
nox.options.reuse_venv = "yes"

PROJECT = nox.project.load_toml("pyproject.toml")
CONSTRAINTS = ("-c", "constraints.txt")


def install(session: nox.Session, *groups: str) -> None:
    """The package with all extras, and dependency groups, at the versions of constraints.txt."""
    session.install(*CONSTRAINTS, "-e", ".[all]", *nox.project.dependency_groups(PROJECT, *groups))


@nox.session
def lint(session: nox.Session) -> None:
    """Style, format, types and import contracts."""
    install(session, "dev")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("mypy")
    session.run("lint-imports", "--no-cache")


@nox.session(python=["3.11", "3.12", "3.13"])
def tests(session: nox.Session) -> None:
    """All tests; further arguments go to pytest."""
    install(session, "test", "docs")
    session.run("pytest", *(session.posargs or ["-n", "2", "--dist", "loadfile"]))


@nox.session(default=False)
def nightly(session: nox.Session) -> None:
    """The tests that take more than 40 s."""
    install(session, "test", "docs")
    session.run("pytest", "-m", "nightly", "--timeout", "3600", *session.posargs)


@nox.session
def docs(session: nox.Session) -> None:
    """The site in `site/`; dead links are errors."""
    install(session, "docs")
    session.run("mkdocs", "build", "--strict", env={"NO_MKDOCS_2_WARNING": "1"})


@nox.session(default=False)
def mutants(session: nox.Session) -> None:
    """Whether the tests notice small changes: `nox -s mutants -- crashkit/mesh/probe.py --sample 15 --seed 0`."""
    install(session, "mutation")
    session.run("python", "tools/mutate.py", *session.posargs)


@nox.session(default=False)
def build(session: nox.Session) -> None:
    """Wheel and source archive in `dist/`."""
    session.install("build")
    session.run("python", "-m", "build")


@nox.session(default=False)
def repo_review(session: nox.Session) -> None:
    """The Scientific Python checks of a repository."""
    session.install("sp-repo-review[cli]")
    session.run("repo-review", ".")


if __name__ == "__main__":
    nox.main()
