"""The default estimator's shape for large teams: one joint filter, strip by strip.

What :class:`~relpos.fusion.bank.estimator.Bank` is for a few people, :class:`LargeTeam` is for
many: with
dozens of users ranging their neighbours the picture is rarely ambiguous, and one hypothesis over
all (:mod:`relpos.fusion.large_teams.sparse_filter`) takes the place of many. A node whose
initial pose is unknown joins once the initialiser has found it; what is doubted is widened.

Of so many users not every pair is listed: ``Estimate.pairs`` holds those in reach of each other.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from relpos.errors import RelposError
from relpos.fusion.bank.settings import BankSettings
from relpos.fusion.estimator import (
    ANY_ANGLE_RAD,
    Estimate,
    NodeEstimate,
    PairEstimate,
    Presence,
    refuse_unmoved,
    refuse_unranged,
    unlocated,
)
from relpos.fusion.initial_poses import Found, Initialiser
from relpos.fusion.large_teams.sparse_filter import NeighbourhoodFilter, RangeModel
from relpos.fusion.large_teams.variance_components import TeamLevels
from relpos.fusion.models.motion import reported_sigmas
from relpos.fusion.models.motion_variances import ALONG, TURN, WHITE, base_variances
from relpos.fusion.models.ranging import Mounting
from relpos.fusion.rewind import Rewinder
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Step, Timeline
from relpos.measurements import Height, Prior, Range

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

OUTLIERS, OUTLIER_M = 0.01, 3.0
"""A large team's share of outliers is not learned, so it is no setting: 0.05 and 5 m cost a crowd
0.002 m of 0.12."""

SIGMA_R_M = 0.3
"""Range sigma to begin with; a few instants of many ranges tell the true one."""

SIGMA_R_WORTH = 50.0
SIGMA_R_MEMORY = 20_000.0
"""The beginning counts as so many ranges; so many are remembered."""

REACH_SLACK = 1.05
"""Strips are this much wider than the longest range of the first instant."""

DOUBTED = 0.5
"""Share of a node's latest ranges that has to be odd before the node is doubted instead."""

FORGET = 0.3
"""Weight of an instant in that share: at a range every 2 s, three instants or so."""

_TWO_PI = 2.0 * math.pi


