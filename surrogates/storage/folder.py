"""A surrogate as a folder: weights, settings, scaling, ranges, the hierarchy it needs, its history and its card.

    model.json             what it is; SHA-256 of every other file, and of itself
    level_3.safetensors .. weights of each level (pod.safetensors for POD regressions); where the model is the mean of
                           several trainings, seed_0.level_3.safetensors .. of each
    graphs.safetensors     the levels' graphs and maps, and the full mesh, so that it lifts and draws without the data
    elements.safetensors   what is said of elements: their removal, plastic strain and the like; where there is any
    coarse.safetensors     what coarse runs add to a POD regression, or the mesh of those beneath a cascade, where there are any
    bands.safetensors      how far predictions may be wrong, from the validation runs
    curves.safetensors     time histories, where they were learnt
    history.json           losses by epoch and level
    card.md                for people

Nothing in it is executed when it is loaded. It is written beside its place and moved there when it is complete.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file
from scipy import sparse

from data_schema.levels import Level
from data_schema.replace import beside
from surrogates.data.campaign import Labels
from surrogates.data.graphs import Graphs
from surrogates.errors import ModelFolderError, SurrogateError
from surrogates.local_errors import LocalErrors
from surrogates.models.coarse_base import CoarseBase, CoarseMesh
from surrogates.models.curves import Curve
from surrogates.models.element_field import ElementField
from surrogates.models.pod_regression import PodRegression
from surrogates.models.removal import Removal, Score
from surrogates.physics.registration import Registration
from surrogates.record import Record, ranges_as_dict, ranges_from_dict, record_as_dict, record_from_dict
from surrogates.settings import Settings, parse
from surrogates.storage.card import card
from surrogates.storage.checks import (
    check_bands,
    check_base,
    check_coarse_mesh,
    check_core,
    check_curves,
    check_elements,
    check_graphs,
    check_labels,
    check_record,
    plain_files,
)
from surrogates.storage.presence import MAIN as MAIN
from surrogates.storage.presence import require_model_folder
from surrogates.surrogate import Surrogate
from surrogates.uncertainty import Band, Spread

if TYPE_CHECKING:
    from surrogates.data.scaling import InputScaling
    from surrogates.models.base import Network

FORMAT = 2
_ELEMENTS = "elements.safetensors"
_SPREADS: tuple[Spread, ...] = ("constant", "size", "deviation", "local")
_CURVES = "curves.safetensors"
_COARSE = "coarse.safetensors"
_OF_RUNS = ("run", "run_full")
_LABELS = ("node_id", "face_part", "part_id", "face_id")


def save(surrogate: Surrogate, folder: str | Path, *, overwrite: bool = False) -> Path:
    """Write `surrogate` as `folder`; with `overwrite` an older model there is replaced once the new one is complete.

    Raises
    ------
    ModelFolderError
        If something is there already or the place cannot be written.
    """
    folder = Path(folder)
    refuse_other(folder, overwrite)
    try:
        with beside(folder, durable=True) as new:
            new.mkdir()
            _write(surrogate, new)
    except OSError as error:
        raise ModelFolderError(
            f"{folder}: cannot be written ({error.strerror or error}); check permissions and free space"
        ) from error
    return folder


def refuse_other(folder: Path, overwrite: bool) -> None:
    """Raise ModelFolderError if saving to `folder` would destroy something: anything but a model to be replaced."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir()) and not (folder / MAIN).exists()):
        raise ModelFolderError(f"{folder}: is there already and is no model folder; choose another name")
    if (folder / MAIN).exists() and not overwrite:
        raise ModelFolderError(f"{folder}: holds a model already; choose another name, or overwrite it")


