"""The registration is chosen by folds, and left alone where it does not pay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plate
import pytest
from scipy.sparse import identity

from data_schema.mirror import MirrorPlane
from surrogates.data.campaign import Campaign
from surrogates.data.samples import Notes
from surrogates.errors import SurrogateError
from surrogates.physics.choice import _Search, _Way, choose, of_campaign
from surrogates.physics.derived import SPEED, STRESS, logarithms
from surrogates.physics.trials import Folds, Trials, courses_of
from surrogates.settings import Settings, settings
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate

TIME = np.linspace(0.0, 0.03, 16)


def crash(runs: int, seed: int = 0) -> Campaign:
    """A beam that bends as its damage number v^2 / sigma says, on a clock and of a size that go with v and sigma."""
    draw = np.random.default_rng(seed)
    mu = draw.uniform([5, -1, 2e8], [35, 1, 8e8], (runs, 3))
    x = np.linspace(0, 1, 30)
    rate = (mu[:, 0] / 20) ** 0.25 * (mu[:, 2] / 5e8) ** 0.25
    tau = rate[:, None] * TIME / TIME[-1]
    damage = np.log(mu[:, 0] ** 2 / mu[:, 2] * 5e8 / 400)
    size = mu[:, 0] / rate / 20
    shape = np.sin(np.pi * x * (2 + np.tanh(damage))[:, None])[:, None] * np.minimum(tau, 0.8)[..., None] ** 2
    u = np.zeros((runs, len(TIME), 30, 3))
    u[..., 0] = (size[:, None] * tau)[..., None]
    u[..., 2] = size[:, None, None] * (0.3 * shape + 0.1 * mu[:, 1, None, None] * tau[..., None] * x)
    u = u.astype(np.float32)
    return Campaign(
        mu, ("speed", "offset", "strength"), ("m s-1", "m", "Pa"), TIME, lambda level: u, 30,
        dimensions=(SPEED, (0.0, 1.0, 0.0), STRESS),
    )  # fmt: skip


def found(of: Campaign, chosen: Settings):  # type: ignore[no-untyped-def]
    runs = np.arange(len(of.parameters))
    courses = courses_of(of, chosen, runs, Notes())
    trials = Trials(courses, of.parameters, Folds.of(len(runs), 6, 0), "pod-gpr", 0)
    return choose(of, runs, chosen, trials)


def test_errors_of_folds_count_what_is_there() -> None:
    whole = crash(8)
    u = np.array(whole.displacement(0))
    u[3, 6:, :10] = np.nan  # ten of thirty nodes are gone from the seventh state on
    runs, chosen = np.arange(8), settings("pod-gpr")
    eroded = replace(whole, displacement=lambda level: u, erodes=True)
    courses = courses_of(eroded, chosen, runs, Notes())
    trials = Trials(courses, eroded.parameters, Folds.of(8, 6, 0), "pod-gpr", 0)
    nothing = np.zeros((1, len(TIME), courses.modes.shape[1]), np.float32)
    expected = np.nanmean(np.linalg.norm(u[3][:, courses.nodes], axis=-1), axis=1)[courses.states].mean()
    assert trials.distances(np.array([3]), nothing)[0] == pytest.approx(expected, rel=1e-5)


@pytest.fixture(scope="module")
def trained() -> Surrogate:
    return train_surrogate(crash(24), settings("pod-gpr"))


def test_clock_and_damage_number_are_found_and_worth_it(trained: Surrogate) -> None:
    clock, errors = trained.registration.clock, trained.record.physics["errors"]
    assert clock.speed == 0
    assert clock.exponents[0] == pytest.approx(0.25, abs=0.13)
    assert errors["all of it"] < 0.6 * errors["parameters as they are"]
    assert errors["all of it"] <= min(errors.values())
    assert {"clock and size alone", "all but clock and size"} <= errors.keys()


@pytest.mark.parametrize("idea", ["inputs.derived=off", "physics.clock=off"])
def test_what_is_switched_off_stays_off(idea: str) -> None:
    registration, _, _ = found(crash(16), settings("pod-gpr", overrides=[idea]))
    assert registration.clock.is_identity if "clock" in idea else registration.inputs.is_identity


def test_named_monomials_are_the_ones_taken() -> None:
    chosen = settings("pod-gpr", overrides=["inputs.derived=speed**2/strength"])
    registration, _, worth = found(crash(16), chosen)
    assert "ln(speed^2 / strength)" in registration.inputs.told()
    assert "inputs as named" in worth.errors


@pytest.mark.parametrize("runs", [4, 16])
def test_named_monomials_are_taken_where_nothing_pays(runs: int) -> None:
    draw = np.random.default_rng(3)
    noise = draw.standard_normal((runs, 7, 81, 3)).astype(np.float32)
    campaign = plate.campaign(runs, displacement=lambda level: noise, dimensions=(SPEED, None, STRESS))
    speed, _, strength = campaign.parameter_names
    chosen = settings("pod-gpr", overrides=[f"inputs.derived={speed}/{strength}"])
    registration, _, _ = found(campaign, chosen)
    assert f"ln({speed} / {strength})" in registration.inputs.told()


def test_noise_is_left_as_it_is() -> None:
    draw = np.random.default_rng(3)
    noise = draw.standard_normal((16, 7, 81, 3)).astype(np.float32)
    campaign = plate.campaign(16, displacement=lambda level: noise, dimensions=(SPEED, None, STRESS))
    registration, _, worth = found(campaign, settings("pod-gpr"))
    assert registration.is_identity
    assert list(worth.errors) == ["parameters as they are"]


def one_sided(runs: int) -> Campaign:
    """Beams of `crash` with positive offsets alone, and a mirror in z that changes the sign of the offset's share."""
    whole = crash(runs)
    mu = whole.parameters * [1, 0, 1] + [0, 1, 0] * np.abs(whole.parameters) + [0, 0.2, 0]
    u = whole.displacement(0)
    return replace(
        whole,
        parameters=mu,
        displacement=lambda level: u,
        mirrors=(MirrorPlane(np.array([0.0, 0.0, 1.0]), 0.0, identity(30)),),
    )


