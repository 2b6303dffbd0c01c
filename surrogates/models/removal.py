"""How likely an element has been removed, of each element at each time: a classifier beside the displacements.

Removal is local and jumps: of two runs that look alike one loses an element and the other its neighbour. So three things
are asked of the training runs and their images, on the reference's clock: how often the element was gone by then (rate),
whether it was in the nearest run (nearest), and how much the process weighs the runs in which it was (process). The last
two are also taken as means over neighbours, one and three rings wide, and over all elements, since a run that loses many
loses them somewhere. A logistic regression makes a probability of these numbers. It is fitted to what folds say of the runs
they leave out, and which of the numbers it uses is chosen by its logarithmic loss there.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from data_schema.mirror import MirrorPlane
from surrogates.data.campaign import Campaign, RunByRun
from surrogates.physics.registration import Registration
from surrogates.physics.trials import Folds, Trials
from surrogates.physics.weigher import Weigher

_log = logging.getLogger(__name__)

# What is asked of the training runs, in the order in which more of it is taken; the first is the baseline.
TERMS = (("rate",), ("rate", "nearest"), ("rate", "process"), ("rate", "process", "nearest"))
# More terms are taken where they lower the logarithmic loss by this share.
_MARGIN = 0.005
# Added below logarithms: of a share, and of a number of elements.
_SHARE, _COUNT = 0.005, 0.5
# Rings of neighbours that means are taken over.
_RINGS = (1, 3)
# States and rows (element, state, run) that the classifier is fitted to.
_STATES, _ROWS = 21, 300_000
# Fewer runs than this choose nothing.
_FEWEST = 6
# An element counts as removed above this probability.
HALF = 0.5


@dataclass
class Score:
    """How well removal is told on runs that were left out, over elements and states.

    Attributes
    ----------
    precision
        Share of those called removed that are; NaN where none is.
    recall
        Share of those removed that are called so.
    loss
        Mean logarithmic loss; NaN for a plain yes or no.
    """

    precision: float
    recall: float
    loss: float = float("nan")


@dataclass
class Removal:
    """The fitted classifier.

    Attributes
    ----------
    faces
        (candidate,) the elements that disappear in some training run or image; all others never do.
    gone_at
        (run and image, candidate) s, when on the reference's clock; infinite where never.
    around
        (candidate, candidate): means over an element and its neighbours.
    terms
        What it uses, of `TERMS`.
    slopes, offset
        Of the logistic regression, by feature; without slopes, the rate itself is the probability.
    scores
        By name, over the runs that folds left out: "chosen", and the baselines.
    """

    weigher: Weigher
    faces: NDArray[np.int64]
    gone_at: NDArray[np.float32]
    around: sparse.csr_matrix
    terms: tuple[str, ...] = ("rate",)
    slopes: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    offset: float = 0.0
    scores: dict[str, Score] = field(default_factory=dict)

    def probability(
        self, registration: Registration, parameters: NDArray[np.float64], time: NDArray[np.float64], faces: int
    ) -> NDArray[np.float32]:
        """(run, state, face) of runs with parameters (run, parameter) at their own times (state,), s."""
        out = np.zeros((len(parameters), len(time), faces), np.float32)
        inputs = registration.read(parameters)
        weights, nearest = self.weigher.weights(inputs), self.weigher.nearest(inputs)
        for k, values in enumerate(parameters):
            asked = _Asked(weights[k], int(nearest[k]), self.gone_at, registration.clock.times(values, time))
            out[k][:, self.faces] = self._of(asked)
        # What is gone stays gone; times may come in any order.
        order = np.argsort(time, kind="stable")
        out[:, order] = np.maximum.accumulate(out[:, order], axis=1)
        return out

    def _of(self, asked: _Asked) -> NDArray[np.float32]:
        if not len(self.slopes):
            return asked.shares("rate").astype(np.float32)
        logit = _features(asked, self.terms, self.around) @ self.slopes + self.offset
        return (1 / (1 + np.exp(-np.clip(logit, -50, 50)))).astype(np.float32)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What has to be kept, with `terms` and `scores`."""
        return {
            **{f"weigher.{name}": values for name, values in self.weigher.arrays().items()},
            "faces": self.faces, "gone_at": self.gone_at, "slopes": self.slopes, "offset": np.array([self.offset]),
            "around.data": self.around.data, "around.indices": self.around.indices, "around.indptr": self.around.indptr,
        }  # fmt: skip

    @classmethod
    def load(cls, arrays: Mapping[str, NDArray[Any]], terms: Sequence[str], scores: Mapping[str, Score]) -> Removal:
        """From what `arrays` gave."""
        weigher = {name.removeprefix("weigher."): v for name, v in arrays.items() if name.startswith("weigher.")}
        count = len(arrays["faces"])
        around = sparse.csr_matrix(tuple(arrays[f"around.{n}"] for n in ("data", "indices", "indptr")), (count, count))
        return cls(
            Weigher.load(weigher), arrays["faces"], arrays["gone_at"], around, tuple(terms), arrays["slopes"],
            float(arrays["offset"][0]), dict(scores),
        )  # fmt: skip


