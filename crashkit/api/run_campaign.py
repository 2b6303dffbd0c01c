"""From a campaign file to computed runs, a dataset, a surrogate and its judged error: the loop until the error is small enough."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_schema.progress import Progress

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from crashkit.campaign.campaign import Campaign
    from crashkit.campaign.executors import Executor
    from surrogates.design.judgement import Judgement

Say = Callable[[str], None]


@dataclass(frozen=True)
class CampaignSummary:
    """What a call of `run_campaign` did.

    Attributes
    ----------
    folder, dataset, model, page
        Where everything is; model is None where none was asked for.
    done, failed, refused
        Runs of the whole campaign.
    judgement
        Error over the box with its interval, m; None where nothing was judged.
    why
        Why the campaign ended.
    """

    folder: Path
    dataset: Path
    model: Path | None
    page: Path
    done: int
    failed: int
    refused: int
    judgement: Judgement | None
    why: str


@dataclass(frozen=True)
class CampaignStatus:
    """How far a campaign is, also while another process runs it.

    Attributes
    ----------
    folder
        Where it is kept.
    counts
        Runs by state: done, failed, refused, and those that wait or run.
    lost
        Name of each run that failed or was refused, and why.
    rounds
        What was judged after each batch: runs, error_m, low_m, high_m, solver_seconds.
    page
        The same as a page; None before the first batch.
    """

    folder: Path
    counts: dict[str, int]
    lost: dict[str, str]
    rounds: list[dict[str, Any]]
    page: Path | None


def campaign_status(where: str | Path) -> CampaignStatus:
    """How far the campaign is that is kept in the folder `where`, or beside the campaign file `where`.

    Raises
    ------
    CrashkitError
        Where no campaign is kept there.
    """
    from crashkit.campaign.table import FILE, STATES, Table
    from crashkit.errors import CrashkitError

    folder = Path(where) if Path(where).is_dir() else Path(where).with_suffix("")
    if not (folder / FILE).exists():
        raise CrashkitError(f"{folder}: no campaign is kept there (no {FILE}); give its folder or its campaign file")
    table = Table(folder)
    try:
        runs, rounds = table.runs(), table.rounds()
    finally:
        table.close()
    page = folder / "status.html"
    return CampaignStatus(
        folder,
        {state: sum(run.state == state for run in runs) for state in STATES},
        {run.name: f"{run.state}: {run.reason}" for run in runs if run.state in ("failed", "refused")},
        rounds,
        page if page.exists() else None,
    )


def run_campaign(
    plan: str | Path,
    folder: str | Path | None = None,
    *,
    until: str | None = None,
    confidence: float | None = None,
    most_runs: int | None = None,
    executor: Executor | None = None,
    retry: bool = False,
    runs: str | Path | None = None,
    report: Progress | None = None,
    say: Say | None = None,
) -> CampaignSummary:
    """Compute the runs of a campaign, and go on until the error over the box is small enough.

    Parameters
    ----------
    plan
        The campaign file (`crashkit.campaign.plan.Plan`).
    folder
        Where everything is kept; default: beside the file, with its name.
    until, confidence
        An error over the box such as "8 mm", and with which confidence it must be below; default: what the file says.
        Without any, the first runs are computed and made a dataset, and that is all.
    most_runs
        End at this number of computed runs; default: what the file says.
    executor
        Where runs are computed; default: processes of this machine, or what the file says.
    retry
        Compute failed runs again.
    runs
        A table of runs to compute as well, one row per run with the parameters of the campaign, units in the heads: such
        as `crashkit optimise` and `crashkit propose` write. Runs that are there already are not computed twice.
    report, say
        `report` hears how many runs are decided and which are running; `say` hears a sentence after each step.

    Returns
    -------
    CampaignSummary

    Raises
    ------
    CrashkitError
        Where the file, the folder, the solver or the disk does not do. What was computed stays; the same call goes on.

    Notes
    -----
    No test run enters the judgement (`surrogates.design.judgement`). Interrupted or killed, the same call goes on.
    """
    from crashkit.extras import need

    need("running a campaign", "campaign")
    from crashkit.campaign.box import CampaignError

    if os.name == "nt":
        raise CampaignError(
            "campaigns need Linux or macOS, for their locks and to end a solver with all it started; on Windows use WSL"
        )
    if confidence is not None and not 0.5 < confidence < 1:
        raise CampaignError(f"a confidence of {confidence:g} was asked for; expected between 0.5 and 1, such as 0.9")
    from crashkit.campaign.campaign import Campaign
    from crashkit.campaign.plan import length_of
    from crashkit.campaign.status import write_page

    speak = say or (lambda sentence: None)
    with Campaign(plan, folder, executor) as campaign:
        target = length_of(until) if until else campaign.plan.target()
        share = confidence or campaign.plan.confidence
        limit = most_runs or campaign.plan.most_runs
        if retry:
            campaign.retry()
        if not campaign.table.runs():
            campaign.add(_first_points(campaign), "start")
        if runs is not None:
            campaign.add(points_of_table(Path(runs), campaign.plan.names, campaign.plan.units), "asked")
        started = time.monotonic()
        while True:
            _compute(campaign, report)
            added = _ingest(campaign)
            counts = {s: len(campaign.table.runs(s)) for s in ("done", "failed", "refused")}
            speak(f"{counts['done']} runs done, {counts['failed']} failed, {counts['refused']} refused")
            judged: Judgement | None = None
            if target is None:
                why = "the runs of the campaign are computed; no error was asked for"
                break
            if counts["done"] < _FEWEST:
                if not added:
                    why = f"only {counts['done']} runs ended well; {_FEWEST} are needed to judge anything"
                    break
                campaign.add(_filling(campaign, campaign.plan.design.batch), "filling")
                continue
            judged, after, points = _train_and_judge(campaign, share)
            solver = sum(r.seconds or 0.0 for r in campaign.table.runs())
            campaign.table.note_round(
                {
                    "error_m": judged.error, "low_m": judged.low, "high_m": judged.high, "after_m": after,
                    "solver_seconds": solver, "confidence": share,
                },
                counts["done"],
            )  # fmt: skip
            write_page(campaign)
            speak(
                f"{counts['done']} runs: error {1e3 * judged.error:.2f} mm ({100 * share:.0f} % interval "
                f"{1e3 * judged.low:.2f} to {1e3 * judged.high:.2f}); the next batch is expected to bring "
                f"{1e3 * (judged.error - after):.2f} mm; {solver / 60:.1f} min of solver time so far"
            )
            stop = _why_stop(campaign, judged, after, target, limit, counts["done"], started)
            if stop:
                why = stop
                break
            campaign.add(points[: max(0, limit - counts["done"])], "proposed")
        page = write_page(campaign)
        model = _train_wanted(campaign) if judged is not None else None
        return CampaignSummary(
            campaign.folder, campaign.dataset, model, page, counts["done"],
            counts["failed"], counts["refused"], judged, why,
        )  # fmt: skip


# Fewer runs than this say nothing about errors.
_FEWEST = 8


def _train_and_judge(campaign: Campaign, confidence: float) -> tuple[Judgement, float, NDArray[np.float64]]:
    """The error over the box by a process on all runs, what it is expected to be after the next batch, and that batch."""
    from crashkit.api._design import TrainedProcess
    from crashkit.api.train import train

    plan = campaign.plan
    odd = [n for n, r in plan.parameters.items() if r.odd]
    told = [f"physics.odd=[{', '.join(odd)}]"] if odd else []
    surrogate = train(
        campaign.dataset, campaign.folder / "process", "pod-gpr", settings=told, seed=plan.design.seed,
        overwrite=True,
    ).surrogate  # fmt: skip
    known = TrainedProcess.of(surrogate, plan)
    judged = known.judge(confidence, plan.design.seed)
    computed = campaign.points("done")
    seed = plan.design.seed + 1000 * len(computed)
    if plan.design.method == "expected-reduction":
        points, share = known.best(known.parameters(computed), plan.design.batch, seed)
    else:
        points = _filling(campaign, plan.design.batch)
        share = known.fall(known.parameters(computed), known.parameters(points), seed)
    return judged, judged.error * share, points


def _why_stop(
    campaign: Campaign, judged: Judgement, after: float, target: float, limit: int, runs: int, started: float
) -> str | None:
    """Why the campaign ends here; None where it goes on."""
    plan = campaign.plan
    if judged.below(target):
        return (
            f"the error is below {1e3 * target:g} mm with a confidence of {100 * judged.confidence:.0f} %: "
            f"{1e3 * judged.error:.2f} mm with {runs} runs"
        )
    if runs >= limit:
        return f"{runs} runs are computed, the most that were allowed; the error is {1e3 * judged.error:.2f} mm"
    hours = (time.monotonic() - started) / 3600
    if plan.most_hours is not None and hours >= plan.most_hours:
        return f"{hours:.1f} hours are used up; the error is {1e3 * judged.error:.2f} mm"
    if judged.error - after < plan.least_gain * judged.error:
        return (
            f"another {plan.design.batch} runs would gain less than {100 * plan.least_gain:g} % of the error, which is "
            f"{1e3 * judged.error:.2f} mm"
        )
    return None


def _train_wanted(campaign: Campaign) -> Path | None:
    """The model that the campaign file asks for, on all runs; the process itself where it asks for that."""
    from crashkit.api.coarsen import coarsen
    from crashkit.api.train import train
    from crashkit.mesh.store import has_hierarchy

    plan, folder = campaign.plan, campaign.folder / "model"
    if plan.model == "pod-gpr" and not plan.settings:
        return campaign.folder / "process"
    if plan.nodes and not has_hierarchy(campaign.dataset):
        coarsen(campaign.dataset, nodes=list(plan.nodes))
    train(campaign.dataset, folder, plan.model, settings=[f"{k}={v}" for k, v in plan.settings.items()], overwrite=True)
    return folder


def points_of_table(path: Path, names: Sequence[str], units: Sequence[str]) -> NDArray[np.float64]:
    """(run, parameter) of a table, in `units`; a column `run` with names is left aside.

    Raises
    ------
    ReadError, DataError
        For a table that cannot be read, lacks a parameter, or has it in another kind of unit.
    """
    import numpy as np

    from crashkit.errors import DataError
    from crashkit.ingestion.parameter_table import read_numbers
    from data_schema import to_si

    table = read_numbers(path, [n.lower() for n in names], aside=("run", "sim", "name"), what="table of runs")
    places = {name: k for k, (name, _) in enumerate(table.columns)}
    if sorted(places) != sorted(names):
        other = sorted(set(places) ^ set(names))[0]
        raise DataError(f"{path}: {other} is in one of table and campaign alone; the campaign has {', '.join(names)}")
    values = np.array([row for _, row in table.rows], np.float64).reshape(len(table.rows), -1)
    out = np.empty((len(values), len(names)))
    for k, (name, unit) in enumerate(zip(names, units, strict=True)):
        column, stated = values[:, places[name]], table.columns[places[name]][1]
        if not np.isfinite(column).all():
            raise DataError(f"{path}: {name} is missing in row {table.rows[int(np.isnan(column).argmax())][0]}")
        (factor, si), (own, own_si) = to_si(stated or unit), to_si(unit)
        if si != own_si:
            raise DataError(f"{path}: {name} is in {stated}; the campaign has it in {unit or 'no unit'}")
        out[:, k] = column * (factor / own)
    return out


def _first_points(campaign: Campaign) -> NDArray[np.float64]:
    return _fill(campaign, campaign.plan.design.start, edges=True)


def _filling(campaign: Campaign, count: int) -> NDArray[np.float64]:
    """The next points of the sequence that the campaign began with."""
    return _fill(campaign, count, skip=len(campaign.table.runs()))


def _fill(campaign: Campaign, count: int, *, edges: bool = False, skip: int = 0) -> NDArray[np.float64]:
    from crashkit.campaign.plan import sequence
    from surrogates.design.space import fill

    plan = campaign.plan
    return fill(
        plan.low, plan.high, count, seed=plan.design.seed, allowed=plan.allowed, edges=edges, skip=skip,
        sequence=sequence(plan.design.method),
    )  # fmt: skip


def _compute(campaign: Campaign, report: Progress | None) -> None:
    """Compute what waits; the status page follows each change."""
    from crashkit.campaign.status import write_page

    seen = ""

    def follow(what: str, done: int, total: int, note: str) -> None:
        nonlocal seen
        state = f"{done} {total} {note}"
        if state != seen:
            seen = state
            write_page(campaign)
        if report is not None:
            report(what, done, total, note)

    campaign.compute(follow)


def _ingest(campaign: Campaign) -> int:
    """Append the runs that are done and not in the dataset yet; returns how many."""
    from crashkit.dataset import opened_dataset
    from crashkit.ingestion.ingest import ingest

    known: set[str] = set()
    if campaign.dataset.exists():
        with opened_dataset(campaign.dataset) as dataset:
            known = {str(n) for n in dataset["sim"].values}
    new = [
        place
        for run, place in zip(campaign.table.runs("done"), campaign.results(), strict=True)
        if run.name not in known
    ]
    if not new:
        return 0
    told = campaign.plan.ingest
    ingest(
        new, campaign.dataset, params=campaign.write_parameters(), units=told.units, reader=told.reader,
        parts=told.parts, exclude_parts=told.exclude_parts, fields=told.fields, time=told.time,
    )  # fmt: skip
    return len(new)
