"""Other places to compute runs: submitit's local jobs in the place of Slurm, and the workers of a Dask scheduler."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from crashkit.campaign.box import CampaignError
from crashkit.campaign.campaign import Campaign
from crashkit.campaign.executors import Dask, Executor, Slurm

EXAMPLES = Path(__file__).parents[3] / "examples" / "campaign"


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for name in ("frame_solver.py", "frame.deck"):
        shutil.copy(EXAMPLES / name, tmp_path)
    text = (EXAMPLES / "frame.yaml").read_text().replace("command: python", f"command: {sys.executable}")
    (tmp_path / "frame.yaml").write_text(text)
    return tmp_path / "frame.yaml"


@pytest.fixture
def scheduler() -> Iterator[str]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp", host="127.0.0.1"
    ) as cluster:
        yield cluster.scheduler_address


def computed(study: Path, executor: Executor) -> set[str]:
    with Campaign(study, study.parent / "out", executor) as campaign:
        campaign.add(np.array([[8.0, 40.0, 50.0]]), "start")
        campaign.compute()
        return {r.state for r in campaign.table.runs()}


def test_jobs_go_through_submitit(study: Path) -> None:
    (study.parent / "out").mkdir()
    assert computed(study, Slurm(study.parent / "out", {}, 60, cluster="local")) == {"done"}


def test_jobs_go_to_the_workers_of_a_dask_scheduler(study: Path, scheduler: str) -> None:
    distributed = pytest.importorskip("distributed")
    with Dask(scheduler) as executor:
        assert computed(study, executor) == {"done"}
        with pytest.raises(ValueError, match="No clients found"):
            distributed.default_client()


def test_a_scheduler_that_does_not_answer_is_named() -> None:
    pytest.importorskip("distributed")
    with pytest.raises(CampaignError, match=r"127\.0\.0\.1:9: no Dask scheduler answers"):
        Dask("tcp://127.0.0.1:9")