class _Asked:
    """What the training runs say of one run at reference times (state,): shares (state, candidate) by term."""

    def __init__(
        self, weights: NDArray[np.float64], nearest: int, gone_at: NDArray[np.float32], times: NDArray[np.float64]
    ) -> None:
        self._weights, self._nearest, self._gone_at, self._times = weights, nearest, gone_at, times

    def shares(self, term: str) -> NDArray[np.float64]:
        """(state, candidate)"""
        at = self._gone_at
        if term == "nearest":
            gone: NDArray[np.float64] = (at[self._nearest][None] <= self._times[:, None]).astype(np.float64)
            return gone
        weights = np.full(len(at), 1 / len(at)) if term == "rate" else self._weights
        return np.asarray([weights @ (at <= t) for t in self._times], np.float64)


def _features(asked: _Asked, terms: Sequence[str], around: sparse.csr_matrix) -> NDArray[np.float64]:
    """(state, candidate, feature): each share and its logarithm; of neighbours and in all as well, but for the rate."""
    columns = []
    for term in terms:
        share = asked.shares(term)
        shares = [share]
        if term != "rate":
            wide = share.T
            for ring in range(1, max(_RINGS) + 1):
                wide = around @ wide
                if ring in _RINGS:
                    shares.append(wide.T)
            count = np.repeat(share.sum(axis=1, keepdims=True), share.shape[1], axis=1)
            columns += [np.log(np.maximum(count, 0) + _COUNT)]
        for one in shares:
            clipped = np.clip(one, 0, 1)
            columns += [clipped, np.log(clipped + _SHARE)]
    return np.stack(columns, axis=-1)


def fit_removal(
    campaign: Campaign, trials: Trials, registration: Registration, plane: int, chosen: NDArray[np.int64], seed: int
) -> Removal | None:
    """The classifier for the training runs `chosen`, in the order of `trials`; None where no element is ever removed."""
    if campaign.alive is None or campaign.points is None or campaign.faces is None:
        return None
    when = removal_times(campaign.alive, campaign.time, chosen)
    images = None
    if registration.symmetry.mirror is not None:
        part = None if campaign.labels is None else campaign.labels.face_part
        images = mirrored_faces(registration.symmetry.mirror, campaign.points, campaign.faces, part)
    parameters = campaign.parameters[chosen]
    rate = registration.clock.rate(parameters)[:, None]
    start = registration.clock.start
    gone = (start + (when - start) * rate).astype(np.float32)
    if images is not None:
        gone = np.concatenate([gone, gone[:, images]])
    faces = np.flatnonzero(np.isfinite(gone).any(axis=0))
    if not len(faces):
        return None
    gone = np.ascontiguousarray(gone[:, faces])
    _log.info("removal of %d elements", len(faces))
    inputs = trials.inputs(registration)
    machine = trials.fitted(registration, inputs, trials.values(registration, plane))
    out = Removal(Weigher.of(machine, inputs), faces, gone, neighbours(campaign.faces[faces]))
    if len(chosen) < _FEWEST or not len(trials.folds.judged):
        return out
    _choose(out, campaign, trials, registration, plane, when[:, faces], seed)
    return out


