"""Residuals of chords and ranges, their derivatives, and what they add to the normal equations.

The tests compare them with :mod:`reference.smoother`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.compiled import compiled, inner
from relpos.fusion.models.ranging import GROWTH_LEAST_M, growth_slope
from relpos.fusion.smoother.block_solver import Covariance, Equations
from relpos.fusion.smoother.graph import Chords, Ranges

_growth_slope = inner(growth_slope)


class State(NamedTuple):
    """A point of the optimisation."""

    poses: Floats
    """(K, N, 3): x, y (m), unwrapped heading (rad)."""
    constants: Floats
    """(N + 2 + P + S N,): each node's heading drift (rad/s), the common range bias and growth, each
    pair's own bias (m), and in each of S parts of the run each node's log of true over reported
    length."""


@compiled
def motion_residuals(state: State, chords: Chords) -> Floats:
    """Residuals (K - 1, N, 3) of the reported chords: along (m), across (m), turn (rad).

    With the turn's error r_t = h' - h - turn - drift dt, a chord of the reported length and
    direction (in the frame of its beginning) is seen under h + s r_t + direction, where s is
    ``turn_share``.
    """
    poses, constants = state
    duration_s, length_m, direction_rad, turn_rad, turn_share, scale_at = chords
    knots, nodes = poses.shape[0], poses.shape[1]
    result = np.empty((knots - 1, nodes, 3))
    for k in range(knots - 1):
        for i in range(nodes):
            turn = poses[k + 1, i, 2] - poses[k, i, 2] - turn_rad[k, i]
            turn -= constants[i] * duration_s[k]
            angle = poses[k, i, 2] + turn_share[i] * turn + direction_rad[k, i]
            c, s = math.cos(angle), math.sin(angle)
            shrink = math.exp(-constants[scale_at[k] + i])
            dx, dy = poses[k + 1, i, 0] - poses[k, i, 0], poses[k + 1, i, 1] - poses[k, i, 1]
            result[k, i, 0] = shrink * (c * dx + s * dy) - length_m[k, i]
            result[k, i, 1] = shrink * (c * dy - s * dx)
            result[k, i, 2] = turn
    return result


@compiled
def _motion_derivative(
    state: State, chords: Chords, k: int, i: int, residual: Floats, j: Floats
) -> None:
    """Chord k of node i: residuals (3) and derivatives (3, 8) by both poses, log scale, drift."""
    before, after = state.poses[k, i], state.poses[k + 1, i]
    duration_s, share = chords.duration_s[k], chords.turn_share[i]
    turn = after[2] - before[2] - chords.turn_rad[k, i] - state.constants[i] * duration_s
    angle = before[2] + share * turn + chords.direction_rad[k, i]
    shrink = math.exp(-state.constants[chords.scale_at[k] + i])
    c, s = shrink * math.cos(angle), shrink * math.sin(angle)
    dx, dy = after[0] - before[0], after[1] - before[1]
    along, across = c * dx + s * dy, c * dy - s * dx
    residual[0], residual[1], residual[2] = along - chords.length_m[k, i], across, turn
    g = 1.0 - share
    late = share * duration_s
    j[0, 0], j[0, 1], j[0, 2] = -c, -s, g * across
    j[0, 3], j[0, 4], j[0, 5] = c, s, share * across
    j[0, 6], j[0, 7] = -along, -late * across
    j[1, 0], j[1, 1], j[1, 2] = s, -c, -g * along
    j[1, 3], j[1, 4], j[1, 5] = -s, c, -share * along
    j[1, 6], j[1, 7] = -across, late * along
    j[2, 0], j[2, 1], j[2, 2] = 0.0, 0.0, -1.0
    j[2, 3], j[2, 4], j[2, 5] = 0.0, 0.0, 1.0
    j[2, 6], j[2, 7] = 0.0, -duration_s


@compiled
def add_motions(state: State, chords: Chords, weight: Floats, equations: Equations) -> None:
    """Add the chords' normal equations; ``weight`` (K - 1, N, 3) is 1 / variance.

    Gradients are of half the squares.
    """
    a, e, border, corner, gradient, corner_gradient = equations
    knots, nodes = state.poses.shape[0], state.poses.shape[1]
    j = np.empty((3, 8))
    r = np.empty(3)
    for k in range(knots - 1):
        for i in range(nodes):
            _motion_derivative(state, chords, k, i, r, j)
            r0, r1, r2 = r[0], r[1], r[2]
            w0, w1, w2 = weight[k, i, 0], weight[k, i, 1], weight[k, i, 2]
            at, places = 3 * i, (chords.scale_at[k] + i, i)
            for p in range(8):
                v0, v1, v2 = w0 * j[0, p], w1 * j[1, p], w2 * j[2, p]
                slope = v0 * r0 + v1 * r1 + v2 * r2
                if p < 3:
                    gradient[k, at + p] += slope
                elif p < 6:
                    gradient[k + 1, at + p - 3] += slope
                else:
                    corner_gradient[places[p - 6]] += slope
                for q in range(8):
                    value = v0 * j[0, q] + v1 * j[1, q] + v2 * j[2, q]
                    if p < 3:
                        if q < 3:
                            a[k, at + p, at + q] += value
                        elif q >= 6:
                            border[k, at + p, places[q - 6]] += value
                    elif p < 6:
                        if q < 3:
                            e[k, at + p - 3, at + q] += value
                        elif q < 6:
                            a[k + 1, at + p - 3, at + q - 3] += value
                        else:
                            border[k + 1, at + p - 3, places[q - 6]] += value
                    elif q >= 6:
                        corner[places[p - 6], places[q - 6]] += value


@compiled
def add_component_columns(
    state: State, chords: Chords, force: Floats, axis: Indices, columns: Floats, corner: Floats
) -> None:
    """Add the negative derivative of the gradient by the logarithm of each variance component.

    ``force`` (K - 1, N, C) is share r / V of a component in its residual's variance; component c
    acts on residual ``axis[c]`` (0 along, 1 across, 2 turn). Column i C + c of ``columns``
    (K, b, N C) and of ``corner`` (G, N C) is component c of node i.
    """
    poses, count = state.poses, force.shape[2]
    knots, nodes = poses.shape[0], poses.shape[1]
    j = np.empty((3, 8))
    r = np.empty(3)
    for k in range(knots - 1):
        for i in range(nodes):
            _motion_derivative(state, chords, k, i, r, j)
            at = 3 * i
            for c in range(count):
                column, f, a = count * i + c, force[k, i, c], axis[c]
                for p in range(3):
                    columns[k, at + p, column] += f * j[a, p]
                    columns[k + 1, at + p, column] += f * j[a, 3 + p]
                corner[chords.scale_at[k] + i, column] += f * j[a, 6]
                corner[i, column] += f * j[a, 7]


class _Slopes(NamedTuple):
    """Derivatives of one predicted range."""

    row: Floats
    """(12,) by the poses of node i before (x, y, h), i after, j before, j after."""
    entry: Indices
    constant: Floats
    """(3,) constants, and the derivatives by them: common bias, the pair's, growth."""


