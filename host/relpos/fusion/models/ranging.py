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


DECORRELATION_M = 0.45
"""Path length of both nodes together over which a range's error changes. Most of it is multipath,
which belongs to the place and not to the moment: in the recordings of robots, consecutive errors
of one pair correlate by 0.5 at 0.3 m and 0.2 to 0.4 at 0.35 m of common path, by 0.9 and more at
a standstill. At half a second's walking it is next to nothing."""

STILL = 0.9
"""Correlation of two ranges without motion in between: a tenth of the variance is independent."""

TURN_M = 0.2
"""A radian of turning counts as so much path: antenna and body turn along."""


@dataclass(slots=True)
class RangeCorrelation:
    """How many independent ranges each counts, by the pair's path since its last one.

    With a correlation rho of consecutive errors each counts (1 - rho) / (1 + rho), the effective
    sample count of a first-order autoregressive sequence: a hundred ranges between two nodes that
    stand say little more than one.
    """

    _path_m: dict[int, float] = field(default_factory=dict)
    _last_m: dict[tuple[int, int], float] = field(default_factory=dict)

    def move(self, node: int, length_m: float, dtheta_rad: float) -> None:
        """Add a displacement to a node's path."""
        length_m += TURN_M * abs(dtheta_rad)
        self._path_m[node] = self._path_m.get(node, 0.0) + length_m

    def effective_counts(self, pairs: Iterable[tuple[int, int]]) -> Floats:
        """Add the ranges of one instant; return (R,), each within (0, 1]."""
        counts = []
        for node, peer in pairs:
            key = (node, peer) if node < peer else (peer, node)
            now = self._path_m.get(node, 0.0) + self._path_m.get(peer, 0.0)
            before = self._last_m.get(key)
            self._last_m[key] = now
            if before is None:
                counts.append(1.0)
                continue
            rho = STILL * math.exp((before - now) / DECORRELATION_M)
            counts.append((1.0 - rho) / (1.0 + rho))
        return np.array(counts)
