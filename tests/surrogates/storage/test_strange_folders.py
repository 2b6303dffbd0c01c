"""Model folders of strangers, signed anew after a change: refused in one line, or harmless; never the end of the interpreter."""

from __future__ import annotations

import contextlib
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import plate
import pytest
import torch
from safetensors.torch import load_file, save_file

from surrogates.errors import ModelFolderError, SurrogateError
from surrogates.settings import settings
from surrogates.storage.folder import _canonical, _sha256, load, save
from surrogates.storage.outline import outline
from surrogates.training.train import train_surrogate


@pytest.fixture(scope="module", params=["mh", "pod-gpr"])
def stored(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    surrogate = train_surrogate(plate.campaign(8), settings(request.param, overrides=["level.epochs=1"]))
    return save(surrogate, tmp_path_factory.mktemp("stored") / "model")


def altered(stored: Path, to: Path, file: str, change: Callable[[dict[str, Any]], None]) -> Path:
    """A copy of the folder `stored` with `file` changed, and all its digests right again."""
    shutil.copytree(stored, to)
    path = to / file
    if file.endswith(".safetensors"):
        tensors = load_file(path)
        change(tensors)
        save_file({k: v.contiguous() for k, v in tensors.items()}, path)
    about = json.loads((to / "model.json").read_text())
    about.pop("sha256")
    if file == "model.json":
        change(about)
    else:
        about["files"][file] = _sha256(path.read_bytes())
    about["sha256"] = _sha256(_canonical(about))
    (to / "model.json").write_text(json.dumps(about))
    return to


def ask(folder: Path) -> None:
    surrogate = load(folder)
    middle = (surrogate.record.ranges.low + surrogate.record.ranges.high) / 2
    for number in surrogate.level_names.values():
        surrogate.predict(middle, level=number)
        surrogate.predict_full(middle, level=number)
        if surrogate.has_band(number):
            surrogate.band(0.9, level=number, full=True, parameters=middle)


def ask_or_refuse(folder: Path) -> None:
    said = ""
    try:
        ask(folder)
    except SurrogateError as error:
        said = str(error)
    assert "\n" not in said


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("faces", 10_000, "faces holds"),
        ("level_1.kept", 10_000, "kept of level 1"),
        ("level_1.kept", -1, "kept of level 1"),
        ("level_1.faces", 10_000, "faces of level 1"),
        ("level_2.in_finer", 10_000, "in_finer of level 2"),
        ("level_2.to_full.indices", 10_000, "to_full of level 2"),
        ("level_2.to_finer.indices", -5, "to_finer of level 2"),
        ("level_2.to_full.indptr", 10_000, "sparse|does not hold together"),
        ("points", float("nan"), "points"),
        ("nodes", -3, "nodes|negative"),
    ],
)
def test_an_index_or_number_out_of_range_is_named(
    stored: Path, tmp_path: Path, name: str, value: float, said: str
) -> None:
    def change(tensors: dict[str, torch.Tensor]) -> None:
        if name not in tensors:
            pytest.skip("a model of the full mesh keeps no levels")
        tensors[name].view(-1)[-1] = value

    with pytest.raises(ModelFolderError, match=said):
        load(altered(stored, tmp_path / "m", "graphs.safetensors", change))


@pytest.mark.parametrize(("name", "said"), [("factor", "factor of the band"), ("unit", "unit 0.0; expected")])
def test_a_band_that_lacks_quantiles_or_a_unit_is_refused(stored: Path, tmp_path: Path, name: str, said: str) -> None:
    def change(tensors: dict[str, torch.Tensor]) -> None:
        key = next(key for key in tensors if key.endswith(f".{name}"))
        tensors[key] = tensors[key][:-1].clone() if name == "factor" else torch.zeros_like(tensors[key])

    with pytest.raises(ModelFolderError, match=said):
        load(altered(stored, tmp_path / "m", "bands.safetensors", change))


def test_times_that_stand_still_are_refused(stored: Path, tmp_path: Path) -> None:
    if not (stored / "pod.safetensors").exists():
        pytest.skip("networks know no times")

    def change(tensors: dict[str, torch.Tensor]) -> None:
        tensors["time"] = torch.zeros_like(tensors["time"])

    with pytest.raises(ModelFolderError, match="times of the modes: not increasing"):
        load(altered(stored, tmp_path / "m", "pod.safetensors", change))


def _deep() -> Any:
    out: Any = []
    for _ in range(300):
        out = [out]
    return out


@pytest.mark.parametrize(
    "change",
    [
        lambda about: about.update(files=["model.json"]),
        lambda about: about["files"].update({"../outside": "x"}),
        lambda about: about.update(record=3),
        lambda about: about["record"].update(time=_deep()),
        lambda about: about["record"].update(left_out={"nobody": [0.1, 1.0]}),
        lambda about: about["record"].update(parameters={"impact_speed": [1.0]}),
        lambda about: about["record"]["ranges"].update(low=[1.0]),
        lambda about: about.update(levels=[{"number": 99}]),
        lambda about: about.update(settings=[]),
    ],
)
def test_a_description_of_another_kind_is_refused_in_one_line(
    stored: Path, tmp_path: Path, change: Callable[[dict[str, Any]], None]
) -> None:
    folder = altered(stored, tmp_path / "m", "model.json", change)
    ask_or_refuse(folder)
    with contextlib.suppress(ModelFolderError):  # any other error is one too many
        outline(folder)


@pytest.mark.parametrize("value", ["many", -1, 1.5, True, None])
def test_an_outline_counts_or_is_refused(stored: Path, tmp_path: Path, value: object) -> None:
    folder = altered(stored, tmp_path / "m", "model.json", lambda about: about["levels"][0].update(latent=value))
    with pytest.raises(ModelFolderError, match="where a count stands"):
        outline(folder)


def test_endless_json_is_refused(stored: Path, tmp_path: Path) -> None:
    shutil.copytree(stored, tmp_path / "m")
    (tmp_path / "m" / "model.json").write_text("[" * 100_000)
    with pytest.raises(ModelFolderError, match="is no JSON"):
        load(tmp_path / "m")


@pytest.mark.parametrize("seed", range(30))
def test_any_array_cut_stretched_or_spoiled_is_refused_or_harmless(stored: Path, tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    file = draw.choice(sorted(p.name for p in stored.glob("*.safetensors")))

    def change(tensors: dict[str, torch.Tensor]) -> None:
        if not tensors:
            return
        name = draw.choice(sorted(tensors))
        values, how = tensors[name], draw.randrange(4)
        if how == 0 and values.ndim and len(values) > 1:
            tensors[name] = values[: len(values) // 2].clone()
        elif how == 1 and values.ndim:
            tensors[name] = torch.cat([values, values])
        elif how == 2:
            del tensors[name]
        elif values.numel():
            spoiled = values.clone().view(-1)
            spoiled[draw.randrange(len(spoiled))] = np.iinfo(np.int32).max if values.dtype != torch.bool else True
            tensors[name] = spoiled.view(values.shape)

    ask_or_refuse(altered(stored, tmp_path / "m", file, change))