def test_a_parameter_declared_odd_is_never_put_in_a_logarithm_even_if_positive_in_all_runs() -> None:
    chosen = settings("pod-gpr", overrides=["physics.odd=[offset]"])
    of = one_sided(8)
    courses = courses_of(of, chosen, np.arange(8), Notes())
    search = _Search(of, np.arange(8), chosen, Trials(courses, of.parameters, Folds.of(8, 6, 0), "pod-gpr", 0))
    mirrored = [way for way in search.starts() if way.plane is not None]
    assert mirrored
    assert all(not column.logarithm for way in mirrored for column in way.inputs.columns if column.powers[1])
    assert all(np.isfinite(search.error(way)) for way in mirrored)
    named = {bool(powers[1]) for way in mirrored for i in search.monomials(way) for powers in (c.powers for c in i.columns)
             if sum(map(bool, powers)) > 1}  # fmt: skip
    assert named == {False}  # nor in a monomial with others
    even = _Way(logarithms(of.parameter_names, of.parameters, warp=True))
    assert any(c.powers[1] and c.powers[0] for i in search.monomials(even) for c in i.columns)


def test_a_parameter_declared_odd_on_a_mesh_without_a_mirror_plane_is_named() -> None:
    off = ["inputs.derived=off", "physics.clock=off"]
    chosen, notes = settings("pod-gpr", overrides=["physics.odd=[offset]", *off]), Notes()
    of_campaign(crash(8), chosen, notes)
    assert any("physics.odd=offset is not used: the mesh has no mirror plane" in line for line in notes.lines)


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("physics.odd=[weight]", "physics.odd names 'weight', which is no parameter; there are speed"),
        (
            "physics.odd=[speed]",
            r"physics.odd names speed, which is \S+ to \S+ .*in these runs; one that changes its sign",
        ),
        ("inputs.derived=speed**2/offset", "takes the logarithm of offset"),
        ("inputs.derived=speed**2/weight", "no parameter"),
        ("inputs.derived=[speed**2/strength, strength/speed**2]", "follows from the monomials named before it"),
    ],
)
def test_names_that_are_not_there_are_refused(override: str, told: str) -> None:
    with pytest.raises(SurrogateError, match=told):
        found(crash(8), settings("pod-gpr", overrides=[override]))


def test_few_runs_choose_nothing() -> None:
    registration, _, worth = found(crash(5), settings("pod-gpr"))
    assert registration.is_identity
    assert not worth.errors


def test_every_run_is_left_out_as_often_as_any_other_and_never_trains_then() -> None:
    for runs in (3, 12, 16, 40, 70):
        folds = Folds.of(runs, 6, 0)
        times = np.zeros(runs, int)
        for train, held in folds:
            assert not set(train) & set(held)
            assert len(train) + len(held) == runs
            times[held] += 1
        assert len(set(times)) == 1
        assert times[0] == {3: 1, 12: 1, 16: 2, 40: 1, 70: 1}[runs]


def test_the_first_state_is_zero_and_the_initial_velocity_is_exact(trained: Surrogate) -> None:
    """Every run flies freely along x at its own speed: that is learnt from none and kept for all."""
    low, high = trained.record.ranges.low, trained.record.ranges.high  # corners where no run was computed
    asked = np.array([[11.0, 0.3, 3e8], [30.0, -0.7, 7e8], low, high])
    u = trained.predict(asked)
    assert np.abs(u[:, 0]).max() < 1e-7
    flight = asked[:, :1] / 20 * TIME / TIME[-1]
    np.testing.assert_allclose(u[..., 0].mean(axis=2), flight, atol=2e-5 * flight.max())


def test_one_parameter_that_has_no_logarithm_is_no_monomial() -> None:
    chosen = settings("pod-gpr", overrides=["inputs.derived=[offset]"])
    with pytest.raises(SurrogateError, match=r"'offset' is a parameter by itself.*leave it out"):
        found(crash(16), chosen)
