"""A dataset from NumPy arrays: it keeps the rules, can be used at once, and what is wrong is named by its argument."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import crashkit
from crashkit.errors import CrashkitError


def arrays(side: int = 6, runs: int = 8) -> dict[str, Any]:
    """A plate with a dent that grows with speed and time, in mm and ms."""
    x, y = np.meshgrid(np.linspace(0, 1000, side), np.linspace(0, 1000, side), indexing="ij")
    number = np.arange(side**2).reshape(side, side)
    speed, place = np.linspace(36, 72, runs), np.random.default_rng(0).uniform(300, 700, runs)
    time = np.linspace(0, 10, 5)
    shape = np.exp(-((x.ravel() - place[:, None]) ** 2 + (y.ravel() - 500) ** 2) / 5e4)
    depth = speed[:, None, None] / 3.6 * time[None, :, None] * shape[:, None]
    return {
        "displacement": np.stack([0 * depth, 0 * depth, -depth], axis=-1),
        "time": time,
        "parameters": {"speed (km/h)": speed, "place": place},
        "position": np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1),
        "faces": np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1).reshape(-1, 4),
        "units": "mm-ms-kg",
        "parameter_units": {"place": "mm"},
    }


def test_values_are_in_si_and_the_dataset_keeps_the_rules() -> None:
    given = arrays()
    dataset = crashkit.from_arrays(**given)
    assert crashkit.validate(dataset) == []
    np.testing.assert_allclose(dataset["displacement"], given["displacement"] / 1000, atol=1e-6)
    np.testing.assert_allclose(dataset["speed"], given["parameters"]["speed (km/h)"] / 3.6)
    np.testing.assert_allclose(dataset["place"], given["parameters"]["place"] / 1000)
    assert [dataset[n].attrs["units"] for n in dataset.crash.parameters] == ["m s-1", "m"]
    assert float(dataset["time"][-1]) == pytest.approx(0.01)
    assert list(dataset["sim"].values[:2]) == ["run_00", "run_01"]


@pytest.mark.parametrize("suffix", [".zarr", ".nc"])
def test_it_is_written_as_it_is(suffix: str, tmp_path: Path) -> None:
    given = arrays(runs=3)
    faces, states = len(given["faces"]), len(given["time"])
    more = {
        "fields": {"strain": (np.full((3, states, faces), 5.0), "%"), "velocity": (given["displacement"], "mm/ms")},
        "history": {"energy": (np.ones((3, 7)), "kJ")},
        "history_time": np.arange(7.0),
        "names": ["a", "b", "c"],
        "part_names": ["plate", "rim"],
        "face_part": np.arange(faces) % 2,
        "alive": np.ones((3, states, faces), bool),
    }
    dataset = crashkit.from_arrays(**given, **more)
    written = crashkit.from_arrays(**given, **more, output=tmp_path / f"plate{suffix}")
    assert crashkit.validate(tmp_path / f"plate{suffix}") == []
    assert written.attrs["checksum"] == dataset.attrs["checksum"]
    assert sorted(map(str, written.variables)) == sorted(map(str, dataset.variables))
    assert float(written["history"][0, 0, 0]) == 1000.0
    assert written["velocity"].dims == ("sim", "time", "node", "xyz")
    assert list(written["part_name"].values) == ["plate", "rim"]
    with pytest.raises(CrashkitError, match=r"output: .* exists"):
        crashkit.from_arrays(**given, output=tmp_path / f"plate{suffix}")


def test_a_full_disk_is_told_in_one_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("crashkit.ingestion.store.zarr_from", full)
    with pytest.raises(CrashkitError, match=r"output: .*plate\.zarr cannot be written \(No space left on device\)"):
        crashkit.from_arrays(**arrays(side=3, runs=2), output=tmp_path / "plate.zarr")
    assert list(tmp_path.iterdir()) == []


def test_a_node_without_living_faces_may_be_missing() -> None:
    given = arrays(side=3, runs=2)
    alive = np.ones((2, len(given["time"]), len(given["faces"])), bool)
    alive[0, 3:, 0] = False
    given["displacement"][0, 3:, 0] = np.nan
    assert crashkit.validate(crashkit.from_arrays(**given, alive=alive)) == []
    with pytest.raises(
        CrashkitError, match=r"displacement, run run_00, state 3, node 0: found a value that is not finite"
    ):
        crashkit.from_arrays(**given)


def test_it_goes_straight_into_a_model(tmp_path: Path) -> None:
    dataset = crashkit.from_arrays(**arrays())
    model = crashkit.train(dataset, model="pod-rbf", test=2)
    truth = dataset.isel(sim=3)
    where = {name: float(truth[name]) for name in dataset.crash.parameters}
    predicted = crashkit.predict(model, where)
    assert np.abs(predicted["displacement"].values - truth["displacement"].values).max() < 0.02


def broken(name: str, change: Any) -> dict[str, Any]:
    given = arrays(side=3, runs=3)
    given[name] = change(given[name]) if callable(change) else change
    return given


def with_nan(values: np.ndarray) -> np.ndarray:
    out = values.copy()
    out.reshape(-1)[-1] = np.nan
    return out


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("displacement", lambda u: u[0], r"displacement: has shape \(5, 9, 3\); expected \(sim, time, node, 3\)"),
        ("displacement", with_nan, r"displacement, run run_02, state 4, node 8: found a value that is not finite"),
        ("displacement", lambda u: u + 1, r"displacement, run run_00, first state: .* not positions"),
        ("time", lambda t: t[::-1], r"time: 7.5 comes after 10 \(state 1\); expected increasing times"),
        ("time", lambda t: t[:-1], r"time: has shape \(4,\); expected \(5 \(time\),\)"),
        ("time", with_nan, r"time: is nan at \[4\]"),
        ("position", lambda p: p[:, :2], r"position: has shape \(9, 2\); expected \(9 \(node\), 3\)"),
        ("position", with_nan, r"position: is nan at \[8, 2\]"),
        ("faces", lambda f: f + 1, r"faces: face 3 has nodes .*; expected 0 to 8, counted from 0"),
        ("faces", lambda f: f.astype(float), r"faces: has shape \(4, 4\) and type float64"),
        ("parameters", {"speed": [1, 2], "place": [1, 2, 3]}, r"parameters, speed: has shape \(2,\); expected \(3 \(sim\),\)"),
        ("parameters", {"place": [1, 2, np.nan]}, r"parameters, place: is nan at \[2\]"),
        ("parameters", {"speed [furlongs/h]": [1, 2, 3], "place": [1, 2, 3]}, "parameters, speed: unit 'furlongs/h' is not known"),
        ("parameters", {"time": [1, 2, 3], "place": [1, 2, 3]}, "parameters: one cannot be called 'time'"),
        ("parameter_units", {"place": "parsec"}, "parameters, place: unit 'parsec' is not known"),
        ("parameter_units", {"places": "mm"}, "parameter_units: 'places' is no parameter; there are speed, place"),
        ("units", "yard-ms-kg", "units: length unit 'yard'"),
        ("names", ["a", "b"], r"names: has shape \(2,\)"),
        ("names", ["a", "b", "b"], "names: found b 2 times"),
        ("node_id", np.ones(9, int), "node_id: found 1 9 times"),
        ("face_part", [0, 0, 0, 1.5], "face_part: has type float64; expected whole numbers"),
        ("part_names", [], r"part_names: has shape \(0,\)"),
        ("alive", np.ones((3, 5, 5), bool), r"alive: has shape \(3, 5, 5\); expected \(3 \(sim\), 5 \(time\), 4 \(face\)\)"),
        ("fields", {"strain": (np.ones((3, 5, 7)), "1")}, r"fields, strain: has shape \(3, 5, 7\); expected"),
        ("history", {"energy": (np.ones((3, 6)), "J")}, r"history, energy: has shape \(3, 6\)"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line_with_the_argument(name: str, change: Any, said: str) -> None:
    given = broken(name, change) if name in arrays() else {**arrays(side=3, runs=3), name: change}
    with pytest.raises(CrashkitError, match=f"^{said}") as caught:
        crashkit.from_arrays(**given)
    assert "\n" not in str(caught.value)
