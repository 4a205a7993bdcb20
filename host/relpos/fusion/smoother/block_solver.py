"""Normal equations of a team's whole track: block Cholesky, solution and covariance.

K knots in time, N nodes, poses (x, y, heading): a block of b = 3 N unknowns a knot, and a border
of G constants (``kernels.State``):

    [ A_0  E_0'              B_0 ]
    [ E_0  A_1  E_1'         B_1 ]          A (K, b, b), E (K - 1, b, b), B (K, b, G), C (G, G)
    [      E_1  A_2  ...     ... ]
    [ B_0' B_1' ...          C   ]
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from relpos.errors import RelposError
from relpos.fusion.arrays import Floats
from relpos.fusion.compiled import compiled


@compiled
def _cholesky_inverse(matrix: Floats, inverse: Floats) -> bool:
    """Inverse of the lower Cholesky factor, in place of ``inverse``; False if not definite."""
    n = matrix.shape[0]
    low = np.zeros((n, n))
    for j in range(n):
        total = matrix[j, j]
        for p in range(j):
            total -= low[j, p] * low[j, p]
        if not total > 0.0:
            return False
        pivot = math.sqrt(total)
        low[j, j] = pivot
        for i in range(j + 1, n):
            total = matrix[i, j]
            for p in range(j):
                total -= low[i, p] * low[j, p]
            low[i, j] = total / pivot
    inverse[:] = 0.0
    for i in range(n):
        scale = 1.0 / low[i, i]
        inverse[i, i] = scale
        for p in range(i):
            factor = -low[i, p] * scale
            for j in range(p + 1):
                inverse[i, j] += factor * inverse[p, j]
    return True


@compiled
def factorise(a: Floats, e: Floats, right: Floats, lower: Floats, w: Floats, v: Floats) -> bool:
    """Block Cholesky of the poses' part, and the border through it; False if not definite.

    ``right`` (K, b, R) is the border with the gradient as a last column. Fills ``lower``
    (K, b, b) with the inverse L^-1 of each diagonal factor, ``w`` (K - 1, b, b) = E L^-T and
    ``v`` (K, b, R) = L^-1 (right - W v of before).
    """
    knots = a.shape[0]
    for k in range(knots):
        block = a[k]
        side = right[k]
        if k > 0:
            block = block - np.dot(w[k - 1], w[k - 1].T)
            side = side - np.dot(w[k - 1], v[k - 1])
        if not _cholesky_inverse(block, lower[k]):
            return False
        # ``v[k] = ...`` would take seconds to compile, with its error message for other shapes.
        np.dot(lower[k], side, v[k])
        if k < knots - 1:
            np.dot(e[k], lower[k].T, w[k])
    return True


@compiled
def back_substitute(lower: Floats, w: Floats, v: Floats) -> Floats:
    """Solve the poses' part for every right side: (K, b, R)."""
    knots = lower.shape[0]
    result = np.empty_like(v)
    for k in range(knots - 1, -1, -1):
        side = v[k]
        if k < knots - 1:
            side = side - np.dot(w[k].T, result[k + 1])
        np.dot(lower[k].T, side, result[k])
    return result


@compiled
def selected_inverse(lower: Floats, w: Floats) -> tuple[Floats, Floats]:
    """Diagonal blocks (K, b, b) of the inverse and those below them (K - 1, b, b).

    Without the border: X C^-1 X' of the solved border is added to it.
    """
    knots, b = lower.shape[0], lower.shape[1]
    diagonal = np.empty((knots, b, b))
    below = np.empty((knots - 1, b, b))
    for k in range(knots - 1, -1, -1):
        np.dot(lower[k].T, lower[k], diagonal[k])
        if k < knots - 1:
            step = np.dot(w[k], lower[k])
            moved = np.dot(diagonal[k + 1], step)
            further = np.dot(step.T, moved)
            for i in range(b):
                for j in range(b):
                    below[k, i, j] = -moved[i, j]
                    diagonal[k, i, j] += further[i, j]
    return diagonal, below


