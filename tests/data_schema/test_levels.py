"""Levels of a mesh as arrays."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from data_schema.levels import lift


def test_lifting_is_a_product_with_the_map_in_every_direction():
    rng = np.random.default_rng(2)
    to_full = sparse.random(9, 4, density=0.6, random_state=0, format="csr")
    field = rng.normal(size=(3, 4, 3)).astype(np.float32)
    expected = np.einsum("nk,skd->snd", to_full.toarray(), field)
    np.testing.assert_allclose(lift(to_full, field), expected, rtol=1e-5, atol=1e-6)


def test_lifting_from_another_mesh_is_an_error():
    with pytest.raises(ValueError, match="takes 4 nodes and the field has 5"):
        lift(sparse.csr_matrix((9, 4)), np.zeros((1, 5, 3), np.float32))
