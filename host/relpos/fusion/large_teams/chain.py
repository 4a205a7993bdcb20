"""The chain of strips: posterior of a block-tridiagonal Gaussian after ranges.

The covariance P is known within strips and between adjacent ones. It represents the Gaussian of
greatest entropy that has these blocks, a Markov chain of strips:

    p(x) = p(x_1) p(x_2 | x_1) p(x_3 | x_2) ...        P_ac = P_ab P_bb^-1 P_bc  for a < b < c

Ranges are information A about positions, block-tridiagonal like the chain's own. With
B_k = P_kk^-1 P_k,k+1 and V_k+1 = P_k+1,k+1 - P_k+1,k B_k the chain's information is

    L_kk = V_k^-1 + B_k V_k+1^-1 B_k^T,    L_k,k+1 = -B_k V_k+1^-1

and the blocks of (L + A)^-1 follow from one block Cholesky sweep forwards and one of selected
inversion backwards. All other states follow the positions of their strip by regression,
h | p ~ K p + noise, which a range does not change: K = P_hp P_pp^-1, P_hp <- K P_pp,
P_hh <- K P_pp K^T + (P_hh - K P_ph).

BLAS and LAPACK work on whole blocks; symmetric ones are kept as their lower halves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import blas, lapack

from relpos.fusion.arrays import Floats
from relpos.fusion.compiled import compiled
from relpos.fusion.large_teams.layout import COVARIANCE, INFORMATION, StripLayout


def update(layout: StripLayout, covariance: Floats, information: Floats, push: Floats) -> Floats:
    """Add information to a covariance, in place; return how the states change (N, 5, C).

    ``push`` (2 N, C) are right-hand sides, strip by strip; they are overwritten.
    """
    diagonal, following = layout.views(covariance, COVARIANCE)
    added, added_next = layout.views(information, INFORMATION)
    sizes, starts = layout.sizes.tolist(), (2 * layout.first).tolist()
    eliminated: list[_Eliminated] = []
    carried: _Carried | None = None
    for k, n in enumerate(sizes):
        to_next = None
        if k + 1 < len(sizes):
            p = 2 * sizes[k + 1]
            to_next = following[k][: 2 * n, :p], diagonal[k + 1][:p, :p], added_next[k]
        one, carried = _eliminate(
            diagonal[k], n, added[k], push[starts[k] : starts[k + 1]], carried, to_next
        )
        if carried is not None:
            push[starts[k + 1] : starts[k + 2]] -= carried.push
        eliminated.append(one)
    moved = np.empty((len(layout.strip), COVARIANCE, push.shape[1]))
    _back_substitute(layout, eliminated, diagonal, following, moved)
    return moved


def information_of(layout: StripLayout, covariance: Floats, motion: Sequence[Floats]) -> Floats:
    """Return G^T P^-1 G (C, C) of the whole chain; ``motion`` is G, strip by strip (5 n, C).

    With B of the strip before, it is the sum of (G_k - B^T G_k-1)^T V_k^-1 (G_k - B^T G_k-1).
    """
    diagonal, following = layout.views(covariance, COVARIANCE)
    information = np.zeros((motion[0].shape[1],) * 2)
    given, rest = _copy(diagonal[0]), motion[0]
    for k, (block, own) in enumerate(zip(diagonal, motion, strict=True)):
        half = _solve_lower(_lower(given), _copy(rest))
        information += half.T @ half
        if k < len(following):
            # L^-1 P_k,k+1 and L^-1 G_k: their products are B^T P_k,k+1 and B^T G_k.
            factor = _lower(_copy(block))
            ahead = _solve_lower(factor, _copy(following[k]))
            given = _minus_square(ahead, diagonal[k + 1])
            rest = motion[k + 1] - ahead.T @ _solve_lower(factor, _copy(own))
    return information


class _Eliminated(NamedTuple):
    """What the forward sweep leaves of a strip for the backward one."""

    factor: Floats
    """Cholesky factor of the strip's information, given the strips before it."""
    right: Floats
    """The factor's inverse times the right-hand sides."""
    ahead: Floats
    """The factor's inverse times the information between this strip and the next."""
    regression: Floats
    """K^T of the other states on the positions."""
    rest: Floats
    """What the positions leave of the other states' covariance."""


class _Carried(NamedTuple):
    """What eliminating a strip adds to the next one."""

    information: Floats
    push: Floats


