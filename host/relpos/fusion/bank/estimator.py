"""A bank of joint error-state filters: the default estimator.

Every hypothesis is one possible history: a joint filter over all users
(:mod:`relpos.fusion.bank.joint`), levels of noise (:mod:`relpos.fusion.bank.variance_components`)
and a weight.
:class:`~relpos.fusion.bank.core.BankCore` holds them as arrays and knows neither measurements nor
node ids;
:class:`Bank` is the :class:`~relpos.fusion.estimator.Estimator` around it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.fusion.bank import kernels as bank_kernels
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.joint import PER_NODE, Of
from relpos.fusion.bank.settings import BankSettings
from relpos.fusion.estimator import (
    ANY_ANGLE_RAD,
    Alternative,
    Estimate,
    NodeEstimate,
    NodeStatus,
    PairEstimate,
    Parameter,
    Presence,
    Rows,
    refuse_unmoved,
    refuse_unranged,
)
from relpos.fusion.initial_poses import (
    HEADING_RESOLVED_RAD,
    Found,
    Initialiser,
    PoseMixture,
    sought_node,
)
from relpos.fusion.models.detection import Detection
from relpos.fusion.models.motion import reported_sigmas
from relpos.fusion.models.north import North
from relpos.fusion.models.odometry_faults import LOST_RAD, VAGUE_M, SpeedGate, ZeroMotionDetector
from relpos.fusion.models.ranging import Mounting, RangeCorrelation
from relpos.fusion.modes import believe, pictures
from relpos.fusion.rewind import Rewinder
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Step, Timeline
from relpos.measurements import Heading, Height, Prior, Range

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

_DRIFT, _SCALE = int(Of.DRIFT), int(Of.SCALE)
_TWO_PI = 2.0 * math.pi


SET_OFF_M = 0.3
"""A node without a heading has set off when it is this far from where it stood."""

SILENT_S = 10.0
"""A node whose motion is missing for longer is tracked by its ranges alone."""

WANDER_M = 0.7
"""Random walk of a person who is not heard of, m per root second: there and back in a room."""

MOST_LISTED = 200
"""Hypotheses that alternatives are made of after a slip."""

NORTH_KNOWN_RAD = 0.5
"""From so well on headings are used; before, they only teach how the frame lies to north."""
HEADING_SIGMA_RAD = 0.17
"""Of an absolute heading that brings no sigma: magnetic ones indoors are 10 degrees off."""


@dataclass(slots=True)
class _Known(Presence):
    """What is kept of a node beside its hypotheses."""

    worn_m: float = 0.0
    """Height of the tag over the floor at the start."""
    drifted_s: float = -math.inf
    """Until then it was tracked by ranges alone."""


@dataclass(slots=True)
class Bank:
    """The filter; :func:`make` returns the :class:`~relpos.fusion.estimator.Estimator` around it.

    ``initialiser`` seeks the nodes whose initial pose is unknown; once found they join the core.
    """

    priors: Sequence[Prior]
    initialiser: Initialiser
    settings: BankSettings = field(default_factory=BankSettings)
    seed: int = 0
    mounting: Mapping[int, Mounting] = field(default_factory=dict)
    core: BankCore = field(init=False)
    detection: Detection = field(default_factory=Detection)
    range_correlation: RangeCorrelation = field(default_factory=RangeCorrelation)
    speed_gate: SpeedGate = field(default_factory=SpeedGate)
    zero_motion: ZeroMotionDetector = field(default_factory=ZeroMotionDetector)
    north: North = field(default_factory=North)
    _row: dict[int, int] = field(default_factory=dict)
    _known: dict[int, _Known] = field(default_factory=dict)
    _standing: dict[int, complex] = field(default_factory=dict)
    """Located nodes without a heading: how far they have gone since, in their own first frame."""
    _facing: dict[int, complex] = field(default_factory=dict)
    _pending: list[Advance] = field(default_factory=list)
    _own: Counter[str] = field(default_factory=Counter)
    _moved: bool = False
    _heights: bool = False
    """Whether anybody's height is known; all are 0 else."""
    _ranges_used: int = 0
    _epoch_s: float = -math.inf

    def __post_init__(self) -> None:
        s = self.settings
        self.core = BankCore(s, self.seed)
        for p in sorted(self.priors, key=lambda p: p.node):
            if p.node in self._known:
                raise RelposError(f"node {p.node} has two initial poses")
            self._meet(p.node)
            if math.isfinite(p.sigma_m) and math.isfinite(p.sigma_rad):
                self._row[p.node] = self.core.add_node(
                    p.x_m, p.y_m, p.heading_rad, p.sigma_m, p.sigma_rad, self._arm(p.node)
                )
            else:
                self.initialiser.add(
                    p.node, (p.x_m, p.y_m, p.heading_rad), (p.sigma_m, p.sigma_m, p.sigma_rad)
                )

    @property
    def shared(self) -> tuple[object, ...]:
        """Objects that copies of the core refer to (:class:`~relpos.fusion.rewind.Core`)."""
        return self.priors, self.settings, self.mounting

    def check_run(self, counters: Mapping[str, int]) -> None:
        """Raise RelposError if the run cannot give relative positions."""
        refuse_unmoved(self._moved or bool(self._pending))
        refuse_unranged(self._ranges_used, counters)

    def counters(self) -> Counter[str]:
        """Count everything doubted, clamped, reset or resampled."""
        return self._own + self.core.counters + self.initialiser.counters

    def update(self, step: Step, timeline: Timeline) -> Estimate | None:
        """Process one step of the timeline; an estimate at the end of an epoch."""
        if isinstance(step, Advance):
            if step.node in self._row:
                # Most of it waits until somebody needs to know, or the epoch ends.
                self._pending.append(step)
                if step.node in self._standing:
                    self._set_off(step)
                return None
            self._moved = True
            self._meet(step.node).received(step.time_s)
            way_m = math.hypot(step.dx_m, step.dy_m)
            self.range_correlation.move(step.node, way_m, step.dtheta_rad)
            self._seek(step.node)
            odd = self.speed_gate.exceeded(step.node, way_m, step.duration_s, step.fraction)
            self._own["motions_doubted"] += odd
            self.initialiser.advance(step, faulty=odd)
        elif isinstance(step, Ranging):
            self._advance()
            self._range(step, timeline)
        elif isinstance(step, Sensed):
            self._meet(step.measurement.node)
            self._sense(step)
        else:
            self._advance()
            self._admit(self.initialiser.find(step.time_s))
            return self._estimate(step.time_s)
        return None

    def cost_s(self, step: Step) -> float:
        """Return about how many seconds of a processor ``update`` needs for a step."""
        if isinstance(step, Ranging):
            return 3e-4 + 3e-10 * self.core.entries
        if isinstance(step, Epoch):
            return 1e-3 + 1e-9 * self.core.entries + self.initialiser.cost_s()
        return 3e-5

    def _meet(self, node: int) -> _Known:
        known = self._known.get(node)
        if known is None:
            known = self._known[node] = _Known()
            worn = self.mounting.get(node)
            if worn is not None and worn.height_m is not None:
                known.worn_m = known.height_m = worn.height_m
                self._heights = True
        return known

    def _arm(self, node: int) -> tuple[float, float]:
        worn = self.mounting.get(node)
        return (0.0, 0.0) if worn is None else worn.antenna_offset_m or (0.0, 0.0)

    def _advance(self) -> None:
        """Work off the displacements since the last time."""
        steps = self._pending
        if not steps:
            return
        self._pending = []
        rows = np.array([self._row[a.node] for a in steps], dtype=np.int64)
        moves = np.array([(a.dx_m, a.dy_m, a.dtheta_rad, a.duration_s) for a in steps])
        told = None
        if any(a.sigma_x_m is not None or a.sigma_theta_rad is not None for a in steps):
            told = np.array([reported_sigmas(a) for a in steps])
        begin = 0
        knowns, zero_motion, speed_gate = self._known, self.zero_motion, self.speed_gate
        self._moved = True
        for k, a in enumerate(steps):
            time_s, node, duration_s, dx_m, dy_m, turn_rad, fraction = a[:7]
            known = knowns[node]
            known.received(time_s)
            way_m = math.hypot(dx_m, dy_m)
            self.range_correlation.move(node, way_m, turn_rad)
            if known.drifted_s > time_s - duration_s:
                # Ranges have moved it so far already; how it turned they cannot say.
                moves[k, :2] *= max(time_s - known.drifted_s, 0.0) / max(duration_s, 1e-9)
            vague = None if told is None else _vagueness(a)
            if told is not None and vague is not None:
                told[k] = math.nan
                self.core.lose(int(rows[k]), *vague)
            if zero_motion.update(node, dx_m, dy_m, turn_rad, duration_s, fraction):
                self._own["motions_still"] += dx_m != 0.0 or turn_rad != 0.0
                moves[k, :3] = 0.0
                continue
            if speed_gate.exceeded(node, way_m, duration_s, fraction):
                self._make(rows, moves, told, slice(begin, k))
                self.core.grow()
                row = int(rows[k])
                east, north = self.core.places_of(row)
                self._make(rows, moves, told, slice(k, k + 1))
                after = self.core.places_of(row)
                self.core.doubt_motion(row, after[0] - east, after[1] - north)
                begin = k + 1
        if begin:
            self._make(rows, moves, told, slice(begin, len(steps)))
        else:
            self.core.move(rows, moves, told)

    def _make(self, rows: Indices, moves: Floats, told: Floats | None, some: slice) -> None:
        """Make some of the displacements ``rows`` (M,), ``moves`` (M, 4)."""
        self.core.move(rows[some], moves[some], None if told is None else told[some])

    def _range(self, step: Ranging, timeline: Timeline) -> None:
        located, time_s = self._row, step.time_s
        everybody = {n for r in step.ranges for n in (r.node, r.peer)}
        for node in everybody:
            self._meet(node).received(time_s)
        ranges: Sequence[Range] = step.ranges
        if not everybody <= located.keys():
            for node in sorted(everybody - located.keys()):
                self._seek(node)
            heights = {n: k.height_m for n, k in self._known.items()}
            self.initialiser.update(time_s, step.ranges, self._places(), heights)
            # A search may be long; finding nobody in it is no fault of the data.
            self._ranges_used += len(step.ranges)
            ranges = [r for r in step.ranges if r.node in located and r.peer in located]
        tried = ranges
        ranges = self._heard_moving(time_s, ranges, timeline)
        measured = np.array([r.range_m for r in ranges])
        pairs = [(r.node, r.peer) for r in ranges]
        first, second, dz = self._pairs(pairs)
        if self.core.unplaced and ranges:
            self.core.sight(first, second, measured)
        rounds = self._hear(time_s, tried, timeline)
        if ranges:
            known = self._known
            variance = np.array(
                [known[a].sigma_height_m ** 2 + known[b].sigma_height_m ** 2 for a, b in pairs]
            )
            worth = self.range_correlation.effective_counts(pairs)
            self.core.update(first, second, measured, dz, variance, worth)
            self._ranges_used += len(ranges)
        for who, heard, surely in rounds:
            self.core.hearing(*who, heard, surely, self.detection)
        self.core.settle()

    def _heard_moving(
        self, time_s: float, ranges: Sequence[Range], timeline: Timeline
    ) -> Sequence[Range]:
        """Leave out ranges of nodes whose motion is missing; let those drift who miss it long.

        A node without motion may be anywhere that it can have walked to. For a while its motion
        may still come (then the ranges are worked in after all, in their place); after
        ``SILENT_S`` it is tracked by ranges alone, as somebody who wanders.
        """
        reported = timeline.reported_s
        silent = {
            node
            for node in {n for r in ranges for n in (r.node, r.peer)}
            if -math.inf < reported(node) < time_s
        }
        if not silent:
            return ranges
        for node in sorted(silent):
            known = self._known[node]
            reported_s = reported(node)
            if time_s - reported_s > SILENT_S:
                since_s = max(known.drifted_s, reported_s)
                self.core.lose(self._row[node], WANDER_M * math.sqrt(time_s - since_s), 0.0)
                known.drifted_s = time_s
                self._own["drifts"] += 1
                silent.discard(node)
        kept = [r for r in ranges if r.node not in silent and r.peer not in silent]
        self._own["ranges_of_silent"] += len(ranges) - len(kept)
        return kept

    def _seek(self, node: int) -> None:
        if node not in self.initialiser:
            self.initialiser.add(node)

    def _places(self) -> dict[int, tuple[float, float, float]]:
        """Everybody in the core: x, y (m), and the variance (m^2) relative to his nearest.

        What the team's places have in common is no error of a place found relative to them.
        """
        if not self._row:
            return {}
        mean, covariance = self.core.moments(poses_alone=True)
        at = PER_NODE * np.array(list(self._row.values()))
        own = 0.5 * (covariance[at, at] + covariance[at + 1, at + 1])
        cross = 0.5 * (covariance[np.ix_(at, at)] + covariance[np.ix_(at + 1, at + 1)])
        apart = own[:, None] + own[None, :] - 2.0 * cross
        np.fill_diagonal(apart, np.inf)
        variance = 0.5 * np.maximum(apart.min(axis=1), 0.0) if len(at) > 1 else np.zeros(1)
        return {
            node: (float(mean[i]), float(mean[i + 1]), float(v))
            for node, i, v in zip(self._row, at, variance, strict=True)
        }

    def _admit(self, found: Found | None) -> None:
        """Let those whose start has been found join the core."""
        if found is None:
            return
        mixture = found.mixture
        beside = self._nearest(mixture) if self._row else None
        rows = [self.core.add_node(0.0, 0.0, 0.0, 1.0, 1.0) for _ in mixture.nodes]
        self._row.update(zip(mixture.nodes, rows, strict=True))
        self.core.place(
            np.array(rows, dtype=np.int64), mixture.poses, mixture.covariances,
            np.log(np.maximum(mixture.weights, 1e-300)), beside,
        )  # fmt: skip
        for n, (node, row) in enumerate(zip(mixture.nodes, rows, strict=True)):
            self.core.set_scale(row, float(mixture.scales[n]))
            if mixture.heading_sigma_rad(n) > HEADING_RESOLVED_RAD:
                self._standing[node] = complex(0.0)

    def _nearest(self, mixture: PoseMixture) -> int:
        """Row of the user of the core who is nearest to those who have been found."""
        mean, _ = self.core.moments(poses_alone=True)
        middle = mixture.poses[0, :, :2].mean(axis=0)
        rows = list(self._row.values())
        off = [np.hypot(*(mean[PER_NODE * r : PER_NODE * r + 2] - middle)) for r in rows]
        return rows[int(np.argmin(off))]

    def _set_off(self, step: Advance) -> None:
        """Watch a node that stands without a heading: where it goes, its ranges will tell."""
        gone = self._standing[step.node]
        gone += complex(step.dx_m, step.dy_m) * self._facing.get(step.node, 1.0)
        self._standing[step.node] = gone
        self._facing[step.node] = self._facing.get(step.node, 1.0) * complex(
            math.cos(step.dtheta_rad), math.sin(step.dtheta_rad)
        )
        if abs(gone) < SET_OFF_M:
            return
        self._advance()
        del self._standing[step.node], self._facing[step.node]
        self.core.split_heading(self._row[step.node], abs(gone))
        self._own["headings_sought"] += 1

    def _pairs(self, pairs: Sequence[tuple[int, int]]) -> tuple[Indices, Indices, Floats]:
        row, known = self._row, self._known
        rows = np.array([(row[a], row[b]) for a, b in pairs], dtype=np.int64).reshape(-1, 2)
        first, second = np.ascontiguousarray(rows.T)
        if not self._heights:
            return first, second, np.zeros(len(rows))
        dz = np.array([known[b].height_m - known[a].height_m for a, b in pairs])
        return first, second, dz

    def _hear(
        self, time_s: float, ranges: Sequence[Range], timeline: Timeline
    ) -> list[tuple[tuple[Indices, Indices, Floats], Bools, Floats]]:
        """Learn who is heard how far.

        Give, of each round, the pairs tried, which of them were heard, and how surely all were
        tried.
        """
        rounds = []
        for done in self.detection.rounds.add(time_s, ranges, timeline.reported_s):
            pairs = done.received + done.missed
            for late in timeline.catch_up({n for p in pairs for n in p}, time_s):
                self.update(late, timeline)
            self._advance()
            who = self._pairs(pairs)
            heard = np.arange(len(pairs)) < len(done.received)
            surely = np.ones(len(pairs))
            surely[len(done.received) :] = self.detection.update(
                done, *self.core.predicted_ranges(*who)
            )
            rounds.append((who, heard, surely))
        return rounds

    def _sense(self, step: Sensed) -> None:
        measured = step.measurement
        if isinstance(measured, Height):
            known = self._known[measured.node]
            self._heights = True
            known.height_m = known.worn_m + measured.height_m
            known.sigma_height_m = measured.sigma_m or 0.0
        elif isinstance(measured, Heading) and measured.node in self._row:
            self._advance()
            self._turn(step.time_s, measured, self._row[measured.node])
        else:
            self._own["headings_unused"] += 1

    def _turn(self, time_s: float, measured: Heading, row: int) -> None:
        """Work in an absolute heading, as far as it is known how the frame lies to it."""
        north = self.north
        told = measured.sigma_rad or HEADING_SIGMA_RAD
        sigma = north.alone_sigma_rad(measured.node, time_s, told)
        mean, covariance = self.core.moments(poses_alone=True)
        place = PER_NODE * row + Of.HEADING
        own, variance = float(mean[place]), float(covariance[place, place])
        if north.sigma_rad < NORTH_KNOWN_RAD:
            self.core.heading(
                row, measured.heading_rad - north.angle_rad, math.hypot(sigma, north.sigma_rad)
            )
        if not north.learn(measured.heading_rad, sigma, own, variance):
            self._own["headings_doubted"] += 1

    # -- estimates -----------------------------------------------------------------------------

    def _estimate(self, time_s: float) -> Estimate:
        for known in self._known.values():
            known.close_epoch(self._epoch_s)
        self._epoch_s = time_s
        mean, covariance = self.core.moments(poses_alone=True)
        if self.core.slipped:
            self.core.find_slipped(covariance)
        slipped = self.core.slipped
        told = []
        for node, row in sorted(self._row.items()):
            known = self._known[node]
            status = known.status if known.silent_epochs else NodeStatus.OK
            if row in slipped and status is NodeStatus.OK:
                status = NodeStatus.AMBIGUOUS
            told.append((node, row, status, known.height_m, known.sigma_height_m))
        picture = _Picture(
            time_s, told, mean, covariance, self.core.biases.copy(),
            (self.detection.range_m, self.detection.range_sigma_m)
            if self.detection.known else None,
        )  # fmt: skip
        mixture = self.initialiser.mixture
        sought = []
        if len(self._row) < len(self._known):
            sought = [
                sought_node(self.initialiser, node, known)
                for node, known in self._known.items()
                if node not in self._row
            ]
        nodes, pairs, alternatives, parameters = picture.rows()
        if slipped:
            nodes = tuple(self._tell_mode(n) if self._row[n.node] in slipped else n for n in nodes)
            pairs = self._slipped_pairs(pairs)
        if mixture is not None:
            pairs += self._sought_pairs(mixture, mean, covariance)
            alternatives = self._alternatives(time_s, mixture, mean, covariance)
        elif slipped:
            alternatives = self._slip_alternatives(time_s)
        together = sorted([*nodes, *sought], key=lambda n: n.node)
        return Estimate(
            time_s, tuple(together), pairs, alternatives, parameters, self.north.known()
        )

    def _tell_mode(self, told: NodeEstimate) -> NodeEstimate:
        """Put the most likely place for the mean of a slipped user's places."""
        belief = believe(self.core.weights(), *self.core.poses_of(self._row[told.node]))
        spread = belief.covariance_m2
        return replace(
            told, x_m=belief.x_m, y_m=belief.y_m,
            heading_rad=math.remainder(belief.heading_rad, _TWO_PI),
            variance_x_m2=float(spread[0, 0]), variance_y_m2=float(spread[1, 1]),
            covariance_xy_m2=float(spread[0, 1]),
            sigma_heading_rad=min(belief.sigma_heading_rad, ANY_ANGLE_RAD),
        )  # fmt: skip

    def _slipped_pairs(self, pairs: Sequence[PairEstimate]) -> tuple[PairEstimate, ...]:
        """Of pairs with one who has slipped the mean of the places says nothing."""
        weights, slipped = self.core.weights(), self.core.slipped
        told = []
        for pair in pairs:
            a, b = self._row[pair.node], self._row[pair.peer]
            if a in slipped or b in slipped:
                told.append(
                    _pair_of_pictures(pair.node, pair.peer, weights, *self.core.apart(a, b))
                )
            else:
                told.append(pair)
        return tuple(told)

    def _slip_alternatives(self, time_s: float) -> tuple[Alternative, ...]:
        """List the possible pictures of the team after a slip: those of the likeliest."""
        weight = self.core.weights()
        likely = np.argsort(-weight, kind="stable")[:MOST_LISTED]
        nodes = sorted(self._row)
        each = [self.core.poses_of(self._row[n]) for n in nodes]
        poses = np.stack([poses[likely] for poses, _ in each], axis=1)
        spread = np.stack([spread[likely, :2, :2] for _, spread in each], axis=1)
        return pictures(time_s, nodes, weight[likely] / weight[likely].sum(), poses, spread)

    def _sought_pairs(
        self, mixture: PoseMixture, mean: Floats, covariance: Floats
    ) -> tuple[PairEstimate, ...]:
        """Pairs with at least one node whose start is unknown: moments over all pictures."""
        places = {n: mixture.poses[:, i, :2] for i, n in enumerate(mixture.nodes)}
        columns = {n: slice(3 * i, 3 * i + 2) for i, n in enumerate(mixture.nodes)}
        pairs = []
        everybody = sorted([*self._row, *mixture.nodes])
        for k, a in enumerate(everybody):
            for b in everybody[k + 1 :]:
                if a in self._row and b in self._row:
                    continue
                total: Floats = np.zeros((len(mixture.weights), 2, 2))
                ends = []
                for node in (a, b):
                    if node in self._row:
                        at = PER_NODE * self._row[node]
                        ends.append(mean[None, at : at + 2])
                        total = total + covariance[at : at + 2, at : at + 2]
                    else:
                        own = columns[node]
                        ends.append(places[node])
                        total = total + mixture.covariances[:, own, own]
                if a in columns and b in columns:
                    cross = mixture.covariances[:, columns[a], columns[b]]
                    total = total - cross - cross.transpose(0, 2, 1)
                pairs.append(_pair_of_pictures(a, b, mixture.weights, ends[1] - ends[0], total))
        return tuple(pairs)

    def _alternatives(
        self, time_s: float, mixture: PoseMixture, mean: Floats, covariance: Floats
    ) -> tuple[Alternative, ...]:
        """List the possible pictures of the whole team while somebody's start is unknown."""
        if set(mixture.nodes) <= self.initialiser.resolved:
            return ()
        count, sought = len(mixture.weights), len(mixture.nodes)
        located = sorted(self._row)
        nodes = [*mixture.nodes, *located]
        poses = np.zeros((count, len(nodes), 3))
        spread = np.zeros((count, len(nodes), 2, 2))
        poses[:, :sought] = mixture.poses
        for i in range(sought):
            spread[:, i] = mixture.covariances[:, 3 * i : 3 * i + 2, 3 * i : 3 * i + 2]
        for i, node in enumerate(located):
            at = PER_NODE * self._row[node]
            poses[:, sought + i] = mean[at : at + 3]
            spread[:, sought + i] = covariance[at : at + 2, at : at + 2]
        return pictures(time_s, nodes, mixture.weights, poses, spread)