@compiled
def _no_slopes() -> _Slopes:
    return _Slopes(np.zeros(12), np.zeros(3, dtype=np.int64), np.zeros(3))


@compiled
def _predict_range(state: State, ranges: Ranges, m: int, slopes: _Slopes) -> float:
    """Return range m as predicted and fill its derivatives; without a pair none by constants."""
    poses, constants, slot, dz_m = state.poses, state.constants, ranges.chord[m], ranges.dz_m[m]
    i, j = ranges.pair[m, 0], ranges.pair[m, 1]
    offset, antenna_m = ranges.offset_m[m], ranges.antenna_m
    row, entry, constant = slopes
    f, g = ranges.fraction[m], 1.0 - ranges.fraction[m]
    x0, y0 = 0.0, 0.0
    for side in range(2):
        node, sign = (i, 1.0) if side == 0 else (j, -1.0)
        before, after = poses[slot, node], poses[slot + 1, node]
        x, y = g * before[0] + f * after[0], g * before[1] + f * after[1]
        c, s = math.cos(before[2]), math.sin(before[2])
        bx = c * offset[2 * side] - s * offset[2 * side + 1]
        by = s * offset[2 * side] + c * offset[2 * side + 1]
        heading = g * before[2] + f * after[2]
        c, s = math.cos(heading), math.sin(heading)
        ox = c * antenna_m[node, 0] - s * antenna_m[node, 1]
        oy = s * antenna_m[node, 0] + c * antenna_m[node, 1]
        x0 += sign * (x + bx + ox)
        y0 += sign * (y + by + oy)
        # Kept here until the direction is known: the lever arms turned by a right angle.
        row[6 * side + 0], row[6 * side + 1] = -by - g * oy, bx + g * ox
        row[6 * side + 3], row[6 * side + 4] = -f * oy, f * ox
    distance = math.sqrt(x0 * x0 + y0 * y0 + dz_m * dz_m)
    # At one and the same place no direction is nearer: the range has no derivative there.
    scale = 1.0 / distance if distance > 1e-6 else 0.0
    ux, uy = x0 * scale, y0 * scale
    for side in range(2):
        sign = 1.0 - 2.0 * side
        at = 6 * side
        row[at + 2] = sign * (ux * row[at] + uy * row[at + 1])
        row[at + 5] = sign * (ux * row[at + 3] + uy * row[at + 4])
        row[at], row[at + 1] = sign * g * ux, sign * g * uy
        row[at + 3], row[at + 4] = sign * f * ux, sign * f * uy
    if ranges.pair_index[m] < 0:
        return distance
    common = poses.shape[1]
    entry[0], entry[1], entry[2] = common, common + 2 + ranges.pair_index[m], common + 1
    constant[0], constant[1], constant[2] = 1.0, 1.0, _growth_slope(distance)
    predicted = distance
    for c in range(3):
        predicted += constant[c] * constants[entry[c]]
    if distance > GROWTH_LEAST_M:
        for p in range(12):
            row[p] *= 1.0 + constants[entry[2]] / distance
    return predicted


