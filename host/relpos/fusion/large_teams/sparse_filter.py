"""The joint filter for large teams: cost per range grows with the neighbourhood, not the team.

A range ties two nodes that are near each other, and in a large team it says little of somebody
far away. The area is divided into strips at least as wide as the radio's reach, so that every
range lies within a strip or between two adjacent ones, and only these blocks of the joint
covariance of all poses are kept (:mod:`relpos.fusion.large_teams.layout`). They represent a Markov
chain of strips (:mod:`relpos.fusion.large_teams.chain`). One epoch, all ranges of one instant,
about the poses predicted for it:

1. *Motion*: P <- F P F^T + Q within the blocks. They come out exactly as the dense filter's would;
   only the chain's independence is assumed anew.
2. *Ranges* update the chain. No information is used twice and nothing is cut from a covariance
   (which would not stay positive definite: ``docs/notebook/large-teams.md``).

With a single strip this is the dense filter, to rounding.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from scipy.linalg import block_diag

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.large_teams import chain, kernels
from relpos.fusion.large_teams.kernels import RangeModel, Ranges
from relpos.fusion.large_teams.layout import COVARIANCE, StripLayout, lay_out
from relpos.fusion.models.ranging import GROWTH_SD_M, CommonIndex, deviations_within
from relpos.fusion.rigid_motion import RIGID, about_origin, rigid_motion

IndicesOrInt = Indices | int

JITTER_M2, JITTER_CONSTANT = 1e-8, 1e-12
"""Least variances of an initial pose, (0.1 mm)^2 and as many rad^2, and of constants: what is exact
has no inverse."""

TERMS = len(CommonIndex)
SHADOW_SD_M, LATENESS_SD_S = 0.3, 0.3
"""Standard deviations beforehand of the body's shadow and of the lateness.

Pairs have no biases here that shadows could be taken for, so that both may be larger than in the
bank. 24 people, 100 s, seeds 14 and 15, with these and with the bank's .05 m and .1 s: ``shadow``
.0680 and .0688 m, ``late-1`` .136 and .140, ``base`` and ``walls`` within .0006."""


class OwnTerm(IntEnum):
    """What of ranges is a node's own, in a team that is not too large."""

    DELAY = 0
    """Its antenna delay, by which its ranges are too long (m)."""
    CLOCK = 1
    """How far its clock is ahead (s)."""


LEFT = np.diag([1e-6, 1e-6, 1e-7])
"""Covariance (m^2, rad^2) of the common motion that is left: blocks keep their inverses.

60 people, 90 s, seeds 4 to 6: squares of the places' errors are 1.0 of what is told; with a hundred
times as much, which is seldom taken out then, 3.9, and with a hundredth 1.1."""

DIRECTIONS = 12
"""So many directions of the strips are tried."""

SLACK = 0.3
"""A node changes strips when it is this fraction of a strip's width outside its own."""

MARGIN_M = 0.5
"""Strips that turn out too narrow become this much wider than the widest range needs."""


def prior_information(bias_sd_m: float) -> Floats:
    """Return the information (T, T) of what all ranges have in common, before any range."""
    sigma = np.empty(TERMS)
    sigma[CommonIndex.BIAS] = bias_sd_m
    sigma[CommonIndex.SHADOW] = SHADOW_SD_M
    sigma[CommonIndex.LATENESS] = LATENESS_SD_S
    sigma[CommonIndex.GROWTH] = GROWTH_SD_M
    return np.diag(1.0 / (sigma**2 + JITTER_CONSTANT))


def own_term(row: IndicesOrInt, which: OwnTerm) -> IndicesOrInt:
    """Return where a node's own term, or those of several (E,), are among all."""
    return TERMS + len(OwnTerm) * row + which


