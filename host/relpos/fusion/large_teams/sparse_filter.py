"""The joint filter for large teams: cost per range grows with the neighbourhood, not the team.

A range ties two users that are near each other, and with many users about, what their ranges say
of somebody far away is little. The area is cut into strips at least as wide as the radio reaches,
so that every range lies within a strip or between two adjacent ones. Of the joint covariance of
all positions and headings only these blocks are kept: within a strip, and between one and the
next. They stand for the Gaussian of greatest entropy that has them, a Markov chain of strips:

    p(x) = p(x_1) p(x_2 | x_1) p(x_3 | x_2) ...        P_ac = P_ab P_bb^-1 P_bc  for a < b < c

One epoch (all ranges of one instant, about the poses predicted for it):

1. *Time passes*: P <- F P F^T + Q within the blocks. They come out exactly as the dense filter's
   would; only the chain's independence is assumed anew.
2. *Ranges* are information A about positions, block-tridiagonal like the chain's own. With
   B_k = P_kk^-1 P_k,k+1 and V_k+1 = P_k+1,k+1 - P_k+1,k B_k the chain's information is

       L_kk = V_k^-1 + B_k V_k+1^-1 B_k^T,    L_k,k+1 = -B_k V_k+1^-1

   and (L + A)^-1 within the blocks follows from one block Cholesky sweep forwards and one of
   selected inversion backwards. No information is used twice and nothing is cut from a covariance
   (which would not stay positive definite: see ``docs/fusion.md``).
3. *Headings* follow the positions of their strip by regression, h | p ~ K p + noise, which a range
   does not change: K = P_hp P_pp^-1, P_hp <- K P_pp, P_hh <- K P_pp K^T + (P_hh - K P_ph).

With a single strip this is the dense filter, to rounding.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.linalg import blas, lapack

from relpos.fusion.large_teams import kernels

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

JITTER_M2 = 1e-8
"""Least variance of a start, (0.1 mm)^2 and as many radians: an exact one has no inverse."""

DIRECTIONS = 12
"""So many directions are tried when the strips are laid out."""

MARGIN_M = 0.5
"""Strips that turn out too narrow become this much wider than the widest range needs."""

SLACK = 0.3
"""A node may stand out of its strip by this share of the strip's width before it is moved over."""


@dataclass(slots=True)
class RangeModel:
    """Of all ranges: standard deviation (m); outliers' share, spread (m), share of short ones."""

    sigma_m: float = 0.1
    outliers: float = 0.0
    outlier_m: float = 3.0
    outliers_short: float = 0.1


@dataclass(slots=True)
class _Layout:
    """Who stands in which strip, and where the blocks of a buffer begin (see the kernels)."""

    members: Indices
    first: Indices
    sizes: Indices
    strip: Indices
    slot: Indices
    at_diagonal: Indices
    at_next: Indices
    total: int
    at_diagonal_p: Indices
    at_next_p: Indices
    total_p: int

    @staticmethod
    def of(strip: Indices) -> _Layout:
        """Lay out nodes by their strips, numbered 0, 1, ... without a gap."""
        members = np.argsort(strip, kind="stable")
        sizes = np.bincount(strip)
        first = np.concatenate([[0], np.cumsum(sizes)])
        slot = np.empty_like(strip)
        slot[members] = np.arange(strip.size) - np.repeat(first[:-1], sizes)
        places = []
        for each in (3, 2):
            diagonal = (each * sizes) ** 2
            following = each * each * sizes[:-1] * sizes[1:]
            both = np.append(diagonal, following)
            start = np.concatenate([[0], np.cumsum(both)])
            places.append((start[: sizes.size], start[sizes.size : -1], int(start[-1])))
        return _Layout(members, first, sizes, strip, slot, *places[0], *places[1])

    def states(self) -> list[Indices]:
        """Of every strip, where its block's rows stand in a covariance kept node by node."""
        return [
            (3 * self.members[a:b] + np.arange(3)[:, None]).reshape(-1)
            for a, b in zip(self.first, self.first[1:], strict=False)
        ]

    def views(self, buffer: Floats, each: int) -> tuple[list[Floats], list[Floats]]:
        """Give the diagonal and the next blocks of a buffer as matrices, ``each`` rows a node."""
        at, following = (
            (self.at_diagonal, self.at_next) if each == 3 else (self.at_diagonal_p, self.at_next_p)
        )
        n = each * self.sizes
        return (
            [
                buffer[s : s + m * m].reshape((m, m), order="F")
                for s, m in zip(at.tolist(), n.tolist(), strict=True)
            ],
            [
                buffer[s : s + m * p].reshape((m, p), order="F")
                for s, m, p in zip(following.tolist(), n[:-1].tolist(), n[1:].tolist(), strict=True)
            ],
        )


