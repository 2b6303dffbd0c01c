"""The whole way that one YAML file describes, through the commands one would type."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashkit.api.steps import Step, run_steps

if TYPE_CHECKING:
    from pydantic import BaseModel

    from crashkit.api.study import Study


@dataclass(frozen=True)
class StudyResult:
    """Where everything is that a study has made.

    Attributes
    ----------
    output
        The folder of the dataset, the models and the report.
    models
        The model folders, in the order of the study.
    report
        The page of the report; None where the study asks for none.
    """

    output: Path
    models: tuple[Path, ...]
    report: Path | None


def run_study(study: str | Path, *, fresh: bool = False, say: Callable[[str], None] | None = None) -> StudyResult:
    """Ingest, coarsen, train and evaluate as a YAML file says; what was done before and is unchanged is not done again.

    Each step is a command in a process of its own, which shows its progress on the terminal.

    Parameters
    ----------
    study
        The YAML file; `crashkit run --help` shows one.
    fresh
        Make everything again.
    say
        Called with a sentence before each step.

    Raises
    ------
    ReadError, DataError
        For the file: what is wrong in it, and where.
    OutputError
        For a result that somebody else has made, or a folder that cannot be written.
    StepFailedError
        Where a step ends with an error.
    """
    from crashkit.api.study import read_study

    wanted, home = read_study(study), Path(study).parent
    output = home / wanted.output
    run_steps(steps(wanted, home), output, fresh=fresh, say=say)
    models = tuple(output / name for name in wanted.train.models)
    return StudyResult(output, models, None if wanted.evaluate is None else output / "report" / "report.html")


def study_steps(study: str | Path) -> list[Step]:
    """The commands that `run_study` would run."""
    from crashkit.api.study import read_study

    return steps(read_study(study), Path(study).parent)


def steps(study: Study, home: Path) -> list[Step]:
    """The commands of a study; `home` is the folder of its YAML file."""
    output = home / study.output
    data = home / study.dataset if study.dataset is not None else output / "crash.zarr"
    out: list[Step] = []
    if study.ingest is not None:
        asked, sources = study.ingest, [home / source for source in study.ingest.sources]
        files = [home / f for f in (asked.params, asked.mesh) if f is not None]
        out.append(
            Step(
                "Solver runs become one dataset",
                ("ingest", *map(str, sources), "-o", str(data), *_options(asked, home, leave=("sources",))),
                data,
                depends=lambda: _stamps([*sources, *files]),
                extends=lambda: _only_more(data, sources),
            )
        )
    picture = output / "levels.png"
    coarsen = [] if study.coarsen is None else _options(study.coarsen, home)
    out.append(
        Step(
            "Coarser meshes, each a subset of the nodes",
            ("coarsen", str(data), *coarsen, "--test", str(study.train.test), "--picture", str(picture)),
            picture,
            depends=lambda: f"{_checksum(data)} {_has_hierarchy(data)}",
            again=("--overwrite",),
        )
    )
    models = []
    for name, options in study.train.models.items():
        given = [] if options is None else _options(options, home, leave=("model", "set"))
        kind = name if options is None or options.model is None else options.model
        chosen = {} if options is None else options.set
        settings = [piece for key, value in chosen.items() for piece in ("--set", f"{key}={json.dumps(value)}")]
        config = [] if options is None or options.config is None else [home / options.config]
        coarse = None if options is None or options.coarse is None else home / options.coarse
        models.append(output / name)
        out.append(
            Step(
                f"Model {name}",
                (
                    "train",
                    str(data),
                    "-o",
                    str(output / name),
                    "--model",
                    kind,
                    "--test",
                    str(study.train.test),
                    *given,
                    *settings,
                ),
                output / name,
                depends=lambda config=config, coarse=coarse: (  # type: ignore[misc]
                    f"{_checksum(data)} {' '.join(coarsen)} {_contents(config)}"
                    + ("" if coarse is None else f" {_checksum(coarse)}")
                ),
                again=("--overwrite",),
            )
        )
    if study.evaluate is not None:
        out.append(
            Step(
                "How far can they be trusted? On runs none of them has seen",
                (
                    "evaluate",
                    str(data),
                    *map(str, models),
                    "-o",
                    str(output / "report"),
                    *_options(study.evaluate, home),
                ),
                output / "report",
                depends=lambda: f"{_checksum(data)} {_contents([m / 'model.json' for m in models])}",
                again=("--overwrite",),
            )
        )
    return out


def _options(section: BaseModel, home: Path, leave: Iterable[str] = ()) -> list[str]:
    """What differs from the default as options of the command of the same name."""
    out: list[str] = []
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if name in leave or value == field.default:
            continue
        option = "--" + name.replace("_", "-")
        out += [option] if value is True else [option, _text(value, home)]
    return out


def _text(value: Any, home: Path) -> str:
    if isinstance(value, list):
        return ",".join(map(str, value))
    return str(home / value) if isinstance(value, Path) else str(value)


def _stamps(paths: Iterable[Path]) -> str:
    """Names, sizes and times of all files under `paths`: what a look at them tells of a change."""
    return _digest(f"{p}:{p.stat().st_size}:{p.stat().st_mtime_ns}" for path in paths for p in _files(path))


def _files(path: Path) -> Iterator[Path]:
    if path.is_dir():
        yield from sorted(p for p in path.rglob("*") if p.is_file())
    elif path.is_file():
        yield path


def _only_more(data: Path, sources: Iterable[Path]) -> bool:
    """Whether every file the dataset was read from is still there, as far as names and sizes tell: then runs are added."""
    from crashkit.dataset import opened_dataset

    with opened_dataset(data) as dataset:
        entries = json.loads(dataset.attrs["source_files"])
    files = {(str(e["file"]), int(e["bytes"]), str(e["sha256"])) for e in entries}  # one may hold several runs
    read = Counter((name, size) for name, size, _ in files)
    return not read - Counter((p.name, p.stat().st_size) for source in sources for p in _files(source))


def _contents(paths: Iterable[Path]) -> str:
    return _digest(hashlib.sha256(p.read_bytes()).hexdigest() if p.is_file() else "" for p in paths)


def _digest(texts: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def _checksum(data: Path) -> str:
    """The checksum that the dataset keeps; empty where it is not there yet."""
    from crashkit.dataset import opened_dataset

    if not data.exists():
        return ""
    with opened_dataset(data) as dataset:
        return str(dataset.attrs.get("checksum", ""))


def _has_hierarchy(data: Path) -> bool:
    from crashkit.mesh.store import has_hierarchy

    return data.exists() and has_hierarchy(data)
