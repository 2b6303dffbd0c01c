"""How good a run is: from its curves, from what its solver printed, and what ingest makes of it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import crashkit
from crashkit.cli import app
from crashkit.errors import CrashkitError
from crashkit.quality import LIMITS, Quality, look, measured
from crashkit.readers.history import Channel, History

DATA = Path(__file__).parents[1] / "data"


def curves(**values: list[float]) -> History:
    """Three samples of each curve."""
    return History(
        np.arange(3.0), tuple(Channel(name, "energy") for name in values), np.array(list(values.values()), float).T
    )


def test_work_done_from_outside_and_the_energy_of_contacts_belong_to_the_balance() -> None:
    energies: dict[str, Any] = {"internal_energy": [0.0, 30.0, 60.0], "kinetic_energy": [100.0, 60.0, 20.0]}
    assert measured(curves(**energies)).energy_error == pytest.approx(20.0)
    energies["contact_energy"] = [0.0, 5.0, 10.0]
    assert measured(curves(**energies)).energy_error == pytest.approx(10.0)
    energies["external_work"] = [0.0, -5.0, -10.0]
    assert measured(curves(**energies)).energy_error == pytest.approx(0.0, abs=1e-9)


def test_the_solvers_own_ratio_goes_before() -> None:
    found = measured(
        curves(
            glstat_internal_energy=[0.0, 1.0, 2.0], glstat_kinetic_energy=[9.0, 1.0, 1.0],
            glstat_energy_ratio=[1.0, 1.04, 0.97], glstat_percent_increase=[0.5, 1.0, 2.5],
        )
    )  # fmt: skip
    assert found.energy_error == pytest.approx(4.0)
    assert found.mass_added == pytest.approx(2.5)


def test_hourglass_energy_is_that_of_the_parts_where_the_whole_is_left_at_zero() -> None:
    found = measured(
        curves(
            internal_energy=[0.0, 50.0, 100.0], hourglass_energy=[0.0, 0.0, 0.0],
            beam_hourglass_energy=[0.0, 1.0, 4.0], rail_hourglass_energy=[0.0, 1.0, 8.0],
        )
    )  # fmt: skip
    assert found.hourglass_share == pytest.approx(12.0)
    assert found.energy_error is None
    assert [told.split(" 12")[0] for told in found.beyond()] == ["hourglass energy over internal energy"]


def test_a_real_history_closes() -> None:
    from crashkit.readers._radioss_history import read_history

    found = measured(read_history(DATA / "histories" / "bumperT01"))
    assert found.energy_error is not None
    assert found.energy_error < 0.1
    assert found.mass_added == pytest.approx(6.38, abs=0.2)
    assert not found.beyond()


def test_nothing_is_said_where_nothing_is_known() -> None:
    assert measured(None) == Quality()
    assert measured(curves(force=[1.0, 2.0, 3.0])) == Quality()
    assert not Quality().beyond()


def test_energies_that_are_all_zero_are_those_of_a_run_in_which_nothing_moved() -> None:
    still = measured(curves(internal_energy=[0.0] * 3, kinetic_energy=[0.0] * 3))
    assert still.still
    assert "nothing moved" in still.beyond()[0]


@pytest.mark.parametrize(("limit", "beyond"), [(10.0, 1), (12.0, 0), (None, 0)])
def test_a_limit_may_be_moved_or_lifted(limit: float | None, beyond: int) -> None:
    assert len(Quality(mass_added=11.0).beyond({**LIMITS, "mass_added": limit})) == beyond


def test_a_value_that_is_no_number_is_beyond_every_limit() -> None:
    assert Quality(energy_error=float("nan")).beyond()


def test_what_ls_dyna_prints_is_read(tmp_path: Path) -> None:
    (tmp_path / "messag").write_text(
        " total energy / initial energy..   1.08000E+00\n\n N o r m a l    t e r m i n a t i o n \n"
    )
    found = look(tmp_path)
    assert found.ended is True
    assert found.energy_error == pytest.approx(8.0)
    (tmp_path / "messag").write_text(" E r r o r    t e r m i n a t i o n \n")
    assert look(tmp_path).beyond() == ["the solver did not end normally"]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two OpenRadioss runs; of the second there are curves, and its solver stopped with an error."""
    for name in ("one", "two"):
        shutil.copytree(DATA / "radioss" / "run_b", tmp_path / "runs" / name)
    shutil.copy(DATA / "histories" / "bumperT01", tmp_path / "runs" / "two" / "kartT01")
    (tmp_path / "runs" / "two" / "kart_0001.out").write_text("     ERROR TERMINATION\n")
    return tmp_path / "runs"


def test_a_run_beyond_a_limit_is_marked_and_its_numbers_are_kept(runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.zarr"
    summary = crashkit.ingest(runs / "two", out, allow_incomplete=True, limits={"mass_added": 1.0})
    assert summary.marked["two"].startswith("the solver did not end normally; added mass 6.")
    crashkit.ingest(runs / "one", out, allow_incomplete=True)
    data = crashkit.open_dataset(out, chunks=None)
    assert data["quality_note"].values.tolist() == [summary.marked["two"], ""]
    assert float(data["mass_added"].sel(sim="two")) == pytest.approx(6.4, abs=0.2)
    assert np.isnan(data["energy_error"].sel(sim="one"))
    assert all("incomplete" in problem.found for problem in crashkit.validate(data))


def test_a_run_beyond_a_limit_is_refused_where_that_is_asked_for(runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.zarr"
    with pytest.raises(CrashkitError, match=r"run two: the solver did not end normally; leave such runs out with"):
        crashkit.ingest(runs, out, allow_incomplete=True, quality="refuse")
    assert not out.exists()
    summary = crashkit.ingest(runs, out, allow_incomplete=True, quality="refuse", on_error="skip")
    assert summary.resumed == 2
    assert summary.runs == ("one",)
    assert summary.skipped == {"two": "the solver did not end normally"}


def test_the_command_takes_limits_and_info_names_marked_runs(runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.zarr"
    arguments = ["ingest", str(runs), "-o", str(out), "--allow-incomplete"]
    told = CliRunner().invoke(app, [*arguments, "--limit", "mass_added=5%", "--limit", "energy_error=none"])
    assert told.exit_code == 0, told.output
    assert "marked two: the solver did not end normally; added mass 6." in told.output
    shown = CliRunner().invoke(app, ["info", str(out)])
    assert "two (the solver did not end normally; added mass" in " ".join(shown.output.split())


@pytest.mark.parametrize("limit", ["mass_added", "mass_added=much", "weight=5", "mass_added=-1"])
def test_a_limit_that_is_none_is_refused(runs: Path, tmp_path: Path, limit: str) -> None:
    told = CliRunner().invoke(app, ["ingest", str(runs), "-o", str(tmp_path / "out.zarr"), "--limit", limit])
    assert told.exit_code != 0
    assert "limit" in str(told.output) + str(told.exception)