@dataclass(slots=True)
class LargeTeam:
    """The filter for dozens to thousands of users; :func:`make` returns the estimator."""

    priors: Sequence[Prior]
    initialiser: Initialiser
    settings: BankSettings = field(default_factory=BankSettings)
    seed: int = 0
    mountings: Mapping[int, Mounting] = field(default_factory=dict)
    filter: NeighbourhoodFilter = field(init=False)
    _nodes: list[int] = field(default_factory=list)
    _row: dict[int, int] = field(default_factory=dict)
    _known: dict[int, Presence] = field(default_factory=dict)
    _pending: list[Advance] = field(default_factory=list)
    _own: Counter[str] = field(default_factory=Counter)
    _odd: Floats = field(default_factory=lambda: np.empty(0))
    _levels: TeamLevels = field(default_factory=TeamLevels)
    _sigma_worth: float = SIGMA_R_WORTH
    _reach_m: float = 0.0
    _moved: bool = False
    _ranges_used: int = 0
    _epoch_s: float = -math.inf

    def __post_init__(self) -> None:
        s = self.settings
        model = RangeModel(SIGMA_R_M, OUTLIERS, OUTLIER_M, s.outliers_short)
        self.filter = NeighbourhoodFilter(math.inf, model)
        known: list[Prior] = []
        for p in sorted(self.priors, key=lambda p: p.node):
            if p.node in self._known:
                raise RelposError(f"node {p.node} has two initial poses")
            self._known[p.node] = Presence()
            if math.isfinite(p.sigma_m) and math.isfinite(p.sigma_rad):
                known.append(p)
            else:
                self.initialiser.add(
                    p.node, (p.x_m, p.y_m, p.heading_rad), (p.sigma_m, p.sigma_m, p.sigma_rad)
                )
        poses = np.array([(p.x_m, p.y_m, p.heading_rad) for p in known]).reshape(-1, 3)
        sigmas = np.array([(p.sigma_m, p.sigma_m, p.sigma_rad) for p in known]).reshape(-1, 3)
        self._add([p.node for p in known], poses, sigmas[:, :, None] ** 2 * np.eye(3))

    @property
    def shared(self) -> tuple[object, ...]:
        """Objects that copies of the core refer to (:class:`~relpos.fusion.rewind.Core`)."""
        return self.priors, self.settings, self.mountings

    def update(self, step: Step, timeline: Timeline) -> Estimate | None:
        """Process one step; an estimate at the end of an epoch."""
        match step:
            case Advance():
                self._moved = True
                self._meet(step.node)
                known = self._known[step.node]
                known.received(step.time_s)
                self._pending.append(step)
            case Ranging():
                self._advance()
                self._range(step)
            case Sensed():
                self._sense(step)
            case Epoch():
                self._advance()
                self._admit(self.initialiser.find(step.time_s))
                return self._estimate(step.time_s)
        return None

    def cost_s(self, step: Step) -> float:
        """Return about how many seconds of a processor ``update`` needs for a step."""
        if isinstance(step, Advance):
            return 2e-5
        search_s = self.initialiser.cost_s() if isinstance(step, Epoch) else 0.0
        return 5e-5 * len(self._nodes) + search_s

    def check_run(self, counters: Mapping[str, int]) -> None:
        """Raise RelposError if the run cannot give relative positions."""
        refuse_unmoved(self._moved)
        refuse_unranged(self._ranges_used, counters)

    def counters(self) -> Counter[str]:
        """Count everything perturbed or joined."""
        return self._own + self.filter.counters + self.initialiser.counters

    # -- users ---------------------------------------------------------------------------------

    def _meet(self, node: int) -> None:
        if node not in self._known:
            self._known[node] = Presence()

    def _add(self, nodes: Sequence[int], poses: Floats, covariances: Floats) -> None:
        if not len(nodes):
            return
        self.filter.add(poses, covariances)
        for node in nodes:
            self._row[node] = len(self._nodes)
            self._nodes.append(node)
            worn = self.mountings.get(node)
            if worn is not None and worn.antenna_offset_m is not None:
                self.filter.antenna_m[self._row[node]] = worn.antenna_offset_m
        self._odd = np.append(self._odd, np.zeros(len(nodes)))
        self._levels.add(poses)

    # -- motion --------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Work off the displacements since the last time."""
        steps, self._pending = self._pending, []
        if not steps:
            return
        for a in steps:
            if a.node not in self._row:
                self.initialiser.advance(a)
        steps = [a for a in steps if a.node in self._row]
        if not steps:
            return
        rows = np.array([self._row[a.node] for a in steps], dtype=np.int64)
        moves = np.array([(a.dx_m, a.dy_m, a.dtheta_rad, a.duration_s) for a in steps])
        told = np.array([reported_sigmas(a) for a in steps])
        self.filter.predict(rows, self._with_noise(rows, moves, told))

    def _with_noise(self, rows: Indices, moves: Floats, told: Floats) -> Floats:
        """Displacements and their sigmas (E, 6) from bases of noise times the nodes' levels."""
        dx, dy, turn, _ = moves.T
        variance = base_variances(moves, told) * self._levels.level[rows]
        result = np.empty((len(rows), 6))
        result[:, :3] = moves[:, :3]
        # Along the way, and a tenth of that across: both as the frame of the body sees them.
        self._levels.turn(rows, turn)
        way = np.maximum(dx * dx + dy * dy, 1e-12)
        along = variance[:, ALONG]
        result[:, 3] = np.sqrt(along * (dx * dx + ACROSS * dy * dy) / way)
        result[:, 4] = np.sqrt(along * (dy * dy + ACROSS * dx * dx) / way)
        result[:, 5] = np.sqrt(variance[:, TURN] + variance[:, WHITE])
        return result

    # -- ranges --------------------------------------------------------------------------------

    def _range(self, step: Ranging) -> None:
        for r in step.ranges:
            for node in (r.node, r.peer):
                self._meet(node)
                known = self._known[node]
                known.received(step.time_s)
        located = [r for r in step.ranges if r.node in self._row and r.peer in self._row]
        if located:
            self._weigh(located)
        self._seek(step)

    def _weigh(self, ranges: Sequence[Range]) -> None:
        node = np.array([self._row[r.node] for r in ranges], dtype=np.int64)
        peer = np.array([self._row[r.peer] for r in ranges], dtype=np.int64)
        measured = np.array([r.range_m for r in ranges])
        rise = np.array([self._height(r.peer) - self._height(r.node) for r in ranges])
        flat = np.sqrt(np.maximum(measured**2 - rise**2, 0.0))
        self._ranges_used += len(ranges)
        f = self.filter
        if not math.isfinite(f.width_m):
            f.widen(float(measured.max()) * REACH_SLACK)
        self._reach_m = max(self._reach_m * REACH_FADE, float(measured.max()))
        before, prior = f.pose.copy(), f.marginals()
        trust, _ = f.update(node, peer, flat)
        self._levels.learn(before, prior, f.pose, f.marginals(), np.concatenate([node, peer]))
        self._own["ranges_distrusted"] += int((trust < 0.5).sum())
        self._learn_sigma(node, peer, flat, trust)
        self._doubt(node, peer, trust)

    def _learn_sigma(self, node: Indices, peer: Indices, measured: Floats, trust: Floats) -> None:
        """Learn the range sigma by expectation and maximisation, as it goes.

        E |z - d|^2 after the ranges is the residual's square and what is still unsure of d.
        """
        spread = self.filter.antenna_spread(node, peer)
        middle = np.sqrt(spread[0] ** 2 + spread[2])
        square = (measured - middle) ** 2 + spread[1]
        total, model = float(trust.sum()), self.filter.model
        summed = model.sigma_m**2 * self._sigma_worth + float((trust * square).sum())
        model.sigma_m = max(math.sqrt(summed / (self._sigma_worth + total)), 0.01)
        self._sigma_worth = min(self._sigma_worth + total, SIGMA_R_MEMORY)

    def _doubt(self, node: Indices, peer: Indices, trust: Floats) -> None:
        """Widen nodes most of whose ranges are odd: they were carried, fell, or slipped."""
        both, twice = np.concatenate([node, peer]), np.concatenate([trust, trust])
        count = np.bincount(both, minlength=self._odd.size)
        odd = np.bincount(both, weights=1.0 - twice, minlength=self._odd.size)
        seen = count > 0
        self._odd[seen] += FORGET * (odd[seen] / count[seen] - self._odd[seen])
        doubted = np.flatnonzero((self._odd > DOUBTED) & (count >= 2))
        if doubted.size:
            self.filter.doubt(doubted, self.settings.jump_m, self.settings.jump_rad)
            self._odd[doubted] = 0.0
            self._own["jumps"] += int(doubted.size)

    def _height(self, node: int) -> float:
        worn = self.mountings.get(node)
        tag_m = 0.0 if worn is None or worn.height_m is None else worn.height_m
        return tag_m + self._known[node].height_m

    # -- nodes that are not located ------------------------------------------------------------

    def _seek(self, step: Ranging) -> None:
        """Let the initialiser use the ranges of nodes that are not located."""
        ranges = [r for r in step.ranges if r.node not in self._row or r.peer not in self._row]
        if not ranges:
            return
        nodes = sorted({n for r in ranges for n in (r.node, r.peer)})
        own = self.filter.marginals()
        located: dict[int, tuple[float, float, float]] = {}
        for node in nodes:
            row = self._row.get(node)
            if row is not None:
                x, y = self.filter.pose[row, :2]
                located[node] = float(x), float(y), 0.5 * float(own[row, 0] + own[row, 1])
            elif node not in self.initialiser:
                self.initialiser.add(node)
        heights = {node: self._height(node) for node in nodes}
        self.initialiser.update(step.time_s, ranges, located, heights)
        self._ranges_used += len(ranges)

    def _admit(self, found: Found | None) -> None:
        """Add the nodes whose poses have been found to the filter, each as one Gaussian."""
        if found is None:
            return
        moments = [found.mixture.moments(k) for k in range(len(found.mixture.nodes))]
        poses, covariances = (np.stack(each) for each in zip(*moments, strict=True))
        self._add(found.mixture.nodes, poses, covariances)
        self._own["joined"] += len(moments)

    def _sense(self, step: Sensed) -> None:
        self._meet(step.measurement.node)
        if isinstance(step.measurement, Height):
            known = self._known[step.measurement.node]
            known.height_m = step.measurement.height_m
            known.sigma_height_m = step.measurement.sigma_m or 0.0
        else:
            self._own["headings_unused"] += 1

    # -- estimates -----------------------------------------------------------------------------

    def _estimate(self, time_s: float) -> Estimate:
        for known in self._known.values():
            known.close_epoch(self._epoch_s)
        self._epoch_s = time_s
        own = self.filter.marginals().tolist() if self._row else []
        pose = self.filter.pose.tolist()
        nodes = []
        for node in sorted(self._known):
            known = self._known[node]
            row = self._row.get(node)
            if row is None:
                nodes.append(unlocated(node, known.height_m, known.sigma_height_m))
                continue
            xx, yy, xy, hh = own[row]
            x, y, heading = pose[row]
            nodes.append(
                NodeEstimate(
                    node, x, y, math.remainder(heading, _TWO_PI), xx, yy, xy,
                    min(math.sqrt(hh), ANY_ANGLE_RAD), known.status, known.height_m,
                    known.sigma_height_m,
                )
            )  # fmt: skip
        return Estimate(time_s, tuple(nodes), self._pairs())

    def _pairs(self) -> tuple[PairEstimate, ...]:
        """Distance and bearing of the pairs in reach of each other, in the order of ids."""
        if len(self._row) < 2:
            return ()
        ids = np.array(self._nodes)
        near = cKDTree(self.filter.pose[:, :2]).query_pairs(
            max(self._reach_m, LEAST_REACH_M), output_type="ndarray"
        )
        swap = ids[near[:, 0]] > ids[near[:, 1]]
        near[swap] = near[swap][:, ::-1]
        near = near[np.lexsort((ids[near[:, 1]], ids[near[:, 0]]))]
        spread = self.filter.spread(near[:, 0].astype(np.int64), near[:, 1].astype(np.int64))
        distance, along, across, bearing = spread
        sigma_bearing = np.minimum(np.sqrt(across) / np.maximum(distance, 1e-9), ANY_ANGLE_RAD)
        rows = zip(
            ids[near[:, 0]].tolist(), ids[near[:, 1]].tolist(), distance.tolist(),
            np.sqrt(along).tolist(), bearing.tolist(), sigma_bearing.tolist(), strict=True,
        )  # fmt: skip
        return tuple(PairEstimate(*row) for row in rows)


def make(
    priors: Sequence[Prior],
    initialiser: Initialiser,
    settings: BankSettings,
    seed: int,
    mountings: Mapping[int, Mounting],
    start_s: float = 0.0,
) -> Rewinder:
    """Return the estimator for a large team; motion counts from ``start_s``."""
    timeline = Timeline(
        [p.node for p in priors],
        start_s=start_s,
        reorder_s=settings.reorder_s,
        max_lag_s=settings.max_lag_s,
    )
    core = LargeTeam(priors, initialiser, settings, seed, mountings)
    return Rewinder(core, timeline, settings.late_s)


ACROSS = 0.1
"""Variance of a displacement across its direction relative to that along it."""

REACH_FADE = 0.999
"""The reach by which pairs are listed shrinks so slowly where ranges become shorter."""

LEAST_REACH_M = 5.0
"""Who is nearer than this is listed, however short the ranges are."""
