"""The joint filter's kernels in NumPy, one hypothesis at a time, as matrices.

The equations are those of ``motion_update``, ``range_update`` and ``detection_update`` in
:mod:`relpos.fusion.bank`; nothing of their code is used. Results are returned, not in place.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from relpos.fusion.models.motion import SCALES_TELL

Floats = npt.NDArray[np.float64]

X, Y, HEADING, DRIFT, SCALE = range(5)
PER_NODE = 5


def advance(
    x: Floats,
    p: Floats,
    row: int,
    motion: Floats,
    component: Floats,
    drawn: float,
    share: float,
    cross: float,
) -> tuple[Floats, Floats]:
    """One displacement of one user: x (D,), p (D, D), ``motion`` (7,), ``component`` (3,)."""
    x, p = x.copy(), p.copy()
    b = PER_NODE * row
    dx, dy, turn, dt = motion[:4]
    noise = motion[5] * component[1] + motion[6] * component[2]
    x[b + HEADING] += drawn * np.sqrt(share * noise)
    p[b + HEADING, b + HEADING] += (1.0 - share) * noise
    heading = x[b + HEADING] - 0.5 * dt * x[b + DRIFT]
    variance = p[b + HEADING, b + HEADING] - dt * p[b + HEADING, b + DRIFT]
    rotation = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    whole = np.exp(x[b + SCALE]) * rotation @ np.array([dx, dy])
    mean = whole * np.exp(-0.5 * max(variance, 0.0))
    jacobian = np.eye(x.size)
    across = np.array([-mean[1], mean[0]])
    jacobian[b : b + 2, b + HEADING] = across
    jacobian[b : b + 2, b + DRIFT] = -0.5 * dt * across
    jacobian[b : b + 2, b + SCALE] = mean
    jacobian[b + HEADING, b + DRIFT] = -dt
    x[b : b + 2] += mean
    x[b + HEADING] += turn - dt * x[b + DRIFT]
    p = jacobian @ p @ jacobian.T
    for constant, walk in ((DRIFT, 3e-9), (SCALE, 2e-5)):
        if p[b + constant, b + constant] > 0.0:
            p[b + constant, b + constant] += walk * dt
    length = float(whole @ whole)
    if length > 0.0:
        unit = whole / np.sqrt(length)
        normal = np.array([-unit[1], unit[0]])
        shorter = np.exp(-max(variance, 0.0))
        along = motion[4] * component[0]
        lost = 0.5 * length * (1.0 - shorter) ** 2
        swept = length * max(0.5 * (1.0 - shorter**2) - variance * shorter, 0.0)
        p[b : b + 2, b : b + 2] += (along + lost) * np.outer(unit, unit)
        p[b : b + 2, b : b + 2] += (cross * along + swept) * np.outer(normal, normal)
    return x, p


def predict_range(
    x: Floats, p: Floats, first: int, second: int, dz: float
) -> tuple[float, float, Floats]:
    """Mean and variance of a slant distance, and its covariance with the state (D,)."""
    i, j = PER_NODE * first, PER_NODE * second
    pick = np.zeros((2, x.size))
    pick[0, j], pick[0, i], pick[1, j + 1], pick[1, i + 1] = 1.0, -1.0, 1.0, -1.0
    off, spread = pick @ x, pick @ p @ pick.T
    flat2 = float(off @ off)
    along = float(off @ spread @ off) / flat2
    across = float(np.trace(spread)) - along
    tilt = dz**2 / (flat2 + dz**2)
    square = flat2 + dz**2 + across + tilt * along
    variance = (along * flat2 + 0.5 * (across**2 + tilt**2 * along**2)) / square
    return np.sqrt(square), variance, p @ pick.T @ off / np.sqrt(square)


def update(
    x: Floats,
    p: Floats,
    first: int,
    second: int,
    measured: float,
    dz: float,
    sigma2: float,
    outlier: tuple[float, float, float],
    nodes: int,
    more: Floats | None = None,
    again: tuple[float, float] = (0.0, 0.0),
) -> tuple[Floats, Floats, float]:
    """One range; gives the state and the log evidence (without the constant 2 pi).

    Where it does not tell of both users' common step scale, that stays (partial update).
    ``more`` (D,) is the slope of what is added to the distance; ``again`` the part of the outlier
    share that repeats the last outlier, and how far that was off.
    """
    mean, variance, gain = predict_range(x, p, first, second, dz)
    if more is not None:
        mean, variance = mean + more @ x, variance + 2.0 * gain @ more + more @ p @ more
        gain = gain + p @ more
    share, wide, short = outlier
    nu, s = measured - mean, variance + sigma2
    good = (1.0 - share) * np.exp(-0.5 * nu**2 / s) / np.sqrt(s)
    side = 2.0 * (1.0 - short if nu > 0.0 else short)
    bad = (share - again[0]) * side * np.exp(-0.5 * nu**2 / (s + wide)) / np.sqrt(s + wide)
    bad += again[0] * np.exp(-0.5 * (nu - again[1]) ** 2 / (s + 0.09)) / np.sqrt(s + 0.09)
    inlier = good / (good + bad)
    k = gain / s
    # Used with probability inlier: the mixture's mean and its full covariance.
    # (I - K h^T) P (I - K h^T)^T + K S K^T with less than the whole gain, by that of the whole.
    held = held_gain(p, gain, variance, (first, second), nodes) / s
    x = x + inlier * (k - held) * nu
    p = p - inlier * s * np.outer(k, k) + inlier * (1.0 - inlier) * nu**2 * np.outer(k, k)
    p = p + inlier * s * np.outer(held, held)
    return x, p, float(np.log(good + bad))


def held_gain(
    p: Floats, gain: Floats, variance: float, users: tuple[int, int], nodes: int
) -> Floats:
    """Return P h (D,) as far as it is not used: of two users' common step scale, by regression."""
    mean, scales = np.zeros(len(gain)), np.zeros(len(gain))
    for user in users:
        mean[PER_NODE * user + SCALE] = 0.5
    scales[SCALE : PER_NODE * nodes : PER_NODE] = 1.0
    if not mean @ p @ mean:
        return 0.0 * scales
    slope = (mean @ gain) / (mean @ p @ mean)
    used = max(1.0 - SCALES_TELL * variance / slope**2, 0.0)
    held: Floats = (1.0 - used) * slope * (p @ mean) * scales
    return held


