"""What a team's heights say of the air together.

In air that is blown all heights rise alike, by an unknown common rise. Given that rise, nodes are
independent: so the probability of the team's heights is a product over nodes for each rise, and
what the others say to one node is the product without its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Bools, Floats
from relpos.fusion.normal import normal_density
from relpos.fusion.vertical.modes import FOLLOWS, Air

FAN_M_S = 0.25
"""Pressure of a fan, in metres a second: 25 Pa within 10 s are 0.21."""

RISES = np.linspace(-3.0, 3.0, 41)
"""Common rises that are considered, over their deviation."""
_LOG_PRIOR = -0.5 * RISES**2 - np.log(np.exp(-0.5 * RISES**2).sum())


class CommonRises(NamedTuple):
    """How well R common rises explain the heights of N nodes."""

    rises_m: Floats
    """The common rises (R,)."""
    density: Floats
    """Of each node's height in each mode (N, MODES, R)."""
    news: Bools
    """Whether a node reported a height (N, 1)."""

    def of_each(self, modes: Floats) -> Floats:
        """Return how probable each node finds each rise (N, R), as a logarithm.

        ``modes`` (N, MODES) are the probabilities of each one's modes in blown air.
        """
        density = (modes[:, :, None] * self.density).sum(axis=1)
        return np.log(np.where(self.news, np.maximum(density, 1e-200), 1.0))


class Others(NamedTuple):
    """What the others say to each of N nodes."""

    evidence: Floats
    """How probable they find each air (N, AIRS), relative to the most probable."""
    rise_m: Floats
    """The common rise in blown air (N,)."""
    rise_m2: Floats
    """Its variance."""


def common_rises(off_m: Floats, variance_m2: Floats, duration_s: float) -> CommonRises:
    """Try common rises on an interval's innovations in blown air (N, MODES); NaN without news."""
    rises_m = RISES * FAN_M_S * duration_s
    news = np.isfinite(off_m)
    off_m = np.where(news, off_m, 0.0)[:, :, None] - FOLLOWS[:, None] * rises_m
    return CommonRises(rises_m, normal_density(off_m, variance_m2[:, :, None]), news[:, :1])


def of_others(in_calm: Floats, blown: CommonRises, modes: Floats) -> Others:
    """Return what the others say; ``in_calm`` (N, AIRS) is how probable each finds its own height.

    ``modes`` (N, MODES) are the probabilities of each one's modes in blown air.
    """
    own = np.log(np.maximum(in_calm, 1e-200))
    evidence = own.sum(axis=0) - own
    rises_m, by_rise = blown.rises_m, blown.of_each(modes)
    others = by_rise.sum(axis=0) - by_rise + _LOG_PRIOR
    highest = others.max(axis=1)
    density = np.exp(others - highest[:, None])
    mass = density.sum(axis=1)
    evidence[:, Air.BLOWN] = np.log(mass) + highest
    rise_m = density @ rises_m / mass
    return Others(
        np.exp(np.maximum(evidence - evidence.max(axis=1, keepdims=True), -70.0)),
        rise_m,
        density @ rises_m**2 / mass - rise_m**2,
    )


def common_rise(blown: CommonRises, modes: Floats) -> float:
    """Return how much the air let all heights rise (m), if it was blown, by what each did."""
    together = blown.of_each(modes).sum(axis=0) + _LOG_PRIOR
    density = np.exp(together - together.max())
    return float(density @ blown.rises_m / density.sum())
