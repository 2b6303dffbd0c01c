"""What must hold on any surface, however bad: hypothesis looks for one where it does not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mesh_shapes import random_surface

from crashkit.mesh.hierarchy import build_hierarchy
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.surface import Surface, surface

seeds = st.integers(0, 2**32 - 1)
shares = st.lists(st.floats(0.08, 0.9), min_size=1, max_size=3)
quick = settings(max_examples=40, deadline=None, derandomize=True)


def coarsened(seed: int, shares: list[float], n_parts: int = 1) -> tuple[Surface, Hierarchy]:
    """A random surface and its hierarchy with those shares of its nodes, each of the level before."""
    position, faces, part = random_surface(seed, n_parts)
    mesh = surface(position, faces, part)
    counts = [int(c) for c in np.cumprod(shares) * mesh.used.sum()]
    assume(counts[-1] >= 1 + 2 * (n_parts > 1) * n_parts)
    assume(all(a > b for a, b in pairwise(counts)))
    return mesh, build_hierarchy(position, faces, counts, face_part=part)


@quick
@given(seed=seeds, shares=shares, n_parts=st.integers(1, 3))
def test_levels_are_nested_subsets_of_exact_size(seed: int, shares: list[float], n_parts: int) -> None:
    mesh, hierarchy = coarsened(seed, shares, n_parts)
    finer = np.flatnonzero(mesh.used)
    for level, count in zip(hierarchy.levels, hierarchy.settings["counts"], strict=True):
        assert level.n_nodes == count == len(np.unique(level.kept))
        assert np.isin(level.kept, finer).all()
        finer = level.kept


@quick
@given(seed=seeds, shares=shares, n_parts=st.integers(1, 3))
def test_maps_are_convex_combinations_and_the_identity_on_kept_nodes(
    seed: int, shares: list[float], n_parts: int
) -> None:
    _, hierarchy = coarsened(seed, shares, n_parts)
    for level in hierarchy.levels:
        for u, same in ((level.to_full, level.kept), (level.to_finer, level.in_finer)):
            assert np.isfinite(u.data).all()
            assert (u.data >= 0).all()
            assert np.abs(u.sum(axis=1) - 1).max() <= 4 * np.finfo(float).eps
            assert (u[same] != np.eye(level.n_nodes)).sum() == 0


@quick
@given(seed=seeds, shares=shares, shift=st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_rigid_translations_come_back(seed: int, shares: list[float], shift: tuple[float, float, float]) -> None:
    mesh, hierarchy = coarsened(seed, shares)
    u = np.broadcast_to(shift, (mesh.n_nodes, 3))
    for level in hierarchy.levels:
        assert np.abs(level.to_full @ u[level.kept] - u).max() <= 4 * np.finfo(float).eps * np.abs(u).max()


@quick
@given(seed=seeds, shares=shares, n_parts=st.integers(1, 2))
def test_affine_fields_come_back_within_gradient_times_distance(seed: int, shares: list[float], n_parts: int) -> None:
    mesh, hierarchy = coarsened(seed, shares, n_parts)
    gradient = np.random.default_rng(seed).normal(size=(3, 3))
    u = mesh.position @ gradient.T + 1.0
    for level in hierarchy.levels:
        error = np.linalg.norm(level.to_full @ u[level.kept] - u, axis=1)
        assert (error <= np.linalg.norm(gradient, 2) * level.distance + 1e-12).all()


@quick
@given(seed=seeds, shares=shares)
def test_quadratic_fields_come_back_within_the_bound_of_second_order(seed: int, shares: list[float]) -> None:
    mesh, hierarchy = coarsened(seed, shares)
    hessian = np.random.default_rng(seed).normal(size=(3, 3))
    hessian = hessian + hessian.T
    x = mesh.position
    u = 0.5 * np.einsum("ni,ij,nj->n", x, hessian, x)
    for level in hierarchy.levels:
        closest = level.to_full @ x[level.kept]
        row = np.repeat(np.arange(mesh.n_nodes), np.diff(level.to_full.indptr))
        reach2 = level.to_full.data * np.sum((x[level.kept][level.to_full.indices] - closest[row]) ** 2, axis=1)
        spread = np.bincount(row, reach2, minlength=mesh.n_nodes)
        # |grad u| is convex, so along the way from the node to its closest point the ends are the largest.
        slope = np.maximum(np.linalg.norm(x @ hessian, axis=1), np.linalg.norm(closest @ hessian, axis=1))
        bound = slope * level.distance + 0.5 * np.linalg.norm(hessian, 2) * spread
        assert (np.abs(level.to_full @ u[level.kept] - u) <= bound + 1e-12).all()


@quick
@given(seed=seeds, shares=shares, n_parts=st.integers(1, 3))
def test_the_numbering_of_nodes_does_not_matter_up_to_ties(seed: int, shares: list[float], n_parts: int) -> None:
    position, faces, part = random_surface(seed, n_parts, twins=False)
    counts = [max(2 * n_parts, int(surface(position, faces).used.sum() * shares[0]))]
    rng = np.random.default_rng(seed)
    order, shuffle = rng.permutation(len(position)), rng.permutation(len(faces))
    renumbered = np.append(np.argsort(order), -1)[faces][shuffle]
    one = build_hierarchy(position, faces, counts, face_part=part)[1]
    other = build_hierarchy(position[order], renumbered, counts, face_part=part[shuffle])[1]
    assert (one.kept == np.sort(order[other.kept])).all()


@quick
@given(seed=seeds, shares=shares)
def test_the_graph_of_a_level_joins_its_nodes_and_has_no_loops(seed: int, shares: list[float]) -> None:
    _, hierarchy = coarsened(seed, shares)
    for level in hierarchy.levels:
        a = level.adjacency
        assert (a != a.T).nnz == 0
        assert a.diagonal().sum() == 0
        sides = np.sort(level.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        assert (a.toarray()[sides[:, 0], sides[:, 1]] == 1).all()
