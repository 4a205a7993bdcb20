"""Whether a team is told mirrored where it is said to be right: distances cannot show that."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Complexes = npt.NDArray[np.complex128]
Floats = npt.NDArray[np.float64]

ASIDE_M = 0.7
"""Who is nearer to the line of the two others is on no side; no estimator knows of this bound."""


def share_on_wrong_side(
    estimate_m: Complexes, truth_m: Complexes, ok: npt.NDArray[np.bool_]
) -> float:
    """Return the share of triangles that are told as their mirror image, of those that are ok.

    Triangles are those of each node and its two nearest. ``estimate_m`` and ``truth_m`` (T, N) are
    places, east + 1j north, ``ok`` (T, N, N) whether a pair is said to be right. NaN without any.
    """
    told, wrong, (times, nodes) = 0, 0, truth_m.shape
    at = np.arange(times)
    for node in range(nodes if nodes > 2 else 0):
        apart_m = np.abs(truth_m - truth_m[:, node, None])
        apart_m[:, node] = -1.0
        three = np.argsort(apart_m, axis=1, kind="stable")[:, :3].T
        relied_on = np.ones(times, dtype=np.bool_)
        for one, other in ((0, 1), (0, 2), (1, 2)):
            relied_on &= ok[at, three[one], three[other]]
        true_m, said_m = (_height_m(places[at, three]) for places in (truth_m, estimate_m))
        clear = np.minimum(np.abs(true_m), np.abs(said_m)) > ASIDE_M
        told += int(relied_on.sum())
        wrong += int((relied_on & clear & (true_m * said_m < 0.0)).sum())
    return wrong / told if told else math.nan


def _height_m(corners_m: Complexes) -> Floats:
    """Return the heights (T,) of triangles (3, T) over their longest sides, signed."""
    first, second, third = corners_m
    area = ((second - first).conj() * (third - first)).imag
    longest_m = np.abs(corners_m - np.roll(corners_m, 1, axis=0)).max(axis=0)
    height_m: Floats = area / np.maximum(longest_m, 1e-9)
    return height_m