def common_terms(
    x: Floats, p: Floats, nodes: int, first: int, second: int, velocity: Floats, dz: float = 0.0
) -> Floats:
    """Slope (D,) of what ranges have in common, before the pairs' biases, of a range.

    ``velocity`` (2, 2) is forward and left of the first and of the second.
    """
    i, j, common = PER_NODE * first, PER_NODE * second, PER_NODE * nodes
    off = x[j : j + 2] - x[i : i + 2]
    distance = predict_range(x, p, first, second, dz)[0]
    sight = off / distance
    ahead = [np.array([np.cos(h), np.sin(h)]) for h in (x[i + HEADING], x[j + HEADING])]
    moving = [
        v[0] * a + v[1] * np.array([-a[1], a[0]]) for v, a in zip(velocity, ahead, strict=True)
    ]
    slope = np.zeros(x.size)
    slope[common] = 1.0
    slope[common + 1] = max(-sight @ ahead[0], 0.0) + max(sight @ ahead[1], 0.0)
    slope[common + 2] = -sight @ (moving[1] - moving[0])
    slope[common + 3] = np.log(max(distance, 1.0) / 5.0)
    slope[common + 4 + first] = -sight @ moving[1]
    slope[common + 4 + second] = sight @ moving[1]
    return slope


def pass_bias(
    x: Floats, p: Floats, entry: int, common: int, kept: float, variance: float
) -> tuple[Floats, Floats]:
    """Return the state after a pair's bias has kept so much of itself, towards the common one.

    A first-order process about the common bias, with the stationary ``variance``.
    """
    transition = np.eye(x.size)
    transition[entry, entry], transition[entry, common] = kept, 1.0 - kept
    spread = transition @ p @ transition.T
    spread[entry, entry] += (1.0 - kept**2) * variance
    return transition @ x, spread


def detection(
    x: Floats,
    p: Floats,
    first: int,
    second: int,
    received: bool,
    attempted: float,
    weight: float,
    curve: Floats,
    step_m: float,
) -> tuple[Floats, Floats, float]:
    """Whether one attempt was received; gives the state and what it adds to the log weight."""
    mean, variance, gain = predict_range(x, p, first, second, 0.0)
    sd = np.sqrt(variance)

    def chance(z: Floats) -> Floats:
        at = np.interp(mean + z * sd, np.arange(len(curve)) * step_m, curve)
        outcome: Floats = np.power(at if received else 1.0 - attempted * at, weight)
        return outcome

    middle, *edges = chance(np.array([0.0, -2.5, 2.5]))
    if all(0.97 < edge / middle < 1.03 for edge in edges):
        return x, p, float(np.log(middle))
    z = np.linspace(-2.5, 2.5, 11)
    bell = np.exp(-0.5 * z**2)
    bell /= bell.sum()
    density = bell * chance(z)
    mass = density.sum()
    shift = (density * z).sum() / mass
    # Relative to the rule's own variance, which is a little under 1.
    after = min(((density * z**2).sum() / mass - shift**2) / (bell * z**2).sum(), 1.0)
    x = x + gain * shift / sd
    p = p - np.outer(gain, gain) * (1.0 - after) / variance
    return x, p, float(np.log(mass))


def moments(x: Floats, p: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Mean and full covariance of a mixture whose headings are close together."""
    mean = weight @ x
    off = x - mean
    covariance: Floats = np.einsum("k,kij->ij", weight, p)
    covariance += np.einsum("k,ki,kj->ij", weight, off, off)
    return mean, covariance
