"""What a study trains: kinds of models, seeds and numbers of runs, in the order in which they are worth having."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

NETWORKS = ("mh", "podnn", "aenn", "gaenn")  # trained by epochs
SLOW = ("aenn", "gaenn")  # on the full mesh an epoch costs many times one of the others


@dataclass(frozen=True)
class Kind:
    """One model of the table: options of `crashkit train` beside data, split and seed.

    Attributes
    ----------
    name
        Begins the name of its folder.
    model, settings
        As `--model` and `--set` take them.
    note
        What its name in learning curves says beside that of the model.
    coarse
        Whether it also learns from runs of a coarser solver mesh.
    """

    name: str
    model: str
    settings: tuple[str, ...] = ()
    note: str = ""
    coarse: bool = False

    def label(self, level: str) -> str:
        """What learning curves call level `level` ("MH1", "POD-GPR") of it."""
        return f"{level} {self.note}" if self.note else level


@dataclass(frozen=True)
class Job:
    """One training: a kind on the first `runs` training runs, which leaves the others alone; None: on all of them."""

    kind: Kind
    seed: int = 0
    runs: int | None = None

    @property
    def folder(self) -> Path:
        """Where the model is kept, within the study's folder."""
        few = "" if self.runs is None else f"-{self.runs}-runs"
        return Path("models") / f"{self.kind.name}{few}-seed-{self.seed}"


@dataclass(frozen=True)
class Plan:
    """A study.

    Attributes
    ----------
    name
        Of the dataset in the study's folder.
    runs, train
        Number of runs; the first `train` are for training, the others for the test.
    nodes
        Of the coarser levels, finest first, as `crashkit coarsen --nodes` takes them.
    table
        Models compared in the report, each trained with every seed.
    curves, sizes
        Models whose learning curves are drawn, and the smaller numbers of training runs.
    once
        Models of the full study that are trained with the first seed alone and stand in no table of the report, such as a
        published setting.
    unit
        Of lengths in tables: cm or mm.
    coarse
        Name of the dataset of runs of a coarser solver mesh, where kinds learn from them.
    """

    name: str
    runs: int
    train: int
    nodes: str
    table: tuple[Kind, ...]
    curves: tuple[Kind, ...] = ()
    sizes: tuple[int, ...] = ()
    once: tuple[Kind, ...] = ()
    unit: str = "cm"
    coarse: str = ""

    @property
    def test(self) -> str:
        """The test runs, as `crashkit --test` takes them."""
        return f"{self.train}:{self.runs}"

    def few(self, short: bool = False) -> tuple[int, ...]:
        """The smaller numbers of training runs."""
        return self.sizes[:1] if short else self.sizes

    def jobs(self, seeds: int, short: bool = False) -> list[Job]:
        """All trainings: the first seed of the table, learning curves, further seeds, what is slow, what is trained once.

        The short ones have one point of the learning curves beside all training runs.
        """
        shape = quick if short else (lambda kind: kind)
        table = [Job(shape(kind), seed) for seed in range(seeds) for kind in self.table]
        fast = [job for job in table if job.kind.model not in SLOW]
        curves = [Job(shape(kind), 0, runs) for runs in (None, *self.few(short)) for kind in self.curves]
        once = [] if short else [Job(kind) for kind in self.once]
        first = [job for job in fast if job.seed == 0]
        return list(dict.fromkeys([*first, *curves, *fast, *table, *once]))

    def compared(self, seeds: int, short: bool = False) -> list[Job]:
        """The trainings whose models the report compares."""
        shape = quick if short else (lambda kind: kind)
        return [Job(shape(kind), seed) for kind in self.table for seed in range(seeds)]

    def timed(self) -> list[Job]:
        """Short trainings of the networks of the table, to be timed while nothing else runs."""
        return [Job(alone(kind)) for kind in self.table if kind.model in NETWORKS]

    def command(self, job: Job, data: Path, home: Path) -> list[str]:
        """The arguments of `crashkit`; the dataset of coarse runs lies beside `data`."""
        own = [part for setting in job.kind.settings for part in ("--set", setting)]
        first = self.train if job.runs is None else job.runs
        return [
            "train", str(data), "-o", str(home / job.folder), "--model", job.kind.model,
            "--test", f"{first}:{self.runs}", "--seed", str(job.seed), "--device", "cpu", *own,
            *(["--coarse", str(data.with_name(f"{self.coarse}.zarr"))] if job.kind.coarse else []),
        ]  # fmt: skip


def _with_epochs(kind: Kind, epochs: Callable[[int], int]) -> tuple[str, ...]:
    """The settings of `kind` with other numbers of epochs; shares of epochs stay."""

    def changed(setting: str) -> str:
        path, value = setting.split("=", 1)
        return f"{path}={epochs(int(value))}" if path.endswith(".epochs") and value.isdigit() else setting

    return tuple(map(changed, kind.settings))


def quick(kind: Kind) -> Kind:
    """A short version for trials: an eighth of the epochs."""
    return replace(kind, settings=_with_epochs(kind, lambda n: max(2, n // 8)))


def alone(kind: Kind) -> Kind:
    """Three epochs of every level, to be timed while nothing else runs."""
    return Kind(f"{kind.name}-alone", kind.model, (*_with_epochs(kind, lambda n: 3), "transfer.epochs=1"))
