"""Which runs to compute next."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

    from crashkit.campaign.box import Box
    from crashkit.campaign.plan import Method
    from data_schema.progress import Progress


def propose(
    dataset: str | Path | None = None,
    count: int = 8,
    *,
    box: str | Path | Box | None = None,
    method: Method = "expected-reduction",
    seed: int = 0,
    odd: tuple[str, ...] = (),
    report: Progress | None = None,
) -> pd.DataFrame:
    """Parameters of the next `count` runs, one row per run.

    Parameters
    ----------
    dataset
        Runs that are computed already: a path. Without, the proposals fill the box.
    count
        Number of runs.
    box
        A YAML file (or a `Box`) with the bounds; default: the box that the dataset's runs span.
    method
        "expected-reduction": the points that lower the error over the box most, by the process's own posterior;
        "halton", "sobol" and "random" fill the box and ask no model.
    seed
        The same seed gives the same table.
    odd
        Parameters that change their sign when the structure is mirrored, besides those the box names.
    report
        Told what is being done.

    Returns
    -------
    pandas.DataFrame
        Columns are the parameters, in the units of `box` (without one, of the table the dataset's parameters came from);
        `attrs["units"]` says which, and, where a model was asked, `attrs["expected_error_m"]` and
        `attrs["expected_error_after_m"]`. The index has names for the runs that go on with those of the dataset.
        Parameters of the dataset that the box does not name are there, too, if all runs have one value.

    Raises
    ------
    CrashkitError
        Where the box or the dataset cannot be used.
    """
    import pandas as pd

    from crashkit.campaign.box import Box, CampaignError, read_box
    from crashkit.campaign.plan import sequence
    from surrogates.design.space import fill

    if count < 1:
        raise CampaignError(f"{count} runs were asked for; expected at least 1")
    if box is None and dataset is None:
        raise CampaignError("neither a dataset nor a box was given; give a dataset, or --box box.yaml")
    known = None if dataset is None else _known(dataset)
    if box is None:
        assert known is not None
        box = Box.of_values(known.names, [u for u, _ in known.written], known.as_written)
    elif not isinstance(box, Box):
        box = read_box(box)
    if known is not None:
        known.check(box)
    if dataset is None or method != "expected-reduction":
        points = fill(
            box.low, box.high, count, seed=seed, allowed=box.allowed, edges=dataset is None,
            sequence=sequence(method),
        )  # fmt: skip
        about: dict[str, float] = {}
    else:
        assert known is not None
        points, about = _most_useful(dataset, known, box, count, seed, odd, report)
    table = pd.DataFrame([[float(f"{v:.7g}") for v in row] for row in points], columns=list(box.names))
    table.attrs["units"] = dict(zip(box.names, box.units, strict=True))
    for name, (value, unit) in ({} if known is None else known.constant).items():
        if name not in box.names:
            table[name] = value
            table.attrs["units"][name] = unit
    table.index = pd.Index(next_names([] if known is None else known.runs, count), name="run")
    table.attrs.update(about)
    return table


def next_names(runs: Sequence[str], count: int) -> list[str]:
    """Names for `count` runs more, which go on with the numbers of `runs`: run_036 after run_035.

    Without a number to go on with they are run_000, ...
    """
    found = [m for name in runs if (m := re.fullmatch(r"(.*?)(\d+)", name))]
    last = max(found, key=lambda m: int(m[2]), default=None)
    stem, number, width = ("run_", -1, 3) if last is None else (last[1], int(last[2]), len(last[2]))
    taken = {name.lower() for name in runs}
    names = (f"{stem}{k:0{width}d}" for k in itertools.count(number + 1))
    return list(itertools.islice((name for name in names if name.lower() not in taken), count))


@dataclass(frozen=True)
class _Known:
    """The runs of a dataset: their names, and names and values (run, parameter) of the parameters.

    written  (unit, its value in the dataset's unit) of the table the parameters came from
    """

    runs: list[str]
    names: list[str]
    written: list[tuple[str, float]]
    values: NDArray[np.float64]

    @property
    def as_written(self) -> NDArray[np.float64]:
        """(run, parameter) in the units of the table."""
        return self.values / [factor for _, factor in self.written]

    def check(self, box: Box) -> None:
        """Raise CampaignError where `box` is not one of these runs: it names other parameters, or has other units."""
        from crashkit.campaign.box import CampaignError
        from data_schema import to_si
        from data_schema.units import UnknownUnits

        needed = [n for n in self.names if n not in self.constant or n in box.names]
        if missing := sorted(set(needed) ^ set(box.names)):
            raise CampaignError(
                f"the box and the runs differ in {', '.join(missing)}; the runs have {', '.join(self.names)}, the box "
                f"{', '.join(box.names)}"
            )
        for name, unit in zip(box.names, box.units, strict=True):
            own = self.written[self.names.index(name)][0]
            try:
                same = to_si(unit)[1] == to_si(own)[1]
            except UnknownUnits as error:
                raise CampaignError(f"{name} in the box: {error}") from error
            if not same:
                raise CampaignError(
                    f"{name} is in {unit or 'no unit'} in the box and in {own or 'no unit'} in the runs"
                )

    @property
    def constant(self) -> dict[str, tuple[float, str]]:
        """Value and unit in the table of each parameter that is the same in all runs."""
        return {
            name: (float(f"{column[0]:.7g}"), unit)
            for name, (unit, _), column in zip(self.names, self.written, self.as_written.T, strict=True)
            if column.min() == column.max()
        }


def _known(dataset: str | Path) -> _Known:
    import numpy as np

    from crashkit.campaign.box import CampaignError
    from crashkit.dataset import opened_dataset
    from data_schema import parameters, table_unit

    with opened_dataset(dataset) as opened:
        names = parameters(opened)
        if not names:
            raise CampaignError(f"{dataset}: no run has a parameter; give them with crashkit ingest --params")
        values = np.stack([opened[n].values.astype(np.float64) for n in names], axis=1)
        return _Known([str(n) for n in opened["sim"].values], names, [table_unit(opened, n) for n in names], values)


def _most_useful(
    dataset: str | Path, runs: _Known, box: Box, count: int, seed: int, odd: tuple[str, ...], report: Progress | None
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """The points that lower the error over the box most, by a process trained on all runs; and what is expected of them."""
    import tempfile

    from crashkit.api._design import TrainedProcess
    from crashkit.api.train import train

    mirrored = sorted({*odd, *(n for n, r in box.parameters.items() if r.odd)})
    settings = [f"physics.odd=[{', '.join(mirrored)}]"] if mirrored else []
    with tempfile.TemporaryDirectory(prefix="crashkit-propose-") as folder:
        surrogate = train(
            dataset, Path(folder) / "model", "pod-gpr", settings=settings, seed=seed, report=report
        ).surrogate
    if report is not None:
        report("choosing the next runs", 0, 0, "")
    known = TrainedProcess.of(surrogate, box)
    points, share = known.best(known.of_runs(runs.names, runs.values), count, seed)
    error = known.judge(0.9, seed).error
    return points, {"expected_error_m": error, "expected_error_after_m": error * share}


def check_table_name(output: Path) -> None:
    """Raise OutputError where `output` does not end as the tables that `write_table` writes."""
    from crashkit.errors import OutputError

    if output.suffix.lower() != ".csv":
        raise OutputError(f"{output}: a table is written as CSV; expected a name that ends in .csv")


def write_table(table: pd.DataFrame, output: str | Path) -> None:
    """Write what `propose` returns as CSV, the unit of each parameter in its heading: as `crashkit predict --params`,
    `crashkit campaign --runs` and `crashkit ingest --params` read it.

    Raises
    ------
    OutputError
        Where `output` cannot be written, or is no name of such a table.
    """
    from crashkit.errors import OutputError
    from data_schema.replace import beside

    output = Path(output)
    check_table_name(output)
    heads = [n if u in ("", "1") else f"{n} ({u})" for n, u in table.attrs["units"].items()]
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with beside(output) as new:
            table.to_csv(new, header=heads, index_label="run")
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror or error}); choose another with -o") from error
