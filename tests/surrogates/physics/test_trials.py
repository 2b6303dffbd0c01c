"""Trials by folds: what is said of runs that are left out does not know them, nor their images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plate
import pytest
from numpy.typing import NDArray

from surrogates.data.campaign import Campaign
from surrogates.data.samples import Notes
from surrogates.models.pod_regression import Inputs, _Candidate, _errors, _held
from surrogates.physics import trials as module
from surrogates.physics.clock import Clock
from surrogates.physics.derived import DerivedInputs
from surrogates.physics.registration import Registration
from surrogates.physics.symmetry import Symmetry
from surrogates.physics.trials import Courses, Folds, Trials, courses_of
from surrogates.settings import settings

RUNS = 14
FOLDS = Folds(np.arange(RUNS)[None] % 4)
CHOSEN = {model: settings(model, overrides=["pod.points=30"]) for model in ("pod-gpr", "pod-rbf")}


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    return plate.campaign(RUNS, mirrors=(plate.MIRROR,))


@pytest.fixture(scope="module")
def courses(campaign: Campaign) -> Courses:
    return courses_of(campaign, CHOSEN["pod-gpr"], np.arange(RUNS), Notes())


def registration(campaign: Campaign, *, mirrored: bool) -> Registration:
    clock = Clock.of(campaign.parameters, 0, {0: 0.25})
    symmetry = Symmetry(plate.MIRROR, ("impact_angle",), flagged=True) if mirrored else Symmetry()
    inputs = DerivedInputs.identity(campaign.parameter_names)
    return Registration(inputs, clock, symmetry, clock.grid(campaign.parameters, campaign.time))


def without(courses: Courses, runs: NDArray[np.int64]) -> Courses:
    """The courses with those of `runs`, and of their images, replaced by others."""
    own, image = courses.own.copy(), courses.images[0].copy()
    own[runs] = own[runs][:, ::-1] + 1.0
    image[runs] = image[runs][:, ::-1] - 2.0
    return replace(courses, own=own, images={0: image})


def trials(courses: Courses, campaign: Campaign, model: str) -> Trials:
    return Trials(courses, campaign.parameters, FOLDS, model, seed=0)


@pytest.mark.parametrize("mirrored", [False, True])
def test_left_out_runs_are_predicted_without_them_and_their_images(
    courses: Courses, campaign: Campaign, mirrored: bool
) -> None:
    known = registration(campaign, mirrored=mirrored)
    before = list(trials(courses, campaign, "pod-rbf").predicted(known))
    assert sorted(np.concatenate([held for held, _ in before]).tolist()) == list(range(RUNS))
    for fold, (held, said) in enumerate(before):
        after = list(trials(without(courses, held), campaign, "pod-rbf").predicted(known))
        np.testing.assert_array_equal(after[fold][1], said)
        others = [k for k in range(4) if k != fold]
        assert all(np.abs(after[k][1] - before[k][1]).max() > 1e-3 for k in others)


def test_some_nodes_of_a_large_mesh_judge_a_registration_as_all_do(
    courses: Courses, campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = registration(campaign, mirrored=True)
    monkeypatch.setattr(module, "_SPANNED", 60)
    monkeypatch.setattr(module, "_JUDGED_NODES", 20)
    some = courses_of(campaign, CHOSEN["pod-gpr"], np.arange(RUNS), Notes(), only_judged=True)
    assert len(some.modes) == 3 * module._SPANNED < len(courses.modes)
    for run in range(RUNS):  # the basis of the same nodes gives the fields that are judged
        rows = some.modes.reshape(-1, 3, some.modes.shape[1])[some.nodes]
        said = np.einsum("sm,nxm->snx", some.own[run][some.states], rows)
        np.testing.assert_allclose(said, some.truth[run], atol=1e-4 * np.abs(some.truth).max())
    worth = [np.mean(trials(c, campaign, "pod-rbf").errors(known)) for c in (courses, some)]
    assert worth[1] == pytest.approx(worth[0], rel=0.1)


def test_the_kernel_of_a_fold_does_not_know_the_runs_it_leaves_out(courses: Courses, campaign: Campaign) -> None:
    """The first fold, which starts from nothing; later ones start their search from the kernel before."""
    known = registration(campaign, mirrored=True)
    held, said, deviation = next(trials(courses, campaign, "pod-gpr").believed(known))
    other = next(trials(without(courses, held), campaign, "pod-gpr").believed(known))
    np.testing.assert_array_equal(other[1], said)
    np.testing.assert_array_equal(other[2], deviation)


@pytest.mark.parametrize(("view", "model"), [("trajectory", "pod-rbf"), ("point", "pod-gpr")])
def test_modes_and_errors_of_a_fold_are_of_its_own_runs(
    courses: Courses, campaign: Campaign, view: Inputs, model: str
) -> None:
    known = Registration.identity(campaign.parameter_names, campaign.time)
    candidate = _Candidate(view, known, 0)
    before = {h.run: h for h in _held(candidate, trials(courses, campaign, model), CHOSEN[model], 3)}
    assert sorted(before) == list(range(RUNS))
    first = np.flatnonzero(FOLDS.part[0] == 0)
    changed = trials(without(courses, first), campaign, model)
    after = {h.run: h for h in _held(candidate, changed, CHOSEN[model], 3)}
    for run in range(RUNS):
        same = np.array_equal(after[run].predicted, before[run].predicted)
        assert same == (run in first)


def test_the_error_of_a_candidate_is_that_of_the_projected_predictions_on_left_out_runs(
    courses: Courses, campaign: Campaign
) -> None:
    candidate = _Candidate("trajectory", Registration.identity(campaign.parameter_names, campaign.time), 0)
    of = trials(courses, campaign, "pod-rbf")
    found = _errors(candidate, of, CHOSEN["pod-rbf"], (2, 5))
    truth = campaign.displacement(0)
    for count, error in zip((2, 5), found, strict=True):
        held = list(_held(candidate, of, CHOSEN["pod-rbf"], count))
        distance = [np.linalg.norm(h.predicted - truth[h.run], axis=-1) for h in held]
        # Judged on all 7 states and all 81 nodes: there are fewer than would be drawn.
        assert error == pytest.approx(np.mean(distance), rel=1e-4)


def test_images_stand_behind_their_runs_and_are_told_from_them(courses: Courses, campaign: Campaign) -> None:
    known = registration(campaign, mirrored=True)
    of = trials(courses, campaign, "pod-gpr")
    inputs, values = of.inputs(known), of.values(known, 0)
    assert inputs.shape == (2 * RUNS, 4)
    np.testing.assert_allclose(inputs[RUNS:, 1], -inputs[:RUNS, 1])
    assert inputs[:, 3].tolist() == [0.0] * RUNS + [1.0] * RUNS
    np.testing.assert_array_equal(of.with_images(known, np.array([1, 5])), [1, 5, 1 + RUNS, 5 + RUNS])
    image = known.clock.apply(courses.images[0][5], campaign.parameters[5], campaign.time, known.grid)
    np.testing.assert_allclose(values[5 + RUNS], image)


def test_runs_in_the_common_basis_are_the_runs(courses: Courses, campaign: Campaign) -> None:
    """Modes are orthonormal, the first three move the structure as a whole, and nothing that matters is lost."""
    modes = courses.modes.astype(np.float64)
    np.testing.assert_allclose(modes.T @ modes, np.eye(modes.shape[1]), atol=1e-5)
    u = campaign.displacement(0)
    back = (courses.own[4] @ courses.modes.T).reshape(u[4].shape)
    np.testing.assert_allclose(back, u[4], atol=1e-4 * np.abs(u).max())
    np.testing.assert_allclose(courses.own[4][:, :3] / 9, u[4].mean(axis=1), atol=1e-6)
    flipped = u[4].reshape(7, 9, 9, 3)[:, ::-1].reshape(7, 81, 3) * [-1, 1, 1]
    image = (courses.images[0][4] @ courses.modes.T).reshape(u[4].shape)
    np.testing.assert_allclose(image, flipped, atol=1e-4 * np.abs(u).max())