def _eliminate(
    block: Floats,
    n: int,
    added: Floats,
    push: Floats,
    before: _Carried | None,
    to_next: tuple[Floats, Floats, Floats] | None,
) -> tuple[_Eliminated, _Carried | None]:
    """Form the chain's information of a strip of ``n`` nodes and eliminate its positions.

    ``to_next`` are the positions' covariance with the next strip, the next strip's own, and the
    information between the two; None for the last strip.
    """
    m = 2 * n
    prior = _lower(_copy(block[:m, :m]))
    others = len(block) - m
    both = np.empty((m, others + (0 if to_next is None else to_next[0].shape[1])), order="F")
    both[:, :others] = block[:m, m:]
    if to_next is not None:
        both[:, others:] = to_next[0]
    both = _solve_lower(prior, both)
    rest = _minus_square(both[:, :others], block[m:, m:])
    given = np.empty((0, 0))
    if to_next is not None:
        given = _lower(_minus_square(both[:, others:], to_next[1]))
    both = _solve_lower(prior, both, transposed=True)
    joined = _inverse(prior) if before is None else before.information
    joined += added
    ahead = coupling = np.empty((m, 0))
    if to_next is not None:
        # Y^T = B L_V^-T, then B V^-1 = Y^T L_V^-1.
        y = blas.dtrsm(1.0, given, both[:, others:], side=1, lower=1, trans_a=1, overwrite_b=1)
        joined = blas.dsyrk(1.0, y, 1.0, joined, lower=1, overwrite_c=1)
        coupling = blas.dtrsm(-1.0, given, y, side=1, lower=1, overwrite_b=1)
        coupling += to_next[2]
    factor = _lower(joined)
    right = _solve_lower(factor, _copy(push))
    carried = None
    if to_next is not None:
        ahead = _solve_lower(factor, coupling)
        carried = _Carried(
            blas.dsyrk(-1.0, ahead, 1.0, _inverse(given), trans=1, lower=1, overwrite_c=1),
            blas.dgemm(1.0, ahead, right, trans_a=1),
        )
    return _Eliminated(factor, right, ahead, both[:, :others], rest), carried


def _back_substitute(
    layout: StripLayout,
    eliminated: list[_Eliminated],
    diagonal: list[Floats],
    following: list[Floats],
    moved: Floats,
) -> None:
    """Fill the posterior blocks and the changes of the states, from the last strip to the first."""
    last = len(eliminated) - 1
    step = later = np.empty((0, 0))
    for k in range(last, -1, -1):
        factor, right, ahead, regression, rest = eliminated[k]
        n = int(layout.sizes[k])
        m = 2 * n
        if k < last:
            p = 2 * int(layout.sizes[k + 1])
            right -= blas.dgemm(1.0, ahead, step)
            slope = _solve_lower(factor, ahead, transposed=True)
            cross = blas.dsymm(-1.0, later, slope, side=1, lower=1)
            later = blas.dgemm(-1.0, cross, slope, 1.0, _inverse(factor), trans_b=1, overwrite_c=1)
            others = blas.dgemm(1.0, cross, eliminated[k + 1].regression)
            block = following[k]
            block[:m, :p] = cross
            block[:m, p:] = others
            block[m:, :p] = blas.dgemm(1.0, regression, cross, trans_a=1)
            block[m:, p:] = blas.dgemm(1.0, regression, others, trans_a=1)
        else:
            later = _inverse(factor)
        step = _solve_lower(factor, right, transposed=True)
        block = diagonal[k]
        others = blas.dsymm(1.0, later, regression, lower=1)
        block[:m, :m] = later
        block[m:, :m] = others.T
        block[m:, m:] = blas.dgemm(1.0, regression, others, 1.0, rest, trans_a=1)
        _fill_upper(block)
        nodes = layout.nodes_of(k)
        moved[nodes, :2] = step.reshape(2, n, -1).swapaxes(0, 1)
        followed = blas.dgemm(1.0, regression, step, trans_a=1)
        moved[nodes, 2:] = followed.reshape(COVARIANCE - 2, n, -1).swapaxes(0, 1)


@compiled
def _fill_upper(matrix: Floats) -> None:
    """Make the lower half of a symmetric matrix its upper one, too."""
    for column in range(1, len(matrix)):
        matrix[:column, column] = matrix[column, :column]


def _lower(matrix: Floats) -> Floats:
    """Cholesky factor of a symmetric matrix in place; ArithmeticError if it is not positive."""
    factor, failed = lapack.dpotrf(matrix, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise ArithmeticError("a covariance block is not positive definite")
    return factor  # type: ignore[no-any-return]


def _solve_lower(factor: Floats, right: Floats, *, transposed: bool = False) -> Floats:
    """L^-1 R or L^-T R; R is overwritten."""
    return blas.dtrsm(  # type: ignore[no-any-return]
        1.0, factor, right, lower=1, trans_a=int(transposed), overwrite_b=1
    )


def _inverse(factor: Floats) -> Floats:
    """(L L^T)^-1, its lower half; L is kept."""
    return lapack.dpotri(factor, lower=1)[0]  # type: ignore[no-any-return]


def _minus_square(half: Floats, of: Floats) -> Floats:
    """Return the lower half of A - H^T H."""
    return blas.dsyrk(  # type: ignore[no-any-return]
        -1.0, half, 1.0, _copy(of), trans=1, lower=1, overwrite_c=1
    )


def _copy(matrix: Floats) -> Floats:
    return np.array(matrix, order="F")
