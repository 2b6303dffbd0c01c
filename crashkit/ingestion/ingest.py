"""Runs of a solver become one dataset: checked, in SI units, at common times, written run by run.

Two passes. The survey (`crashkit.ingestion.survey`) opens every run, reads no displacement, and settles what all runs share.
Then each run is transferred on its own (`crashkit.ingestion.transfer`), here or by Dask workers, into a staging folder beside
the output (`crashkit.ingestion.staging`), where a journal notes the finished ones. At the end the dataset is put together from
them and takes its place in one step (`crashkit.ingestion.store`). A killed ingest goes on behind the last note, and ends with
the same bytes; a dataset that is appended to stays whole until the new one replaces it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from crashkit.display import Described, Facts, Rows, listed, watched
from crashkit.errors import CrashkitError, DataError, OutputError, ReadError
from crashkit.ingestion.alignment import common_time, reach, same_time
from crashkit.ingestion.assembly import Existing, publish
from crashkit.ingestion.scale import CampaignScale
from crashkit.ingestion.staging import BackgroundHashes, StagedRun, Staging, key_of
from crashkit.ingestion.store import check_output, recover
from crashkit.ingestion.structure import Structure
from crashkit.ingestion.survey import Choice, Found, Survey, described, reader_options, survey
from crashkit.ingestion.transfer import Layout, is_whole, let_memory_go, transfer
from crashkit.parallel import as_finished
from crashkit.quality import LIMITS, MEASURES, Limits, Quality
from crashkit.version import __version__
from data_schema import run_checksum
from data_schema.progress import Progress

if TYPE_CHECKING:
    from crashkit.mesh.levels import Hierarchy


# Runs beyond a limit that are listed one by one.
_TOLD = 5


@dataclass(frozen=True, repr=False)
class IngestSummary(Described):
    """What an ingest did.

    Attributes
    ----------
    runs
        Names of all runs in the dataset, in its order.
    added, replaced
        Those written now; unchanged: named again but already there.
    resumed
        How many of them an earlier, interrupted start had read.
    skipped
        run -> why it is not in the dataset.
    alignment_error
        run -> estimated error of the change to the common times, m; of the runs written now.
    marked
        run -> what of it is beyond its limit (energy balance, hourglass energy, added mass, its end); it is in the dataset.
    notes
        What else is worth knowing, such as parts left out.
    scale
        Size, duration, largest displacement and speed of the runs written now.
    question
        What to ask where they are absurd, so that the units may be wrong; empty where they are not.
    """

    output: Path
    runs: tuple[str, ...]
    added: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    unchanged: tuple[str, ...] = ()
    resumed: int = 0
    skipped: Mapping[str, str] = field(default_factory=dict)
    alignment_error: Mapping[str, float] = field(default_factory=dict)
    marked: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    nodes: int = 0
    states: int = 0
    scale: CampaignScale | None = None
    question: str = ""

    def _facts(self) -> tuple[str, Facts, Sequence[str], Rows]:
        runs = {"added": self.added, "replaced": self.replaced, "unchanged": self.unchanged}
        facts: dict[str, object] = {
            "runs": len(self.runs),
            **{what: f"{len(names)}: {listed(names)}" for what, names in runs.items() if names},
            **{f"skipped {run}": why for run, why in self.skipped.items()},
            **{f"marked {run}": why for run, why in self.marked.items()},
            "nodes": self.nodes,
            "states": self.states,
            **({"scale": self.scale} if self.scale is not None else {}),
            **({"question": self.question} if self.question else {}),
            **{f"note {k}": note for k, note in enumerate(self.notes, 1)},
        }
        return f"ingested into {self.output}", facts, (), ()


def ingest(
    sources: Sequence[str | Path] | str | Path,
    output: str | Path,
    *,
    params: str | Path | None = None,
    units: str | None = None,
    reader: str | None = None,
    mesh: str | Path | None = None,
    time_step: float | None = None,
    names: str = "{run}",
    parts: Sequence[str] = (),
    exclude_parts: Sequence[str] = (),
    keep_rigid_walls: bool = False,
    fields: Sequence[str] = (),
    time: Sequence[float] | NDArray[np.float64] | None = None,
    on_error: Literal["stop", "skip"] = "stop",
    allow_incomplete: bool = False,
    overwrite: bool = False,
    quality: Literal["mark", "refuse"] = "mark",
    limits: Mapping[str, float | None] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    report: Progress | None = None,
    progress: bool | Literal["auto"] = "auto",
) -> IngestSummary:
    """Read all runs in `sources` (files or folders) and write them as one dataset to `output` (`.zarr` or `.nc`).

    An existing dataset gets new runs appended at its own times; its mesh hierarchy goes on with them, since it depends
    on the mesh alone. Interrupted, the same call goes on where it was.

    Raises CrashkitError (ReadError, DataError, OutputError) with file and place.

    Parameters
    ----------
    sources
        Files and folders with runs.
    output
        The dataset, `.zarr` or `.nc`. If it exists, new runs are added to it.
    params
        Table of design parameters (CSV, TSV, JSON, XLSX); its values replace those of the source.
    units
        Unit system of the source, such as "mm-ms-kg"; needed if the source does not say its units.
    reader
        Use this reader instead of detecting the format.
    mesh
        File with the faces, if the source has none.
    time_step
        Time between two states in the source's unit, if the source has no times.
    names
        Names of the runs in the dataset: text with {run} and {source}, such as "{source}-{run}".
    parts, exclude_parts
        Only these parts, or all but these (number, title or pattern).
    keep_rigid_walls
        Keep rigid-wall elements.
    fields
        Further result fields to read, by name.
    time
        Common output times, s; default: those of the run with the fewest states.
    on_error
        "stop" at the first run that cannot be used, or "skip" it and list it in the summary.
    allow_incomplete
        Accept incomplete runs; their missing states are NaN.
    overwrite
        Replace runs that the dataset already contains; without it, they must be unchanged.
    quality
        What becomes of a run beyond a limit: "mark" it in the dataset (`quality_note`), or "refuse" it, which `on_error`
        answers to.
    limits
        Largest values that are fine, per cent, over `crashkit.quality.LIMITS`: energy_error (15), hourglass_share (10),
        mass_added (10); None: no limit. A run that did not end normally, has no energy, or in which a single node leaps
        away in one state and is back in the next, is beyond them in any case.
    workers
        Number of processes on this machine (a script that uses several needs `if __name__ == "__main__":`).
    scheduler
        Address of a Dask scheduler to use instead; its workers must be able to read the same files.
    report
        Called with (what, steps done, steps in all or 0, note).
    progress
        Show a line of progress in a notebook; "auto": where this is one.
    """
    output = Path(output)
    paths = [Path(sources)] if isinstance(sources, (str, Path)) else [Path(s) for s in sources]
    if on_error not in ("stop", "skip"):
        raise CrashkitError(f"on_error {on_error!r} is not known; expected stop or skip")
    if quality not in ("mark", "refuse"):
        raise CrashkitError(f"quality {quality!r} is not known; expected mark or refuse")
    if unknown := sorted(set(limits or ()) - set(MEASURES)):
        raise CrashkitError(f"there is no limit of {unknown[0]!r}; expected {', '.join(MEASURES)}")
    check_output(output)
    for path in paths:
        if not path.exists():
            raise ReadError(f"{path}: no such file or folder")
    choice = Choice(
        units=units, parts=tuple(parts), exclude_parts=tuple(exclude_parts), keep_rigid_walls=keep_rigid_walls,
        fields=tuple(dict.fromkeys(fields)), allow_incomplete=allow_incomplete, names=names, reader=reader,
        reader_options=reader_options(mesh, time_step),
    )  # fmt: skip
    with Staging(output) as staging, _what_is_kept(staging):
        recover(staging.folder, output)
        job = _Job(
            staging=staging,
            choice=choice,
            params=None if params is None else Path(params),
            wanted=None if time is None else np.asarray(time, np.float64),
            stop=on_error == "stop",
            overwrite=overwrite,
            limits={**LIMITS, **(limits or {})},
            refuse=quality == "refuse",
            tell=watched(report, progress),
        )
        try:
            return job.run(paths, _Workers(workers, scheduler))
        finally:
            let_memory_go()


@dataclass
class _Job:
    """One call of `ingest`."""

    staging: Staging
    choice: Choice
    params: Path | None
    wanted: NDArray[np.float64] | None
    stop: bool
    overwrite: bool
    limits: Limits
    refuse: bool
    tell: Progress

    def run(self, sources: list[Path], workers: _Workers) -> IngestSummary:
        staging = self.staging
        staging.discard_unfinished()
        former = Existing.open(staging.output)
        look, old = self._survey(sources, former)
        with closing(BackgroundHashes(staging)) as hashes:
            fresh, unchanged = self._fresh(look, old, hashes)
            if not fresh:
                summary = _nothing_new(staging.output, old, unchanged, look)
                staging.discard()
                return summary
            layout = self._layout(look, fresh, old)
            for found in fresh:
                for file in found.files:
                    hashes.ask(file)
            keys = {f.name: _key(f, layout) for f in fresh}
            staged = self._staged_before(fresh, keys)
            resumed = len(staged)
            self._transfer(fresh, keys, staged, layout, look, workers)
            marked = self._beyond(staged, look)
            fresh = [f for f in fresh if f.name in staged]
            if not fresh:
                raise DataError(f"no run can be used ({look.reasons()})")
            self.tell("putting the dataset together", 0, 0, "")
            hierarchy = _hierarchy_of(former)
            names = publish(staging, layout, fresh, staged, old, hashes, marked)
        if hierarchy is not None:
            look.note(_carried(staging.output, hierarchy))
        _note_equal_parameters(fresh, staged, old, look)
        scale = _scale_of(fresh, staged, layout)
        before = set(former.names) if former else set()
        summary = IngestSummary(
            output=staging.output,
            runs=names,
            added=tuple(f.name for f in fresh if f.name not in before),
            replaced=tuple(f.name for f in fresh if f.name in before),
            unchanged=tuple(unchanged),
            resumed=resumed,
            skipped=dict(look.skipped),
            alignment_error={f.name: staged[f.name].error for f in fresh},
            marked=marked,
            notes=tuple(look.notes),
            nodes=layout.structure.n_nodes,
            states=len(layout.time),
            scale=scale,
            question=scale.question(fresh[0].units),
        )
        staging.discard()
        return summary

    def _survey(self, sources: list[Path], old: Existing | None) -> tuple[Survey, Existing | None]:
        def look(structure: Structure | None) -> Survey:
            grid = self.wanted if self.wanted is not None or structure is None or old is None else old.time
            return survey(
                sources, self.choice, params=self.params, time=grid, structure=structure, stop=self.stop,
                tell=lambda name: self.tell("ingest", 0, 0, f"looking at {name}"),
            )  # fmt: skip

        if old is None:
            return look(None), None
        if self.overwrite:
            alone = look(None)
            if set(old.names) <= {f.name for f in alone.found}:
                return alone, None  # nothing of the old dataset stays, so nothing of it binds
        return look(old.structure), old

    def _fresh(self, look: Survey, old: Existing | None, hashes: BackgroundHashes) -> tuple[list[Found], list[str]]:
        """The runs to read, and the names of those that are in the dataset unchanged."""
        if old is None:
            return self._reaching(look, self.wanted), []
        if self.wanted is not None and not same_time(self.wanted, old.time):
            raise DataError(
                f"{old.path}: has {len(old.time)} states from {old.time[0]:g} to {old.time[-1]:g} s, other times were asked "
                "for; leave --time out, or ingest into a new dataset"
            )
        if set(old.fields) != set(self.choice.fields):
            raise DataError(
                f"{old.path}: holds the fields {', '.join(old.fields) or 'none'}, asked for were "
                f"{', '.join(self.choice.fields) or 'none'}; ask for the same with --fields"
            )
        mine = {n: u for n, (_, u) in look.found[0].parameters.items()}
        if mine != old.parameters:
            raise DataError(
                f"{old.path}: has the parameters {described(old.parameters)}, the new runs have {described(mine)}; "
                "expected the same"
            )
        fresh, unchanged = [], []
        for found in self._reaching(look, old.time):
            if found.name not in old.names or self.overwrite:
                fresh.append(found)
                continue
            difference = old.difference(found, hashes)
            if difference is None:
                unchanged.append(found.name)
            else:
                error = DataError(
                    f"{old.path} holds it already, {difference}; replace it with --overwrite, or rename it"
                )
                look.refuse(found.name, error, self.stop)
        return fresh, unchanged

    def _reaching(self, look: Survey, grid: NDArray[np.float64] | None) -> list[Found]:
        """The runs that cover the times that are given."""
        if grid is None:
            return look.found
        out = []
        for found in look.found:
            slack = 1e-6 * float(np.abs(found.time).max())
            ends_early = found.complete and reach(found.time) < grid[-1]
            if ends_early or found.time[0] > grid[0] + slack:
                error = DataError(
                    f"{found.source}: covers {found.time[0]:g} to {found.time[-1]:g} s, the dataset's times are "
                    f"{grid[0]:g} to {grid[-1]:g} s; nothing is extrapolated"
                )
                look.refuse(found.name, error, self.stop)
            else:
                out.append(found)
        return out

    def _layout(self, look: Survey, fresh: list[Found], old: Existing | None) -> Layout:
        structure = old.structure if old is not None else look.structure
        if structure is None:
            raise DataError("no run can be used")
        whole = [f for f in fresh if f.complete] or fresh
        time = old.time if old is not None else common_time([f.time for f in whole], self.wanted)
        if old is None and self.wanted is None:
            _note_lost_end(time, whole, look)
        wanted = {n: next(f.fields[n] for f in look.found if n in f.fields) for n in self.choice.fields}
        return Layout(
            choice=self.choice,
            structure=structure,
            time=time,
            fields=wanted,
            one_shape=look.one_shape and (old is None or old.one_shape),
        )

    def _staged_before(self, fresh: list[Found], keys: Mapping[str, str]) -> dict[str, StagedRun]:
        """The runs that an earlier start has read, by name; their values are looked at again."""
        staging = self.staging
        out: dict[str, StagedRun] = {}
        for found in fresh:
            staged = staging.runs.get(keys[found.name])
            if staged is None:
                continue
            self.tell("ingest", len(out), len(fresh), f"{found.name} was read before")
            if is_whole(staged, staging.place(staged.key)):
                out[found.name] = staged
        return out

    def _transfer(
        self,
        fresh: list[Found],
        keys: Mapping[str, str],
        staged: dict[str, StagedRun],
        layout: Layout,
        look: Survey,
        workers: _Workers,
    ) -> None:
        """Read every run that is not staged yet and add it to `staged`; runs that are unusable are refused."""
        todo = [f for f in fresh if f.name not in staged]
        items = [(found, keys[found.name], self.staging.place(keys[found.name])) for found in todo]
        outcomes = as_finished(
            _attempt, items, layout,
            workers=workers.count, scheduler=workers.scheduler, label=lambda item: f"run {item[0].name}",
        )  # fmt: skip
        for place, outcome in outcomes:
            if isinstance(outcome, StagedRun):
                self.staging.finish(outcome)
                staged[outcome.name] = outcome
            else:
                look.refuse(todo[place].name, outcome, self.stop)
            self.tell("ingest", len(staged), len(fresh), todo[place].name)

    def _beyond(self, staged: dict[str, StagedRun], look: Survey) -> dict[str, str]:
        """Run -> what of it is beyond its limit; where such runs are refused, they leave `staged`."""
        wrong = {name: "; ".join(Quality(**run.quality).beyond(self.limits)) for name, run in staged.items()}
        beyond = {name: told for name, told in wrong.items() if told}
        if not self.refuse or not beyond:
            return beyond
        if self.stop:
            told = [f"run {name}: {what}" for name, what in list(beyond.items())[:_TOLD]]
            more = [f"and {len(beyond) - _TOLD} more"] if len(beyond) > _TOLD else []
            raise DataError(
                f"{'; '.join([*told, *more])}; leave such runs out with --on-error skip, keep them with --quality mark, or "
                "set another --limit"
            )
        for name, what in beyond.items():
            del staged[name]
            look.skipped[name] = what
        return {}


# --- who does the work -------------------------------------------------------------------------------------------

_Outcome = StagedRun | CrashkitError


@dataclass(frozen=True)
class _Workers:
    """How many processes on this machine, or whose scheduler."""

    count: int
    scheduler: str | None


def _attempt(todo: tuple[Found, str, Path], layout: Layout) -> _Outcome:
    """Read one run; what is wrong with it is an outcome like any other."""
    found, key, place = todo
    try:
        return transfer(found, layout, key, place)
    except (ReadError, DataError) as error:
        return error


@contextmanager
def _what_is_kept(staging: Staging) -> Iterator[None]:
    """Failures say which finished runs are kept; a full disk and the like are reported as what they are."""

    def kept() -> str:
        count = len(staging.runs)
        told = f"{count} finished run{'s are' if count > 1 else ' is'} kept in {staging.folder.name}"
        return f" ({told}; the same command goes on from there)" if count else ""

    try:
        yield
    except CrashkitError as error:
        raise type(error)(f"{error}{kept()}") from error
    except OSError as error:
        raise OutputError(
            f"{error.filename or staging.output}: {error.strerror or error}, while writing {staging.output}{kept()}"
        ) from error


def _key(found: Found, layout: Layout) -> str:
    """What the arrays of a run depend on, as a name."""
    files = [(str(f.absolute()), f.stat().st_size, f.stat().st_mtime_ns) for f in found.files]
    s = layout.structure
    return key_of(
        {
            "version": __version__,
            "source": [str(found.source.absolute()), found.index, found.name, files],
            "units": found.units,
            "choice": asdict(layout.choice) | {"names": "", "fields": sorted(layout.fields)},
            "time": layout.time.tolist(),
            "mesh": [_hash(a) for a in (s.node_id, s.face_nodes, s.cell_nodes, s.face_id, s.cell_id)],
            "one_shape": layout.one_shape,
        }
    )


def _note_lost_end(time: NDArray[np.float64], runs: Sequence[Found], look: Survey) -> None:
    """Say so where the common times end a state or more before some run does."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    longest = max(runs, key=lambda f: float(f.time[-1]))
    if float(longest.time[-1]) - time[-1] > 0.5 * step:
        shortest = min(runs, key=lambda f: float(f.time[-1]))
        look.note(
            f"the common times end at {time[-1]:g} s, since run {shortest.name} ends at {shortest.time[-1]:g} s; run "
            f"{longest.name} goes on to {longest.time[-1]:g} s"
        )