def load(folder: str | Path) -> Surrogate:
    """The surrogate in `folder`; needs nothing else.

    Raises
    ------
    ModelFolderError
        Naming the file that is missing, was altered, or does not fit.
    """
    folder = Path(folder)
    about, files = checked_about(folder)
    try:
        settings = parse(about["settings"], f"{folder / MAIN}: settings")
        histories = json.loads((folder / "history.json").read_text(encoding="utf-8"))
        record = record_from_dict(about["record"], {int(k): v for k, v in histories.items()})
        stored = load_file(folder / "graphs.safetensors")
        graphs, points, faces = _graphs(stored)
        check_record(record)
        check_graphs(graphs, points, faces)
        of_coarse = load_file(folder / _COARSE) if _COARSE in files else {}
        base = CoarseBase.load(of_coarse) if "slopes" in of_coarse else None
        check_base(base, graphs)
        mesh_below = CoarseMesh.load(of_coarse) if of_coarse and base is None else None
        if mesh_below is not None:
            check_coarse_mesh(mesh_below, graphs)
        core = _core(folder, about, settings, record, graphs, base)
        registration = Registration.from_dict(about["registration"])
        stored_bands = load_file(folder / "bands.safetensors")
        bands = _bands({k: v for k, v in stored_bands.items() if k.split(".")[1] not in _OF_RUNS}, record)
        of_runs = _bands({k: v for k, v in stored_bands.items() if k.split(".")[1] in _OF_RUNS}, record)
        check_bands(of_runs, graphs, record)
        labels = _labels(stored, about)
        check_bands(bands, graphs, record)
        curves = _curves(load_file(folder / _CURVES) if _CURVES in files else {}, about.get("curves", {}))
        check_curves(curves)
        check_labels(labels, graphs.n_full, 0 if faces is None else len(faces))
        check_core(core, graphs)
        tensors = load_file(folder / _ELEMENTS) if _ELEMENTS in files else {}
        elements = _elements(tensors, about.get("elements", {}))
        check_elements(*elements, 0 if faces is None else len(faces), len(registration.grid))
        surrogate = Surrogate(settings, record, graphs, core, points, faces, registration)
        for number in core.numbers:  # asked once: sizes that do not fit show here
            surrogate.predict((record.ranges.low + record.ranges.high) / 2, record.time[:1], number)
    except ModelFolderError:
        raise
    except Exception as error:  # what a folder of somebody else makes the libraries raise is theirs to choose
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise ModelFolderError(f"{folder}: does not hold together ({said}); train it again") from error
    surrogate.bands = bands
    surrogate.run_bands, surrogate.mesh_below = of_runs, mesh_below
    surrogate.labels = labels
    surrogate.removal, surrogate.fields = elements
    surrogate.curves = curves
    return surrogate


def checked_about(folder: Path) -> tuple[dict[str, Any], Mapping[str, str]]:
    """What the model in `folder` says of itself, and its files, each of which is there as it was written.

    Raises
    ------
    ModelFolderError
        Naming the file that is missing or was altered.
    """
    about = _about(folder)
    try:
        files = plain_files(about.get("files"))
    except SurrogateError as error:
        raise ModelFolderError(f"{folder / MAIN}: {error}; copy the model folder again") from error
    for name, digest in files.items():
        path = folder / name
        if not path.is_file():
            raise ModelFolderError(f"{path}: is missing; copy the whole model folder again")
        if _sha256_of(path) != digest:
            raise ModelFolderError(f"{path}: was altered after training; copy the model folder again, or train anew")
    return about, files