def make(
    priors: Sequence[Prior],
    initialiser: Initialiser,
    settings: BankSettings,
    seed: int,
    mounting: Mapping[int, Mounting],
) -> Rewinder:
    """Return the bank as an estimator that accepts late measurements."""
    timeline = Timeline(
        [p.node for p in priors],
        reorder_s=settings.reorder_s,
        max_lag_s=settings.max_lag_s,
        lazy=True,
    )
    return Rewinder(Bank(priors, initialiser, settings, seed, mounting), timeline, settings.late_s)


@dataclass(frozen=True, slots=True)
class _Picture:
    """What is said of the located at one time, as numbers; ``rows`` makes objects of them."""

    time_s: float
    told: list[tuple[int, int, NodeStatus, float, float]]
    """Node, row, status, height and its deviation (m), by node."""
    mean: Floats
    covariance: Floats
    biases: Mapping[tuple[int, int], int]
    hearing: tuple[float, float] | None
    """How far one is heard, and its deviation, m."""

    def rows(self) -> Rows:
        means, variances = self.mean.tolist(), self.covariance.diagonal().tolist()
        time_s, nodes, parameters = self.time_s, [], []
        for node, row, status, height_m, sigma_height_m in self.told:
            at = PER_NODE * row
            nodes.append(
                NodeEstimate(
                    node, means[at], means[at + 1], math.remainder(means[at + 2], _TWO_PI),
                    variances[at], variances[at + 1], float(self.covariance[at, at + 1]),
                    min(math.sqrt(variances[at + 2]), ANY_ANGLE_RAD),
                    status, height_m, sigma_height_m,
                )
            )  # fmt: skip
            drift = math.sqrt(max(variances[at + _DRIFT], 0.0))
            scale = math.sqrt(max(variances[at + _SCALE], 0.0))
            grow = math.exp(means[at + _SCALE])
            parameters += [
                Parameter(time_s, node, None, "step_scale", grow, grow * scale),
                Parameter(time_s, node, None, "heading_drift_rad_s", means[at + _DRIFT], drift),
            ]
        named = {row: node for node, row, *_ in self.told}
        for (a, b), place in sorted(self.biases.items()):
            node, peer = sorted((named[a], named[b]))
            sigma = math.sqrt(max(variances[place], 0.0))
            parameters.append(Parameter(time_s, node, peer, "range_bias_m", means[place], sigma))
        if self.hearing is not None:
            # One curve for the team; every node has it.
            parameters += [
                Parameter(time_s, node, None, "detection_range_m", *self.hearing)
                for node, *_ in self.told
            ]
        return tuple(nodes), self._pairs(), (), tuple(parameters)

    def _pairs(self) -> tuple[PairEstimate, ...]:
        rows = np.array([row for _, row, *_ in self.told], dtype=np.int64)
        figures = bank_kernels.pairs(self.mean, self.covariance, rows).tolist()
        every = combinations([node for node, *_ in self.told], 2)
        return tuple(PairEstimate(*two, *own) for two, own in zip(every, figures, strict=True))


