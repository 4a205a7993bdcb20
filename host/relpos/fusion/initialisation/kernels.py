"""Kernels of the initial pose search: many fits of tracks to ranges at once.

The parameters (D,) of one fit, a *hypothesis*, are for each of N nodes the present pose and the
errors of its dead reckoning on the way to it,

    x, y (m), heading (rad), log of true over reported length, turn_1 ... turn_K (rad)

and one range bias (m) common to all: D = N (4 + K) + 1. ``turn_k`` is a heading error made at the
node's k-th knot, counted back from now: everything older is turned about the place of the knot.
The reference is the present pose, not the start, so that old data count less (their variance has
grown) and the answer needs no extrapolation.

A range is predicted as |p_i(t) - p_j(t)| + bias. Its error is a mixture of a Gaussian and a wider
one (outliers); Gauss-Newton takes both with their fractions. Where a range is short against its
error a circle is of no use to a linear solver: such a range, a *disc*, says that the difference of
the two places is normal about zero with variance range^2 / 2 + sigma^2 along each axis.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.compiled import compiled, inner
from relpos.fusion.initial_poses import POSE

PER_NODE = 4
"""Parameters of a node before its turns: x, y, heading, log scale."""

SCALE_VARIANCE, BIAS_VARIANCE_M2 = 0.2**2, 0.3**2
"""Priors of the log scales and of the range bias, of sensors that have just been met."""

OUTLIER_FRACTION = 0.05
OUTLIER_VARIANCE_M2 = 9.0
"""Outlier mixture: 5 % with 3 m."""

_TINY = 1e-12


class Tracks(NamedTuple):
    """Dead reckoning of N nodes at T times, as seen from their present poses."""

    poses: Floats
    """(T, N, 3), m and rad."""
    segments: Indices
    """(T, N): number of knots between then and now."""
    knots: Floats
    """(K + 1, N, 2), m: places of the knots, counted back; the first is now."""
    turn_variance: Floats
    """(K, N), rad^2."""

    def place(self, parameters: Floats, i: int, time: int) -> Floats:
        """Return the place (2,) of node i at a time index, by its own parameters (4 + K,)."""
        stretch, angle = math.exp(parameters[3]), float(parameters[2])
        place = parameters[:2].copy()
        segment = int(self.segments[time, i])
        corners = [*self.knots[: segment + 1, i], self.poses[time, i, :2]]
        for k in range(segment + 1):
            dx, dy = corners[k + 1] - corners[k]
            c, s = stretch * math.cos(angle), stretch * math.sin(angle)
            place += (c * dx - s * dy, s * dx + c * dy)
            if k < segment:
                angle += float(parameters[PER_NODE + k])
        return place


class Priors(NamedTuple):
    """What is known of the nodes' poses at one time each."""

    at: Indices
    """(N,), indices of times."""
    mean: Floats
    """(N, 3)."""
    precision: Floats
    """(N, 3), zero where nothing is known."""


class Ranges(NamedTuple):
    """E ranges between nodes, or between a node and a fixed place."""

    ends: Indices
    """(E, 2): index of the node, or -1 for a fixed place."""
    at: Indices
    """(E,), indices of times."""
    range_m: Floats
    variance_m2: Floats
    height2_m2: Floats
    """(E,), squared height difference."""
    is_disc: Bools
    places: Floats
    """(E, 2, 2), m: the fixed places."""


class Problem(NamedTuple):
    """What hypotheses are fitted to."""

    tracks: Tracks
    priors: Priors
    ranges: Ranges
    cell: Floats
    """(3 N,), m and rad: largest standard deviations of one hypothesis."""


class Fits(NamedTuple):
    """M hypotheses, filled by :func:`fit`."""

    parameters: Floats
    """(M, D)."""
    costs: Floats
    """(M,), -2 log posterior."""
    log_volumes: Floats
    """(M,), half the log determinant of the covariance."""
    covariances: Floats
    """(M, 3 N, 3 N), of the present poses."""


class System(NamedTuple):
    """The Gauss-Newton system of one hypothesis."""

    cost: Floats
    """(1,), -2 log posterior."""
    hessian: Floats
    """(D, D), of which the lower triangle counts."""
    gradient: Floats
    """(D,)."""


