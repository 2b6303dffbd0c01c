"""The registration of a campaign, chosen by cross-validation over training runs; what does not pay is left out.

The three ideas do little alone and a tenth or more each once the others are in, so the search starts from all of them
and then changes one thing at a time: the parity of parameters, the inputs, the exponents of the clock, the side flag.
Inputs of one clock are first compared by likelihood, and only the best of them by folds.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogates.data.campaign import Campaign
from surrogates.data.samples import Notes
from surrogates.errors import SurrogateError
from surrogates.physics.clock import Clock, neighbours
from surrogates.physics.derived import (
    MASS,
    SPEED,
    STRESS,
    DerivedInputs,
    candidates,
    is_positive,
    logarithms,
    parse_monomial,
    places_for,
    with_matrix,
    with_monomial,
)
from surrogates.physics.registration import Registration
from surrogates.physics.symmetry import Symmetry, check_odd, may_be_odd
from surrogates.physics.trials import Folds, Trials, courses_of, one_thread
from surrogates.settings import Settings

_log = logging.getLogger(__name__)

# A change is kept if it lowers the error by this share. The whole is kept if it does by the larger one, and by so many
# standard errors of the mean over runs: with few runs the best of forty trials is better by chance alone.
_WORTH_A_CHANGE = 0.003
_WORTH_IT_ALL, _SURE = 0.01, 1.65
_ROUNDS = 2
# Sets of inputs that get to the folds in each round.
_FINALISTS = 3
# Fewer runs than this choose nothing.
FEWEST = 6


@dataclass
class Worth:
    """What was chosen, and what each idea was worth in cross-validation.

    errors   e2, m, by what was tried: "as they are", "all", and each idea alone and left out
    tried    registrations that were judged
    """

    errors: dict[str, float] = field(default_factory=dict)
    tried: int = 0


@dataclass(frozen=True)
class _Way:
    """One registration to be tried; `plane` is a place in the campaign's mirrors, None for no images.

    whole  whether the likelihood counts courses beyond the reference's end
    """

    inputs: DerivedInputs
    exponents: tuple[tuple[int, float], ...] = ()
    plane: int | None = None
    odd: tuple[str, ...] = ()
    flagged: bool = False
    whole: bool = False


class _Search:
    def __init__(self, campaign: Campaign, chosen: NDArray[np.int64], settings: Settings, trials: Trials) -> None:
        self.campaign, self.settings, self.trials = campaign, settings, trials
        self.parameters = campaign.parameters[chosen]
        self.names = campaign.parameter_names
        self.dimensions = campaign.dimensions or (None,) * len(self.names)
        positive = [k for k in range(len(self.names)) if is_positive(self.parameters[:, k])]
        clock = settings.physics.clock == "auto"
        self.speeds = [k for k in positive if clock and self.dimensions[k] == SPEED]
        self.others = tuple(k for k in positive if self.dimensions[k] in (STRESS, MASS))
        self.plain = self._as_named(settings.inputs.derived)
        self.tried: set[_Way] = set()
        self.lowest = np.inf

    def registration(self, way: _Way) -> Registration:
        clock = Clock.identity(len(self.names))
        if way.exponents:
            clock = Clock.of(self.parameters, way.exponents[0][0], dict(way.exponents), float(self.campaign.time[0]))
        mirror = None if way.plane is None else self.campaign.mirrors[way.plane]
        symmetry = Symmetry() if mirror is None else Symmetry(mirror, way.odd, way.flagged)
        grid = clock.grid(self.parameters, self.campaign.time)
        reach = np.inf if way.whole or not way.exponents else float(self.campaign.time[-1])
        return Registration(way.inputs, clock, symmetry, grid, reach)

    def error(self, way: _Way) -> float:
        if way not in self.tried:
            best = f", best {100 * self.lowest:.2f} cm" if np.isfinite(self.lowest) else ""
            _log.info("physics: %d tried by cross-validation%s", len(self.tried), best)
        self.tried.add(way)
        error = float(np.nanmean(self.trials.errors(self.registration(way), way.plane or 0)))
        self.lowest = min(self.lowest, error)
        return error

    def best(self, ways: Sequence[_Way], margin: float = _WORTH_A_CHANGE) -> _Way:
        """The first one unless another is better by `margin`."""
        chosen = ways[0]
        limit = self.error(chosen) * (1 - margin)
        for way in ways[1:]:
            error = self.error(way)
            if error < limit:
                chosen, limit = way, error
        return chosen

    def clearly_better(self, way: _Way, other: _Way) -> bool:
        """Whether the error is lower beyond what the runs that happen to be there would explain."""
        errors = [self.trials.errors(self.registration(w), w.plane or 0) for w in (way, other)]
        judged = np.isfinite(errors[0]) & np.isfinite(errors[1])
        gain = (errors[1] - errors[0])[judged]
        if len(gain) < 2:
            return bool(gain.sum() > 0)
        needed = max(_WORTH_IT_ALL * errors[1][judged].mean(), _SURE * gain.std(ddof=1) / np.sqrt(len(gain)))
        return bool(gain.mean() > needed)

    def starts(self) -> list[_Way]:
        """Everything at once, for each parity that parameters may have, and without images."""
        out = []
        clocks = [_sorted(k, {k: 0.25, **dict.fromkeys(self._strengths, 0.25)}) for k in self.speeds]
        for exponents in clocks or [()]:
            out.append(_Way(self.sets(())[0], exponents))
            for plane, odd in self.parities():
                out.append(_Way(self.sets(odd)[0], exponents, plane, odd, flagged=True))
        return out

    @property
    def _strengths(self) -> tuple[int, ...]:
        return tuple(k for k in self.others if self.dimensions[k] == STRESS)

    def parities(self) -> list[tuple[int, tuple[str, ...]]]:
        """Planes and the parameters that change their sign there, as declared or to be tried."""
        wish = self.settings.physics
        if wish.symmetry == "off" or not self.campaign.mirrors:
            return []
        sets = may_be_odd(self.names, self.parameters) if wish.odd is None else [tuple(wish.odd)]
        return [(plane, odd) for plane in range(len(self.campaign.mirrors)) for odd in sets if odd]

    def sets(self, odd: tuple[str, ...]) -> list[DerivedInputs]:
        """Inputs to choose from, with no monomials but those that the settings name, which all of them have."""
        wish = self.settings.inputs.derived
        if wish == "off":
            return [self.plain]
        logs = [logarithms(self.names, self.parameters, warp=warp, odd=odd) for warp in (True, False)]
        if not isinstance(wish, str):
            logs = [self._with_named(inputs, wish) for inputs in logs]
        out = [*logs, *(with_matrix(inputs, odd) for inputs in logs), self.plain]
        return list(dict.fromkeys(out))

    def _as_named(self, wish: str | Sequence[str]) -> DerivedInputs:
        """The parameters as they are, but for the monomials that the settings name: what is left where nothing pays."""
        plain = DerivedInputs.identity(self.names)
        if isinstance(wish, str):
            return plain
        used = np.any([parse_monomial(text, self.names) for text in wish], axis=0)
        logs = logarithms(self.names, self.parameters, warp=False).columns
        columns = (log if k else column for k, log, column in zip(used, logs, plain.columns, strict=True))
        return self._with_named(replace(plain, columns=tuple(columns)), wish)

    def _with_named(self, inputs: DerivedInputs, wanted: Sequence[str]) -> DerivedInputs:
        """Each named monomial in the place of its last parameter for which that is possible."""
        given: list[tuple[float, ...]] = []
        for text in wanted:
            powers = parse_monomial(text, self.names)
            used = [k for k, power in enumerate(powers) if power]
            bad = [self.names[k] for k in used if not is_positive(self.parameters[:, k])]
            if bad and len(used) == 1:
                raise SurrogateError(
                    f"inputs.derived: {text!r} is a parameter by itself, which is an input as it is where it is not positive "
                    "or hardly changes; leave it out, and name products of powers of positive parameters"
                )
            if bad:
                raise SurrogateError(
                    f"inputs.derived: {text!r} takes the logarithm of {bad[0]}, which is not positive or hardly changes"
                )
            places = [k for k in places_for(inputs, powers) if inputs.columns[k].powers not in given]
            if not places:
                raise SurrogateError(
                    f"inputs.derived: {text!r} follows from the monomials named before it; leave it out"
                )
            inputs = with_monomial(inputs, powers, places[-1])
            given.append(inputs.columns[places[-1]].powers)
        return inputs

    def monomials(self, way: _Way) -> Iterator[DerivedInputs]:
        """The inputs of `way` with one more monomial, each possible place, without those of odd parameters."""
        if self.settings.inputs.derived != "auto":
            return
        for powers in candidates(self.names, self.dimensions, self.parameters):
            if any(power and name in way.odd for power, name in zip(powers, self.names, strict=True)):
                continue
            if any(column.powers == powers for column in way.inputs.columns):
                continue
            for place in places_for(way.inputs, powers):
                yield with_monomial(way.inputs, powers, place)

    def improved_inputs(self, way: _Way) -> _Way:
        """First logarithms, warps and the matrix, then one more monomial on top of what was best."""
        way = self.best([way, *(replace(way, inputs=i) for i in self.sets(way.odd) if i != way.inputs)])
        logs = replace(way.inputs, mixed=())
        options = dict.fromkeys([logs, with_matrix(logs, way.odd)])
        named = list(self.monomials(replace(way, inputs=logs)))
        if len(named) > _FINALISTS:
            likely = [-self.trials.likelihood(self.registration(replace(way, inputs=i)), way.plane or 0) for i in named]
            named = [named[k] for k in np.argsort(likely)[:_FINALISTS]]
        options |= dict.fromkeys(named)
        return self.best([way, *(replace(way, inputs=i) for i in options if i != way.inputs)])

    def improved_clock(self, way: _Way) -> _Way:
        if not way.exponents:
            return way
        speed, exponents = way.exponents[0][0], dict(way.exponents)
        options = [replace(way, exponents=_sorted(speed, e)) for e in neighbours(exponents, speed, self.others)]
        way = self.best([way, replace(way, exponents=()), *options])
        return self.best([way, replace(way, whole=not way.whole)]) if way.exponents else way

    def improved_symmetry(self, way: _Way) -> _Way:
        if way.plane is None:
            return way
        return self.best([way, replace(way, flagged=not way.flagged), replace(way, plane=None, odd=(), flagged=False)])


def choose(
    campaign: Campaign,
    chosen: NDArray[np.int64],
    settings: Settings,
    trials: Trials,
) -> tuple[Registration, int, Worth]:
    """The registration of the training runs `chosen`, the place of its plane, and what it is worth.

    The identity where runs are few, nothing is known of the parameters, or nothing was gained; monomials that the
    settings name are inputs in every case.
    """
    search = _Search(campaign, chosen, settings, trials)
    check_odd(settings.physics.odd or (), search.names, campaign.parameters, campaign.table_units)
    identity = _Way(search.plain)
    worth = Worth()
    if len(chosen) < FEWEST:
        return search.registration(identity), 0, worth
    way = search.best([identity, *search.starts()], margin=0.0)
    if way == identity:
        way = search.best(search.starts(), margin=0.0)
    for _ in range(_ROUNDS):
        before = way
        way = search.improved_inputs(way)
        way = search.improved_clock(way)
        way = search.improved_symmetry(way)
        if way == before:
            break
    if not search.clearly_better(way, identity):
        way = identity
    worth.errors = _worth(search, identity, way)
    worth.tried = len(search.tried)
    return search.registration(way), way.plane or 0, worth


def _worth(search: _Search, identity: _Way, way: _Way) -> dict[str, float]:
    """e2, m: as they are, all, and each idea alone and left out."""
    as_named = not isinstance(search.settings.inputs.derived, str)
    out = {"inputs as named" if as_named else "parameters as they are": search.error(identity)}
    if way == identity:
        return out
    ideas: dict[str, dict[str, Any]] = {
        "derived inputs": {"inputs": identity.inputs},
        "clock and size": {"exponents": ()},
        "mirrored runs": {"plane": None, "odd": (), "flagged": False},
    }
    used = {name: none for name, none in ideas.items() if any(getattr(way, k) != v for k, v in none.items())}
    for name, none in used.items():
        alone = replace(identity, **{k: getattr(way, k) for k in none})
        out[f"{name} alone"] = search.error(alone)
    for name, none in used.items():
        out[f"all but {name}"] = search.error(replace(way, **none))
    if way.flagged:
        out["all but the side as an input"] = search.error(replace(way, flagged=False))
    out["all of it"] = search.error(way)
    return out


def not_used(registration: Registration, settings: Settings) -> list[str]:
    """A sentence for each wish of the settings that cross-validation, or the mesh, did not confirm."""
    out = []
    if settings.physics.odd and registration.symmetry.is_identity:
        out.append(
            f"physics.odd={', '.join(settings.physics.odd)} is not used: the mesh has no mirror plane, or mirrored runs "
            "did not lower the error in cross-validation"
        )
    return out


def _sorted(speed: int, exponents: dict[int, float]) -> tuple[tuple[int, float], ...]:
    """The speed first, then the others that count, in order."""
    rest = sorted((k, v) for k, v in exponents.items() if k != speed and v)
    return ((speed, exponents.get(speed, 0.0)), *rest)


def of_campaign(
    campaign: Campaign,
    settings: Settings,
    notes: Notes,
) -> tuple[Registration, Worth]:
    """The registration of all training runs for models that are trained behind it, judged with processes by folds."""
    if settings.physics.clock == settings.physics.symmetry == settings.inputs.derived == "off":
        return Registration.identity(campaign.parameter_names, campaign.time), Worth()
    everyone = np.arange(len(campaign.parameters))
    courses = courses_of(campaign, settings, everyone, notes, only_judged=True)
    folds = Folds.of(len(everyone), settings.validation.folds, settings.seed)
    trials = Trials(courses, campaign.parameters, folds, "pod-gpr", settings.seed)
    with one_thread():
        registration, _, worth = choose(campaign, everyone, settings, trials)
    for line in not_used(registration, settings):
        notes.add(line)
    return registration, worth
