"""What can be chosen: one model, checked once, stored with every surrogate.

Settings come from four places; a later one replaces an earlier one: the preset ("fast", or "paper" for exactly what the
paper does), the defaults of the model, a YAML file, and overrides such as `level.epochs=200`. Sizes that follow from the
data (nodes, inputs) are not settings.
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from surrogates.errors import SurrogateError

ModelName = Literal["mh", "podnn", "aenn", "gaenn", "pod-gpr", "pod-rbf"]
Preset = Literal["fast", "paper"]
MODELS: tuple[ModelName, ...] = ("mh", "podnn", "aenn", "gaenn", "pod-gpr", "pod-rbf")
PRESETS: tuple[Preset, ...] = ("fast", "paper")

# Names of reductions; `surrogates.reductions.reduction.register` adds to them.
REDUCTIONS = ["gcn", "ae", "pod"]

Positive = Annotated[int, Field(ge=1)]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


class MlpSettings(_Frozen):
    """The network from parameters and time to the latent vector.

    Attributes
    ----------
    widths
        Widths of the hidden layers; the output layer is linear.
    activation
        Activation function of the hidden layers.
    members
        Number of networks whose mean is taken, where the regression is chosen by folds.
    """

    widths: tuple[Positive, ...] = (64, 64, 64)
    activation: Literal["elu", "gelu", "silu", "tanh"] = "elu"
    members: Positive = 1


class LevelSettings(_Frozen):
    """One level: its reduction, its regression and how both are trained.

    Attributes
    ----------
    reduction
        `gcn`: graph convolutions and a dense layer; `ae`: fully connected autoencoder; `pod`: POD, computed and not
        trained; or the name of a registered reduction.
    convolution
        Kind of convolution of `gcn`: Chebyshev (`cheb`), first order (`gcn`) or with initial residual (`gcn2`).
    latent
        Length of the latent vector.
    channels
        Channels of `gcn` after each convolution; the input has the three coordinates.
    order
        Number of Chebyshev terms.
    hidden
        Widths of the hidden layers of `ae`, from the state to the latent vector.
    start
        `plain`: random initial weights; `pod`: sum of a POD-initialised linear autoencoder, which is trained too, and
        the reduction `gcn` or `ae`, whose output is initialised to zero.
    mlp
        The network from parameters and time to the latent vector.
    regression
        `network`: the MLP, trained with the reduction; `process`: a Gaussian process over whole runs, fitted to the
        encoded training states; `mean` of both; `auto`: the mixture that is best on runs left out. All but `network`
        train the MLP on encoded states, leaving out folds of the runs in turn. Levels that are trained together use
        the MLP.
    epochs, batch
        Passes over the training states; states per step.
    states
        Share of the training states that an epoch goes through, others each time; `auto`: a quarter on levels of more
        than 10 000 nodes, where training the coarser level so loses nothing on runs left out, else all. Where regressions
        are chosen by folds, it is that of the reduction's training.
    learning_rate, schedule, optimiser, weight_decay
        Of the training; `one_cycle` and `cosine` change the rate during the training.
    clip
        Largest norm of a gradient; 0: no limit.
    rate_inputs
        The learning rate of a layer is scaled by min(1, rate_inputs / number of its inputs); 0: off.
    patience
        Share of its epochs after which a training ends that gets no better on runs left out; 0: never.
    first_state
        `learned`, or `kept`: where all training runs start undeformed, so do predictions.
    weight_approximation, weight_reconstruction
        Weights of the two parts of the loss (section 3.3).
    """

    reduction: str = "gcn"
    convolution: Literal["cheb", "gcn", "gcn2"] = "cheb"
    latent: Positive = 4
    channels: tuple[Positive, ...] = (6, 12, 24)
    order: Positive = 3
    hidden: tuple[Positive, ...] = (200, 80)
    start: Literal["plain", "pod"] = "plain"
    mlp: MlpSettings = MlpSettings()
    regression: Literal["network", "process", "mean", "auto"] = "network"

    epochs: Positive = 1500
    batch: Positive = 32
    states: Annotated[float, Field(gt=0, le=1)] | Literal["auto"] = 1.0
    learning_rate: Annotated[float, Field(gt=0)] = 1e-3
    schedule: Literal["constant", "one_cycle", "cosine"] = "constant"
    optimiser: Literal["adamw", "adam", "sgd"] = "adamw"
    weight_decay: Annotated[float, Field(ge=0)] = 0.0
    clip: Annotated[float, Field(ge=0)] = 0.0
    rate_inputs: Annotated[int, Field(ge=0)] = 0
    patience: Annotated[float, Field(ge=0, le=1)] = 0.0
    first_state: Literal["learned", "kept"] = "learned"
    weight_approximation: Annotated[float, Field(ge=0)] = 1.0
    weight_reconstruction: Annotated[float, Field(ge=0)] = 1.0

    @field_validator("reduction")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in REDUCTIONS:
            *most, last = (f"'{name}'" for name in REDUCTIONS)
            raise ValueError(f"found {value!r}; expected {', '.join(most)} or {last}")
        return value

    @field_validator("channels")
    @classmethod
    def _some(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        if not value:
            raise ValueError("at least one convolution is needed")
        return value


class TransferSettings(_Frozen):
    """How a level uses the frozen coarser one (section 3.4).

    Attributes
    ----------
    upsampling
        `static`: the barycentric U; `sparse`: only the non-zero entries of U are trained; `linear`: all of W x + b
        (equation 12).
    encoder
        `add`: z = enc(D x) + enc*(x); `concat`: both side by side, so the latent vector grows.
    mlp
        `input`: the output of the coarse regression is a further input; `residual`: it is also added to the result.
    epochs
        Fraction of `level.epochs` used by a level that starts from a coarser one.
    lifting
        From a level to the full mesh: `static`, the barycentric U of the paper; `auto`, a map learnt from the training
        runs where runs left out show that it is better.
    """

    upsampling: Literal["static", "sparse", "linear"] = "linear"
    encoder: Literal["add", "concat"] = "add"
    mlp: Literal["input", "residual"] = "input"
    epochs: Annotated[float, Field(gt=0, le=1)] = 1.0
    lifting: Literal["auto", "static"] = "auto"


class InputSettings(_Frozen):
    """Further inputs of the regression, beside parameters and time; all are scaled to [-1, 1].

    Attributes
    ----------
    derived
        What replaces the parameters: `off` (nothing); `auto` (chosen by cross-validation among logarithms, a warped
        angle, monomials that the units allow, and a full matrix of lengths); or monomials such as
        `impact_speed**2/yield_stress`, one or a list.
    products
        Also each parameter times the time.
    angles
        Also sine and cosine of parameters in degree.
    initial_state
        Also the encoded first state of the run (z0).
    """

    derived: Literal["auto", "off"] | tuple[str, ...] = "auto"
    products: bool = False
    angles: bool = False
    initial_state: bool = False

    @field_validator("derived", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        if value is False:  # YAML reads off as false
            return "off"
        if isinstance(value, str) and value not in ("auto", "off"):
            return tuple(part.strip() for part in value.split(",") if part.strip())
        return value


class PhysicsSettings(_Frozen):
    """What is known of a crash before the first run: see `surrogates.physics`.

    Attributes
    ----------
    clock
        `auto`: scale time and displacement of the runs to a common clock and size, with exponents chosen by
        cross-validation, if a parameter is a speed; `off`: do not.
    symmetry
        `auto`: also train on mirrored runs, if the mesh has a plane of symmetry and cross-validation shows a gain;
        `off`: do not.
    odd
        Parameters that change their sign in the mirror, such as [impact_angle]; None: chosen by cross-validation.
    """

    clock: Literal["auto", "off"] = "auto"
    symmetry: Literal["auto", "off"] = "auto"
    odd: tuple[str, ...] | None = None

    @field_validator("clock", "symmetry", mode="before")
    @classmethod
    def _off(cls, value: Any) -> Any:
        return "off" if value is False else value

    @field_validator("odd", mode="before")
    @classmethod
    def _some(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value


class ValidationSettings(_Frozen):
    """How the best epoch and other choices are found; the weights of the epoch with the lowest total loss are kept.

    Attributes
    ----------
    measure
        `runs`: loss on validation runs held out of the training runs; `paper`: loss on the training runs themselves.
    share
        Fraction of the training runs held out, drawn with the seed.
    runs
        Names of the validation runs, instead of `share`.
    folds
        Number of folds of a cross-validation over training runs.
    """

    measure: Literal["runs", "paper"] = "runs"
    share: Annotated[float, Field(gt=0, lt=1)] = 1 / 8
    runs: tuple[str, ...] = ()
    folds: Annotated[int, Field(ge=2)] = 6


class RefinementSettings(_Frozen):
    """Adaptive refinement: finer levels only where the coarser one has large errors (section 3.5).

    Attributes
    ----------
    adaptive
        Whether finer levels are refined adaptively.
    share
        Fraction of the coarse nodes, those with the largest validation error, around which nodes are added.
    rings
        How many rings of neighbours in the finer graph are added around each of them.
    """

    adaptive: bool = False
    share: Annotated[float, Field(gt=0, le=1)] = 0.25
    rings: Positive = 1


class PodSettings(_Frozen):
    """POD with Gaussian processes or radial basis functions.

    Attributes
    ----------
    modes
        Numbers of modes to choose from by cross-validation.
    inputs
        `trajectory`: one sample per run; `point`: one sample per state, with the time as an input; `auto`: chosen by
        cross-validation.
    points
        Largest number of samples for a Gaussian process with `point`.
    """

    modes: tuple[Positive, ...] = (2, 4, 8, 16, 32, 48, 64, 96)
    inputs: Literal["auto", "trajectory", "point"] = "auto"
    points: Positive = 800


class Settings(_Frozen):
    """All settings of a training.

    Attributes
    ----------
    model
        Kind of model: `mh`, `podnn`, `aenn`, `gaenn`, `pod-gpr` or `pod-rbf`.
    preset
        `fast`, or `paper` for exactly what the paper does.
    seed
        Of all random numbers.
    seeds
        Trainings, with `seed` and the next ones, of which the model is the mean.
    levels
        Mesh levels of the cascade, coarsest first; empty: all levels of the hierarchy.
    level
        Settings of every level.
    at
        Settings of single levels, by level number; they replace those of `level`.
    transfer, inputs, physics, validation, refinement, pod
        See the classes above.
    unified
        One latent vector for all levels, trained together (section 3.5).
    precision
        `tf32` and `bfloat16` (dense layers only) are faster on a GPU.
    missing
        Nodes without a displacement: `hold` the last displacement of each; `refuse` such runs; `auto`: hold if
        elements erode, else refuse.
    targets
        What is learnt: `displacement`, and beside it results on elements such as `plastic_strain` and time histories such
        as `history:wall_force_x` or `history:wall*`.
    removal
        Where elements erode, also how likely each is gone (`auto`), or not (`off`).
    kpi
        Name -> formula of numbers that are predicted, banded and rated: {intrusion: "max(displacement(part=box))"}.
    """

    model: ModelName = "mh"
    preset: Preset = "fast"
    seed: Annotated[int, Field(ge=0)] = 0
    seeds: Positive = 1
    levels: tuple[Annotated[int, Field(ge=0)], ...] = ()
    level: LevelSettings = LevelSettings()
    at: Mapping[int, Mapping[str, Any]] = {}
    transfer: TransferSettings = TransferSettings()
    inputs: InputSettings = InputSettings()
    physics: PhysicsSettings = PhysicsSettings()
    validation: ValidationSettings = ValidationSettings()
    refinement: RefinementSettings = RefinementSettings()
    unified: bool = False
    pod: PodSettings = PodSettings()
    precision: Literal["float32", "tf32", "bfloat16"] = "float32"
    missing: Literal["auto", "hold", "refuse"] = "auto"
    targets: tuple[str, ...] = ("displacement",)
    removal: Literal["auto", "off"] = "auto"
    kpi: Mapping[str, str] = {}

    @field_validator("removal", mode="before")
    @classmethod
    def _off(cls, value: Any) -> Any:
        return "off" if value is False else value  # YAML reads off as false

    @field_validator("kpi", mode="before")
    @classmethod
    def _whole_formulas(cls, given: Any) -> Any:
        """YAML parts {a: max(f(x, y))} at the comma: what follows comes as a name without a value, and belongs before it."""
        if not isinstance(given, Mapping):
            return given
        out: dict[Any, Any] = {}
        for name, text in given.items():
            if text is None and out:
                last = next(reversed(out))
                out[last] = f"{out[last]}, {name}"
            else:
                out[name] = text
        return out

    @model_validator(mode="after")
    def _fits_together(self) -> Settings:
        if "displacement" not in self.targets and not any(t.startswith("history:") for t in self.targets):
            raise ValueError(
                f"targets {', '.join(self.targets) or 'none'} lacks displacement, which everything else stands beside; "
                f"expected such as displacement,plastic_strain"
            )
        if len(set(self.levels)) != len(self.levels):
            raise ValueError(f"levels {list(self.levels)} names a level twice")
        if list(self.levels) != sorted(self.levels, reverse=True):
            raise ValueError(f"levels {list(self.levels)} must go from coarse to fine, the largest number first")
        for number in self.at:
            try:
                self.for_level(number)
            except ValidationError as error:
                raise SurrogateError(_told(error, ("at", number))) from error
        latents = {self.for_level(k).latent for k in (*self.at, -1)}
        if len(latents) > 1 and self.transfer.encoder == "add":
            raise ValueError(f"latent sizes {sorted(latents)} differ; transfer.encoder=add needs one size")
        if self.unified and self.refinement.adaptive:
            raise ValueError("unified trains all levels together, refinement.adaptive one after the other; choose one")
        if self.seeds > 1 and self.refinement.adaptive:
            raise ValueError(
                "refinement.adaptive makes another mesh in every training, and trainings (seeds) are averaged on one; "
                "choose one of both"
            )
        if self.unified and self.transfer.encoder == "concat":
            raise ValueError("unified has one latent vector, so transfer.encoder=concat means nothing")
        return self

    def for_level(self, number: int, *, transferred: bool = False) -> LevelSettings:
        """The settings of level `number`: those of `level`, and what `at` says of it.

        Where it starts from a coarser one (`transferred`), `transfer.epochs` shortens its training, unless `at` says.
        """
        own = self.at.get(number, {})
        out = LevelSettings.model_validate(_merged(self.level.model_dump(), own)) if own else self.level
        if transferred and "epochs" not in own:
            out = out.model_copy(update={"epochs": max(1, round(self.transfer.epochs * out.epochs))})
        return out

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as they go into JSON and YAML."""
        return self.model_dump(mode="json")


