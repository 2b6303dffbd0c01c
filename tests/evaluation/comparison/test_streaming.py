"""Runs over workers: the order and the result stay."""

from __future__ import annotations

import functools
import operator

import pytest

from evaluation.comparison.streaming import over_runs
from evaluation.errors import EvaluationError

double = functools.partial(operator.mul, 2)


def test_results_come_in_the_order_of_the_runs():
    seen = []
    assert over_runs(double, [5, 3, 4], done=seen.append) == [10, 6, 8]
    assert seen == [5, 3, 4]


def test_workers_give_the_same_in_the_same_order():
    seen = []
    assert over_runs(double, [5, 3, 4], workers=2, done=seen.append) == [10, 6, 8]
    assert sorted(seen) == [3, 4, 5]


def test_a_scheduler_out_of_reach_is_an_error_that_says_what_to_do():
    with pytest.raises(EvaluationError, match="no Dask scheduler answers at tcp://"):
        over_runs(double, [1, 2], scheduler="tcp://127.0.0.1:1", patience=0.5)


def test_a_scheduler_does_the_work():
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, processes=False, dashboard_address="127.0.0.1:0") as cluster:
        assert over_runs(double, [1, 2], scheduler=cluster.scheduler_address) == [2, 4]


def test_no_worker_is_an_error():
    with pytest.raises(EvaluationError, match="0 workers"):
        over_runs(double, [1], workers=0)


def test_without_dask_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(EvaluationError, match=r"install crashkit\[distributed\]"):
        over_runs(double, [1, 2], workers=2)
