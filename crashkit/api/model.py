"""A trained model as people ask it: parameters by name, labelled arrays out, which can be drawn."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import ArrayLike, NDArray

    from surrogates.record import Record
    from surrogates.settings import Settings
    from surrogates.surrogate import Surrogate


class Model:
    """A trained surrogate, as `crashkit.train` and `crashkit.load_model` return it.

    Attributes
    ----------
    surrogate : surrogates.surrogate.Surrogate
        The arrays-only core: everything this class does, without labels.
    folder : Path or None
        Where it is stored, if it is.
    """

    def __init__(self, surrogate: Surrogate, folder: Path | None = None) -> None:
        self.surrogate = surrogate
        self.folder = folder

    @property
    def name(self) -> str:
        """The name of its folder, or of the kind of model where it is not stored."""
        return self.surrogate.settings.model if self.folder is None else self.folder.resolve().name

    @property
    def settings(self) -> Settings:
        """The settings it was trained with."""
        return self.surrogate.settings

    @property
    def record(self) -> Record:
        """How its training went: runs, ranges, errors, versions."""
        return self.surrogate.record

    @property
    def levels(self) -> dict[str, int]:
        """Name of each level it predicts on and the mesh level, coarsest first: {"MH3": 3, "MH2": 2, "MH1": 1}."""
        return self.surrogate.level_names

    @property
    def parameters(self) -> dict[str, tuple[float, float, str]]:
        """Each parameter with its trained range and unit: {"impact_speed": (10.0, 30.0, "m s-1")}."""
        ranges = self.record.ranges
        spans = zip(ranges.names, ranges.low, ranges.high, ranges.units, strict=True)
        return {name: (float(low), float(high), unit) for name, low, high, unit in spans}

    @property
    def time(self) -> NDArray[np.float64]:
        """(state,) times of the training runs, s."""
        return self.record.time

    def predict(
        self,
        parameters: Mapping[str, Any],
        time: ArrayLike | None = None,
        level: int | None = None,
        full: bool | None = None,
        *,
        extrapolate: bool = False,
        band: float | None = None,
        sensitivity: bool = False,
        coarse_run: str | Path | xr.Dataset | None = None,
    ) -> xr.Dataset:
        """Displacements of one run, or of several.

        Parameters
        ----------
        parameters
            Values by name: numbers in the dataset's unit (SI), or text, with a unit ("400MPa") or in the unit in which
            the parameter's table was written ("400"). A list or an array for a parameter asks for several runs at
            once; all lists have one length.
        time
            s; without it the states of the training runs.
        level
            A mesh level of the model, on its own nodes; without it all nodes of the mesh, from the finest level.
        full
            With `level`: on all nodes of the mesh, interpolated from that level.
        extrapolate
            Also far outside the trained range: by more than a quarter of it.
        band
            Also `half_width`, m: a prediction band that should contain this share of nodes and states, e.g. 0.9. Its
            width comes from errors on runs that were left out in training.
        sensitivity
            Also `displacement_by_NAME`: the derivative by each parameter. For one run.
        coarse_run
            A run with these parameters on the coarse mesh of a model that was trained with `coarse`, to start from: the
            folder or file of a solver, `coarse.zarr:run_012`, or a dataset of one run. Displacements and their band use
            it; what is said of elements, histories and numbers does not.

        Returns
        -------
        xarray.Dataset
            `displacement` (time, node, xyz), m, with `sim` in front for several runs; `history` (sample, channel) of the
            channels that were targets of the training, and the numbers of the settings' `kpi`; with `band` also
            `history_half_width` and NAME_half_width; the parameters; and the mesh, so
            that `prediction.crash.to_pyvista(time=0.02).plot()` draws it. Also the results on elements (time, face) that
            were among the targets, and on the full mesh `removal_probability` (time, face) where training runs lost
            elements. The coordinate `node` says which node of the full mesh each one is. Attributes: `model`, `level`,
            and `warnings`: what lies outside the trained range or near a fold, where neighbouring runs differ by more
            than their distance explains, one per line. Each is a Python warning, too.

        Raises
        ------
        DataError
            For parameters that are unknown, missing or no numbers, and far outside the trained range unless
            `extrapolate`.
        SurrogateError
            For a level the model does not have; with `band`, where too few runs were left out.
        """
        import numpy as np

        from crashkit.api.parameters import parameter_table
        from crashkit.errors import DataError
        from data_schema.finite import all_finite

        surrogate, ranges = self.surrogate, self.record.ranges
        values, several = parameter_table(parameters, ranges)
        at = self.time if time is None else np.atleast_1d(np.asarray(time, np.float64))
        number = surrogate.number(level)
        full = level is None if full is None else full
        outside = self.check(parameters, at, extrapolate=extrapolate)
        if sensitivity and len(values) > 1:
            raise DataError(f"sensitivities are those of one run; found parameters of {len(values)}")
        if coarse_run is not None and (several or sensitivity):
            raise DataError("a coarse run is that of one prediction, and has no derivative by parameters")
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused below
            if coarse_run is not None:
                from crashkit.api.coarse_runs import coarse_run_states

                seen = coarse_run_states(coarse_run, surrogate, values[0], number)
                u = surrogate.predict_from_coarse(values, *seen, at, number, full=full)[None]
            else:
                u = surrogate.predict_full(values, at, number) if full else surrogate.predict(values, at, number)
        if not all_finite(u):
            raise DataError(
                "the model gives numbers that are not finite for these parameters; check the values, or train it again"
            )
        unsure = [*outside, *surrogate.hard(values)]
        for sentence in unsure:
            warnings.warn(sentence, stacklevel=2)
        arrays: dict[str, tuple[NDArray[Any], str]] = {"displacement": (u, "m")}
        if band is not None:
            started = coarse_run is not None
            widths = [
                surrogate.band(band, at, number, full=full, parameters=row, from_coarse=started) for row in values
            ]
            arrays["half_width"] = (np.stack(widths), "m")
        if sensitivity:
            slopes = surrogate.sensitivity(values[0], at, number)
            for k, (name, unit) in enumerate(zip(ranges.names, ranges.units, strict=True)):
                slope = np.ascontiguousarray(slopes[..., k])
                slope = surrogate.lift(slope, number) if full else slope
                arrays[f"displacement_by_{name}"] = (slope[None], f"m ({unit})-1")
        on_elements = self._on_elements(values, at, 0 if full else number)
        out = _labelled(
            {
                **on_elements,
                **{
                    name: (("sim", "time", "node", "xyz")[: array.ndim], array, {"units": unit, **_role(name)})
                    for name, (array, unit) in arrays.items()
                },
                **{
                    name: ("sim", values[:, k], {"units": unit, "table_units": written, "role": "parameter"})
                    for k, (name, unit, (written, _)) in enumerate(
                        zip(ranges.names, ranges.units, ranges.written, strict=True)
                    )
                },
                **self._histories(values, band),
                **self._numbers(values, band, number),
                **self._mesh(0 if full else number),
            },
            coords={
                "time": ("time", at, {"units": "s"}),
                "node": ("node", surrogate.graphs.kept(0 if full else number)),
            },
            attrs={
                "model": next(name for name, k in self.levels.items() if k == number),
                "level": 0 if full else number,
                "warnings": "\n".join(unsure),
            },
        )
        if not several:
            return out.isel(sim=0)
        return out.assign_coords(sim=[f"prediction_{k}" for k in range(len(values))])

    def check(
        self, parameters: Mapping[str, Any], time: ArrayLike | None = None, *, extrapolate: bool = False
    ) -> list[str]:
        """What `predict` would say of these parameters and times that lie outside the trained range, a sentence each.

        Parameters
        ----------
        parameters, time, extrapolate
            As for `predict`.

        Raises
        ------
        DataError, SurrogateError
            As `predict` would.
        """
        import numpy as np

        from crashkit.api.parameters import mistaken_unit, parameter_table
        from crashkit.errors import DataError
        from surrogates.data.inputs import far_outside

        ranges = self.record.ranges
        values, _ = parameter_table(parameters, ranges)
        at = self.time if time is None else np.atleast_1d(np.asarray(time, np.float64))
        beyond = [ranges.beyond(*self.surrogate.checked(row, at)) for row in values]
        far = [[] if extrapolate else far_outside(ranges, row[None], at) for row in values]
        if any(far):
            said = dict.fromkeys(of_run[name] for of_run, names in zip(beyond, far, strict=True) for name in names)
            units = [mistaken_unit(parameters, name, ranges) for name in ranges.names if any(name in f for f in far)]
            if any("time" in f for f in far) and 1e-3 * at.max() <= self.time[-1]:
                units.append(
                    f"times are in s, so for {at.max():g} ms write '{at.max():g}ms', from Python {1e-3 * at.max():g}"
                )
            raise DataError(
                f"{'; '.join(said)}: that is far outside, and nothing is known there; "
                f"{'; '.join(filter(None, units)) or 'check the value and its unit'}, or extrapolate: --extrapolate, "
                "from Python extrapolate=True"
            )
        return list(dict.fromkeys(sentence for of_run in beyond for sentence in of_run.values()))

    def _on_elements(self, values: NDArray[np.float64], time: NDArray[np.float64], level: int) -> dict[str, Any]:
        """What is said of elements, as variables (sim, time, face) of the mesh of `level`."""
        surrogate = self.surrogate
        if surrogate.faces is None:
            return {}
        dims = ("sim", "time", "face")
        out: dict[str, Any] = {
            name: (dims, surrogate.predict_field(name, values, time, level), {"units": known.unit, "role": "field"})
            for name, known in surrogate.fields.items()
        }
        if surrogate.removal is not None and not level:
            said = surrogate.predict_removal(values, time)
            out["removal_probability"] = (dims, said, {"units": "1", "role": "field"})
        return out

    def encode(self, states: xr.Dataset | xr.DataArray | ArrayLike, level: int | None = None) -> xr.DataArray:
        """Latent vectors of displacements.

        Parameters
        ----------
        states
            A crash dataset, its `displacement`, or an array (state, node, 3), m; on the full mesh or on the level's
            own nodes. Dimensions before `node` (sim, time) are kept.
        level
            A mesh level of the model; without it the finest it has.

        Returns
        -------
        xarray.DataArray
            (..., latent), with the coordinates of what was given.
        """
        import xarray as xr

        given, labelled = self._on_level(states, level)
        *before, _, _ = labelled.dims
        latent = self.surrogate.encode(given, level)
        out = latent.reshape(*labelled.shape[:-2], -1)
        coords = {k: v for k, v in labelled.coords.items() if set(v.dims) <= set(before)}
        return xr.DataArray(out, dims=(*before, "latent"), coords=coords, name="latent")

    def reconstruct(self, states: xr.Dataset | xr.DataArray | ArrayLike, level: int | None = None) -> xr.DataArray:
        """Displacements encoded and decoded: what the reduction alone costs.

        Parameters
        ----------
        states, level
            As for `encode`.

        Returns
        -------
        xarray.DataArray
            (..., node of the level, xyz), m.
        """
        import xarray as xr

        given, labelled = self._on_level(states, level)
        *before, _, _ = labelled.dims
        back = self.surrogate.reconstruct(given, level)
        coords = {k: v for k, v in labelled.coords.items() if set(v.dims) <= set(before)}
        coords["node"] = ("node", self.surrogate.graphs.kept(self.surrogate.number(level)))
        return xr.DataArray(
            back.reshape(*labelled.shape[:-2], *back.shape[1:]), dims=(*before, "node", "xyz"), coords=coords,
            name="displacement", attrs={"units": "m"},
        )  # fmt: skip

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Store the model as `folder`, from which `crashkit.load_model` brings it back.

        Raises
        ------
        OutputError
            Where the folder holds something already, or cannot be written.
        """
        from crashkit.output import check_model_folder
        from surrogates.storage.folder import save

        folder = Path(folder)
        check_model_folder(folder, overwrite)
        save(self.surrogate, folder, overwrite=overwrite)
        self.folder = folder
        return folder

    def _on_level(
        self, states: xr.Dataset | xr.DataArray | ArrayLike, level: int | None
    ) -> tuple[NDArray[np.float32], xr.DataArray]:
        """States as (state, node of the level, 3), and with their labels (..., node, xyz)."""
        import numpy as np
        import xarray as xr

        from crashkit.errors import DataError

        if isinstance(states, xr.Dataset):
            states = states["displacement"]
        if not isinstance(states, xr.DataArray):
            array = np.asarray(states)
            if array.ndim < 2:
                raise DataError(f"states have the shape {array.shape}; expected (state, node, 3)")
            states = xr.DataArray(array, dims=("sim", "time", "node", "xyz")[-array.ndim :])
        if states.dims[-2:] != ("node", "xyz"):
            raise DataError(f"states have the dimensions {states.dims}; expected (..., node, xyz)")
        graphs, number = self.surrogate.graphs, self.surrogate.number(level)
        if number and states.sizes["node"] == graphs.n_nodes(0) != graphs.n_nodes(number):
            states = states.isel(node=graphs.kept(number))
        flat = np.asarray(states.values, np.float32).reshape(-1, *states.shape[-2:])
        return flat, states

    def _histories(self, values: NDArray[np.float64], band: float | None) -> dict[str, Any]:
        """Histories that were learnt, as variables of a dataset."""
        import numpy as np

        curves = self.surrogate.curves
        if not curves:
            return {}
        said = [self.surrogate.predict_curve(name, values) for name in curves]
        out: dict[str, Any] = {
            "history": (("sim", "sample", "channel"), np.stack(said, axis=-1)),
            "history_time": ("sample", next(iter(curves.values())).time, {"units": "s"}),
            "channel": ("channel", list(curves)),
            "channel_unit": ("channel", [curve.unit for curve in curves.values()]),
        }
        if band is not None and all(curve.band is not None for curve in curves.values()):
            of_runs = [curve.half_width(band, self.surrogate.registration, values) for curve in curves.values()]
            out["history_half_width"] = (("sim", "sample", "channel"), np.stack(of_runs, axis=-1))
        return out

    def _numbers(self, values: NDArray[np.float64], band: float | None, level: int) -> dict[str, Any]:
        """Numbers by formula of the settings, as variables of a dataset."""
        if not self.record.numbers:
            return {}
        from crashkit.api.numbers import predicted_numbers

        out: dict[str, Any] = {}
        for found in predicted_numbers(self.surrogate, values, band, level):
            attributes = {"units": found.unit, "role": "number"}
            out[found.name] = ("sim", found.values, attributes)
            if found.half_width is not None:
                out[f"{found.name}_half_width"] = ((), found.half_width, attributes)
        return out

    def _mesh(self, level: int) -> dict[str, Any]:
        """The mesh of a level as variables of a dataset; nothing where the model was stored without."""
        import numpy as np

        from data_schema.edges import without_sides

        surrogate = self.surrogate
        if surrogate.points is None or surrogate.faces is None:
            return {}
        faces = surrogate.graphs[level].faces if level else surrogate.faces
        out: dict[str, Any] = {
            "reference_position": (("node", "xyz"), surrogate.points[surrogate.graphs.kept(level)], {"units": "m"}),
            "face_nodes": (("face", "corner"), faces),
        }
        labels = surrogate.labels
        if labels is not None:
            out["node_id"] = ("node", labels.node_id[surrogate.graphs.kept(level)])
            if not level:
                out["face_part"], out["part_id"] = ("face", labels.face_part), ("part", labels.part_id)
                out["part_name"] = ("part", np.array(labels.part_name, dtype=str))
                if labels.face_id is not None:
                    out["face_id"] = ("face", labels.face_id)
        if level:
            out["line_nodes"] = (("line", "end"), without_sides(surrogate.graphs[level].edges, faces))
        return out

    def _facts(self) -> tuple[str, dict[str, object], tuple[str, ...], list[tuple[object, ...]]]:
        from crashkit.display import listed, seeds_told

        record, settings = self.record, self.settings
        spans = (f"{name} {low:.4g} to {high:.4g} {unit}" for name, (low, high, unit) in self.parameters.items())
        facts: dict[str, object] = {
            "dataset": f"{record.attributes.get('dataset') or 'not recorded'}, checksum {record.checksum[:12] or 'none'}",
            "parameters": listed(spans),
            "states": f"{len(self.time)} from {self.time[0]:.4g} to {self.time[-1]:.4g} s",
            "runs": record.runs_told,
        }
        rows: list[tuple[object, ...]] = [
            (
                name, self.surrogate.graphs.n_nodes(level), self.surrogate.n_latent(level),
                self.surrogate.n_parameters(level), _centimetres(record.errors.get(name)),
            )
            for name, level in self.levels.items()
        ]  # fmt: skip
        title = f"crashkit.Model {self.name}: {settings.model}, preset {settings.preset}, {seeds_told(self.surrogate.seeds)}"
        return title, facts, ("level", "nodes", "latent", "parameters", f"{record.error_name} (cm)"), rows

    def __repr__(self) -> str:
        from crashkit.display import as_text

        return as_text(*self._facts())

    def _repr_html_(self) -> str:
        from crashkit.display import as_html

        return as_html(*self._facts())