# The fast preset keeps the paper's architecture and loss; `docs/surrogates.md` has the measurements behind it.
_FAST: dict[str, Any] = {
    "level": {
        "latent": 48,
        "start": "pod",
        "mlp": {"widths": [64] * 6, "activation": "gelu", "members": 2},
        "epochs": 300,
        "batch": 64,
        "states": "auto",
        "learning_rate": 4e-3,
        "schedule": "one_cycle",
        "weight_decay": 0.1,
        "rate_inputs": 16,
        "regression": "auto",
        "patience": 0.2,
        "first_state": "kept",
    },
    "transfer": {"upsampling": "sparse", "mlp": "residual", "epochs": 0.2},
}
_PAPER: dict[str, Any] = {
    "removal": "off",
    "validation": {"measure": "paper"},
    "inputs": {"derived": "off"},
    "physics": {"clock": "off", "symmetry": "off"},
    "transfer": {"lifting": "static"},
}
_PRESETS: Mapping[str, dict[str, Any]] = {"fast": _FAST, "paper": _PAPER}
_OF_MODEL: Mapping[str, dict[str, Any]] = {
    "podnn": {"level": {"reduction": "pod", "start": "plain", "latent": 4, "regression": "network"}, "levels": [0]},
    "aenn": {"level": {"reduction": "ae", "start": "plain", "regression": "network"}, "levels": [0]},
    "gaenn": {"level": {"reduction": "gcn", "regression": "network"}, "levels": [0]},
}


