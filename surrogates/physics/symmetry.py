"""Symmetry: a structure that is its own mirror image gives every run a second one, for nothing.

With the reflection R = I - 2 n n^T and the field at mirrored places, the image of a run is u'(x) = R u(R x). Parameters
that say on which side something happens (an angle, an offset) change their sign: they are odd; the others stay as they
are. A mesh is rarely as symmetric as its shape, so an image is a little less true than a run. One more input, the side
(0 as computed, 1 mirrored), lets a model trust it less.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from data_schema.mirror import ODD, MirrorPlane, comes_near_zero
from surrogates.errors import SurrogateError

# States that are mirrored at once.
_STATES = 16
# Parameters that may be odd and are tried in all combinations.
_TRIED = 3


@dataclass(frozen=True)
class Symmetry:
    """The images that a campaign is doubled by.

    Attributes
    ----------
    mirror
        The plane, with the map of fields; None: no images.
    odd
        Parameters that change their sign in the mirror.
    flagged
        Whether the side is one more input.
    """

    mirror: MirrorPlane | None = None
    odd: tuple[str, ...] = ()
    flagged: bool = False

    @property
    def is_identity(self) -> bool:
        return self.mirror is None

    def images(self, parameters: NDArray[np.float64], names: Sequence[str]) -> NDArray[np.float64]:
        """Parameters (run, parameter) of the mirrored runs."""
        return parameters * np.where([name in self.odd for name in names], -1.0, 1.0)

    def apply(self, states: NDArray[np.float32], nodes: NDArray[np.int64] | None = None) -> NDArray[np.float32]:
        """The mirror image of states (state, node of the full mesh, 3), m, on `nodes` of the full mesh (default: all).

        Applied twice it gives the states back as far as the mesh is symmetric.
        """
        return mirrored(self.mirror, states, nodes) if self.mirror is not None else states

    def told(self) -> str:
        """The symmetry in a line."""
        if self.mirror is None:
            return "no mirrored runs"
        odd = f"{', '.join(self.odd)} with the opposite sign" if self.odd else "all parameters as they are"
        side = ", the side is an input" if self.flagged else ""
        return f"every run also mirrored at {self.mirror.name}, {odd}{side}"

    def as_dict(self) -> dict[str, Any]:
        """Plain values; the map of fields is left out, since only training needs it."""
        plane = None
        if self.mirror is not None:
            fit = {name: getattr(self.mirror, name) for name in ("offset", "mean", "most", "largest", "edge")}
            plane = {"normal": self.mirror.normal.tolist(), **fit}
        return {"mirror": plane, "odd": list(self.odd), "flagged": self.flagged}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Symmetry:
        """The way back, with an empty map."""
        plane = values["mirror"]
        mirror = None
        if plane is not None:
            fit = {name: float(plane[name]) for name in ("mean", "most", "largest", "edge")}
            normal, none = np.array(plane["normal"], np.float64), sparse.csr_matrix((0, 0))
            mirror = MirrorPlane(normal, float(plane["offset"]), none, **fit)
        return cls(mirror, tuple(values["odd"]), bool(values["flagged"]))


def mirrored(
    mirror: MirrorPlane, states: NDArray[np.float32], nodes: NDArray[np.int64] | None = None
) -> NDArray[np.float32]:
    """(state, node, 3): the image of states (state, node of the full mesh, 3) in `mirror`, on `nodes` (default: all)."""
    rows = (mirror.to_image if nodes is None else mirror.to_image[nodes]).astype(states.dtype)
    turn = mirror.reflection.T.astype(states.dtype)
    out = np.empty((len(states), rows.shape[0], 3), states.dtype)
    for k in range(0, len(states), _STATES):  # some at a time: their copies by node are as large as they are
        some = states[k : k + _STATES]
        flat = rows @ some.transpose(1, 0, 2).reshape(some.shape[1], -1)
        out[k : k + _STATES] = (flat.reshape(-1, len(some), 3) @ turn).transpose(1, 0, 2)
    return out


def check_odd(
    odd: Sequence[str], names: Sequence[str], parameters: NDArray[np.float64], written: Sequence[tuple[str, float]] = ()
) -> None:
    """Refuse parameters of `odd` that cannot change their sign in the mirror.

    Parameters
    ----------
    parameters
        (run, parameter).
    written
        (unit, its value in that of `parameters`) in which people speak of each parameter.

    Raises
    ------
    SurrogateError
        For one that is no parameter, and for one that stays away from zero in all runs: no mirrored run would come near a
        computed one.
    """
    for name in odd:
        if name not in names:
            raise SurrogateError(f"physics.odd names {name!r}, which is no parameter; there are {', '.join(names)}")
        k = list(names).index(name)
        low, high = float(parameters[:, k].min()), float(parameters[:, k].max())
        if not comes_near_zero(low, high):
            unit, factor = written[k] if written else ("", 1.0)
            raise SurrogateError(
                f"physics.odd names {name}, which is {low / factor:.4g} to {high / factor:.4g} {unit}".rstrip()
                + f" in these runs; {ODD} leave it out of --odd"
            )


def may_be_odd(names: Sequence[str], parameters: NDArray[np.float64]) -> list[tuple[str, ...]]:
    """Sets of parameters that could change their sign in a mirror: those with values on both sides of zero.

    Parameters
    ----------
    parameters
        (run, parameter). All combinations of the first few, the fewest first; empty where none qualifies.
    """
    both = [
        n for k, n in enumerate(names)
        if parameters[:, k].min() < 0 < parameters[:, k].max()
        and min(-parameters[:, k].min(), parameters[:, k].max()) > 0.2 * np.abs(parameters[:, k]).max()
    ]  # fmt: skip
    some = both[:_TRIED]
    out = [tuple(n for i, n in enumerate(some) if bits >> i & 1) for bits in range(1, 1 << len(some))]
    return sorted(out, key=len)