class _Work(NamedTuple):
    """Memory of :func:`normal_equations`."""

    offset: Floats
    """(N, K + 1, 2): the knots as seen from the present place, with the hypothesis's errors."""
    angle: Floats
    """(N, K + 1): by how much each segment is turned."""
    place: Floats
    """(2, 2): places of a range's two ends."""
    slope: Floats
    """(2, 2, 4 + K): their derivatives by the node's own parameters."""
    row: Floats
    column: Indices
    """Derivatives of a residual, and the parameters that they belong to."""


@compiled
def normal_equations(parameters: Floats, problem: Problem, system: System) -> None:
    """Fill the Gauss-Newton system of one hypothesis."""
    nodes, count = problem.tracks.poses.shape[1], problem.tracks.knots.shape[0] - 1
    each = PER_NODE + count
    # Loops in place of expressions of arrays, which take the compiler seconds.
    system.cost[0] = 0.0
    for i in range(parameters.size):
        system.gradient[i] = 0.0
        for j in range(parameters.size):
            system.hessian[i, j] = 0.0
    work = _Work(
        np.zeros((nodes, count + 1, 2)), np.zeros((nodes, count + 1)), np.zeros((2, 2)),
        np.zeros((2, 2, each)), np.zeros(2 * each + 1), np.zeros(2 * each + 1, dtype=np.intp),
    )  # fmt: skip
    _add_parameter_priors(parameters, problem, system)
    _bend_tracks(parameters, problem.tracks, work)
    for i in range(nodes):
        if problem.priors.precision[i, 0] != 0.0 or problem.priors.precision[i, 2] != 0.0:
            _add_pose_prior(parameters, i, problem, work, system)
    for e in range(problem.ranges.at.size):
        _add_range(parameters, e, problem, work, system)


@inner
def _add_parameter_priors(parameters: Floats, problem: Problem, system: System) -> None:
    """Add the priors of turns, scales and the range bias, all about zero."""
    nodes, count = problem.tracks.poses.shape[1], problem.tracks.knots.shape[0] - 1
    cost, hessian, gradient = system
    for i in range(nodes):
        base = i * (PER_NODE + count)
        for k in range(count):
            precision = 1.0 / problem.tracks.turn_variance[k, i]
            turn = parameters[base + PER_NODE + k]
            cost[0] += precision * turn * turn
            hessian[base + PER_NODE + k, base + PER_NODE + k] += precision
            gradient[base + PER_NODE + k] -= precision * turn
        precision = 1.0 / SCALE_VARIANCE
        cost[0] += precision * parameters[base + 3] ** 2
        hessian[base + 3, base + 3] += precision
        gradient[base + 3] -= precision * parameters[base + 3]
    bias = parameters[parameters.size - 1]
    cost[0] += bias * bias / BIAS_VARIANCE_M2
    hessian[parameters.size - 1, parameters.size - 1] += 1.0 / BIAS_VARIANCE_M2
    gradient[parameters.size - 1] -= bias / BIAS_VARIANCE_M2


@inner
def _bend_tracks(parameters: Floats, tracks: Tracks, work: _Work) -> None:
    """Turn the tracks at their knots, and scale them."""
    count = tracks.knots.shape[0] - 1
    for i in range(tracks.knots.shape[1]):
        base = i * (PER_NODE + count)
        stretch = math.exp(parameters[base + 3])
        work.angle[i, 0] = parameters[base + 2]
        for k in range(count):
            c, s = stretch * math.cos(work.angle[i, k]), stretch * math.sin(work.angle[i, k])
            dx = tracks.knots[k + 1, i, 0] - tracks.knots[k, i, 0]
            dy = tracks.knots[k + 1, i, 1] - tracks.knots[k, i, 1]
            work.offset[i, k + 1, 0] = work.offset[i, k, 0] + c * dx - s * dy
            work.offset[i, k + 1, 1] = work.offset[i, k, 1] + s * dx + c * dy
            work.angle[i, k + 1] = work.angle[i, k] + parameters[base + PER_NODE + k]


@inner
def _add_pose_prior(
    parameters: Floats, i: int, problem: Problem, work: _Work, system: System
) -> None:
    """Add what is known of node i's pose at one time."""
    each = work.slope.shape[2]
    base, t = i * each, problem.priors.at[i]
    segment = problem.tracks.segments[t, i]
    _place_end(parameters, i, t, problem.tracks, work, 0)
    for a in range(POSE):
        precision = problem.priors.precision[i, a]
        if precision == 0.0:
            continue
        for q in range(each):
            work.row[q] = work.slope[0, a, q] if a < 2 else 0.0
        if a < 2:
            off = problem.priors.mean[i, a] - work.place[0, a]
        else:
            off = problem.priors.mean[i, 2]
            off -= work.angle[i, segment] + problem.tracks.poses[t, i, 2]
            off -= 2.0 * math.pi * math.floor(off / (2.0 * math.pi) + 0.5)
            work.row[2] = 1.0
            for k in range(segment):
                work.row[PER_NODE + k] = 1.0
        system.cost[0] += precision * off * off
        for p in range(each):
            system.gradient[base + p] += precision * off * work.row[p]
            for q in range(each):
                system.hessian[base + p, base + q] += precision * work.row[p] * work.row[q]