@compiled
def range_residuals(state: State, ranges: Ranges, measured_m: Floats) -> Floats:
    """Predicted less measured ranges, (M,)."""
    result, slopes = np.empty(measured_m.size), _no_slopes()
    for m in range(measured_m.size):
        result[m] = _predict_range(state, ranges, m, slopes) - measured_m[m]
    return result


@compiled
def add_ranges(
    state: State, ranges: Ranges, measured_m: Floats, weight: Floats, equations: Equations
) -> None:
    """Add the ranges' normal equations; ``weight`` (M,) is 1 / variance."""
    a, e, border, corner, gradient, corner_gradient = equations
    pairs, slopes = ranges.pair, _no_slopes()
    row, entry, constant = slopes
    for m in range(measured_m.size):
        w = weight[m]
        if w <= 0.0:
            continue
        k = ranges.chord[m]
        r = _predict_range(state, ranges, m, slopes) - measured_m[m]
        modelled = constant.size if ranges.pair_index[m] >= 0 else 0
        for p in range(12):
            value = w * row[p]
            if value == 0.0:
                continue
            late_p = (p // 3) % 2
            at_p = 3 * pairs[m, p // 6] + p % 3
            gradient[k + late_p, at_p] += value * r
            for c in range(modelled):
                border[k + late_p, at_p, entry[c]] += value * constant[c]
            for q in range(12):
                late_q = (q // 3) % 2
                at_q = 3 * pairs[m, q // 6] + q % 3
                if late_p == late_q:
                    a[k + late_p, at_p, at_q] += value * row[q]
                elif late_p == 1:
                    e[k, at_p, at_q] += value * row[q]
        for c in range(modelled):
            value = w * constant[c]
            corner_gradient[entry[c]] += value * r
            for d in range(modelled):
                corner[entry[c], entry[d]] += value * constant[d]


@compiled
def add_range_columns(
    state: State,
    ranges: Ranges,
    weight: Floats,
    added: tuple[Indices, Indices],
    columns: Floats,
    corner: Floats,
) -> None:
    """Add the derivative of the gradient by lengths that are added to some predicted ranges.

    ``added`` are the ranges (L,) and which length is added to each: a column of ``columns``
    (K, b, R) and of ``corner`` (G, R). ``weight`` (M,) is 1 / variance of all ranges.
    """
    chosen, column = added
    pairs, slopes = ranges.pair, _no_slopes()
    row, entry, constant = slopes
    for n in range(chosen.size):
        m, at = chosen[n], column[n]
        k = ranges.chord[m]
        _predict_range(state, ranges, m, slopes)
        for p in range(12):
            late, place = (p // 3) % 2, 3 * pairs[m, p // 6] + p % 3
            columns[k + late, place, at] += weight[m] * row[p]
        if ranges.pair_index[m] >= 0:
            for c in range(constant.size):
                corner[entry[c], at] += weight[m] * constant[c]


@compiled
def motion_variances(state: State, chords: Chords, covariance: Covariance) -> Floats:
    """Posterior variances (K - 1, N, 3) of the chords' residuals."""
    diagonal, below, with_constants, constants, _ = covariance
    knots, nodes = state.poses.shape[0], state.poses.shape[1]
    result = np.empty((knots - 1, nodes, 3))
    j, r, own = np.empty((3, 8)), np.empty(3), np.zeros((8, 8))
    for k in range(knots - 1):
        for i in range(nodes):
            _motion_derivative(state, chords, k, i, r, j)
            at, places = 3 * i, (chords.scale_at[k] + i, i)
            for p in range(3):
                for q in range(3):
                    own[p, q] = diagonal[k, at + p, at + q]
                    own[3 + p, 3 + q] = diagonal[k + 1, at + p, at + q]
                    own[3 + p, q] = own[q, 3 + p] = below[k, at + p, at + q]
            for c in range(2):
                column = places[c]
                for p in range(3):
                    own[p, 6 + c] = own[6 + c, p] = with_constants[k, at + p, column]
                    own[3 + p, 6 + c] = with_constants[k + 1, at + p, column]
                    own[6 + c, 3 + p] = own[3 + p, 6 + c]
                for d in range(2):
                    own[6 + c, 6 + d] = constants[column, places[d]]
            for axis in range(3):
                total = 0.0
                for p in range(8):
                    for q in range(8):
                        total += j[axis, p] * own[p, q] * j[axis, q]
                result[k, i, axis] = total
    return result


@compiled
def range_variances(state: State, ranges: Ranges, covariance: Covariance) -> Floats:
    """Posterior variances (M,) of the predicted ranges, biases included where they have any."""
    diagonal, below, with_constants, constants, _ = covariance
    pairs, slopes = ranges.pair, _no_slopes()
    row, entry, constant = slopes
    result = np.empty(ranges.chord.size)
    for m in range(ranges.chord.size):
        k = ranges.chord[m]
        _predict_range(state, ranges, m, slopes)
        modelled = constant.size if ranges.pair_index[m] >= 0 else 0
        total = 0.0
        for p in range(12):
            if row[p] == 0.0:
                continue
            late_p = (p // 3) % 2
            at_p = 3 * pairs[m, p // 6] + p % 3
            part = 0.0
            for q in range(12):
                late_q = (q // 3) % 2
                at_q = 3 * pairs[m, q // 6] + q % 3
                if late_p == late_q:
                    part += row[q] * diagonal[k + late_p, at_p, at_q]
                elif late_p == 1:
                    part += row[q] * below[k, at_p, at_q]
                else:
                    part += row[q] * below[k, at_q, at_p]
            for c in range(modelled):
                part += 2.0 * constant[c] * with_constants[k + late_p, at_p, entry[c]]
            total += row[p] * part
        for c in range(modelled):
            for d in range(modelled):
                total += constant[c] * constant[d] * constants[entry[c], entry[d]]
        result[m] = total
    return result


@compiled
def two_states(
    density: Floats, chain: Indices, share: float, go_on: float, probability: Floats
) -> tuple[float, float]:
    """Forward-backward passes of two-state Markov chains; fills ``probability`` (M,) of state 0.

    ``density`` (M, 3): in state 0, in state 1 after state 0, in state 1 after state 1. ``chain``
    (M,) tells the chains, one after another. State 1 has the stationary probability ``share`` and
    follows itself with ``go_on``. Returns how often it is expected to do so, and the log
    likelihood.
    """
    count = chain.size
    begin = share * (1.0 - go_on) / (1.0 - share)
    first, second, scale = np.empty(count), np.empty(count), np.empty(count)
    log_likelihood = 0.0
    for m in range(count):
        if m > 0 and chain[m] == chain[m - 1]:
            first[m] = (1.0 - begin) * first[m - 1] + (1.0 - go_on) * second[m - 1]
            second[m] = begin * first[m - 1] * density[m, 1]
            second[m] += go_on * second[m - 1] * density[m, 2]
        else:
            first[m], second[m] = 1.0 - share, share * density[m, 1]
        first[m] *= density[m, 0]
        scale[m] = first[m] + second[m]
        first[m] /= scale[m]
        second[m] /= scale[m]
        log_likelihood += math.log(scale[m])
    followed = 0.0
    late_first, late_second = 1.0, 1.0
    for m in range(count - 1, -1, -1):
        if m == count - 1 or chain[m] != chain[m + 1]:
            late_first, late_second = 1.0, 1.0
        else:
            good = density[m + 1, 0] * late_first / scale[m + 1]
            again = go_on * density[m + 1, 2] * late_second / scale[m + 1]
            bad = density[m + 1, 1] * late_second / scale[m + 1]
            followed += second[m] * again
            late_first = (1.0 - begin) * good + begin * bad
            late_second = (1.0 - go_on) * good + again
        probability[m] = first[m] * late_first
    return followed, log_likelihood
