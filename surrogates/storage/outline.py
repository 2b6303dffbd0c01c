"""What a model folder says of itself, without its weights: to describe it, neither torch nor the model is needed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogates.errors import ModelFolderError, SurrogateError
from surrogates.record import Record, record_from_dict
from surrogates.settings import Settings, parse
from surrogates.storage.checks import check_record
from surrogates.storage.folder import MAIN, checked_about, load

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate


@dataclass(frozen=True)
class LevelOutline:
    """One level of a model: its name and number, nodes, latent numbers, parameters, and whether it has a band."""

    name: str
    number: int
    nodes: int
    latent: int
    parameters: int
    band: bool


@dataclass(frozen=True)
class Outline:
    """Settings, record, seeds, nodes of the full mesh, and levels, the coarsest first."""

    settings: Settings
    record: Record
    seeds: tuple[int, ...]
    nodes: int
    levels: tuple[LevelOutline, ...]

    @classmethod
    def of(cls, surrogate: Surrogate) -> Outline:
        """Of a model in memory."""
        levels = tuple(
            LevelOutline(
                name, number, surrogate.graphs.n_nodes(number), surrogate.n_latent(number),
                surrogate.n_parameters(number), surrogate.has_band(number),
            )
            for name, number in surrogate.level_names.items()
        )  # fmt: skip
        return cls(surrogate.settings, surrogate.record, tuple(surrogate.seeds), surrogate.graphs.n_nodes(0), levels)


def outline(folder: str | Path) -> Outline:
    """Of the model in `folder`, whose files are compared with their checksums and not loaded.

    A folder that was written before it said so much of itself is loaded.

    Raises
    ------
    ModelFolderError
        As `load`, for files that are missing or were altered, and for what is no outline.
    """
    folder = Path(folder)
    about, _ = checked_about(folder)
    if "nodes" not in about:
        return Outline.of(load(folder))
    try:
        record = record_from_dict(about["record"], _history(folder))
        check_record(record)
        members = about.get("members")
        seeds = (record.seed,) if members is None else tuple(_count(m["seed"]) for m in members)
        levels = tuple(_level(told) for told in about["levels"])
        return Outline(
            parse(about["settings"], f"{folder / MAIN}: settings"), record, seeds, _count(about["nodes"]), levels
        )
    except ModelFolderError:
        raise
    except Exception as error:  # what a folder of somebody else makes the libraries raise is theirs to choose
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise ModelFolderError(f"{folder}: does not hold together ({said}); train it again") from error


def _history(folder: Path) -> dict[int, Any]:
    """The losses of each level."""
    found = json.loads((folder / "history.json").read_text(encoding="utf-8"))
    return {int(k): v for k, v in found.items()}


def _level(told: Mapping[str, Any]) -> LevelOutline:
    counts = {name: _count(told[name]) for name in ("number", "nodes", "latent", "parameters")}
    return LevelOutline(name=str(told["name"]), band=told["band"] is True, **counts)


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise SurrogateError(f"found {value!r} where a count stands")
    return value