def _scale_of(fresh: Sequence[Found], staged: Mapping[str, StagedRun], layout: Layout) -> CampaignScale:
    """Size, duration, displacement and speed of the runs that were read now."""
    size = np.ptp(layout.structure.position, axis=0)
    return CampaignScale(
        size=(float(size[0]), float(size[1]), float(size[2])),
        duration=max(float(f.time[-1] - f.time[0]) for f in fresh),
        displacement=max(staged[f.name].displacement for f in fresh),
        speed=max(staged[f.name].speed for f in fresh),
    )


def _note_equal_parameters(
    fresh: Sequence[Found], staged: Mapping[str, StagedRun], old: Existing | None, look: Survey
) -> None:
    """Say which runs have the same parameters: a surrogate can give them one result only."""
    names = tuple(fresh[0].parameters) if fresh else ()
    if not names:
        return
    seen: dict[tuple[float, ...], tuple[str, str]] = {}
    replaced = {f.name for f in fresh}
    for k, name in enumerate(old.names if old is not None else ()):
        if old is not None and name not in replaced:
            values = tuple(float(old.small[n].values[k]) for n in names)
            seen.setdefault(values, (name, str(old.small["run_checksum"].values[k])))
    for found in fresh:
        values = tuple(found.parameters[n][0] for n in names)
        checksum = run_checksum(staged[found.name].digests)
        other, its = seen.setdefault(values, (found.name, checksum))
        if other != found.name:
            same = (
                "the same result; is one a copy?" if its == checksum else "different results; is a parameter missing?"
            )
            look.note(f"runs {other} and {found.name} have equal parameters and {same}")


