"""How a user whose start is unknown joins a located team: least squares over what was heard.

Of such a user the last ranges to located users are kept with where those stood and how it has
walked since. Its pose now, x, y and heading, is what fits them:

    z_k ~ | p + R(theta) o_k - q_k |        o_k: own odometry, where it stood then, seen from now

Gauss-Newton with Cauchy's weights from many headings round the ring of the newest range. It joins
once the best fit is good, precise, and no other place fits nearly as well (a mirror image does
until both have walked).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

KEPT = 60
"""So many of the newest ranges are fitted."""

LEAST = 8
"""Not before so many; then again after every ``AGAIN`` more."""

AGAIN = 4

ATTEMPTS = 4
"""So many users are tried at one instant, those who wait longest first: it takes 2 ms each."""

HEADINGS, BEARINGS, ROUNDS = 12, 8, 12
"""Starts of the fit: headings times bearings from the newest peer; steps from each."""

WALK_VARIANCE = 0.01
"""Variance (m^2) that a metre walked since adds to a range: a twentieth in length and 5 degrees."""

APART_M, APART_RAD = 1.0, 0.5
"""Fits that differ by more are other places."""

CLEARLY = 12.0
"""So much worse (chi^2) another place has to fit: odds of 400 to 1."""

PRECISE_M, PRECISE_RAD = 1.0, 0.5
WIDER = 2.0
"""Demanded of the fit; its covariance is taken this many times larger: peers' errors are alike."""


@dataclass(slots=True)
class _Heard:
    """Of one user: o_k x, y (seen from now), way since, q_k x, y, its variance, range."""

    rows: Floats = field(default_factory=lambda: np.empty((0, 7)))
    fresh: int = 0
    waited: int = 0


@dataclass(slots=True)
class Joining:
    """Users that are not located yet."""

    counters: Counter[str] = field(default_factory=Counter)
    _heard: dict[int, _Heard] = field(default_factory=dict)

    def move(self, node: int, dx_m: float, dy_m: float, dtheta_rad: float) -> None:
        """The user walks: all that was is seen from its new pose."""
        heard = self._heard.get(node)
        if heard is None or not heard.rows.size:
            return
        c, s = math.cos(dtheta_rad), math.sin(dtheta_rad)
        x, y = heard.rows[:, 0] - dx_m, heard.rows[:, 1] - dy_m
        heard.rows[:, 0], heard.rows[:, 1] = c * x + s * y, c * y - s * x
        heard.rows[:, 2] += math.hypot(dx_m, dy_m)

    def hear(
        self, node: int, peer_m: tuple[float, float], variance_m2: float, range_m: float
    ) -> None:
        """Keep a range to a located user, who stands at ``peer_m`` with that variance per axis."""
        heard = self._heard.setdefault(node, _Heard())
        row = np.array([[0.0, 0.0, 0.0, *peer_m, variance_m2, range_m]])
        heard.rows = np.concatenate([heard.rows, row])[-KEPT:]
        heard.fresh += 1

    def found(self, sigma_m: float) -> list[tuple[int, Floats, Floats]]:
        """Give users that are found now: id, pose (3,), covariance (3, 3); they are forgotten."""
        ready = [
            (heard.waited, node)
            for node, heard in self._heard.items()
            if len(heard.rows) >= LEAST and heard.fresh >= AGAIN
        ]
        result: list[tuple[int, Floats, Floats]] = []
        for _, node in sorted(ready, key=lambda one: (-one[0], one[1])):
            heard = self._heard[node]
            heard.waited += 1
            if len(result) >= ATTEMPTS:
                continue
            heard.fresh = heard.waited = 0
            fit = locate(heard.rows, sigma_m)
            if fit is not None:
                result.append((node, *fit))
                del self._heard[node]
                self.counters["joined"] += 1
        return result


def locate(rows: Floats, sigma_m: float) -> tuple[Floats, Floats] | None:
    """Fit a pose to what was heard (rows of ``_Heard``); None where that is not clear yet."""
    own, peer, measured = rows[:, :2], rows[:, 3:5], rows[:, 6]
    variance = sigma_m**2 + rows[:, 5] + WALK_VARIANCE * rows[:, 2]
    heading = np.repeat(np.arange(HEADINGS) * (2.0 * math.pi / HEADINGS), BEARINGS)
    bearing = np.tile(np.arange(BEARINGS) * (2.0 * math.pi / BEARINGS), HEADINGS)
    pose = np.stack(
        [
            peer[-1, 0] + measured[-1] * np.cos(bearing),
            peer[-1, 1] + measured[-1] * np.sin(bearing),
            heading,
        ],
        axis=1,
    )
    for _ in range(ROUNDS):
        off, square, j = _residuals(pose, own, peer, measured, variance)
        weight = 1.0 / (1.0 + square / 9.0) / variance
        normal = np.einsum("fka,fk,fkb->fab", j, weight, j) + 1e-6 * np.eye(3)
        step = np.linalg.solve(normal, np.einsum("fka,fk,fk->fa", j, weight, off)[..., None])
        pose = pose + np.clip(step[..., 0], -3.0, 3.0)
    _, square, j = _residuals(pose, own, peer, measured, variance)
    cost = (9.0 * np.log1p(square / 9.0)).sum(axis=1)
    best = int(cost.argmin())
    turned = np.abs(np.remainder(pose[:, 2] - pose[best, 2] + math.pi, 2.0 * math.pi) - math.pi)
    away = np.hypot(*(pose[:, :2] - pose[best, :2]).T)
    others = cost[(away > APART_M) | (turned > APART_RAD)]
    if others.size and others.min() - cost[best] < CLEARLY:
        return None
    if np.median(square[best]) > 1.5:  # of one degree of freedom it is 0.45
        return None
    information = np.einsum("ka,k,kb->ab", j[best], 1.0 / variance, j[best])
    if np.linalg.matrix_rank(information) < 3:
        return None
    covariance: Floats = WIDER * np.linalg.inv(information)
    sigma = math.sqrt(max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 0.0))
    if sigma > PRECISE_M or covariance[2, 2] > PRECISE_RAD**2:
        return None
    return pose[best], covariance


def _residuals(
    pose: Floats, own: Floats, peer: Floats, measured: Floats, variance: Floats
) -> tuple[Floats, Floats, Floats]:
    """Measured minus expected (F, K), its square over the variance, and the Jacobian (F, K, 3)."""
    c, s = np.cos(pose[:, 2:3]), np.sin(pose[:, 2:3])
    x, y = c * own[:, 0] - s * own[:, 1], s * own[:, 0] + c * own[:, 1]
    dx, dy = pose[:, 0:1] + x - peer[:, 0], pose[:, 1:2] + y - peer[:, 1]
    distance = np.maximum(np.hypot(dx, dy), 1e-6)
    off = measured - distance
    ux, uy = dx / distance, dy / distance
    return off, off * off / variance, np.stack([ux, uy, uy * x - ux * y], axis=2)