def _lower(matrix: Floats) -> Floats:
    """Cholesky factor of a symmetric matrix in place; ArithmeticError where it is not positive."""
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
    """Give the lower half of A - H^T H."""
    return blas.dsyrk(  # type: ignore[no-any-return]
        -1.0, half, 1.0, _copy(of), trans=1, lower=1, overwrite_c=1
    )


def _copy(matrix: Floats) -> Floats:
    return np.array(matrix, order="F")


@dataclass(slots=True)
class NeighbourhoodFilter:
    """Poses and covariance of a large team, arrays in and out.

    ``pose`` (N, 3) world metres and radians; ``width_m`` is how wide strips are at least: what the
    radio reaches. Nodes are numbered 0 to N - 1 in the order in which they were added.
    """

    width_m: float
    model: RangeModel = field(default_factory=RangeModel)
    pose: Floats = field(default_factory=lambda: np.empty((0, 3)))
    antenna_m: Floats = field(default_factory=lambda: np.empty((0, 2)))
    """Of every node, where its antenna is: forward and left of the point that moves, (N, 2)."""
    counters: Counter[str] = field(default_factory=Counter)
    """How often nodes changed strips, and strips were laid out anew or widened."""
    _lever: Floats = field(default_factory=lambda: np.empty((0, 2)))
    _noise: Floats = field(default_factory=lambda: np.empty((0, 6)))
    _variance: Floats = field(default_factory=lambda: np.empty(0))
    _behind: bool = False
    _axis: Floats = field(default_factory=lambda: np.array([1.0, 0.0]))
    _origin_m: float = 0.0
    _layout: _Layout = field(init=False)
    _covariance: Floats = field(default_factory=lambda: np.empty(0))
    _cell: Indices = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    # -- nodes ---------------------------------------------------------------------------------

    def add(self, pose: Floats, covariance: Floats) -> None:
        """Add nodes with poses (E, 3) and covariances (E, 3, 3), independent of all others."""
        count = self.pose.shape[0]
        full = self._dense() if count else np.empty((0, 0))
        self.pose = np.concatenate([self.pose, pose])
        more = pose.shape[0]
        self.antenna_m = np.concatenate([self.antenna_m, np.zeros((more, 2))])
        self._lever = np.zeros((count + more, 2))
        self._noise = np.zeros((count + more, 6))
        self._variance = np.zeros(count + more)
        whole = np.zeros((3 * (count + more), 3 * (count + more)))
        whole[: 3 * count, : 3 * count] = full
        for i, each in enumerate(covariance, count):
            whole[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = each + JITTER_M2 * np.eye(3)
        self._lay_out(whole)

    def _lay_out(self, whole: Floats) -> None:
        """Choose the strips' direction and cut the covariance (3N, 3N) into blocks."""
        # Along the direction whose strips cost least: their work grows with the cube of their size.
        position = self.pose[:, :2]
        best = math.inf
        for angle in np.arange(DIRECTIONS) * (math.pi / DIRECTIONS):
            axis = np.array([math.cos(angle), math.sin(angle)])
            along = position @ axis
            origin = float(along.min())
            cell = np.floor((along - origin) / self.width_m).astype(np.int64)
            cost = float((np.bincount(cell).astype(float) ** 3).sum())
            if cost < best:
                best, self._axis, self._origin_m, self._cell = cost, axis, origin, cell
        self._layout = _Layout.of(np.unique(self._cell, return_inverse=True)[1].astype(np.int64))
        self._take(whole)

    def _take(self, whole: Floats) -> None:
        layout = self._layout
        self._covariance = np.empty(layout.total)
        diagonal, following = layout.views(self._covariance, 3)
        states = layout.states()
        for k, at in enumerate(states):
            diagonal[k][:] = whole[np.ix_(at, at)]
            if k + 1 < len(states):
                following[k][:] = whole[np.ix_(at, states[k + 1])]
        self._note_variance()

    def _note_variance(self) -> None:
        layout = self._layout
        for k, block in enumerate(layout.views(self._covariance, 3)[0]):
            n = int(layout.sizes[k])
            nodes = layout.members[layout.first[k] : layout.first[k + 1]]
            self._variance[nodes] = block.diagonal()[2 * n :]

    def _dense(self) -> Floats:
        """Give the whole covariance (3N, 3N), node by node: far blocks by the chain."""
        self._catch_up()
        layout, count = self._layout, self.pose.shape[0]
        whole = np.empty((3 * count, 3 * count))
        diagonal, following = layout.views(self._covariance, 3)
        states = layout.states()
        onward = [np.linalg.solve(d, c) for d, c in zip(diagonal[1:], following[1:], strict=False)]
        for k, block in enumerate(diagonal):
            whole[np.ix_(states[k], states[k])] = block
            far = block
            for q in range(k, len(following)):
                far = following[q] if q == k else far @ onward[q - 1]
                whole[np.ix_(states[k], states[q + 1])] = far
                whole[np.ix_(states[q + 1], states[k])] = far.T
        return whole

    # -- time ----------------------------------------------------------------------------------

    def predict(self, node: Indices, moved: Floats) -> None:
        """Move nodes (E,) by displacements and their standard deviations (E, 6).

        Forward, left, turn, then the three sigmas; body frame, metres and radians.
        """
        kernels.advance(self.pose, self._lever, self._noise, self._variance, node, moved)
        self._behind = True

    def _catch_up(self) -> None:
        if not self._behind:
            return
        layout = self._layout
        self._variance += self._noise[:, 5]
        kernels.pass_time(
            self._covariance, layout.at_diagonal, layout.at_next, layout.sizes, layout.members,
            layout.first, self._lever, self._noise,
        )  # fmt: skip
        self._behind = False

    # -- ranges --------------------------------------------------------------------------------

    def update(self, node: Indices, peer: Indices, measured_m: Floats) -> tuple[Floats, Floats]:
        """Work in the ranges (E,) of one instant; give the believed share and the surprise, (E,).

        The surprise is the squared innovation over its expected variance.
        """
        self._catch_up()
        self._move_over(node, peer)
        layout, model = self._layout, self.model
        spread = self.antenna_spread(node, peer)
        information, push = np.empty(layout.total_p), np.empty(2 * self.pose.shape[0])
        weight, surprise = np.empty(node.size), np.empty(node.size)
        kernels.gather(
            spread, node, peer, measured_m, np.full(node.size, model.sigma_m**2),
            np.array([model.outliers, model.outlier_m**2, model.outliers_short]), layout.strip,
            layout.slot, layout.sizes, layout.at_diagonal_p, layout.at_next_p, information, push,
            weight, surprise,
        )  # fmt: skip
        self._solve(information, push)
        return weight, surprise

    def _solve(self, information: Floats, push: Floats) -> None:
        """Posterior blocks and poses from the ranges' information (module's text, 2 and 3).

        BLAS and LAPACK on whole blocks; symmetric ones are kept as their lower halves.
        """
        layout = self._layout
        sizes = layout.sizes.tolist()
        last = len(sizes) - 1
        diagonal, following = layout.views(self._covariance, 3)
        told, told_next = layout.views(information, 2)
        starts = np.concatenate([[0], np.cumsum(2 * layout.sizes)]).tolist()
        regression: list[Floats] = []
        rest: list[Floats] = []
        factor: list[Floats] = []
        ahead: list[Floats] = []
        right: list[Floats] = []
        own = step = later = np.empty((0, 0))
        # The chain's information, strip by strip, and its elimination right behind it.
        for k, n in enumerate(sizes):
            m = 2 * n
            block = diagonal[k]
            prior = _lower(_copy(block[:m, :m]))
            both = np.empty((m, n + (2 * sizes[k + 1] if k < last else 0)), order="F")
            both[:, :n] = block[:m, m:]
            if k < last:
                both[:, n:] = following[k][:m, : 2 * sizes[k + 1]]
            both = _solve_lower(prior, both)
            # Headings: K^T = P_pp^-1 P_ph; what positions do not tell of them stays.
            rest.append(_minus_square(both[:, :n], block[m:, m:]))
            if k < last:
                p = 2 * sizes[k + 1]
                given = _lower(_minus_square(both[:, n:], diagonal[k + 1][:p, :p]))
            both = _solve_lower(prior, both, transposed=True)
            regression.append(both[:, :n])
            joined = _inverse(prior) if k == 0 else own
            joined += told[k]
            if k < last:
                # Y^T = B L_V^-T, then B V^-1 = Y^T L_V^-1.
                y = blas.dtrsm(1.0, given, both[:, n:], side=1, lower=1, trans_a=1, overwrite_b=1)
                joined = blas.dsyrk(1.0, y, 1.0, joined, lower=1, overwrite_c=1)
                coupling = blas.dtrsm(-1.0, given, y, side=1, lower=1, overwrite_b=1)
                coupling += told_next[k]
            pivot = _lower(joined)
            factor.append(pivot)
            g = blas.dtrsv(pivot, push[starts[k] : starts[k + 1]], lower=1)
            right.append(g)
            if k < last:
                t = _solve_lower(pivot, coupling)
                ahead.append(t)
                own = blas.dsyrk(-1.0, t, 1.0, _inverse(given), trans=1, lower=1, overwrite_c=1)
                push[starts[k + 1] : starts[k + 2]] -= blas.dgemv(1.0, t, g, trans=1)
        for k in range(last, -1, -1):
            n, m = sizes[k], 2 * sizes[k]
            pivot, g = factor[k], right[k]
            if k < last:
                p = 2 * sizes[k + 1]
                t = ahead[k]
                g -= blas.dgemv(1.0, t, step)
                step = blas.dtrsv(pivot, g, lower=1, trans=1)
                slope = _solve_lower(pivot, t, transposed=True)
                cross = blas.dsymm(-1.0, later, slope, side=1, lower=1)
                later = blas.dgemm(
                    -1.0, cross, slope, 1.0, _inverse(pivot), trans_b=1, overwrite_c=1
                )
                ph = blas.dgemm(1.0, cross, regression[k + 1])
                block = following[k]
                block[:m, :p] = cross
                block[:m, p:] = ph
                block[m:, :p] = blas.dgemm(1.0, regression[k], cross, trans_a=1)
                block[m:, p:] = blas.dgemm(1.0, regression[k], ph, trans_a=1)
            else:
                step = blas.dtrsv(pivot, g, lower=1, trans=1)
                later = _inverse(pivot)
            block = diagonal[k]
            ph = blas.dsymm(1.0, later, regression[k], lower=1)
            block[:m, :m] = later
            block[m:, :m] = ph.T
            block[m:, m:] = blas.dgemm(1.0, regression[k], ph, 1.0, rest[k], trans_a=1)
            nodes = layout.members[layout.first[k] : layout.first[k + 1]]
            self.pose[nodes, 0] += step[:n]
            self.pose[nodes, 1] += step[n:]
            self.pose[nodes, 2] += blas.dgemv(1.0, regression[k], step, trans=1)
            self._variance[nodes] = block.diagonal()[m:]
        kernels.mirror(self._covariance, layout.at_diagonal, layout.sizes)

    def spread(self, node: Indices, peer: Indices) -> Floats:
        """Of pairs (E,) distance, variances along and across it, bearing of the peer: (4, E)."""
        self._catch_up()
        layout = self._layout
        return kernels.pair_spread(
            self._covariance, layout.at_diagonal, layout.at_next, layout.sizes, layout.strip,
            layout.slot, self.pose, node, peer,
        )  # fmt: skip

    def antenna_spread(self, node: Indices, peer: Indices) -> Floats:
        """:meth:`spread` between antennas, whose offsets turn with the headings as believed."""
        if not self.antenna_m.any():
            return self.spread(node, peer)
        self._catch_up()
        layout, pose = self._layout, self.pose.copy()
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        pose[:, 0] += c * self.antenna_m[:, 0] - s * self.antenna_m[:, 1]
        pose[:, 1] += s * self.antenna_m[:, 0] + c * self.antenna_m[:, 1]
        return kernels.pair_spread(
            self._covariance, layout.at_diagonal, layout.at_next, layout.sizes, layout.strip,
            layout.slot, pose, node, peer,
        )  # fmt: skip

    def marginals(self) -> Floats:
        """Of every node the variances xx, yy, the covariance xy, and the heading's: (N, 4)."""
        self._catch_up()
        layout = self._layout
        return kernels.marginals(
            self._covariance, layout.at_diagonal, layout.sizes, layout.strip, layout.slot
        )

    def doubt(self, nodes: Indices, sigma_m: float, sigma_rad: float) -> None:
        """Let nodes be anywhere so far from where they were thought to be."""
        self._noise[nodes, 0] += sigma_m**2
        self._noise[nodes, 2] += sigma_m**2
        self._noise[nodes, 5] += sigma_rad**2
        self._behind = True

    # -- strips --------------------------------------------------------------------------------

    def widen(self, width_m: float) -> None:
        """Lay strips of another width, (m); infinite: all users in one."""
        self.width_m = width_m
        if self.pose.size:
            self._lay_out(self._dense())

    def _move_over(self, node: Indices, peer: Indices) -> None:
        """Move nodes to the strip that they walked into; lay all out anew where that must be."""
        layout = self._layout
        place = (self.pose[:, :2] @ self._axis - self._origin_m) / self.width_m
        lag = place - self._cell
        apart = np.abs(layout.strip[node] - layout.strip[peer]) > 1
        if not apart.any() and lag.min() >= -SLACK and lag.max() < 1.0 + SLACK:
            return
        for direction in (1, -1):
            movers = np.flatnonzero(lag >= 1.0 if direction > 0 else lag < 0.0)
            if movers.size and not self._move(movers, direction):
                self._lay_out(self._dense())
                self.counters["strips_laid_out"] += 1
                break
        apart = np.abs(self._layout.strip[node] - self._layout.strip[peer]) > 1
        if apart.any():
            # Somebody is ranged from further off than a strip is wide.
            off = self.pose[node, :2] - self.pose[peer, :2]
            self.widen(float(np.hypot(off[:, 0], off[:, 1]).max()) + MARGIN_M)
            self.counters["strips_widened"] += 1

    def _move(self, movers: Indices, direction: int) -> bool:
        """Move nodes one strip on; False where a strip would be left empty or skipped."""
        layout = self._layout
        cell = self._cell.copy()
        cell[movers] += direction
        cells, strip = np.unique(cell, return_inverse=True)
        old_cells = np.unique(self._cell)
        if not np.isin(old_cells, cells).all() or np.any(np.diff(cells) > 1):
            return False
        diagonal, following = layout.views(self._covariance, 3)
        far: list[Floats] = []
        far_start = np.full(cell.size, -1)
        far_strip = np.full(cell.size, -1)
        at, begin = layout.strip[movers], 0
        for k in np.unique(at).tolist():
            middle, beyond = k + direction, k + 2 * direction
            if not 0 <= beyond < len(layout.sizes):
                continue
            some = movers[at == k]
            n, count = int(layout.sizes[k]), some.size
            rows = (layout.slot[some] + n * np.arange(3)[:, None]).reshape(-1)
            # P_ac = P_ab P_bb^-1 P_bc, rows (component, mover).
            if direction > 0:
                near, on = following[k][rows].T, following[middle]
            else:
                near, on = following[middle][:, rows], following[beyond].T
            solved = lapack.dpotrs(_lower(_copy(diagonal[middle])), _copy(near), lower=1)[0]
            block = solved.T @ on
            wide = block.shape[1]
            block = block.reshape(3, count, wide).transpose(1, 0, 2)
            far.append(block.reshape(-1))
            far_start[some] = begin + 3 * wide * np.arange(count)
            far_strip[some] = beyond
            begin += block.size
        after = _Layout.of(strip.astype(np.int64))
        covariance = np.empty(after.total)
        unknown = kernels.lay_over(
            self._covariance, layout.at_diagonal, layout.at_next, layout.sizes, layout.strip,
            layout.slot, np.concatenate(far) if far else np.empty(0), far_start, far_strip,
            covariance, after.at_diagonal, after.at_next, after.sizes, after.members, after.first,
        )  # fmt: skip
        self._covariance, self._layout, self._cell = covariance, after, cell
        self.counters["strips_changed"] += int(movers.size)
        self.counters["covariances_unknown"] += int(unknown)
        return True
