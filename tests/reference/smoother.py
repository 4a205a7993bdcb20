"""NumPy twins of the smoother's kernels: one dense matrix, derivatives by small steps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


def motion_residuals(
    poses: Floats,
    log_scale: Floats,
    drift_rad_s: Floats,
    duration_s: Floats,
    length_m: Floats,
    direction_rad: Floats,
    turn_rad: Floats,
    follow: Floats,
) -> Floats:
    """Along, across (m) and turn (rad) residuals, (K - 1, N, 3), as complex numbers see them."""
    place = poses[..., 0] + 1j * poses[..., 1]
    turn = np.diff(poses[..., 2], axis=0) - turn_rad - duration_s[:, None] * drift_rad_s
    angle = poses[:-1, :, 2] + follow * turn + direction_rad
    seen = np.exp(-log_scale - 1j * angle) * np.diff(place, axis=0) - length_m
    return np.stack((seen.real, seen.imag, turn), axis=-1)


def range_residuals(
    poses: Floats,
    bias_m: Floats,
    slots: Integers,
    pairs: Integers,
    shares: Floats,
    bends: Floats,
    antenna_m: Floats,
    rise_m: Floats,
    range_m: Floats,
    pair_index: Integers,
) -> Floats:
    """Predicted minus measured ranges, (M,)."""
    ends = []
    for side in (0, 1):
        before, after = poses[slots, pairs[:, side]], poses[slots + 1, pairs[:, side]]
        between = before + shares[:, None] * (after - before)
        lever = antenna_m[pairs[:, side]] @ [1.0, 1j]
        bend = bends[:, 2 * side : 2 * side + 2] @ [1.0, 1j]
        ends.append(
            between[:, 0]
            + 1j * between[:, 1]
            + np.exp(1j * before[:, 2]) * bend
            + np.exp(1j * between[:, 2]) * lever
        )
    slant = np.hypot(np.abs(ends[0] - ends[1]), rise_m)
    result: Floats = slant + bias_m[0] + bias_m[1 + pair_index] - range_m
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
