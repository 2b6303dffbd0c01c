"""Which runs to compute next."""

from __future__ import annotations

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
        Columns are the parameters, in the units of `box` (of the dataset without one); `attrs["units"]` says which,
        and, where a model was asked, `attrs["expected_error_m"]` and `attrs["expected_error_after_m"]`.

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
    if box is None:
        if dataset is None:
            raise CampaignError("neither a dataset nor a box was given; give a dataset, or --box box.yaml")
        box = Box.of_values(*_parameters(dataset))
    elif not isinstance(box, Box):
        box = read_box(box)
    if dataset is None or method != "expected-reduction":
        points = fill(
            box.low, box.high, count, seed=seed, allowed=box.allowed, edges=dataset is None,
            sequence=sequence(method),
        )  # fmt: skip
        about: dict[str, float] = {}
    else:
        points, about = _most_useful(dataset, box, count, seed, odd, report)
    table = pd.DataFrame([[float(f"{v:.7g}") for v in row] for row in points], columns=list(box.names))
    table.attrs["units"] = dict(zip(box.names, box.units, strict=True))
    table.attrs.update(about)
    return table


def _parameters(dataset: str | Path) -> tuple[list[str], list[str], NDArray[np.float64]]:
    """Names, units and values (run, parameter) of a dataset's parameters."""
    import numpy as np

    from crashkit.campaign.box import CampaignError
    from crashkit.dataset import opened_dataset
    from data_schema import parameters

    with opened_dataset(dataset) as opened:
        names = parameters(opened)
        if not names:
            raise CampaignError(f"{dataset}: no run has a parameter; give them with crashkit ingest --params")
        values = np.stack([opened[n].values.astype(np.float64) for n in names], axis=1)
        return names, [str(opened[n].attrs.get("units", "")) for n in names], values


def _most_useful(
    dataset: str | Path, box: Box, count: int, seed: int, odd: tuple[str, ...], report: Progress | None
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
    points, share = known.best(known.of_runs(_parameters(dataset)), count, seed)
    error = known.judge(0.9, seed).error
    return points, {"expected_error_m": error, "expected_error_after_m": error * share}


def write_table(table: pd.DataFrame, output: str | Path) -> None:
    """Write what `propose` returns as CSV, with the unit of each parameter in its heading.

    Raises
    ------
    OutputError
        Where `output` cannot be written.
    """
    from crashkit.errors import OutputError
    from data_schema.replace import beside

    output = Path(output)
    heads = [n if u in ("", "1") else f"{n} ({u})" for n, u in table.attrs["units"].items()]
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with beside(output) as new:
            table.to_csv(new, index=False, header=heads)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror or error}); choose another with -o") from error