def _pair_of_pictures(
    node: int, peer: int, weights: Floats, off: Floats, spread: Floats
) -> PairEstimate:
    """Distance and bearing of a pair whose difference is a mixture: (K, 2), (K, 2, 2)."""
    distance = np.hypot(off[:, 0], off[:, 1])
    both = np.trace(spread, axis1=1, axis2=2)
    # On the same spot no direction is along; one is as good as the other.
    apart = distance > 1e-3 * np.sqrt(both)
    unit = np.where(apart[:, None], off / np.where(apart, distance, 1.0)[:, None], 0.0)
    along = np.where(apart, np.einsum("ka,kab,kb->k", unit, spread, unit), 0.5 * both)
    across = both - along
    # To second order, as the joint filter's range: E d^2 = |off|^2 + across.
    distance = np.sqrt(distance**2 + across)
    middle = float(weights @ distance)
    variance = float(weights @ (along + (distance - middle) ** 2))
    together = complex((weights * (unit[:, 0] + 1j * unit[:, 1])).sum())
    length = min(max(abs(together), 1e-3), 1.0)
    bearing_sd = math.sqrt(
        -2.0 * math.log(length) + float(weights @ across) / max(middle, 1e-3) ** 2
    )
    return PairEstimate(
        node, peer, middle, math.sqrt(max(variance, 0.0)), float(np.angle(together)),
        min(bearing_sd, ANY_ANGLE_RAD),
    )  # fmt: skip


def _vagueness(step: Advance) -> tuple[float, float] | None:
    """Standard deviations (m, rad) of a piece whose report says to know next to nothing."""
    sigma_m, _, sigma_rad = (0.0 if math.isnan(s) else s for s in reported_sigmas(step))
    sigma_m = min(sigma_m, step.sigma_y_m or 0.0)
    whole = math.sqrt(max(step.fraction, 1e-9))
    if sigma_m / whole > VAGUE_M or sigma_rad / whole > LOST_RAD:
        return sigma_m, sigma_rad
    return None
