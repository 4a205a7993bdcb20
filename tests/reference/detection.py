"""Reference implementation of the detection statistics, in NumPy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from relpos.fusion.models.detection import (
    FAILS,
    LENGTH,
    STEP_M,
    TRUSTED_M,
    Attempts,
    Statistics,
)

Floats = npt.NDArray[np.float64]

_OFFSETS = np.sqrt(3.0) * np.array([[-1.0], [0.0], [1.0]])
_SHARES = np.array([[1.0], [4.0], [1.0]]) / 6.0
"""Three-point Gauss-Hermite rule."""


def add_attempts(attempts: Attempts, curve: Floats, statistics: Statistics) -> Floats:
    """Add one round, in place; return how surely each missed attempt was made."""
    first, second, received, observable, distance_m, sigma_m = attempts
    grid_m = np.arange(LENGTH) * STEP_M
    chance = (_SHARES * np.interp(distance_m + _OFFSETS * sigma_m, grid_m, curve)).sum(axis=0)
    # Each node's probability that its UWB works, from whether any other receives it.
    working, surprise, counts, sums = statistics
    busy = {int(slot) for slot in (*first[:received], *second[:received])}
    silences: dict[int, float] = {}
    for a, b, p in zip(first[received:], second[received:], chance[received:], strict=True):
        for slot in (int(a), int(b)):
            if slot not in busy:
                silences[slot] = silences.get(slot, 1.0) * (1.0 - float(p))
    working[list(busy)] = 1.0
    for slot, silence in silences.items():
        up = working[slot] * (1.0 - FAILS)
        working[slot] = up * silence / (up * silence + 1.0 - up)
    attempted: Floats = working[first[received:]] * working[second[received:]]
    weight = 1.0 / (1.0 + (sigma_m / TRUSTED_M) ** 2)
    weight[:received] *= observable
    weight[received:] *= attempted
    # Each pair's surprise beside its last one.
    now = (np.arange(len(first)) < received) - chance
    before = surprise[first, second]
    again = ~np.isnan(before)
    w, then, since = weight[again], before[again], now[again]
    sums[0] += float((w * then * since).sum())
    sums[1] += float((w * 0.5 * (then**2 + since**2)).sum())
    surprise[first, second] = now
    # Attempts are spread over the two nearest entries of three places each.
    place = np.clip((distance_m + _OFFSETS * sigma_m) / STEP_M, 0.0, LENGTH - 1.0)
    index = np.minimum(place.astype(np.intp), LENGTH - 2)
    beyond = place - index
    share = _SHARES * weight
    for outcome, some in ((1, slice(None, received)), (0, slice(received, None))):
        np.add.at(counts[outcome], index[:, some], (share * (1.0 - beyond))[:, some])
        np.add.at(counts[outcome], index[:, some] + 1, (share * beyond)[:, some])
    sums[2] += float(weight.sum())
    return attempted