@inner
def _add_range(parameters: Floats, e: int, problem: Problem, work: _Work, system: System) -> None:
    """Add range e."""
    ranges, place, each = problem.ranges, work.place, work.slope.shape[2]
    used = 0
    for end in range(2):
        i = ranges.ends[e, end]
        if i < 0:
            place[end, 0], place[end, 1] = ranges.places[e, end, 0], ranges.places[e, end, 1]
        else:
            _place_end(parameters, i, ranges.at[e], problem.tracks, work, end)
            for q in range(each):
                work.column[used + q] = i * each + q
            used += each
    dx, dy = place[1, 0] - place[0, 0], place[1, 1] - place[0, 1]
    if ranges.is_disc[e]:
        variance = 0.5 * ranges.range_m[e] ** 2 + ranges.variance_m2[e]
        _differentiate(ranges.ends, e, 1.0, 0.0, work)
        _add_residual(-dx, variance, used, work, system)
        _differentiate(ranges.ends, e, 0.0, 1.0, work)
        _add_residual(-dy, variance, used, work, system)
        return
    distance = math.sqrt(dx * dx + dy * dy + ranges.height2_m2[e]) + 1e-6
    _differentiate(ranges.ends, e, dx / distance, dy / distance, work)
    work.row[used], work.column[used] = 1.0, parameters.size - 1
    off = ranges.range_m[e] - distance - parameters[parameters.size - 1]
    _add_residual(off, ranges.variance_m2[e], used + 1, work, system)


@inner
def _differentiate(ends: Indices, e: int, ux: float, uy: float, work: _Work) -> None:
    """Fill the derivatives of the difference of range e's ends along (ux, uy)."""
    each, used = work.slope.shape[2], 0
    for end in range(2):
        if ends[e, end] >= 0:
            sign = 1.0 if end == 1 else -1.0
            for q in range(each):
                slope = ux * work.slope[end, 0, q] + uy * work.slope[end, 1, q]
                work.row[used + q] = sign * slope
            used += each


@inner
def _place_end(parameters: Floats, i: int, t: int, tracks: Tracks, work: _Work, end: int) -> None:
    """Fill place and slope of one end: node i at time index t."""
    offset, slope = work.offset, work.slope
    each = slope.shape[2]
    base, segment = i * each, tracks.segments[t, i]
    stretch = math.exp(parameters[base + 3])
    c = stretch * math.cos(work.angle[i, segment])
    s = stretch * math.sin(work.angle[i, segment])
    dx = tracks.poses[t, i, 0] - tracks.knots[segment, i, 0]
    dy = tracks.poses[t, i, 1] - tracks.knots[segment, i, 1]
    x = offset[i, segment, 0] + c * dx - s * dy
    y = offset[i, segment, 1] + s * dx + c * dy
    work.place[end, 0], work.place[end, 1] = parameters[base] + x, parameters[base + 1] + y
    slope[end, 0, 0], slope[end, 1, 0] = 1.0, 0.0
    slope[end, 0, 1], slope[end, 1, 1] = 0.0, 1.0
    slope[end, 0, 2], slope[end, 1, 2] = -y, x
    slope[end, 0, 3], slope[end, 1, 3] = x, y
    for k in range(each - PER_NODE):
        if k < segment:
            slope[end, 0, PER_NODE + k] = -(y - offset[i, k + 1, 1])
            slope[end, 1, PER_NODE + k] = x - offset[i, k + 1, 0]
        else:
            slope[end, 0, PER_NODE + k] = 0.0
            slope[end, 1, PER_NODE + k] = 0.0


