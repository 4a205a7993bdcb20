"""Ranges that are too long for a while, and that tracks have followed.

Past a wall or a body all ranges of a pair are too long for some seconds, and alike. Tracks that
were bent to them fit them, so that no residual shows it, and the alternation stays there. A score
test does (Rao 1948): give a block of a pair's ranges an excess e of its own. With residuals r
(predicted less measured), weights w, the slopes c of all other unknowns by e, and the inverse H^-1
of the normal equations, a step from e = 0 leads to

    e = -sum(w r) / I,    I = sum(w) - c' H^-1 c,

and gains e^2 I / 2 of log likelihood. Blocks that gain are taken for outliers, all at once; the
alternation goes on from there, and the greater evidence decides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.smoother import kernels
from relpos.fusion.smoother.kernels import State
from relpos.fusion.smoother.problem import Problem, Weights
from relpos.fusion.smoother.solution import Solution, smooth
from relpos.fusion.smoother.variance_components import motion_bases, weights_of

BLOCKS_S = (10.0, 20.0, 40.0)
"""What stands in between does so for so long; each also begins at half of it."""

LEAST_GAIN, LEAST_M = 1.0, 2.0
"""A block is doubted if it gains so much, and its excess is so many range sigmas long."""

BETTER_BY = 0.5
"""How much more (logarithmic) evidence it has to have without them."""

NUMBERS_AT_A_TIME = 2_000_000
"""So many numbers are in the right sides that are solved for together."""


class Excesses(NamedTuple):
    """What blocks' own excesses would be: metres, and how sharply that is known (1/m^2)."""

    length_m: Floats
    information: Floats


def without_lasting_errors(problem: Problem, best: Solution) -> Solution:
    """Return the likeliest of a solution and those that take what it has followed for outliers."""
    while (followed := _followed(problem, best)).any():
        doubted = best.inliers._replace(ranges=np.where(followed, 0.0, best.inliers.ranges))
        other = smooth(problem, best.state, best.components, doubted)
        if other.cost > best.cost - BETTER_BY:
            break
        best = other
    return best


def excesses(
    problem: Problem, state: State, weights: Weights, blocks: Sequence[Indices]
) -> Excesses:
    """Return what the excess of each block of ranges would be, if it had one."""
    equations = problem.normal_equations(state, weights)
    force = weights.ranges * problem.range_residuals(state)
    knots, size = equations.gradient.shape
    several = max(NUMBERS_AT_A_TIME // (knots * size), 1)
    length_m, information = np.empty(len(blocks)), np.empty(len(blocks))
    for begin in range(0, len(blocks), several):
        some = blocks[begin : begin + several]
        columns = np.zeros((knots, size, len(some)))
        corner = np.zeros((problem.constants, len(some)))
        chosen = np.concatenate(some)
        column = np.repeat(np.arange(len(some)), [len(block) for block in some])
        kernels.add_range_columns(
            state, problem.graph.ranges, weights.ranges, (chosen, column), columns, corner
        )
        _, poses, constants = equations.covariance_and_solution(columns, corner)
        explained = np.sum(columns * poses, axis=(0, 1)) + np.sum(corner * constants, axis=0)
        total = np.bincount(column, weights.ranges[chosen])
        at = slice(begin, begin + len(some))
        information[at] = np.maximum(total - explained, 1e-9 * total)
        length_m[at] = -np.bincount(column, force[chosen]) / information[at]
    return Excesses(length_m, information)


def _followed(problem: Problem, solution: Solution) -> Bools:
    """Return which ranges (M,) belong to blocks that would rather be too long."""
    state, components = solution.state, solution.components
    bases = motion_bases(problem, state, components)
    weights = weights_of(problem, components, bases, solution.inliers)
    followed = np.zeros(problem.graph.range_m.size, dtype=bool)
    blocks = list(_blocks(problem, solution))
    if not blocks:
        return followed
    length_m, information = excesses(problem, state, weights, blocks)
    gain = 0.5 * length_m**2 * information
    least_m = LEAST_M * np.sqrt(components.range_m2)
    for k in np.flatnonzero((gain > LEAST_GAIN) & (length_m > least_m)):
        followed[blocks[k]] = True
    return followed


def _blocks(problem: Problem, solution: Solution) -> Iterator[Indices]:
    """Give the inliers of each pair within each of ``BLOCKS_S``, two or more."""
    graph, ranges = problem.graph, problem.graph.ranges
    time_s = graph.time_s[ranges.chord] + ranges.fraction * graph.chords.duration_s[ranges.chord]
    for pair in range(len(graph.pairs)):
        own = np.flatnonzero((ranges.pair_index == pair) & (solution.inliers.ranges > 0.5))
        for block_s in BLOCKS_S:
            for shift in (0.0, 0.5):
                number = np.floor(time_s[own] / block_s + shift)
                ends = np.flatnonzero(np.diff(number)) + 1
                for block in np.split(own, ends):
                    if block.size > 1:
                        yield block