def _labelled(
    arrays: Mapping[str, tuple[Any, ...]], coords: Mapping[str, tuple[Any, ...]], attrs: Mapping[str, Any]
) -> xr.Dataset:
    """What `xarray.Dataset(arrays, coords, attrs)` is, of arrays (dimensions, values, attributes) and coordinates of one dimension.

    That imports Dask and Pint where they are installed, to ask whether arrays are theirs, which takes a second.
    """
    import numpy as np
    import pandas as pd
    import xarray as xr

    def variable(dims: str | tuple[str, ...], values: Any, attributes: Mapping[str, Any] | None = None) -> xr.Variable:
        return xr.Variable((dims,) if isinstance(dims, str) else dims, np.asarray(values), attributes, fastpath=True)

    indexes = {name: xr.indexes.PandasIndex(pd.Index(told[1], name=name), name) for name, told in coords.items()}
    labels: dict[Any, Any] = {}
    for name, told in coords.items():
        labels |= indexes[name].create_variables({name: variable(*told)})
    variables = {name: variable(*told) for name, told in arrays.items()}
    return xr.Dataset(variables, coords=xr.Coordinates(labels, indexes=indexes), attrs=attrs)


def _centimetres(error: float | None) -> str:
    return "-" if error is None else f"{100 * error:.2f}"


def _role(name: str) -> dict[str, str]:
    """Further results are fields of a crash dataset, which writers and drawings know."""
    return {} if name == "displacement" else {"role": "field"}