class Covariance(NamedTuple):
    """Blocks of the inverse."""

    diagonal: Floats
    """(K, b, b)"""
    below: Floats
    """(K - 1, b, b) of a knot with the one before."""
    with_constants: Floats
    """(K, b, G)"""
    constants: Floats
    """(G, G)"""
    log_determinant: float
    """Of the whole information matrix."""


class Equations(NamedTuple):
    """Normal equations by blocks: A, E, B, C, and the gradient of poses (K, b) and constants."""

    a: Floats
    e: Floats
    border: Floats
    corner: Floats
    gradient: Floats
    corner_gradient: Floats

    def _factorise(
        self, damping: float, further: Floats | None = None
    ) -> tuple[Floats, Floats, Floats] | None:
        b = self.a.shape[1]
        a = self.a
        if damping > 0.0:
            diagonal = np.arange(b)
            a = a.copy()
            a[:, diagonal, diagonal] *= 1.0 + damping
        parts = [self.border, self.gradient[:, :, None]]
        right = np.concatenate(parts if further is None else [*parts, further], axis=2)
        lower, w, v = np.empty_like(a), np.empty_like(self.e), np.empty_like(right)
        if not factorise(a, self.e, right, lower, w, v):
            return None
        return lower, w, v

    def solve(self, damping: float = 0.0) -> tuple[Floats, Floats] | None:
        """Solve M x = gradient: poses (K, b) and constants (G,); None if not definite."""
        factors = self._factorise(damping)
        if factors is None:
            return None
        lower, w, v = factors
        border, last = v[:, :, :-1].reshape(-1, self.corner.shape[0]), v[:, :, -1].ravel()
        schur = self.corner + damping * np.diag(np.diag(self.corner)) - border.T @ border
        try:
            solved = np.linalg.solve(schur, self.corner_gradient - border.T @ last)
        except np.linalg.LinAlgError:
            return None
        constants: Floats = solved.astype(np.float64)
        side = last - border @ constants
        x = back_substitute(lower, w, side.reshape(*v.shape[:2], 1))
        return x[:, :, 0], constants

    def covariance_and_solution(
        self, columns: Floats, corner_columns: Floats
    ) -> tuple[Covariance, Floats, Floats]:
        """Blocks of the inverse, and the inverse times columns (K, b, R) over (G, R).

        RelposError if the inverse does not exist.
        """
        factors = self._factorise(0.0, columns)
        if factors is None:
            raise RelposError("the trajectory is not observable from these measurements")
        lower, w, v = factors
        size = self.corner.shape[0]
        side, v = v[:, :, size + 1 :], v[:, :, : size + 1]
        diagonal, below = selected_inverse(lower, w)
        b = lower.shape[1]
        pivots = lower[:, np.arange(b), np.arange(b)]
        log_determinant = -2.0 * float(np.log(pivots).sum())
        flat = v[:, :, :-1].reshape(-1, size)
        schur = self.corner - flat.T @ flat
        through = back_substitute(lower, w, np.ascontiguousarray(v[:, :, :-1]))
        constants: Floats = np.linalg.inv(schur).astype(np.float64)
        log_determinant += float(np.linalg.slogdet(schur)[1])
        with_constants = -(through @ constants)
        diagonal -= with_constants @ through.transpose(0, 2, 1)
        below -= with_constants[1:] @ through[:-1].transpose(0, 2, 1)
        found = Covariance(diagonal, below, with_constants, constants, log_determinant)
        solved_constants: Floats = constants @ (
            corner_columns - np.tensordot(v[:, :, :-1], side, axes=((0, 1), (0, 1)))
        )
        side = side - v[:, :, :-1] @ solved_constants
        solved = back_substitute(lower, w, np.ascontiguousarray(side))
        return found, solved, solved_constants
