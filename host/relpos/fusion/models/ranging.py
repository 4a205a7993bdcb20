"""What a UWB range says about two positions: the paper's eqs. (5) and (6).

    p(z_ij | x_i, x_j) = N(z_ij; |x_i - x_j|, sigma_r^2)

Only positive measurements are considered (paper sect. IV-C). An optional outlier share mixes in
a density that is flat over ``outlier_span_m``, so that one wrong range cannot outvote all others;
it is zero in the paper.

Heights make the distance slant: where the nodes' heights differ by h, the predicted range is
sqrt(|x_i - x_j|^2 + h^2).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class Mounting(Protocol):
    """How a node is worn, as ``run.toml`` tells it; None where it does not."""

    @property
    def height_m(self) -> float | None:
        """Height of the tag over the floor where it starts."""

    @property
    def antenna_offset_m(self) -> tuple[float, float] | None:
        """The antenna's place (forward, left) of the point whose motion is reported."""


@dataclass(frozen=True, slots=True)
class RangeNoise:
    """Parameters of the ranging model: metres, and the share of outliers (0 to 1)."""

    sigma_r_m: float = 2.0
    outliers: float = 0.0
    outlier_span_m: float = 30.0

    @property
    def flat_over_peak(self) -> float:
        """Density of an outlier relative to the peak of all other ranges'; 0 without outliers."""
        if self.outliers <= 0.0:
            return 0.0
        peak = (1.0 - self.outliers) / (math.sqrt(2.0 * math.pi) * self.sigma_r_m)
        return self.outliers / self.outlier_span_m / peak


def predicted_range(dx_m: Floats, dy_m: Floats, dz_m: Floats | float = 0.0) -> Floats:
    """Slant distance over the given differences."""
    squared: Floats = dx_m * dx_m
    squared += dy_m * dy_m
    squared += np.square(dz_m)
    return np.sqrt(squared, out=squared)


def log_likelihood(measured_m: Floats, predicted_m: Floats, noise: RangeNoise) -> Floats:
    """Give eq. (6) as a logarithm, up to a constant; with outliers the mixture's."""
    scaled: Floats = (measured_m - predicted_m) / noise.sigma_r_m
    exponent: Floats = -0.5 * scaled * scaled
    if noise.outliers <= 0.0:
        return exponent
    mixed: Floats = np.logaddexp(exponent, math.log(noise.flat_over_peak))
    return mixed


DECORRELATION_M = 0.45
"""Way of both nodes together over which a range's error changes. Most of it is multipath, which
is the place's and not the moment's: in the recordings of robots, consecutive errors of one pair
correlate by 0.5 at 0.3 m and 0.2 to 0.4 at 0.35 m of common way, by 0.9 and more at a standstill.
At half a second's walking it is next to nothing."""

STILL = 0.9
"""Correlation of two ranges that nobody moved between: a tenth of the variance is the moment's."""

TURN_M = 0.2
"""A radian of turning counts as so much way: antenna and body turn along."""


@dataclass(slots=True)
class Repetition:
    """How many independent ranges one is worth, by how far the two have moved since their last.

    A sequence of errors that correlate by rho from one to the next is worth (1-rho)/(1+rho)
    independent ones each (the effective size of a first-order autoregressive sequence), however
    often the two range: hundred ranges of two who stand tell little more than one.
    """

    _way_m: dict[int, float] = field(default_factory=dict)
    _last_m: dict[tuple[int, int], float] = field(default_factory=dict)

    def move(self, node: int, dx_m: float, dy_m: float, dtheta_rad: float) -> None:
        """Take note of a displacement."""
        self.went(node, math.hypot(dx_m, dy_m), dtheta_rad)

    def went(self, node: int, way_m: float, dtheta_rad: float) -> None:
        """As ``move``, of a displacement so long."""
        way_m += TURN_M * abs(dtheta_rad)
        self._way_m[node] = self._way_m.get(node, 0.0) + way_m

    def worth(self, pairs: Iterable[tuple[int, int]]) -> Floats:
        """Give (R,) for the ranges of one instant, each in (0, 1], and take note of them."""
        worth = []
        for node, peer in pairs:
            key = (node, peer) if node < peer else (peer, node)
            now = self._way_m.get(node, 0.0) + self._way_m.get(peer, 0.0)
            before = self._last_m.get(key)
            self._last_m[key] = now
            if before is None:
                worth.append(1.0)
                continue
            rho = STILL * math.exp((before - now) / DECORRELATION_M)
            worth.append((1.0 - rho) / (1.0 + rho))
        return np.array(worth)
