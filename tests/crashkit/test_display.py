"""What summaries, hierarchies and evaluations say of themselves, as text and in a notebook."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import sparse

import crashkit
from crashkit.mesh.levels import Hierarchy
from data_schema.levels import Level


def test_a_summary_says_what_was_ingested_and_what_was_not() -> None:
    summary = crashkit.IngestSummary(
        Path("kart.zarr"),
        ("a", "b", "<c>"),
        added=("b", "<c>"),
        unchanged=("a",),
        skipped={"d": "is cut short"},
        nodes=5,
        states=2,
    )
    text, page = repr(summary), summary._repr_html_()
    assert [line.split() for line in text.splitlines()] == [
        ["ingested", "into", "kart.zarr"],
        ["runs", "3"],
        ["added", "2:", "b,", "<c>"],
        ["unchanged", "1:", "a"],
        ["skipped", "d", "is", "cut", "short"],
        ["nodes", "5"],
        ["states", "2"],
    ]
    assert "&lt;c&gt;" in page
    assert "<c>" not in page


def test_a_hierarchy_says_its_levels() -> None:
    up = sparse.csr_matrix(np.full((4, 2), 0.5))
    level = Level(
        1, np.array([0, 2]), np.empty((0, 3), np.int32), np.array([[0, 1]], np.int32), np.array([0, 2]), up, up,
        distance=np.array([0.0, 0.004, 0.0, 0.004]),
    )  # fmt: skip
    text = repr(Hierarchy(4, (level,), {}))
    assert [line.split() for line in text.splitlines()[2:]] == [["0", "4"], ["1", "2", "0", "1", "2.00"]]
    assert "<td>2.00</td>" in Hierarchy(4, (level,), {})._repr_html_()
