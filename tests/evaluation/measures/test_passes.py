"""The compiled passes against the same sums in plain numpy, in any order of memory and with nodes that are gone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from evaluation.measures.distance import group_means, mean_node_error, node_distance
from evaluation.measures.probes import intrusion
from evaluation.measures.projection import last_seen, projection_error
from evaluation.measures.rigid import fit_rigid, split_error
from evaluation.measures.tally import Tally

NODES, STATES = 300, 5  # more nodes than are gone through at once


@pytest.fixture(params=["by state", "by node", "some gone"])
def fields(request: pytest.FixtureRequest) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Positions, truth and prediction of a body that moves, turns and is dented."""
    draw = np.random.default_rng(0)
    x = draw.uniform(0, 3, (NODES, 3))
    truth = np.empty((STATES, NODES, 3), np.float32)
    for k, angle in enumerate(np.linspace(0, 0.4, STATES)):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        truth[k] = x @ turn.T - x + 0.3 * k + 0.02 * draw.standard_normal(x.shape)
    prediction = truth + np.float32(0.05) * draw.standard_normal(truth.shape).astype(np.float32)
    if request.param == "by node":
        truth, prediction = (np.ascontiguousarray(a.transpose(1, 2, 0)).transpose(2, 0, 1) for a in (truth, prediction))
    if request.param == "some gone":
        truth[2:, 10:40] = np.nan
    return x, truth, prediction


def test_distances_are_norms(fields):
    _, truth, prediction = fields
    np.testing.assert_allclose(
        node_distance(truth, prediction), np.linalg.norm(truth.astype(np.float64) - prediction, axis=-1), rtol=1e-12
    )


def test_rigid_and_deformed_parts_are_those_of_the_fields(fields):
    x, truth, prediction = fields
    seen = np.where(np.isfinite(truth), prediction, np.nan)
    true, predicted = fit_rigid(x, truth), fit_rigid(x, seen)
    found = split_error(x, truth, prediction)
    gone = ~np.isfinite(truth).all(axis=-1)

    def mean(field: NDArray[np.float64]) -> NDArray[np.float64]:
        return mean_node_error(np.where(gone, np.nan, np.linalg.norm(field, axis=-1)))

    deformations = [m.deformation(x, u) for m, u in ((true, truth), (predicted, prediction))]
    np.testing.assert_allclose(found.rigid, mean(true.displacement(x) - predicted.displacement(x)), rtol=1e-9)
    np.testing.assert_allclose(found.deformation, mean(deformations[1] - deformations[0]), rtol=1e-9)
    np.testing.assert_allclose(found.true_rigid, mean(true.displacement(x)), rtol=1e-9)
    np.testing.assert_allclose(found.true_deformation, mean(deformations[0]), rtol=1e-9)


def test_intrusion_is_the_largest_deformation_along_the_direction(fields):
    x, truth, _ = fields
    inside = np.arange(5, 200)
    towards = np.array([-1.0, 0.5, 0.0])
    found = intrusion(x, truth, inside, towards, np.arange(NODES))
    along = fit_rigid(x, truth).deformation(x, truth)[:, inside] @ (towards / np.linalg.norm(towards))
    np.testing.assert_allclose(found.history, np.nanmax(along, axis=1), rtol=1e-9)
    assert along[found.state, found.node - 5] == pytest.approx(found.largest) == pytest.approx(np.nanmax(along))


def test_projection_leaves_what_no_mode_takes(fields):
    _, truth, _ = fields
    modes = np.linalg.qr(np.random.default_rng(1).standard_normal((3 * NODES, 7)))[0].astype(np.float32)
    found = projection_error(truth, modes)
    flat = last_seen(truth).reshape(STATES, -1)
    for r in range(7):
        rest = (flat - flat @ modes[:, : r + 1] @ modes[:, : r + 1].T).reshape(truth.shape)
        distance = np.where(np.isfinite(truth).all(axis=-1), np.linalg.norm(rest, axis=-1), np.nan)
        np.testing.assert_allclose(found[r], mean_node_error(distance), rtol=2e-6)


def test_a_tally_of_blocks_is_that_of_the_whole(fields):
    _, truth, prediction = fields
    groups = {"part": [np.arange(100), np.arange(50, 300), np.array([], int)]}
    tally = Tally(groups, NODES)
    for states in (slice(0, 2), slice(2, 5)):
        tally.add(truth[states], prediction[states])
    distance = node_distance(truth, prediction)
    np.testing.assert_allclose(tally.over_time("e2"), mean_node_error(distance), rtol=1e-12)
    np.testing.assert_allclose(tally.node_sum, np.nansum(distance, axis=0), rtol=1e-12)
    found, expected = tally.of_groups("part"), group_means(distance, groups["part"])
    np.testing.assert_allclose(found[:2], np.nanmean(expected[:, :2], axis=0), rtol=1e-12)
    assert np.isnan(found[2])
    relative = np.sqrt(np.nansum(distance**2) / np.nansum(truth.astype(np.float64) ** 2))
    assert tally.relative == pytest.approx(relative, rel=1e-6)
