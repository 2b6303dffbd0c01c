"""A YAML file of settings: read, and checked against a pydantic model; what does not fit is one line with its place."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from crashkit.errors import DataError, ReadError

Kind = TypeVar("Kind", bound=BaseModel)


def read_yaml(path: str | Path, expected: str) -> dict[str, Any]:
    """The names and values in a YAML file.

    Parameters
    ----------
    expected
        What the file should hold, for messages: "a campaign, such as examples/campaign/frame.yaml".

    Raises
    ------
    ReadError
        Where there is no such file, or it is no YAML, with the line.
    DataError
        Where it holds something else than names with values.
    """
    import yaml

    path = Path(path)
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ReadError(f"{path}: cannot be read ({error.strerror or error}); expected {expected}") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ReadError(f"{path}: cannot be read as YAML ({' '.join(str(error).split())[:160]})") from error
    if not isinstance(found, dict):
        raise DataError(f"{path}: holds no names with values; expected {expected}")
    return found


def checked(kind: type[Kind], values: Mapping[str, Any], path: str | Path) -> Kind:
    """`values` of the file at `path` as an object of `kind`.

    Raises
    ------
    DataError
        Where a name is not known or a value does not fit: the first such place, what was found, what was expected.
    """
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise DataError(f"{path}: {_said(kind, error)}") from error


def _said(kind: type[BaseModel], error: ValidationError) -> str:
    first = error.errors()[0]
    place = ".".join(str(p) for p in first["loc"] if not str(p).startswith("function-"))
    if first["type"] == "extra_forbidden":
        known = _known(kind, first["loc"][:-1])
        near = difflib.get_close_matches(str(first["loc"][-1]), known, 1)
        return f"{place} is not known" + (f"; did you mean {near[0]}?" if near else f"; known are {', '.join(known)}")
    text = first["msg"].removeprefix("Value error, ")
    if first["type"] == "missing":
        return f"{place} is missing; the file says {', '.join(map(str, first['input'])) or 'nothing'}"
    if first["type"] in ("model_type", "model_attributes_type", "dict_type"):
        known = _known(kind, first["loc"])
        text = f"expected {{{', '.join(f'{name}: ..' for name in known)}}}" if known else "expected names with values"
    asked = first["type"] == "missing" or isinstance(first["input"], (dict, BaseModel))
    return (f"{place}: " if place else "") + text + ("" if asked else f", found {first['input']!r}")


def _known(kind: type[BaseModel], place: tuple[Any, ...]) -> list[str]:
    """The names that may stand at a place."""
    for part in place:
        field = kind.model_fields.get(str(part))
        kind = next(iter(_models(field.annotation)), kind) if field else kind
    return list(kind.model_fields)


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]
