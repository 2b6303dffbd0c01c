"""A script beside a written run with which ParaView shows it: warped, and coloured over one range for all states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass
class ValueRanges:
    """Smallest and largest value of arrays over all states, of vectors of their length.

    Attributes
    ----------
    of
        Name -> (smallest, largest), finite values only.
    on
        Name -> "POINTS" or "CELLS".
    vectors
        Names of the point arrays with three components.
    """

    of: dict[str, tuple[float, float]] = field(default_factory=dict)
    on: dict[str, str] = field(default_factory=dict)
    vectors: list[str] = field(default_factory=list)

    def note(self, point_data: Mapping[str, NDArray[Any]], cell_data: Mapping[str, NDArray[Any]]) -> None:
        """Take the arrays of one state into account; numbers of nodes, elements and parts are no quantities."""
        for kind, arrays in (("POINTS", point_data), ("CELLS", cell_data)):
            for name, values in arrays.items():
                if values.dtype.kind == "f" and (values.ndim == 1 or values.shape[1] == 3):
                    self._note(kind, name, values)

    def _note(self, kind: str, name: str, values: NDArray[Any]) -> None:
        sizes = values if values.ndim == 1 else np.sqrt(np.einsum("nx,nx->n", values, values))
        there = sizes[np.isfinite(sizes)]
        if not len(there):
            return
        low, high = self.of.get(name, (np.inf, -np.inf))
        self.of[name] = (min(low, float(there.min())), max(high, float(there.max())))
        self.on[name] = kind
        if kind == "POINTS" and values.ndim == 2 and name not in self.vectors:
            self.vectors.append(name)


def view_script(name: str, ranges: ValueRanges, units: Mapping[str, str]) -> str:
    """A Python script for ParaView that shows the file `name`, which lies beside it.

    All names stand in it as Python literals: whoever named an array or a unit cannot make the script do anything else.
    """
    warp = "displacement" if "displacement" in ranges.vectors else next(iter(ranges.vectors), None)
    colour = next((n for n in ranges.of if n.startswith("error")), warp) or next(iter(ranges.of), None)
    table = "".join(
        f"    {n!r}: ({ranges.on[n]!r}, {low!r}, {high!r}, {units.get(n, '')!r}),\n"
        for n, (low, high) in ranges.of.items()
    )
    return _SCRIPT.format(name=ascii(name), table=table, warp=warp, colour=colour)


_SCRIPT = """# Load in ParaView with File > Load State, or start paraview --script=THIS_FILE.
# Change WARP and COLOUR to see other arrays. The colour ranges hold for all states.
import os

from paraview.simple import *

FILE = {name}
if "__file__" in globals():
    FILE = os.path.join(os.path.dirname(os.path.abspath(__file__)), FILE)
WARP = {warp!r}  # vectors that move the mesh; None: leave it undeformed
COLOUR = {colour!r}
RANGES = {{  # array: points or cells, smallest and largest value over all states (of vectors, their length), unit
{table}}}

source = OpenDataFile(FILE)
shown = WarpByVector(Input=source, Vectors=["POINTS", WARP]) if WARP else source
view = GetActiveViewOrCreate("RenderView")
display = Show(shown, view)
if COLOUR in RANGES:
    where, low, high, unit = RANGES[COLOUR]
    ColorBy(display, (where, COLOUR))
    colours = GetColorTransferFunction(COLOUR)
    colours.AutomaticRescaleRangeMode = "Never"
    colours.RescaleTransferFunction(low, high)
    display.SetScalarBarVisibility(view, True)
    GetScalarBar(colours, view).ComponentTitle = unit
GetAnimationScene().UpdateAnimationUsingDataTimeSteps()
GetAnimationScene().GoToLast()
ResetCamera(view)
Render(view)
"""