def _choose(
    out: Removal, campaign: Campaign, trials: Trials, registration: Registration, plane: int,
    when: NDArray[np.float64], seed: int,
) -> None:  # fmt: skip
    """Fit the logistic regression to what folds say of the runs they leave out; choose its terms there."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    states = np.unique(np.linspace(0, len(campaign.time) - 1, _STATES).astype(int))
    rows: dict[str, list[NDArray[np.float32]]] = {term: [] for term in TERMS[-1]}
    truth: list[NDArray[np.bool_]] = []
    group: list[NDArray[np.int64]] = []
    nearest: list[NDArray[np.bool_]] = []
    draw = np.random.default_rng(seed)
    most = max(1000, _ROWS // max(1, len(trials.parameters)))
    once = Trials(trials.courses, trials.parameters, Folds(trials.folds.part[:1]), trials.machine, trials.seed)
    for fold, (held, part, weigher, inputs) in enumerate(once.weighers(registration, plane)):
        weights, near = weigher.weights(inputs), weigher.nearest(inputs)
        for k, run in enumerate(held):
            times = registration.clock.times(trials.parameters[run], campaign.time[states])
            asked = _Asked(weights[k], int(near[k]), out.gone_at[part], times)
            true = (when[run][None] <= campaign.time[states][:, None]).ravel()
            some = np.sort(draw.permutation(len(true))[:most])
            for term, known in rows.items():
                found = _features(asked, (term,), out.around)
                known.append(found.reshape(len(true), -1)[some].astype(np.float32))
            truth.append(true[some])
            group.append(np.full(len(some), fold))
            nearest.append(asked.shares("nearest").ravel()[some] > HALF)
    y, folds = np.concatenate(truth), np.concatenate(group)
    columns = {term: np.concatenate(known) for term, known in rows.items()}
    if not y.any() or y.all():
        return

    def model() -> Any:
        return make_pipeline(StandardScaler(), LogisticRegression(C=1.0, max_iter=500))

    best = np.inf
    for terms in TERMS:
        x = np.concatenate([columns[term] for term in terms], axis=1)
        said = np.full(len(y), y.mean())
        for fold in np.unique(folds):
            others = folds != fold
            if y[others].any() and not y[others].all():
                said[~others] = model().fit(x[others], y[others]).predict_proba(x[~others])[:, 1]
        score = judged(said, y)
        if len(terms) == 1:
            out.scores["rate of the element"] = score
        if score.loss < best * (1 - _MARGIN):
            best, out.terms = score.loss, terms
            out.scores["chosen"] = score
    out.scores["nearest run"] = _yes_or_no(np.concatenate(nearest), y)
    fitted = model().fit(np.concatenate([columns[term] for term in out.terms], axis=1), y)
    scaler, logistic = fitted[0], fitted[1]
    out.slopes = np.asarray(logistic.coef_[0] / scaler.scale_, np.float64)
    out.offset = float(logistic.intercept_[0] - out.slopes @ scaler.mean_)


def judged(probability: NDArray[np.floating], removed: NDArray[np.bool_]) -> Score:
    """The score of probabilities against what was removed, both of any one shape."""
    kept = np.clip(np.asarray(probability, np.float64), 1e-6, 1 - 1e-6)
    loss = -np.where(removed, np.log(kept), np.log1p(-kept)).mean()
    score = _yes_or_no(probability > HALF, removed)
    return Score(score.precision, score.recall, float(loss))


def _yes_or_no(called: NDArray[np.bool_], removed: NDArray[np.bool_]) -> Score:
    right = int((called & removed).sum())
    return Score(
        right / int(called.sum()) if called.any() else float("nan"),
        right / int(removed.sum()) if removed.any() else float("nan"),
    )


def removal_times(
    alive: RunByRun, time: NDArray[np.float64], runs: Sequence[int] | NDArray[np.int64]
) -> NDArray[np.float64]:
    """(run, face) s: between the last state in which an element lives and the next; infinite where it lives on."""
    out = []
    middle = np.concatenate([time[:1], (time[1:] + time[:-1]) / 2, [np.inf]])
    for run in runs:
        life = np.asarray(alive[int(run)], bool)
        lives_until = len(life) - life[::-1].argmax(axis=0)  # one behind the last state in which it lives
        out.append(middle[np.where(life.any(axis=0), lives_until, 0)])
    return np.stack(out)


def centres(points: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """(face, 3): means of the corners; -1 in the last corner of a triangle."""
    there = faces >= 0
    corners = points[np.where(there, faces, 0)] * there[..., None]
    return np.asarray(corners.sum(axis=1) / there.sum(axis=1)[:, None])


def mirrored_faces(
    mirror: MirrorPlane, points: NDArray[np.float64], faces: NDArray[np.integer], part: NDArray[np.int64] | None
) -> NDArray[np.int64]:
    """(face,): the face nearest to each one's mirror image; within the parts where the images of faces lie."""
    from scipy.spatial import cKDTree

    at, image = centres(points, faces), centres(mirror.to_image @ points, faces)
    first = cKDTree(at).query(image)[1]
    if part is None:
        return np.asarray(first, np.int64)
    out = np.asarray(first, np.int64)
    for number in np.unique(part):
        mine = np.flatnonzero(part == number)
        partner = np.bincount(part[first[mine]]).argmax()  # the part that this one's image covers
        there = np.flatnonzero(part == partner)
        out[mine] = there[cKDTree(at[there]).query(image[mine])[1]]
    return out


def neighbours(faces: NDArray[np.integer]) -> sparse.csr_matrix:
    """(face, face): rows that take the mean over a face and those that share a node with it."""
    there = faces >= 0
    rows = np.repeat(np.arange(len(faces)), faces.shape[1])[there.ravel()]
    uses = sparse.csr_matrix((np.ones(len(rows)), (rows, faces[there])), (len(faces), int(faces.max(initial=0)) + 1))
    touches = (uses @ uses.T).sign()
    count = np.asarray(touches.sum(axis=1)).ravel()
    return sparse.csr_matrix(sparse.diags(1 / np.maximum(count, 1)) @ touches)