@dataclass(slots=True)
class NeighbourhoodFilter:
    """States and covariance of a large team, arrays in and out.

    ``state`` (N, 5) is x, y (m), heading (rad), the heading's drift (rad/s) and the logarithm of
    the step scale, the last two as in the bank (``StateIndex``); ``width_m`` is the least width of
    a strip: the reach of the radio. Nodes are numbered 0 to N - 1 in the order in which they were
    added.
    """

    width_m: float
    model: RangeModel = field(default_factory=RangeModel)
    state: Floats = field(default_factory=lambda: np.empty((0, COVARIANCE)))
    antenna_m: Floats = field(default_factory=lambda: np.empty((0, 2)))
    """Where the antenna of each node is: forward and left of the point that moves, (N, 2)."""
    terms: Floats = field(default_factory=lambda: np.zeros(TERMS))
    """What all ranges have in common (:class:`~relpos.fusion.models.ranging.CommonIndex`), then
    each node's own terms (:class:`OwnTerm`), where they are modelled: T = 4 + 2 N or 4."""
    own_sd: tuple[float, ...] = ()
    """Standard deviations beforehand of a node's own terms; none: they are not modelled."""
    _carried: Floats = field(default_factory=lambda: np.empty((0, COVARIANCE, TERMS)))
    """V (N, 5, T): derivative of the states by the terms."""
    terms_information: Floats = field(
        default_factory=lambda: prior_information(BankSettings().bias_m)
    )
    common: Floats = field(default_factory=lambda: np.zeros((RIGID, RIGID)))
    """Covariance of the rigid motion of the whole team that has been taken out of the blocks."""
    counters: Counter[str] = field(default_factory=Counter)
    """How often nodes changed strips, and strips were laid out anew or widened."""
    _lever: Floats = field(default_factory=lambda: np.empty((0, 3, 3)))
    _noise: Floats = field(default_factory=lambda: np.empty((0, len(kernels.ENTRIES))))
    _before: Floats = field(default_factory=lambda: np.empty((0, COVARIANCE, COVARIANCE)))
    """Each node's own covariance (N, 5, 5) at the last update."""
    _behind: bool = False
    _axis: Floats = field(default_factory=lambda: np.array([1.0, 0.0]))
    _origin_m: float = 0.0
    _layout: StripLayout = field(init=False)
    _covariance: Floats = field(default_factory=lambda: np.empty(0))
    _cell: Indices = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Interval of ``width_m`` along the axis that each node belongs to; its strip skips gaps."""

    @property
    def pose(self) -> Floats:
        """Poses (N, 3), a view."""
        return self.state[:, :3]

    # -- nodes ---------------------------------------------------------------------------------

    def add(
        self, pose: Floats, covariance: Floats, sigma_constants: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Add nodes with poses (E, 3) and covariances (E, 3, 3), independent of all others.

        ``sigma_constants`` are the standard deviations of drift and scale, which begin with 0.
        """
        count, more = self.state.shape[0], pose.shape[0]
        full = self._dense() if count else np.empty((0, 0))
        self.state = np.concatenate([self.state, np.pad(pose, ((0, 0), (0, 2)))])
        self.antenna_m = np.concatenate([self.antenna_m, np.zeros((more, 2))])
        self._add_terms(more)
        self._lever = np.zeros((count + more, 3, 3))
        self._noise = np.zeros((count + more, len(kernels.ENTRIES)))
        whole = np.zeros((COVARIANCE * (count + more), COVARIANCE * (count + more)))
        whole[: len(full), : len(full)] = full
        for i, each in enumerate(covariance, count):
            at = COVARIANCE * i
            whole[at : at + 3, at : at + 3] = each + JITTER_M2 * np.eye(3)
            for entry, sigma in enumerate(sigma_constants, at + 3):
                whole[entry, entry] = sigma**2 + JITTER_CONSTANT
        self._lay_out(whole)

    def _add_terms(self, more: int) -> None:
        """Give so many more nodes their own terms; where none are modelled, nobody has any."""
        own = np.tile(self.own_sd, more)
        if not own.size and len(self.terms) > TERMS:
            self.terms, self._carried = self.terms[:TERMS], self._carried[..., :TERMS].copy()
            known = np.linalg.inv(self.terms_information)[:TERMS, :TERMS]
            self.terms_information = np.asarray(np.linalg.inv(known), np.float64)
        self.terms = np.pad(self.terms, (0, own.size))
        self._carried = np.pad(self._carried, ((0, more), (0, 0), (0, own.size)))
        self._know_terms(self.terms_information, own)

    def _know_terms(self, known: Floats, own_sd: Floats) -> None:
        """Take over the information of some terms, and of those after them by their deviations."""
        information = block_diag(known, np.diag(1.0 / (own_sd**2 + JITTER_CONSTANT)))
        self.terms_information = np.asarray(information, np.float64)

    def forget_terms(self, known: Floats) -> None:
        """Begin anew with the terms: what all ranges have in common has the information ``known``.

        States go back to what they would be without.
        """
        self.state -= self._carried @ self.terms
        self.terms = np.zeros_like(self.terms)
        self._know_terms(known, np.tile(self.own_sd, len(self.state)))

    def _lay_out(self, whole: Floats) -> None:
        """Choose the strips' direction and cut the covariance (5N, 5N) into blocks."""
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
                best, self._axis, self._origin_m, chosen = cost, axis, origin, cell
        self._cut(chosen, whole)

    def _cut(self, cell: Indices, whole: Floats) -> None:
        """Put nodes into cells (N,) and cut the blocks from a covariance kept node by node."""
        layout = lay_out(np.unique(cell, return_inverse=True)[1].astype(np.int64))
        self._cell, self._layout = cell, layout
        self._covariance = np.empty(layout.covariance.total)
        diagonal, following = layout.views(self._covariance, COVARIANCE)
        states = layout.states()
        for k, at in enumerate(states):
            diagonal[k][:] = whole[np.ix_(at, at)]
            if k + 1 < len(states):
                following[k][:] = whole[np.ix_(at, states[k + 1])]
        self._before = self._own_covariances()

    def _dense(self, reach: int | None = None) -> Floats:
        """Return the whole covariance (5N, 5N), node by node: far blocks by the chain.

        With ``reach`` only strips so many apart at most; the other blocks are 0.
        """
        self._catch_up()
        layout, size = self._layout, self.state.size
        whole = np.zeros((size, size))
        diagonal, following = layout.views(self._covariance, COVARIANCE)
        states = layout.states()
        onward = [np.linalg.solve(d, c) for d, c in zip(diagonal[1:], following[1:], strict=False)]
        for k, block in enumerate(diagonal):
            whole[np.ix_(states[k], states[k])] = block
            far = block
            for q in range(k, len(following) if reach is None else min(k + reach, len(following))):
                far = following[q] if q == k else far @ onward[q - 1]
                whole[np.ix_(states[k], states[q + 1])] = far
                whole[np.ix_(states[q + 1], states[k])] = far.T
        return whole

    # -- time ----------------------------------------------------------------------------------

    def predict(self, node: Indices, moved: Floats) -> None:
        """Move nodes (E,) by displacements (E, 7), body frame, metres, radians and seconds.

        Forward, left, turn, then the three standard deviations, then how long the node moved.
        """
        kernels.move(self.state, self._lever, self._noise, self._before, node, moved)
        self._behind = True

    def _catch_up(self) -> None:
        if not self._behind:
            return
        for axis, by in kernels.LEVERS:
            self._carried[:, axis] += self._lever[:, axis, by, None] * self._carried[:, 2 + by]
        kernels.propagate(self._covariance, self._layout, self._lever, self._noise)
        self._behind = False
        self._before = self._own_covariances()

    # -- ranges --------------------------------------------------------------------------------

    def slopes_in_terms(
        self, node: Indices, peer: Indices, common: Floats, peer_m_s: Floats
    ) -> Floats:
        """Return the slopes of ranges in all terms (E, T).

        ``common`` (E, 4) are those in what all have in common, ``peer_m_s`` (E,) the peers'
        velocities along the sight: the node's clock dates a range, its peer is seen where it was
        when that clock was right, if its own is (``fusion/bank/range_update.py``).
        """
        slopes = np.zeros((len(node), len(self.terms)))
        slopes[:, :TERMS] = common
        if len(self.terms) > TERMS:
            ranges = np.arange(len(node))
            for end, speed_m_s in ((node, -peer_m_s), (peer, peer_m_s)):
                slopes[ranges, own_term(end, OwnTerm.DELAY)] = 1.0
                slopes[ranges, own_term(end, OwnTerm.CLOCK)] = speed_m_s
        return slopes

    def update(self, ranges: Ranges) -> Floats:
        """Use the ranges (E,) of one instant; return their probabilities of being no outliers.

        The T terms are estimated in a second stage (Friedland 1969), which is exact for constants:
        with V the derivative of the states by them, an innovation depends on them by its slopes
        plus H V, and V changes by the gain times that. What they are not known to adds nothing to
        the covariance (:meth:`spread_of_terms`).
        """
        self._catch_up()
        node, peer = ranges.node, ranges.peer
        self._change_strips(node, peer)
        measured_m = ranges.measured_m - ranges.slopes @ self.terms
        pairs = self.antenna_pairs(node, peer)
        information, push, inlier, lines = kernels.range_information(
            self._layout, pairs, ranges._replace(measured_m=measured_m), self.model, self._carried
        )
        moved = chain.update(self._layout, self._covariance, information, push)
        self.state += moved[:, :, 0]
        self._carried -= moved[:, :, 1:]
        weight, ux, uy = lines[:, :3].T
        change = moved[peer] - moved[node]
        # R^-1 (y - H K y), which is (R + H P H^T)^-1 y, of innovations and their derivatives.
        whitened = lines[:, 3:] - ux[:, None] * change[:, 0] - uy[:, None] * change[:, 1]
        told = lines[:, 4:].T @ (weight[:, None] * whitened)
        self.terms_information += told[:, 1:]
        step = np.linalg.solve(self.terms_information, told[:, 0])
        self.terms = self.terms + step
        self.state += self._carried @ step
        self._before = self._own_covariances()
        pull = np.zeros((len(self.state), 2))
        pulls = (weight * whitened[:, 0])[:, None] * lines[:, 1:3]
        np.subtract.at(pull, node, pulls)
        np.add.at(pull, peer, pulls)
        self._turn_ways(moved[:, 2, 0], pull)
        return inlier

    def _turn_ways(self, turn_rad: Floats, pull: Floats) -> None:
        """Turn each node's way (N,) as its heading was corrected, from the next motion on.

        The way since its position was last known is the covariance of its position with its step
        scale over the scale's variance. Left where a noisy heading had put it, the ranges of people
        who walk side by side change with their scales, and shorter steps explain that noise best.
        The scale moves by the gain of the way turned half (midpoint rule): the gains of both ends
        err, to opposite sides. ``pull`` (N, 2) is H^T (R + H P H^T)^-1 times the innovations.
        """
        for k, block in enumerate(self._layout.views(self._covariance, COVARIANCE)[0]):
            nodes = self._layout.nodes_of(k)
            own = block[:, 4 * len(nodes) :].reshape(COVARIANCE, len(nodes), -1)
            x, y, _, _, variance = own.diagonal(axis1=1, axis2=2)
            turned = turn_rad[nodes, None] * np.column_stack([-y, x])
            self.state[nodes, 4] += 0.5 * (turned * pull[nodes]).sum(axis=1)
            self._lever[nodes, :2, 2] += turned / variance[:, None]

    def take_out_common_motion(self) -> None:
        """Keep the team's rigid motion apart from the blocks: no range can measure it.

        Left in them, the chain would take it for independent errors of its strips, which ranges
        between them do measure.
        """
        self._catch_up()
        middle = self.pose[:, :2].mean(axis=0)
        poses = rigid_motion(*(self.pose[:, :2] - middle).T).reshape(-1, 3, RIGID)
        whole = np.pad(poses, ((0, 0), (0, COVARIANCE - 3), (0, 0))).reshape(-1, RIGID)
        motion = [whole[rows] for rows in self._layout.states()]
        information = chain.information_of(self._layout, self._covariance, motion)
        s = np.asarray(np.linalg.inv(information) - LEFT, np.float64)
        if np.linalg.eigvalsh(s)[0] <= 0.0:
            return
        diagonal, following = self._layout.views(self._covariance, COVARIANCE)
        blocks = [*zip(diagonal, motion, motion, strict=True)]
        blocks += zip(following, motion, motion[1:], strict=False)
        for block, own, other in blocks:
            block -= own @ s @ other.T
        self.common += about_origin(s, *middle)
        self._before = self._own_covariances()

    def pairs(self, node: Indices, peer: Indices) -> Floats:
        """Return distance, variances along and across it, and bearing of pairs (E,): (4, E)."""
        self._catch_up()
        return kernels.pair_moments(self._covariance, self._layout, self.pose, node, peer)

    def antenna_pairs(self, node: Indices, peer: Indices) -> Floats:
        """Return :meth:`pairs` between antennas, whose offsets turn with the estimated headings."""
        if not self.antenna_m.any():
            return self.pairs(node, peer)
        self._catch_up()
        pose = self.antennas_m(np.arange(len(self.state)))
        return kernels.pair_moments(self._covariance, self._layout, pose, node, peer)

    def antennas_m(self, rows: Indices) -> Floats:
        """Return where the antennas of nodes (E,) are now: (E, 2)."""
        if not self.antenna_m.any():
            return self.pose[rows, :2]
        x, y, heading = self.pose[rows].T
        forward, left = self.antenna_m[rows].T
        c, s = np.cos(heading), np.sin(heading)
        return np.column_stack([x + c * forward - s * left, y + s * forward + c * left])

    def marginals(self) -> Floats:
        """Return the variances xx, yy, the covariance xy, and the heading's variance: (N, 4)."""
        self._catch_up()
        return self._before[:, [0, 1, 0, 2], [0, 1, 1, 2]]

    def common_marginals(self) -> Floats:
        """Return what the common motion adds to :meth:`marginals` (N, 4)."""
        g = rigid_motion(*self.pose[:, :2].T).reshape(-1, 3, RIGID)
        added: Floats = g @ self.common @ g.swapaxes(1, 2)
        return added[:, [0, 1, 0, 2], [0, 1, 1, 2]]

    def _own_covariances(self) -> Floats:
        result = np.empty((len(self.state), COVARIANCE, COVARIANCE))
        for k, block in enumerate(self._layout.views(self._covariance, COVARIANCE)[0]):
            n = len(block) // COVARIANCE
            each = block.reshape((n, COVARIANCE, n, COVARIANCE), order="F")
            result[self._layout.nodes_of(k)] = each.diagonal(axis1=0, axis2=2).transpose(2, 0, 1)
        return result

    def inflate(self, nodes: Indices, sigma_m: float, sigma_rad: float) -> None:
        """Add so much to the standard deviations of nodes, independently of all others."""
        self._noise[nodes, 0] += sigma_m**2
        self._noise[nodes, 2] += sigma_m**2
        self._noise[nodes, 5] += sigma_rad**2
        self._behind = True

    def diffuse(self, row: int, way_m: Floats, covariance: Floats) -> None:
        """Move a node by ``way_m`` (2,), and add to the covariance (2, 2) of its place."""
        self.state[row, :2] += way_m
        self._noise[row, :3] += covariance[[0, 0, 1], [0, 1, 1]]
        self._behind = True

    def spread_of_terms(self, node: Indices, peer: Indices, bearing_rad: Floats) -> Floats:
        """Return what the errors of the T terms add to the variances of pairs (E,) (m^2): (2, E).

        Along and across the line; nothing where nodes have no terms of their own.
        """
        if len(self.terms) == TERMS:
            return np.zeros((2, len(node)))
        self._catch_up()
        x, y = (self._carried[peer, :2] - self._carried[node, :2]).swapaxes(0, 1)
        c, s = np.cos(bearing_rad)[:, None], np.sin(bearing_rad)[:, None]
        lines = np.stack([c * x + s * y, c * y - s * x])
        spread: Floats = (lines @ np.linalg.inv(self.terms_information) * lines).sum(axis=2)
        return spread

    def sigma_of_terms(self) -> Floats:
        """Return the terms' standard deviations (T,)."""
        return np.asarray(np.sqrt(np.linalg.inv(self.terms_information).diagonal()), np.float64)

    def own_terms(self, which: OwnTerm) -> tuple[Floats, Floats]:
        """Return one of the nodes' own terms and its standard deviations, (N,) or empty.

        They are relative to the mean of the team, of which ranges do not tell more.
        """
        own = np.arange(TERMS + which, len(self.terms), len(OwnTerm))
        value = self.terms[own]
        covariance = np.asarray(np.linalg.inv(self.terms_information), np.float64)
        sigma = deviations_within(covariance, own)
        return value - value.sum() / max(own.size, 1), sigma

    # -- strips --------------------------------------------------------------------------------

    def widen(self, width_m: float) -> None:
        """Lay out strips of another width in metres; infinite: all nodes in one."""
        self.width_m = width_m
        if self.pose.size:
            self._lay_out(self._dense())

    def _change_strips(self, node: Indices, peer: Indices) -> None:
        """Move nodes to the strip that they walked into; lay out all strips anew if that fails."""
        strip = self._layout.strip
        place = (self.pose[:, :2] @ self._axis - self._origin_m) / self.width_m
        lag = place - self._cell
        apart = np.abs(strip[node] - strip[peer]) > 1
        if not apart.any() and lag.min() >= -SLACK and lag.max() < 1.0 + SLACK:
            return
        cell = np.where((lag < 0.0) | (lag >= 1.0), np.floor(place), self._cell).astype(np.int64)
        changed = np.abs(cell - self._cell)
        if np.array_equal(np.unique(cell), np.unique(self._cell)):
            self._cut(cell, self._dense(1 + 2 * int(changed.max())))
            self.counters["strips_changed"] += int((changed > 0).sum())
        else:
            self._lay_out(self._dense())
            self.counters["strips_laid_out"] += 1
        apart = np.abs(self._layout.strip[node] - self._layout.strip[peer]) > 1
        if apart.any():
            # A range is longer than a strip is wide.
            off = self.pose[node, :2] - self.pose[peer, :2]
            self.widen(float(np.hypot(off[:, 0], off[:, 1]).max()) + MARGIN_M)
            self.counters["strips_widened"] += 1
