"""What the numbers say, in words: which model for which purpose, and what not to believe.

Every sentence follows from a rule stated here and printed in the report. Nothing is said that the numbers of
this evaluation do not say; a model that loses is named as the one that loses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.comparison.result import Evaluation
from evaluation.comparison.split import Entry
from evaluation.drawing.style import CM, called
from evaluation.measures.distance import masked_mean

FEW_RUNS = 10  # fewer test runs than this carry no reliable ranking of close models
NEAR = 1.25  # "nearly as exact": at most a quarter worse than the best
# Share of the mean error: a larger displacement in the first state, where nothing has moved, gives a warning.
START_SHARE = 0.1
BAND_HOLDS = 0.85  # a 90 % band that holds less than this share on test runs gives a warning
OUTLIER = 2.0  # a test run whose error is more than this many times the median gives a warning
MOSTLY_REGRESSION, MOSTLY_COMPRESSION = 0.5, 0.8  # shares of the error that compression alone has
POOR_RELATIVE = 0.15  # a relative displacement error above this gives a warning
USELESS_RELATIVE = 0.5  # above this not even trends are to be trusted

RULES = (
    f"Two models are called different only if the 95 % interval of the mean difference of their errors over the test "
    f"runs and the training seeds (paired bootstrap, 4000 resamples, fixed seed) does not contain zero. "
    f"Most accurate: lowest mean node error on the full mesh. "
    f"Many queries: the fastest on the full mesh among those at most {100 * (NEAR - 1):.0f} % worse than the best, "
    f"none where their relative displacement error is above {100 * POOR_RELATIVE:.0f} %. "
    f"Visualisation: among models that predict on a coarse mesh, the one with the fewest nodes at most "
    f"{100 * (NEAR - 1):.0f} % worse than the best of these. "
    f"Worst case: lowest error on its worst test run, without those outside the range of the training runs. "
    f"The error is called regression where compression alone has less than {100 * MOSTLY_REGRESSION:.0f} % of it, and "
    f"compression where it has more than {100 * MOSTLY_COMPRESSION:.0f} %. "
    f"A warning is given for fewer than {FEW_RUNS} test runs, a relative displacement error above "
    f"{100 * POOR_RELATIVE:.0f} % (above {100 * USELESS_RELATIVE:.0f} % not even trends are to be trusted), "
    f"a group of nodes whose error exceeds half of its own motion, a finer level that is "
    f"not better than the coarser one, a baseline that is better than a multi-hierarchical model, test runs outside "
    f"the range of the training runs, a 90 % band that holds less than {100 * BAND_HOLDS:.0f} %, models trained once, "
    f"a test run whose error is more than {OUTLIER:g} times the median, "
    f"or a model that moves nodes in the first state by more than "
    f"{100 * START_SHARE:.0f} % of its mean error."
)


@dataclass(frozen=True)
class Statement:
    """`kind` is "use" (a recommendation), "finding" or "warning"; `about` its heading, `text` one or two sentences."""

    kind: str
    about: str
    text: str


def statements(evaluation: Evaluation) -> list[Statement]:
    """The words of the report, recommendations first. See `RULES`."""
    return [
        *_use(evaluation),
        *_error_source(evaluation),
        *_families(evaluation),
        *_levels(evaluation),
        *_warnings(evaluation),
    ]


def difference(a: NDArray[np.float64], b: NDArray[np.float64], resamples: int = 4000) -> tuple[float, float, float]:
    """Mean of `a - b` and its 95 % interval by a bootstrap over runs, the same for both, and over the seeds of each.

    Parameters
    ----------
    a, b
        (seed, run) m, or (run,) of one seed. Seeded. One run: the interval is infinite, since one run says nothing
        about the next. See Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapter 13.
    """
    rng = np.random.default_rng(0)
    errors = [np.atleast_2d(np.asarray(x, dtype=np.float64)) for x in (a, b)]
    mean = float(errors[0].mean() - errors[1].mean())
    count = errors[0].shape[1]
    if count < 2:
        return mean, -np.inf, np.inf
    runs = rng.integers(0, count, (resamples, count))
    drawn = []
    for x in errors:
        seeds = rng.integers(0, len(x), (resamples, len(x)))
        drawn.append(np.take_along_axis(x[seeds].mean(axis=1), runs, axis=1).mean(axis=1))
    low, high = np.quantile(drawn[0] - drawn[1], (0.025, 0.975))
    return mean, float(low), float(high)


def _between(evaluation: Evaluation, a: Entry, b: Entry) -> tuple[float, float, float]:
    """`difference` of two rows. Levels of one cascade share their seeds, so these are paired too."""
    ours, theirs = (masked_mean(evaluation.scores[e.label].e2, axis=2) for e in (a, b))
    if [model for model, _ in a.keys] == [model for model, _ in b.keys]:
        return difference(ours - theirs, np.zeros_like(theirs))
    return difference(ours, theirs)


def clearly_better(evaluation: Evaluation, a: Entry, b: Entry) -> bool:
    """Whether `a` has the lower error than `b` beyond what other test runs or other seeds would explain."""
    return _between(evaluation, a, b)[2] < 0


def _cm(value: float) -> str:
    return f"{value * CM:.2f} cm"


def _error(evaluation: Evaluation, entry: Entry) -> float:
    return evaluation.scores[entry.label].mean


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _is(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _use(evaluation: Evaluation) -> list[Statement]:
    ranked = evaluation.ranked
    best = ranked[0]
    scores = evaluation.scores
    relative = float(masked_mean(scores[best.label].relative))
    equal = [e.label for e in ranked[1:] if not clearly_better(evaluation, best, e)]
    text = (
        f"{best.label}: mean node error {_cm(_error(evaluation, best))} on the full mesh, "
        f"{100 * relative:.1f} % of the displacement"
    )
    if len(ranked) == 1:
        text += ". There is no other model to compare it with."
    elif equal:
        text += (
            f". On these {len(evaluation.runs)} test runs, {_listed(equal)} {_is(equal)} not significantly different."
        )
    else:
        text += f", ahead of {ranked[1].label} with {_cm(_error(evaluation, ranked[1]))}."
    out = [Statement("use", "Highest accuracy", text)]
    if evaluation.timings:
        out.append(Statement("use", "Many queries (optimisation, uncertainty)", _many_queries(evaluation)))
    coarse = [e for e in ranked if e.level > 0]
    if coarse:
        limit = NEAR * _error(evaluation, coarse[0])
        light = min(
            (e for e in coarse if _error(evaluation, e) <= limit),
            key=evaluation.nodes,
        )
        nodes, full = evaluation.nodes(light), evaluation.reference.n_nodes
        own = float(masked_mean(scores[light.label].on_level[..., light.level]))
        out.append(
            Statement(
                "use",
                "Visualisation on weak hardware",
                f"{light.label}: {nodes} of {full} nodes, {_cm(own)} on its own nodes and "
                f"{_cm(_error(evaluation, light))} lifted to the full mesh.",
            )
        )
    beyond = _beyond(evaluation)
    if len(ranked) > 1 and (~beyond).sum() > 1:
        # One extrapolated run would choose the model that happens to be least wrong where nobody should ask any of them.
        errors = {e.label: np.where(beyond, -np.inf, scores[e.label].of_runs) for e in ranked}
        safe = min(ranked, key=lambda e: float(errors[e.label].max()))
        worst = int(np.argmax(errors[safe.label]))
        aside = _listed([evaluation.test_names[k] for k in np.flatnonzero(beyond)[:6]]) if beyond.any() else ""
        out.append(
            Statement(
                "use",
                "Smallest worst case",
                f"{safe.label}: on its worst test run, {evaluation.test_names[worst]}, the mean node error is "
                f"{_cm(float(errors[safe.label][worst]))}; the largest error of any node at any time is "
                f"{_cm(float(scores[safe.label].peak_value[:, ~beyond].max()))}."
                + (f" Left out, as outside the range of the training runs: {aside}." if aside else ""),
            )
        )
    return out


def _many_queries(evaluation: Evaluation) -> str:
    """The fastest of the nearly best models, unless their error is too large to optimise with."""
    best = evaluation.ranked[0]
    near = [e for e in evaluation.ranked if _error(evaluation, e) <= NEAR * _error(evaluation, best)]
    usable = [e for e in near if float(masked_mean(evaluation.scores[e.label].relative)) <= POOR_RELATIVE]
    if not usable:
        return f"no model: even the best is wrong by more than {100 * POOR_RELATIVE:.0f} % of the displacement."
    fast = min(usable, key=lambda e: evaluation.timings[e.label].lifted)
    ms = evaluation.timings[fast.label].lifted
    rank = (
        ", the fastest of those nearly as accurate as the best."
        if len(near) > 1
        else "; no other model comes within a quarter of its error."
    )
    return f"{fast.label}: {ms:.3g} ms per state on the full mesh at {_cm(_error(evaluation, fast))}{rank}"


def _error_source(evaluation: Evaluation) -> list[Statement]:
    best = evaluation.ranked[0]
    s = evaluation.scores[best.label]
    latent = evaluation.predictor(best).n_latent
    floor = evaluation.floor_at(latent)
    source = (
        "Most of it is regression: more runs or a better regression would help, a larger latent size would not."
        if s.reduction < MOSTLY_REGRESSION * s.mean
        else (
            "Most of it is compression: a larger latent size or a better reduction would help."
            if s.reduction > MOSTLY_COMPRESSION * s.mean
            else "Compression and regression both matter."
        )
    )
    beside = (
        f" The best linear compression to {latent} numbers (POD) has an error of {_cm(floor)}."
        if floor == floor
        else ""
    )
    return [
        Statement(
            "finding",
            "Where the error comes from",
            f"The error of {best.label} is {_cm(s.mean)}; its compression error (encoding and decoding the true states) "
            f"is {_cm(s.reduction)}.{beside} {source}",
        )
    ]


def _families(evaluation: Evaluation) -> list[Statement]:
    """Multi-hierarchical models against the best model of the full mesh, win or lose."""
    coarse = [e for e in evaluation.ranked if e.level > 0]
    full = [e for e in evaluation.ranked if e.level == 0]
    if not coarse or not full:
        return []
    rival = full[0]
    ours = coarse[0]
    delta, low, high = _between(evaluation, ours, rival)
    wins = int((evaluation.scores[ours.label].of_runs < evaluation.scores[rival.label].of_runs).sum())
    count = len(evaluation.runs)
    errors = f"{_cm(_error(evaluation, ours))} against {_cm(_error(evaluation, rival))}"
    numbers = f"{errors}, better on {wins} of {count} test runs"
    spread = f"95 % interval {low * CM:+.2f} to {high * CM:+.2f}"
    interval = f" (difference {delta * CM:+.2f} cm, {spread})" if count > 1 else ""
    about = "Multi-hierarchical against the best baseline"
    if high < 0:
        return [Statement("finding", about, f"{ours.label} is better than {rival.label}: {numbers}{interval}.")]
    if low > 0:
        return [
            Statement(
                "warning",
                about,
                f"{ours.label}, the best multi-hierarchical level, is worse than {rival.label}: {numbers}{interval}. For "
                f"accuracy on the full mesh, {rival.label} is the better choice here.",
            )
        ]
    return [
        Statement(
            "finding", about, f"{ours.label} and {rival.label} are not significantly different: {numbers}{interval}."
        )
    ]


def _levels(evaluation: Evaluation) -> list[Statement]:
    """Whether each finer level of a cascade is better than the next coarser one."""
    out = []
    for m in range(len(evaluation.models)):
        rows = [e for e in evaluation.entries if e.keys[0][0] == m]
        rows.sort(key=lambda e: -e.level)
        if len(rows) < 2:
            continue
        values = [_error(evaluation, e) for e in rows]
        said = ", ".join(f"{e.label} {_cm(v)}" for e, v in zip(rows, values, strict=True))
        worse = [
            f"{fine.label} is not better than {coarse.label}"
            for coarse, fine, a, b in zip(rows, rows[1:], values, values[1:], strict=False)
            if b >= a
        ]
        if worse:
            out.append(
                Statement("warning", "Levels", f"{said}: {_listed(worse)}. The finer levels did not reduce the error.")
            )
        else:
            out.append(Statement("finding", "Levels", f"The error decreases with every finer level: {said}."))
    return out


def _warnings(evaluation: Evaluation) -> list[Statement]:
    out = []
    count = len(evaluation.runs)
    if count == 1:
        out.append(
            Statement(
                "warning",
                "One test run",
                "All numbers come from a single test run and say nothing about other runs. Do not rank models by them.",
            )
        )
    elif count < FEW_RUNS:
        out.append(
            Statement(
                "warning",
                "Few test runs",
                f"There are {count} test runs. Differences smaller than the spread between runs are not reliable.",
            )
        )
    averaged = [e.label for e in evaluation.leaders if evaluation.model(e).averaged > 1]
    once = [e.label for e in evaluation.leaders if len(e.keys) == 1 and e.label not in averaged]
    if len(once) < len(evaluation.leaders) and once:
        text = f"Trained once, so without a spread: {_listed(once)}. How much their results depend on the seed is not known."
        out.append(Statement("warning", "Models with one seed", text))
    if once and len(once) == len(evaluation.leaders):
        out.append(
            Statement(
                "warning",
                "One seed each",
                "Every model was trained with one seed. Another seed gives other numbers; train with several seeds to see "
                "how much.",
            )
        )
    relative = {e.label: float(masked_mean(evaluation.scores[e.label].relative)) for e in evaluation.ranked}
    poor, useless = (
        [f"{label} {100 * error:.0f} %" for label, error in relative.items() if low < error <= high]
        for low, high in ((POOR_RELATIVE, USELESS_RELATIVE), (USELESS_RELATIVE, np.inf))
    )
    texts = [f"{_listed(poor)}. Good for trends, not for values at a node"] if poor else []
    texts += (
        [f"{_listed(useless)}. Wrong by more than half of the motion, so not good for trends either"] if useless else []
    )
    if texts:
        out.append(Statement("warning", "Large relative error", f"Relative displacement error: {'. '.join(texts)}."))
    narrow = [
        f"{e.label} {100 * held:.0f} %"
        for e in evaluation.ranked
        if (held := float(masked_mean(evaluation.scores[e.label].covered))) < BAND_HOLDS
    ]
    if narrow:
        out.append(
            Statement(
                "warning",
                "Bands miss their promise",
                f"The 90 % band should hold nine of ten nodes and states of the test runs; it holds {_listed(narrow)}. "
                f"Do not take it for the error.",
            )
        )
    best = evaluation.ranked[0]
    for what, names in evaluation.group_names.items():
        errors = masked_mean(evaluation.scores[best.label].groups[what], axis=(0, 1))
        sizes = masked_mean(np.array([r.group_size[what] for r in evaluation.runs]), axis=0)
        bad = [f"{name} ({_cm(e)} of {_cm(s)})" for name, e, s in zip(names, errors, sizes, strict=True) if e > 0.5 * s]
        if bad:
            out.append(
                Statement(
                    "warning",
                    f"By {what}",
                    f"{best.label} misses more than half of the motion of {_listed(bad[:5])}.",
                )
            )
    out += _start(evaluation)
    out += _outside(evaluation)
    worst = evaluation.scores[best.label].of_runs
    if count > 2 and worst.max() > OUTLIER * np.median(worst):
        run = int(np.argmax(worst))
        out.append(
            Statement(
                "warning",
                "An outlier",
                f"On {called(evaluation.test_names[run])} the error of {best.label} is "
                f"{worst.max() / np.median(worst):.1f} times "
                f"the median; see where it lies in the design space below.",
            )
        )
    return out


def _start(evaluation: Evaluation) -> list[Statement]:
    """Models that predict motion where there is none yet."""
    if float(np.nanmax([r.size[0] for r in evaluation.runs])) > 0:
        return []
    moved = [
        f"{e.label} {_cm(start)}"
        for e in evaluation.ranked
        if (start := float(masked_mean(evaluation.scores[e.label].e2[..., 0]))) > START_SHARE * _error(evaluation, e)
    ]
    if not moved:
        return []
    text = f"In the first state nothing has moved, but the mean predicted displacement is not zero: {_listed(moved)}."
    return [Statement("warning", "Non-zero prediction at t = 0", text)]


def _beyond(evaluation: Evaluation) -> NDArray[np.bool_]:
    """(test run,): whether it lies outside the ranges of the training runs."""
    reference = evaluation.reference
    if not reference.parameter_names or not evaluation.split.train:
        return np.zeros(len(evaluation.split.test), bool)
    train, test = (reference.parameters[list(k)] for k in (evaluation.split.train, evaluation.split.test))
    return np.asarray(((test < train.min(axis=0)) | (test > train.max(axis=0))).any(axis=1))


def _outside(evaluation: Evaluation) -> list[Statement]:
    """Test runs beyond the training runs' ranges, and the error without them."""
    beyond = _beyond(evaluation)
    if not beyond.any():
        return []
    best = evaluation.ranked[0]
    errors = evaluation.scores[best.label].of_runs
    names = _listed([evaluation.test_names[k] for k in np.flatnonzero(beyond)[:6]])
    without = f" Without them {best.label} has {_cm(float(errors[~beyond].mean()))}." if (~beyond).any() else ""
    text = (
        f"{int(beyond.sum())} of {len(beyond)} test runs lie outside the range of the training runs: {names}.{without}"
    )
    return [Statement("warning", "Extrapolation", text)]
