"""Compiled passes over displacements: each field of a run is read once, and what is wanted of it comes out together.

Fields are (state, node, 3) float32 or float64, m, in any order in memory; sums run in float64. A node that is gone is
NaN in the truth and takes no part; where it is NaN in the prediction alone, its distance is NaN.
"""

from __future__ import annotations

from math import isfinite, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from data_schema.compiled import compiled

Field = NDArray[np.floating]
Floats = NDArray[np.float64]

# Nodes gone through together: so many states of them stay in the processor's cache, whichever way a field lies.
_NODES = 256


@compiled
def distances(truth: Field, prediction: Field, out: Floats) -> tuple[float, float, int]:
    """Write |q - q~| to `out` (state, node), NaN where `truth` is gone.

    Returns the sums of squares of distance and of displacement over nodes that are there, and how many values of the
    prediction are not finite where the truth is.
    """
    states, nodes = out.shape
    wrong, size, bad = 0.0, 0.0, 0
    for first in range(0, nodes, _NODES):
        for t in range(states):
            for n in range(first, min(first + _NODES, nodes)):
                square, length = 0.0, 0.0
                for k in range(3):
                    u = np.float64(truth[t, n, k])
                    square += (u - prediction[t, n, k]) ** 2
                    length += u * u
                if not isfinite(length):
                    out[t, n] = nan
                    continue
                if not isfinite(square):
                    bad += 1
                out[t, n] = sqrt(square)
                wrong += square
                size += length
    return wrong, size, bad


@compiled
def moments(arm: Floats, field: Field, truth: Field, count: NDArray[np.int64], sums: Floats, products: Floats) -> None:
    """Of each state: how many nodes are there in both fields, and over these the sums of x, y, y x^T.

    x is `arm` (node, 3), y = x + u. count (state,), sums (state, 2, 3), products (state, 3, 3) hold zero before.
    """
    states, nodes = field.shape[:2]
    for first in range(0, nodes, _NODES):
        for t in range(states):
            for n in range(first, min(first + _NODES, nodes)):
                x0, x1, x2 = arm[n, 0], arm[n, 1], arm[n, 2]
                y0, y1, y2 = x0 + field[t, n, 0], x1 + field[t, n, 1], x2 + field[t, n, 2]
                if not (isfinite(y0 + y1 + y2) and isfinite(truth[t, n, 0] + truth[t, n, 1] + truth[t, n, 2])):
                    continue
                count[t] += 1
                sums[t, 0, 0] += x0
                sums[t, 0, 1] += x1
                sums[t, 0, 2] += x2
                sums[t, 1, 0] += y0
                sums[t, 1, 1] += y1
                sums[t, 1, 2] += y2
                products[t, 0, 0] += y0 * x0
                products[t, 0, 1] += y0 * x1
                products[t, 0, 2] += y0 * x2
                products[t, 1, 0] += y1 * x0
                products[t, 1, 1] += y1 * x1
                products[t, 1, 2] += y1 * x2
                products[t, 2, 0] += y2 * x0
                products[t, 2, 1] += y2 * x1
                products[t, 2, 2] += y2 * x2


@compiled
def parted(
    arm: Floats,
    truth: Field,
    prediction: Field,
    true_rotation: Floats,
    true_translation: Floats,
    rotation: Floats,
    translation: Floats,
    count: NDArray[np.int64],
    sums: Floats,
) -> None:
    """Sums over the nodes of each state: count (state,), and the five of sums (state, 5), which hold zero before.

    The distances of rigid displacements, of deformations and of both together, and the sizes of the true rigid
    displacement and deformation, where a rigid motion takes x to R x + T and leaves the deformation R^T (y - T) - x.
    """
    states, nodes = truth.shape[:2]
    for first in range(0, nodes, _NODES):
        for t in range(states):
            a, b = true_rotation[t], rotation[t]
            v, w = true_translation[t], translation[t]
            for n in range(first, min(first + _NODES, nodes)):
                x0, x1, x2 = arm[n, 0], arm[n, 1], arm[n, 2]
                u0, u1, u2 = np.float64(truth[t, n, 0]), np.float64(truth[t, n, 1]), np.float64(truth[t, n, 2])
                if not isfinite(u0 + u1 + u2):
                    continue
                p0, p1, p2 = prediction[t, n, 0], prediction[t, n, 1], prediction[t, n, 2]
                count[t] += 1
                # Rigid displacements.
                r0 = a[0, 0] * x0 + a[0, 1] * x1 + a[0, 2] * x2 + v[0] - x0
                r1 = a[1, 0] * x0 + a[1, 1] * x1 + a[1, 2] * x2 + v[1] - x1
                r2 = a[2, 0] * x0 + a[2, 1] * x1 + a[2, 2] * x2 + v[2] - x2
                s0 = b[0, 0] * x0 + b[0, 1] * x1 + b[0, 2] * x2 + w[0] - x0
                s1 = b[1, 0] * x0 + b[1, 1] * x1 + b[1, 2] * x2 + w[1] - x1
                s2 = b[2, 0] * x0 + b[2, 1] * x1 + b[2, 2] * x2 + w[2] - x2
                sums[t, 0] += sqrt((r0 - s0) ** 2 + (r1 - s1) ** 2 + (r2 - s2) ** 2)
                sums[t, 3] += sqrt(r0 * r0 + r1 * r1 + r2 * r2)
                sums[t, 2] += sqrt((p0 - u0) ** 2 + (p1 - u1) ** 2 + (p2 - u2) ** 2)
                # What is left, turned back.
                e0, e1, e2 = u0 - r0, u1 - r1, u2 - r2
                f0, f1, f2 = p0 - s0, p1 - s1, p2 - s2
                d0 = a[0, 0] * e0 + a[1, 0] * e1 + a[2, 0] * e2
                d1 = a[0, 1] * e0 + a[1, 1] * e1 + a[2, 1] * e2
                d2 = a[0, 2] * e0 + a[1, 2] * e1 + a[2, 2] * e2
                g0 = b[0, 0] * f0 + b[1, 0] * f1 + b[2, 0] * f2 - d0
                g1 = b[0, 1] * f0 + b[1, 1] * f1 + b[2, 1] * f2 - d1
                g2 = b[0, 2] * f0 + b[1, 2] * f1 + b[2, 2] * f2 - d2
                sums[t, 1] += sqrt(g0 * g0 + g1 * g1 + g2 * g2)
                sums[t, 4] += sqrt(d0 * d0 + d1 * d1 + d2 * d2)


@compiled
def furthest(
    arm: Floats, field: Field, nodes: NDArray[np.int64], rotation: Floats, translation: Floats, towards: Floats,
    largest: Floats, where: NDArray[np.int64],
) -> None:  # fmt: skip
    """Of each state the largest deformation of `nodes` along `towards`, and where among `nodes`; -inf where all are gone."""
    for t in range(len(field)):
        c = rotation[t] @ towards
        back = c[0] * translation[t, 0] + c[1] * translation[t, 1] + c[2] * translation[t, 2]
        best, at = -np.inf, 0
        for k in range(len(nodes)):
            n = nodes[k]
            x0, x1, x2 = arm[n, 0], arm[n, 1], arm[n, 2]
            seen = c[0] * (x0 + field[t, n, 0]) + c[1] * (x1 + field[t, n, 1]) + c[2] * (x2 + field[t, n, 2]) - back
            seen -= towards[0] * x0 + towards[1] * x1 + towards[2] * x2
            if seen > best:
                best, at = seen, k
        largest[t], where[t] = best, at
