"""What is learnt beside the displacements is judged on runs that were left out: nothing can be said of mere chance."""

from __future__ import annotations

import numpy as np
import plate
import pytest

from surrogates.data.campaign import ElementTarget
from surrogates.settings import settings
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate

RUNS, FACES = 18, 64


@pytest.fixture(scope="module", params=[False, True], ids=["as computed", "mirrored"])
def chance(request: pytest.FixtureRequest) -> Surrogate:
    """A result, and elements that disappear, that go by lot and not by the parameters."""
    draw = np.random.default_rng(0)
    luck = draw.standard_normal((RUNS, 1, FACES)).astype(np.float32)
    values = np.broadcast_to(luck, (RUNS, len(plate.TIME), FACES))
    alive = np.ones((RUNS, len(plate.TIME), FACES), bool)
    alive[:, 4:] = draw.random((RUNS, 1, FACES)) < 0.5
    chosen = settings(
        "pod-gpr",
        overrides=["targets=[displacement, luck]", "inputs.derived=off", "physics.clock=off", "validation.folds=3",
                   f"physics.symmetry={'auto' if request.param else 'off'}"],
    )  # fmt: skip
    campaign = plate.campaign(
        RUNS,
        targets=(ElementTarget("luck", "1", values),),
        alive=alive,
        mirrors=(plate.MIRROR,) if request.param else (),
    )
    return train_surrogate(campaign, chosen)


def test_a_result_that_goes_by_lot_is_predicted_no_better_than_its_spread(chance: Surrogate) -> None:
    """A run that took part in what is said of it would be told exactly."""
    errors = chance.fields["luck"].errors
    spread = np.sqrt(2 / np.pi)  # of normal numbers about zero, on average
    assert errors["mean of the runs"] == pytest.approx(spread, rel=0.1)
    assert errors["nearest run"] == pytest.approx(np.sqrt(2) * spread, rel=0.1)  # the difference of two of them
    assert errors["chosen"] > 0.9 * spread


def test_elements_that_go_by_lot_are_told_as_often_wrong_as_right(chance: Surrogate) -> None:
    assert chance.removal is not None
    scores = chance.removal.scores
    # Three of seven states are those in which half of the elements are gone; before, none is.
    assert scores["nearest run"].precision == pytest.approx(0.5, abs=0.08)
    assert scores["nearest run"].recall == pytest.approx(0.5, abs=0.08)
    chosen = scores["chosen"]
    assert not chosen.precision > 0.6
    assert chosen.loss > 0.9 * (3 / 7) * np.log(2)
