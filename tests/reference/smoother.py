"""Reference of the smoother's kernels: one dense matrix, derivatives by small steps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from relpos.fusion.smoother.graph import Chords, Ranges

Floats = npt.NDArray[np.float64]


def motion_residuals(
    poses: Floats, log_scale: Floats, drift_rad_s: Floats, chords: Chords
) -> Floats:
    """Along, across (m) and turn (rad) residuals, (K - 1, N, 3), as complex numbers see them."""
    place = poses[..., 0] + 1j * poses[..., 1]
    turn = np.diff(poses[..., 2], axis=0) - chords.turn_rad
    turn = turn - chords.duration_s[:, None] * drift_rad_s
    angle = poses[:-1, :, 2] + chords.turn_share * turn + chords.direction_rad
    seen = np.exp(-log_scale - 1j * angle) * np.diff(place, axis=0) - chords.length_m
    return np.stack((seen.real, seen.imag, turn), axis=-1)


def range_residuals(poses: Floats, bias_m: Floats, ranges: Ranges, measured_m: Floats) -> Floats:
    """Predicted less measured ranges, (M,); ``bias_m``: common, growth, then each pair's."""
    ends = []
    for side in (0, 1):
        node = ranges.pair[:, side]
        before, after = poses[ranges.chord, node], poses[ranges.chord + 1, node]
        between = before + ranges.fraction[:, None] * (after - before)
        lever = ranges.antenna_m[node] @ [1.0, 1j]
        offset = ranges.offset_m[:, 2 * side : 2 * side + 2] @ [1.0, 1j]
        ends.append(
            between[:, 0]
            + 1j * between[:, 1]
            + np.exp(1j * before[:, 2]) * offset
            + np.exp(1j * between[:, 2]) * lever
        )
    slant = np.hypot(np.abs(ends[0] - ends[1]), ranges.dz_m)
    grown = bias_m[1] * np.log(np.maximum(slant, 1.0) / 5.0)
    result: Floats = slant + bias_m[0] + bias_m[2 + ranges.pair_index] + grown - measured_m
    return result


def normal_equations(
    residuals: Callable[[Floats], Floats], at: Floats, weight: Floats, step: float = 1e-6
) -> tuple[Floats, Floats]:
    """Return J' W J and J' W r of residuals (M,) at a point (n,), J by central differences."""
    columns = []
    for k in range(at.size):
        shift = np.zeros(at.size)
        shift[k] = step
        columns.append((residuals(at + shift) - residuals(at - shift)) / (2.0 * step))
    jacobian = np.array(columns).T
    return jacobian.T @ (weight[:, None] * jacobian), jacobian.T @ (weight * residuals(at))


def whole_matrix(a: Floats, e: Floats, border: Floats, corner: Floats) -> Floats:
    """Put the blocks together to one dense symmetric matrix."""
    knots, b, constants = border.shape
    size = knots * b
    result = np.zeros((size + constants, size + constants))
    for k in range(knots):
        at = slice(k * b, (k + 1) * b)
        result[at, at] = a[k]
        result[at, size:], result[size:, at] = border[k], border[k].T
        if k < knots - 1:
            after = slice((k + 1) * b, (k + 2) * b)
            result[after, at], result[at, after] = e[k], e[k].T
    result[size:, size:] = corner
    return result