def _write(surrogate: Surrogate, folder: Path) -> None:
    record, core = surrogate.record, surrogate.core
    if isinstance(core, PodRegression):
        save_file(core.arrays(), folder / "pod.safetensors")
        if core.base is not None:
            save_file(_contiguous(core.base.arrays()), folder / _COARSE)
    else:
        from safetensors.torch import save_file as save_tensors

        for stem, tensors in core.tensors().items():
            save_tensors({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, folder / f"{stem}.safetensors")
        if surrogate.coarse_mesh is not None:
            save_file(_contiguous(surrogate.coarse_mesh.arrays()), folder / _COARSE)
    save_file(_graph_arrays(surrogate), folder / "graphs.safetensors")
    save_file(_band_arrays(surrogate), folder / "bands.safetensors")
    if surrogate.removal is not None or surrogate.fields:
        save_file(_element_arrays(surrogate), folder / _ELEMENTS)
    if surrogate.curves:
        arrays = {f"{name}/{k}": v for name, curve in surrogate.curves.items() for k, v in curve.arrays().items()}
        save_file({k: np.array(v, order="C") for k, v in arrays.items()}, folder / _CURVES)
    histories = {str(k): {n: _plain(v) for n, v in f.history.items()} for k, f in record.fits.items()}
    (folder / "history.json").write_text(json.dumps(histories), encoding="utf-8")
    (folder / "card.md").write_text(card(surrogate), encoding="utf-8")
    for path in folder.iterdir():  # safetensors writes for the owner alone
        path.chmod(0o644)
    about: dict[str, Any] = {
        "format": FORMAT,
        "settings": surrogate.settings.as_dict(),
        "record": _plain(record_as_dict(record)),
        "inputs": _plain(ranges_as_dict(record.ranges if isinstance(core, PodRegression) else core.inputs.ranges)),
        "registration": _plain(surrogate.registration.as_dict()),
        "levels": [
            {"number": k, "name": name, "nodes": surrogate.graphs.n_nodes(k), **_of_level(core, k)}
            | {
                "latent": surrogate.n_latent(k),
                "parameters": surrogate.n_parameters(k),
                "band": surrogate.has_band(k),
            }
            for name, k in surrogate.level_names.items()
        ],
        "nodes": surrogate.graphs.n_nodes(0),
        **_about_members(core),
        "curves": _plain({name: curve.told() for name, curve in surrogate.curves.items()}),
        "parts": [] if surrogate.labels is None else list(surrogate.labels.part_name),
        "elements": _plain(_about_elements(surrogate)),
        "files": {path.name: _sha256_of(path) for path in sorted(folder.iterdir())},
    }
    about["sha256"] = _sha256(_canonical(about))
    (folder / MAIN).write_text(json.dumps(about, indent=1), encoding="utf-8")


def _about(folder: Path) -> dict[str, Any]:
    require_model_folder(folder)
    path = folder / MAIN
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ModelFolderError(f"{path}: is no JSON ({error}); copy the model folder again") from error
    if not isinstance(about, dict) or "format" not in about:
        raise ModelFolderError(f"{path}: is no model description; expected a model folder made by crashkit train")
    if about["format"] != FORMAT:
        raise ModelFolderError(
            f"{path}: has format {about['format']}, this crashkit reads {FORMAT}; use the crashkit that wrote it ({_writer(about)})"
        )
    digest = about.pop("sha256", None)
    if digest != _sha256(_canonical(about)):
        raise ModelFolderError(f"{path}: was altered after training; copy the model folder again, or train anew")
    return about


def _core(
    folder: Path, about: Mapping[str, Any], settings: Settings, record: Record, graphs: Graphs, base: CoarseBase | None
) -> Network | PodRegression:
    if settings.model in ("pod-gpr", "pod-rbf"):
        return PodRegression.load(load_file(folder / "pod.safetensors"), settings.model, record.choice["inputs"], base)
    from surrogates.data.scaling import InputScaling
    from surrogates.models.average import Average

    ranges = ranges_from_dict(about["inputs"])
    scaling = InputScaling(ranges, products=settings.inputs.products, angles=settings.inputs.angles)
    told = about.get("members")
    if told is None:
        return _network(folder, "", about["levels"], settings, graphs, scaling)
    members = [_network(folder, f"seed_{m['seed']}.", m["levels"], settings, graphs, scaling) for m in told]
    return Average(members, [int(m["seed"]) for m in told], float(about["floor"]))


def _network(
    folder: Path, prefix: str, entries: Sequence[Mapping[str, Any]], settings: Settings, graphs: Graphs, scaling: InputScaling
) -> Network:  # fmt: skip
    """A network whose levels are `entries`, with the weights in files that begin with `prefix`."""
    from safetensors.torch import load_file as load_tensors

    from surrogates.models.base import take_over
    from surrogates.models.cascade import Cascade, build_level
    from surrogates.models.unified import Unified

    if settings.unified:
        network = Unified(scaling, settings, graphs, tuple(entry["number"] for entry in entries))
        network.scale = float(entries[0]["scale"])
        take_over(network.state_dict(), load_tensors(folder / f"{prefix}levels.safetensors"))
        return network
    cascade = Cascade(scaling)
    for entry in entries:
        level = build_level(entry["number"], settings, graphs, cascade)
        level.scale = float(entry["scale"])
        level.at_rest = bool(entry["at_rest"])
        level.load_own_state(load_tensors(folder / f"{prefix}level_{entry['number']}.safetensors"))
        level.settle()
        cascade.add(entry["number"], level)
    return cascade


def _about_members(core: Network | PodRegression) -> dict[str, Any]:
    """Seed and levels of each training that a model is the mean of; nothing for a single one."""
    if isinstance(core, PodRegression):
        return {}
    from surrogates.models.average import Average

    if not isinstance(core, Average):
        return {}
    members = [
        {"seed": seed, "levels": [{"number": k, **_of_level(member, k)} for k in member.numbers]}
        for seed, member in zip(core.seeds, core.networks, strict=True)
    ]
    return {"members": members, "floor": core.floor}


def _of_level(core: Network | PodRegression, number: int) -> dict[str, Any]:
    """The unit of a level's states, and whether it rests at zero."""
    if isinstance(core, PodRegression):
        return {"scale": 1.0, "at_rest": False}
    from surrogates.models.cascade import Cascade

    return {"scale": core.scales[number], "at_rest": isinstance(core, Cascade) and core.levels[number].at_rest}


def _graph_arrays(surrogate: Surrogate) -> dict[str, NDArray[Any]]:
    graphs = surrogate.graphs
    arrays: dict[str, NDArray[Any]] = {"nodes": np.array([graphs.n_full])}
    if surrogate.points is not None and surrogate.faces is not None:
        arrays |= {"points": np.asarray(surrogate.points, np.float64), "faces": np.asarray(surrogate.faces, np.int32)}
    if surrogate.labels is not None:
        arrays |= {
            name: np.asarray(a, np.int64) for name in _LABELS if (a := getattr(surrogate.labels, name)) is not None
        }
    numbers = surrogate.core.numbers
    if 0 in numbers and not isinstance(surrogate.core, PodRegression) and graphs.full_edges is not None:
        arrays["edges"] = graphs.full_edges
    for level in graphs.levels[: max(numbers, default=0)]:
        prefix = f"level_{level.index}."
        for name in ("kept", "faces", "edges", "in_finer"):
            arrays[prefix + name] = getattr(level, name)
        for name in ("to_finer", "to_full"):
            matrix = sparse.csr_matrix(getattr(level, name))
            arrays[f"{prefix}{name}.data"] = matrix.data.astype(np.float64)
            arrays[f"{prefix}{name}.indices"] = matrix.indices.astype(np.int32)
            arrays[f"{prefix}{name}.indptr"] = matrix.indptr.astype(np.int64)
    return {k: np.ascontiguousarray(v) for k, v in arrays.items()}


def _graphs(a: Mapping[str, NDArray[Any]]) -> tuple[Graphs, NDArray[np.float64] | None, NDArray[np.int32] | None]:
    n_full = int(a["nodes"][0])
    levels: list[Level] = []
    finer = n_full
    while f"level_{len(levels) + 1}.kept" in a:
        prefix = f"level_{len(levels) + 1}."
        kept = a[prefix + "kept"]

        def csr(name: str, rows: int, columns: int, prefix: str = prefix) -> sparse.csr_matrix:
            parts = tuple(a[f"{prefix}{name}.{p}"] for p in ("data", "indices", "indptr"))
            return sparse.csr_matrix(parts, shape=(rows, columns))

        levels.append(
            Level(
                len(levels) + 1, kept, a[prefix + "faces"], a[prefix + "edges"], a[prefix + "in_finer"],
                csr("to_finer", finer, len(kept)), csr("to_full", n_full, len(kept)),
            )
        )  # fmt: skip
        finer = len(kept)
    return Graphs(n_full, tuple(levels), a.get("edges")), a.get("points"), a.get("faces")


def _labels(stored: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> Labels | None:
    if "node_id" not in stored:
        return None
    arrays = {name: stored[name] for name in _LABELS if name in stored}
    return Labels(**arrays, part_name=tuple(map(str, about["parts"])))


def _curves(stored: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> dict[str, Curve]:
    out = {}
    for name, told in about.items():
        arrays = {k.removeprefix(f"{name}/"): v for k, v in stored.items() if k.startswith(f"{name}/")}
        known = {**told, "errors": {k: float("nan") if v is None else v for k, v in told["errors"].items()}}
        out[str(name)] = Curve.load(str(name), known, arrays)
    return out


def _band_arrays(surrogate: Surrogate) -> dict[str, NDArray[Any]]:
    out: dict[str, NDArray[Any]] = {}
    bands = {f"{number}.{'full' if lifted else 'own'}.": band for (number, lifted), band in surrogate.bands.items()}
    bands |= {f"{number}.{_OF_RUNS[lifted]}.": band for (number, lifted), band in surrogate.run_bands.items()}
    for prefix, band in bands.items():
        arrays: dict[str, NDArray[Any]] = {"node": band.node, "state": band.state, "factor": band.factor}
        if band.local is not None:
            arrays |= {"points": band.local.points, "ratio": band.local.ratio, "run": band.local.run}
            arrays["width"] = np.array([band.local.width])
        out |= {prefix + k: np.ascontiguousarray(v) for k, v in arrays.items()}
        out[prefix + "runs"] = np.array([band.runs])
        out[prefix + "spread"] = np.array([_SPREADS.index(band.spread)])
        out[prefix + "unit"] = np.array([band.unit])
    return out


def _bands(stored: Mapping[str, NDArray[Any]], record: Record) -> dict[tuple[int, bool], Band]:
    out = {}
    for key in stored:
        number, where, name = key.split(".")
        if name == "runs":
            parts = {n: stored[f"{number}.{where}.{n}"] for n in ("node", "state", "factor")}
            spread = _SPREADS[int(stored[f"{number}.{where}.spread"][0])]
            unit = float(stored[f"{number}.{where}.unit"][0])
            runs = int(stored[key][0])
            local = None
            if spread == "local":
                a = {n: stored[f"{number}.{where}.{n}"] for n in ("points", "ratio", "run", "width")}
                local = LocalErrors(a["points"], a["ratio"], a["run"], float(a["width"][0]))
            out[int(number), where.endswith("full")] = Band(
                **parts, time=record.time, runs=runs, spread=spread, unit=unit, local=local
            )
    return out


def _element_arrays(surrogate: Surrogate) -> dict[str, NDArray[Any]]:
    out = {} if surrogate.removal is None else {f"removal/{k}": v for k, v in surrogate.removal.arrays().items()}
    for name, known in surrogate.fields.items():
        out |= {f"field/{name}/{k}": v for k, v in known.arrays().items()}
    return {k: np.ascontiguousarray(v) for k, v in out.items()}


def _about_elements(surrogate: Surrogate) -> dict[str, Any]:
    removal = surrogate.removal
    return {
        "removal": None
        if removal is None
        else {"terms": list(removal.terms), "scores": {k: asdict(v) for k, v in removal.scores.items()}},
        "fields": {name: {"unit": f.unit, "errors": f.errors} for name, f in surrogate.fields.items()},
    }


def _elements(
    arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]
) -> tuple[Removal | None, dict[str, ElementField]]:
    def under(prefix: str) -> dict[str, NDArray[Any]]:
        return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}

    told = about.get("removal")
    removal = None
    if told is not None:
        scores = {
            str(k): Score(*(float("nan") if v[n] is None else float(v[n]) for n in ("precision", "recall", "loss")))
            for k, v in told["scores"].items()
        }
        removal = Removal.load(under("removal/"), [str(t) for t in told["terms"]], scores)
    fields = {
        str(name): ElementField.load(under(f"field/{name}/"), str(name), str(known["unit"]), known["errors"])
        for name, known in about.get("fields", {}).items()
    }
    return removal, fields


def _contiguous(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: np.ascontiguousarray(values) for name, values in arrays.items()}


def _plain(value: Any) -> Any:
    """Values JSON has: no numpy, and null for what is not finite."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _canonical(about: Mapping[str, Any]) -> bytes:
    return json.dumps(about, sort_keys=True).encode()


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _sha256_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _writer(about: Mapping[str, Any]) -> str:
    try:
        return f"crashkit {about['record']['versions']['crashkit']}"
    except (KeyError, TypeError):
        return "unknown version"
