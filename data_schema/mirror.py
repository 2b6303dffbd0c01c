"""A mirror plane of a structure: what the mesh finds, and surrogates train with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy import sparse

# What a parameter is that may be odd, for people.
ODD = "one that changes its sign in the mirror has values on both sides of zero, or from zero on, such as an angle or an offset;"
# An odd parameter comes at least this close to zero, as a share of its range.
_NEAR_ZERO = 0.1


def comes_near_zero(low: float, high: float) -> bool:
    """Whether a parameter from `low` to `high` may be odd: else no mirrored run would come near a computed one."""
    return max(low, -high) <= _NEAR_ZERO * (high - low)


@dataclass(frozen=True)
class MirrorPlane:
    """A plane in which the mesh is (nearly) its own image, and the map of fields.

    Attributes
    ----------
    normal
        (3,), of length 1, its largest component positive; offset, m: the plane is normal . x = offset.
    to_image
        (n, n): row i holds the weights with which the field at the mirror image of node i is put together.
    mean, most, largest
        Distance, m, of mirrored nodes from the surface: mean, 99 of 100, largest.
    edge
        Mean edge length, m.
    """

    normal: NDArray[np.float64]
    offset: float
    to_image: sparse.csr_matrix
    mean: float = 0.0
    most: float = 0.0
    largest: float = 0.0
    edge: float = 0.0

    @property
    def reflection(self) -> NDArray[np.float64]:
        """(3, 3): what a vector becomes in the mirror, the Householder matrix I - 2 n n^T."""
        return np.eye(3) - 2 * np.outer(self.normal, self.normal)

    @property
    def name(self) -> str:
        """Such as "y = 0.012 m", or the normal where the plane is oblique."""
        axis = int(np.abs(self.normal).argmax())
        if self.normal[axis] > 1 - 1e-9:
            return f"{'xyz'[axis]} = {round(self.offset, 4) + 0.0:g} m"
        return f"({', '.join(f'{c:.3f}' for c in self.normal)}) . x = {self.offset:.4g} m"

    @property
    def told(self) -> str:
        """One sentence on how well the mesh fits its image."""
        return (
            f"mirror plane {self.name}: mirrored nodes lie {1e3 * self.mean:.2g} mm from the surface on average, "
            f"{1e3 * self.largest:.2g} mm at most (edges are {1e3 * self.edge:.2g} mm)"
        )