@inner
def _add_residual(off: float, variance: float, used: int, work: _Work, system: System) -> None:
    """Add one residual of the outlier mixture, whose ``used`` derivatives are in ``work.row``."""
    row, column = work.row, work.column
    wide = variance + OUTLIER_VARIANCE_M2
    near = (1.0 - OUTLIER_FRACTION) * math.exp(-0.5 * off * off / variance)
    far = OUTLIER_FRACTION * math.sqrt(variance / wide) * math.exp(-0.5 * off * off / wide)
    both = near + far + 1e-300
    weight = near / both / variance + far / both / wide
    for p in range(used):
        weighted = weight * row[p]
        system.gradient[column[p]] += weighted * off
        for q in range(p + 1):
            system.hessian[column[p], column[q]] += weighted * row[q]
    system.cost[0] += -2.0 * math.log(both)


@compiled
def fit(fits: Fits, iterations: int, problem: Problem) -> None:
    """Fit M hypotheses by Levenberg-Marquardt, in place.

    Along what the data leave open the covariances end at ``problem.cell``: one hypothesis stands
    for a cell of that size.
    """
    size = fits.parameters.shape[1]
    system = System(np.zeros(1), np.zeros((size, size)), np.zeros(size))
    trial_system = System(np.zeros(1), np.zeros((size, size)), np.zeros(size))
    factor = np.zeros((size, size))
    step, trial = np.zeros(size), np.zeros(size)
    each = PER_NODE + problem.tracks.knots.shape[0] - 1
    for m in range(fits.parameters.shape[0]):
        parameters = fits.parameters[m]
        damping = 1e-3
        cost = math.inf
        for i in range(size):
            step[i] = 0.0
        # The first round only evaluates. (One call alone: it is compiled into here.)
        for rounds in range(iterations + 1):
            for i in range(size):
                trial[i] = parameters[i] + step[i]
            normal_equations(trial, problem, trial_system)
            if trial_system.cost[0] < cost:
                gain = cost - trial_system.cost[0]
                cost = trial_system.cost[0]
                for i in range(size):
                    parameters[i] = trial[i]
                system, trial_system = trial_system, system
                if rounds > 0:
                    damping = max(0.2 * damping, 1e-6)
                if gain < 0.01:
                    break
            else:
                damping *= 8.0
                if damping > 1e6:
                    break
            while not _factor(system.hessian, damping, factor) and damping < 1e9:
                damping = max(damping * 10.0, 1e-6)
            _solve(factor, system.gradient, step)
            _shorten(step, each)
        fits.costs[m] = cost
        _invert(m, problem.cell, each, system.hessian, factor, fits)


@inner
def _shorten(step: Floats, each: int) -> None:
    """Bound a step's turns: a wide one leaves the neighbourhood that the system was made for."""
    largest = 0.0
    for base in range(0, step.size - 1, each):
        largest = max(largest, abs(step[base + 2]), 2.0 * abs(step[base + 3]))
    shrink = min(1.0, 0.7 / (largest + _TINY))
    for i in range(step.size):
        step[i] *= shrink


@inner
def _invert(m: int, cell: Floats, each: int, hessian: Floats, factor: Floats, fits: Fits) -> None:
    """Fill the log volume and the poses' covariance of hypothesis m."""
    size, nodes = hessian.shape[0], cell.size // POSE
    for i in range(nodes):
        for a in range(POSE):
            hessian[i * each + a, i * each + a] += 1.0 / cell[i * POSE + a] ** 2
    if not _factor(hessian, 0.0, factor):
        fits.costs[m] = math.inf
        return
    total = 0.0
    for i in range(size):
        total -= math.log(factor[i, i])
    fits.log_volumes[m] = total
    unit, column = np.zeros(size), np.zeros(size)
    for i in range(nodes):
        for a in range(POSE):
            unit[i * each + a] = 1.0
            _solve(factor, unit, column)
            unit[i * each + a] = 0.0
            for j in range(nodes):
                for b in range(POSE):
                    fits.covariances[m, i * POSE + a, j * POSE + b] = column[j * each + b]


@inner
def _factor(matrix: Floats, damping: float, factor: Floats) -> bool:
    """Cholesky of the lower triangle with its diagonal times 1 + damping."""
    for j in range(matrix.shape[0]):
        total = matrix[j, j] * (1.0 + damping) + _TINY
        for k in range(j):
            total -= factor[j, k] * factor[j, k]
        if not total > 0.0:
            return False
        root = math.sqrt(total)
        factor[j, j] = root
        for i in range(j + 1, matrix.shape[0]):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = total / root
    return True


@inner
def _solve(factor: Floats, right: Floats, solution: Floats) -> None:
    """Solve L L^T x = b."""
    size = right.size
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * solution[k]
        solution[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = solution[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * solution[k]
        solution[i] = total / factor[i, i]