def settings(
    model: str | None = None,
    preset: str | None = None,
    file: str | Path | None = None,
    overrides: Mapping[str, Any] | Sequence[str | Mapping[str, Any] | Sequence[str]] = (),
) -> Settings:
    """The settings for one training.

    Parameters
    ----------
    model, preset
        Kind of model and preset; default: what `file` says, else `mh` and `fast`.
    file
        YAML with the fields of `Settings`.
    overrides
        A dictionary, nested or with dotted paths: {"level": {"epochs": 20}} or {"level.epochs": 20}; or texts
        "path=value" with a dotted path and a YAML value, such as "level.mlp.widths=[32, 32]" or "at.3.epochs=9"; or a
        list of both, of which later ones win.

    Raises
    ------
    SurrogateError
        Naming the field, what was found and what is possible.
    """
    given: dict[Any, Any] = _read(Path(file)) if file is not None else {}
    given = _merged(given, _given(overrides))
    model, preset = model or given.get("model", "mh"), preset or given.get("preset", "fast")
    if model not in MODELS:
        raise SurrogateError(f"model {model!r} is not known; choose {_listed(MODELS)}")
    if preset not in PRESETS:
        raise SurrogateError(f"preset {preset!r} is not known; choose {_listed(PRESETS)}")
    values = _merged(_merged(_PRESETS[preset], _OF_MODEL.get(model, {})), given)
    return parse({**values, "model": model, "preset": preset}, str(file or "settings"))