def _hash(values: NDArray[Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()


def _hierarchy_of(former: Existing | None) -> Hierarchy | None:
    """The mesh hierarchy of the dataset that is replaced, None where it has none."""
    if former is None or not former.has_hierarchy:
        return None
    from crashkit.mesh.store import open_hierarchy

    return open_hierarchy(former.path)


def _carried(output: Path, hierarchy: Hierarchy) -> str:
    """Give the new dataset the hierarchy of the former one, with the displacements of all its runs; returns the note about it.

    The selection depends on the mesh alone, which new runs share; where they replaced it, the hierarchy is gone.
    """
    from crashkit.mesh.store import write_hierarchy

    try:
        write_hierarchy(output, hierarchy)
    except DataError:
        return "the mesh hierarchy was that of another mesh and is gone; make a new one with crashkit coarsen"
    return f"the mesh hierarchy ({', '.join(str(k.n_nodes) for k in hierarchy.levels)} nodes) goes on with the new runs"


def _nothing_new(output: Path, old: Existing | None, unchanged: list[str], look: Survey) -> IngestSummary:
    if old is None or not unchanged:
        raise DataError(f"no run can be used ({look.reasons()})")
    return IngestSummary(
        output, old.names, unchanged=tuple(unchanged), skipped=dict(look.skipped), notes=tuple(look.notes),
        nodes=old.structure.n_nodes, states=len(old.time),
    )  # fmt: skip