def parse(values: Mapping[str, Any], where: str) -> Settings:
    """`values` as settings; raises SurrogateError with `where` and the field."""
    try:
        return Settings.model_validate(values)
    except ValidationError as error:
        raise SurrogateError(f"{where}: {_told(error)}") from error
    except SurrogateError as error:
        raise SurrogateError(f"{where}: {error}") from error


def _read(file: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(file.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise SurrogateError(f"{file}: is no YAML ({' '.join(str(error).split())[:160]})") from error
    except UnicodeDecodeError as error:
        raise SurrogateError(f"{file}: is no text; expected YAML settings") from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise SurrogateError(f"{file}: holds a {type(values).__name__}; expected fields such as level: {{epochs: 200}}")
    return values


def _override(text: str) -> dict[Any, Any]:
    path, equals, value = text.partition("=")
    if not equals or not path.strip():
        raise SurrogateError(f"setting {text!r} not understood; expected path=value, such as level.epochs=200")
    try:
        parsed = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise SurrogateError(f"setting {text!r}: the value is no YAML") from error
    if isinstance(parsed, str):  # YAML 1.1 reads 1e-3 as text
        with contextlib.suppress(ValueError):
            parsed = float(parsed)
    return _at_path(path, parsed)


def _given(overrides: str | Mapping[str, Any] | Sequence[Any]) -> dict[Any, Any]:
    """Texts, dictionaries, or a list of such, as one nested dictionary; later ones win."""
    if isinstance(overrides, str):
        return _override(overrides)
    if isinstance(overrides, Mapping):
        return _nested(overrides)
    out: dict[Any, Any] = {}
    for some in overrides:
        out = _merged(out, _given(some))
    return out


def _at_path(path: object, value: Any) -> dict[Any, Any]:
    """`value` at a dotted path, as nested dictionaries; numbers in the path are level numbers."""
    out = value
    for key in reversed(str(path).strip().split(".")):
        out = {int(key) if key.isdigit() else key: out}
    return dict(out)


def _nested(values: Mapping[Any, Any]) -> dict[Any, Any]:
    """A dictionary without dotted paths."""
    out: dict[Any, Any] = {}
    for path, value in values.items():
        out = _merged(out, _at_path(path, _nested(value) if isinstance(value, Mapping) else value))
    return out


def _merged(below: Mapping[Any, Any], above: Mapping[Any, Any]) -> dict[Any, Any]:
    """`above` over `below`, mapping by mapping."""
    out = dict(below)
    for key, value in above.items():
        old = out.get(key)
        out[key] = _merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


def _told(error: ValidationError, above: tuple[int | str, ...] = ()) -> str:
    """The first of the errors in one line; `above` is the place of what was validated."""
    first = error.errors()[0]
    place = (*above, *first["loc"])
    path = ".".join(map(str, place)) or "settings"
    if first["type"] == "extra_forbidden":
        fields = _fields_at(place[:-1])
        near = _nearest(place, fields)
        return (
            f"{path} is not a setting; " + (f"did you mean {near}? " if near else "") + f"there are {_listed(fields)}"
        )
    message = first["msg"].removeprefix("Value error, ")
    return f"{path} = {first['input']!r}: {message}" if place else message


def _nearest(place: tuple[int | str, ...], fields: Sequence[str]) -> str | None:
    """What was probably meant: a field of the same place, or one of that name elsewhere; None where nothing is near."""
    *above, own = map(str, place)
    near = difflib.get_close_matches(own, fields, n=1)
    if near:
        return ".".join([*above, *near])
    paths = {path.rpartition(".")[2]: path for path in reversed(_paths(Settings))}
    found = difflib.get_close_matches(own, paths, n=1)
    return paths[found[0]] if found else None


def _paths(kind: type[BaseModel]) -> list[str]:
    """Dotted names of all settings."""
    out = []
    for name, field in kind.model_fields.items():
        out.append(name)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            out += [f"{name}.{path}" for path in _paths(field.annotation)]
    return out


def _fields_at(place: tuple[int | str, ...]) -> list[str]:
    kind: Any = Settings
    if place[:1] == ("at",):
        place = ("level", *place[2:])  # single levels have the fields of all
    for key in place:
        field = kind.model_fields.get(str(key)) if isinstance(kind, type) and issubclass(kind, BaseModel) else None
        kind = None if field is None else field.annotation
    return list(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)
