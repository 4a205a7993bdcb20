"""The default estimator: a bank of joint filters behind a timeline.

:class:`Bank` translates measurements with node ids and times into the arrays of
:class:`~relpos.fusion.bank.core.BankCore`, applies the models that need no hypotheses (speed gate,
zero-motion detector, range correlation, north), and lets an initialiser find nodes whose initial
pose is unknown. :mod:`relpos.fusion.bank.reporting` makes its estimates.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import median

import numpy as np

from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.detection_update import Attempts
from relpos.fusion.bank.mirrored import open_nodes
from relpos.fusion.bank.reporting import Report
from relpos.fusion.bank.storage import PER_NODE, StateIndex
from relpos.fusion.clocks import Clocks
from relpos.fusion.estimator import (
    Estimate,
    Presence,
    Vertical,
    heights_apart,
    refuse_unmoved,
    refuse_unranged,
)
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.initial_poses import HEADING_RESOLVED_RAD, Initialiser, PoseMixture, by_node
from relpos.fusion.models.detection import Detection, on_one_floor
from relpos.fusion.models.handedness import Handedness, TurnAgreement, Way
from relpos.fusion.models.motion import reported_sigmas, velocity_m_s
from relpos.fusion.models.north import North
from relpos.fusion.models.odometry_faults import SpeedGate, ZeroMotionDetector, vagueness
from relpos.fusion.models.ranging import (
    CommonIndex,
    Mounting,
    OutlierPersistence,
    RangeCorrelation,
    Repeats,
    antenna_m,
    deviations_within,
    slab_variance,
    slant_height,
    tag_height_m,
)
from relpos.fusion.models.unseen_walk import UnseenWalk
from relpos.fusion.post import posts_of
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Step, Timeline
from relpos.fusion.vertical.filter import VerticalFilter
from relpos.measurements import Heading, Height, Prior, Range, nodes_of

SET_OFF_M = 0.3
"""A node without a heading has set off when it is this far from where it stood."""

HEADING_SIGMA_RAD = 0.17
"""Of an absolute heading without a reported sigma: magnetic ones indoors are 10 degrees off."""


@dataclass(slots=True)
class Bank:
    """The core of the estimator (:class:`~relpos.fusion.rewind.Core`).

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
    outliers: OutlierPersistence = field(default_factory=OutlierPersistence)
    speed_gate: SpeedGate = field(default_factory=SpeedGate)
    zero_motion: ZeroMotionDetector = field(default_factory=ZeroMotionDetector)
    north: North = field(default_factory=North)
    vertical: VerticalFilter = field(init=False)
    clocks: Clocks = field(default_factory=Clocks)
    handedness: Handedness = field(default_factory=Handedness)
    turn_agreement: TurnAgreement = field(default_factory=TurnAgreement)
    _row: dict[int, int] = field(default_factory=dict)
    _known: dict[int, Presence] = field(default_factory=dict)
    _standing: dict[int, Way] = field(default_factory=dict)
    """Located nodes without a heading: what they have gone since."""
    _pending: list[Advance] = field(default_factory=list)
    _counters: Counter[str] = field(default_factory=Counter)
    _moved: bool = False
    _ranges_used: int = 0
    _epoch_s: float = -math.inf

    def __post_init__(self) -> None:
        s = self.settings
        self.core = BankCore(s, self.seed)
        self.vertical = VerticalFilter(posts=posts_of(self.mounting))
        for p in by_node(self.priors):
            self._meet(p.node)
            if p.is_known:
                self._row[p.node] = self.core.add_node(
                    (p.x_m, p.y_m, p.heading_rad), p.sigma_m, p.sigma_rad,
                    antenna_m(self.mounting, p.node),
                )  # fmt: skip
            else:
                self.initialiser.add(p.node, p)

    @property
    def shared(self) -> tuple[object, ...]:
        """Objects that copies of the core refer to (:class:`~relpos.fusion.rewind.Core`)."""
        return self.priors, self.settings, self.mounting

    def check_run(self, counters: Mapping[str, int]) -> None:
        """Raise RelposError if the run cannot give relative positions."""
        refuse_unmoved(self._moved or bool(self._pending))
        refuse_unranged(self._ranges_used, counters)

    def counters(self) -> Counter[str]:
        """Count everything perturbed, clamped, reset or resampled."""
        return self._counters + self.core.counters + self.initialiser.counters

    def update(self, step: Step, timeline: Timeline) -> Estimate | None:
        """Process one step of the timeline; an estimate at the end of an epoch."""
        if isinstance(step, Advance):
            step = self.vertical.move(step)
            if step.node in self._row:
                # It waits until a range or heading needs it, or the epoch ends.
                self._pending.append(step)
                if step.node in self._standing:
                    self._set_off(step)
                return None
            self._moved = True
            self._meet(step.node).received(step.time_s)
            way_m = math.hypot(step.dx_m, step.dy_m)
            self.range_correlation.move(step.node, way_m, step.dtheta_rad)
            self._seek(step.node)
            odd = self.speed_gate.exceeded(step)
            self._counters["motions_doubted"] += odd
            self.initialiser.advance(step, faulty=odd)
        elif isinstance(step, Ranging):
            self._advance()
            self._range(step, timeline)
        elif isinstance(step, Sensed):
            self._meet(step.measurement.node)
            self._sense(step)
        else:
            self._advance()
            self._climb(step.time_s)
            self._diffuse(self._row, step.time_s, timeline)
            self._admit(self.initialiser.find(step.time_s))
            return self._estimate(step.time_s, timeline)
        return None

    def cost_s(self, step: Step) -> float:
        """Return about how many seconds of a processor ``update`` needs for a step."""
        if isinstance(step, Ranging):
            return 3e-4 + 3e-10 * self.core.hypotheses.covariance_entries
        if isinstance(step, Epoch):
            return 1e-3 + 1e-9 * self.core.hypotheses.covariance_entries + self.initialiser.cost_s()
        return 3e-5

    def _meet(self, node: int) -> Presence:
        known = self._known.get(node)
        if known is None:
            known = self._known[node] = Presence(Vertical(tag_height_m(self.mounting, node)))
            worn = self.mounting.get(node)
            if worn is not None and worn.height_m is not None:
                self.core.hypotheses.biases.know_heights()
        return known

    def _advance(self) -> None:
        """Process the displacements that wait."""
        steps = self._pending
        if not steps:
            return
        self._pending = []
        rows = np.array([self._row[a.node] for a in steps], dtype=np.int64)
        moves = np.array([(a.dx_m, a.dy_m, a.dtheta_rad, a.duration_s) for a in steps])
        reported = np.array([reported_sigmas(a) for a in steps])
        begin = 0
        knowns, zero_motion, speed_gate = self._known, self.zero_motion, self.speed_gate
        self._moved = True
        for k, a in enumerate(steps):
            time_s, node, duration_s, dx_m, dy_m, turn_rad = a[:6]
            known = knowns[node]
            known.received(time_s)
            way_m = math.hypot(dx_m, dy_m)
            self.range_correlation.move(node, way_m, turn_rad)
            self.handedness.move(a)
            self.turn_agreement.move(a)
            known.velocity_m_s = velocity_m_s(a)
            usual = speed_gate.usual_m_s.get(node, 0.0)
            known.move(a, usual, knowns.values())
            # How it turned meanwhile its ranges cannot say.
            if known.leads_nowhere(a):
                moves[k, :2] = 0.0
                self._walk_unseen(node, time_s)
            else:
                moves[k, :2] *= known.undiffused(time_s, duration_s)
            vague = vagueness(a)
            if vague is not None:
                reported[k] = math.nan
                self.core.relocalisation.inflate_covariance(int(rows[k]), *vague)
            if zero_motion.update(a):
                self._counters["motions_still"] += dx_m != 0.0 or turn_rad != 0.0
                moves[k, :3] = 0.0
                known.velocity_m_s = (0.0, 0.0)
                continue
            if speed_gate.exceeded(a):
                self.core.move(rows[begin:k], moves[begin:k], reported[begin:k])
                begin = k + 1
                self._move_doubtful(rows[k:begin], moves[k:begin], reported[k:begin])
        self.core.move(rows[begin:], moves[begin:], reported[begin:])

    def _move_doubtful(self, rows: Indices, moves: Floats, reported: Floats) -> None:
        """Make a displacement that is far out of its node's habit in half the hypotheses."""
        self.core.adaptive.grow()
        row, these = int(rows[0]), self.core.hypotheses
        before, _ = these.poses_of(row)
        self.core.move(rows, moves, reported)
        self.core.relocalisation.split_motion(row, these.poses_of(row)[0] - before)

    def _range(self, step: Ranging, timeline: Timeline) -> None:
        located, time_s = self._row, step.time_s
        ends = nodes_of(step.ranges)
        self._diffuse(ends, time_s, timeline)
        for node in ends:
            self._meet(node).ranged(time_s)
        for one in step.ranges:
            self.vertical.ranged(one)
        ranges: Sequence[Range] = step.ranges
        if not ends <= located.keys():
            for node in sorted(ends - located.keys()):
                self._seek(node)
            heights = {n: k.vertical.z_m for n, k in self._known.items()}
            self.initialiser.update(time_s, step.ranges, self._places(), heights)
            # A search may be long; finding no pose in it is no fault of the data.
            self._ranges_used += len(step.ranges)
            ranges = [r for r in step.ranges if r.node in located and r.peer in located]
        if ranges:
            self._use_ranges(step, ranges, timeline)
        self._end_instant(time_s)

    def _use_ranges(self, step: Ranging, ranges: Sequence[Range], timeline: Timeline) -> None:
        """Update with those ``ranges`` of an instant that are between located nodes."""
        time_s, ends, known = step.time_s, nodes_of(step.ranges), self._known
        measured = np.array([r.range_m for r in ranges])
        pairs = [(r.node, r.peer) for r in ranges]
        first, second, dz, variance = self._pairs(pairs)
        self.core.relocalisation.relocalise_lost(time_s, first, second, measured)
        rounds = self._attempts(time_s, ranges, timeline)
        repeats = self._repeats(pairs)
        velocity = [known[a].velocity_at(time_s) + known[b].velocity_at(time_s) for a, b in pairs]
        outliers = self.outliers.expected(time_s, pairs)
        before = self._unseen(ends, time_s)
        inlier, excess_m = self.core.update(
            first, second, measured, dz, variance, repeats, np.array(velocity), outliers
        )
        self.outliers.learn(time_s, pairs, inlier, excess_m)
        self._ranges_used += len(ranges)
        after = self._unseen(ends, time_s)
        for (walk, place, spread), (_, moved, left) in zip(before, after, strict=True):
            walk.correct(moved - place, spread, left)
        for attempts in rounds:
            self.core.update_detection(attempts, self.detection)

    def _end_instant(self, time_s: float) -> None:
        faulty = [node for node, row in self._row.items() if row == self.core.faulty_row]
        stands = any(self._known[node].contradict(time_s) for node in faulty)
        self.core.end_instant(time_s, turned=not stands)

    def _repeats(self, pairs: Sequence[tuple[int, int]]) -> Repeats:
        """Return what the ranges of ``pairs`` repeat; those that are less certain count less."""
        known = self._known
        uneven = [
            known[a].within.range_variance_m2() + known[b].within.range_variance_m2()
            for a, b in pairs
        ]
        own_m2 = np.array(uneven) + slab_variance(
            [(known[a].vertical.floor, known[b].vertical.floor) for a, b in pairs]
        )
        variance = self.core.range_variance_m2
        count, kept = self.range_correlation.repeats(pairs)
        return Repeats(variance * count / (variance + count * own_m2), kept)

    def _climb(self, time_s: float) -> None:
        """Update heights at the end of an epoch; take back what stairs have added to motion."""
        if not self.vertical.active:
            return
        for back in self.vertical.close(time_s):
            self._counters["stairs_corrected"] += 1
            row = self._row.get(back.node)
            if row is None:
                self.initialiser.advance(back)
            else:
                moves = np.array([[back.dx_m, back.dy_m, 0.0, 0.0]])
                self.core.move(np.array([row]), moves, np.array([reported_sigmas(back)]))
        for node, known in self._known.items():
            vertical, tag_m = self.vertical.of(node, time_s), tag_height_m(self.mounting, node)
            known.vertical = vertical._replace(z_m=tag_m + vertical.z_m)

    def _diffuse(self, nodes: Iterable[int], time_s: float, timeline: Timeline) -> None:
        """Let nodes whose motion is missing be anywhere that they can have walked to.

        Their ranges are used all the same. Where the motion comes late, the rewinder repeats both.
        """
        for node in sorted((self._row.keys() & nodes) - self.vertical.posts):
            known, heading = self._known[node], partial(self._heading_rad, node)
            if known.is_unseen(time_s, timeline.reported_s(node), heading):
                self._walk_unseen(node, time_s)

    def _walk_unseen(self, node: int, time_s: float) -> None:
        """Let a node walk on without a report."""
        walked = self._known[node].walk_unseen(time_s)
        if walked is not None:
            path_m, way_m, unknown = walked
            self.range_correlation.move(node, path_m, 0.0)
            self.core.relocalisation.diffuse(self._row[node], way_m, unknown)
            self._counters["diffusions"] += 1

    def _heading_rad(self, node: int) -> float:
        mean, _ = self.core.hypotheses.moments(poses_alone=True)
        return float(mean[PER_NODE * self._row[node] + StateIndex.HEADING])

    def _unseen(
        self, nodes: Iterable[int], time_s: float
    ) -> list[tuple[UnseenWalk, Floats, Floats]]:
        """Return who of ``nodes`` walks unseen now, with its place (2,) and covariance (2, 2)."""
        walks = [
            (node, known.unseen)
            for node, known in ((n, self._known[n]) for n in sorted(self._row.keys() & nodes))
            if known.unseen is not None and known.diffused_s == time_s
        ]
        if not walks:
            return []
        mean, covariance = self.core.hypotheses.relative_moments()
        found = []
        for node, walk in walks:
            at = PER_NODE * self._row[node]
            found.append((walk, mean[at : at + 2], covariance[at : at + 2, at : at + 2]))
        return found

    def _seek(self, node: int) -> None:
        if node not in self.initialiser:
            self.initialiser.add(node)

    def _places(self) -> dict[int, tuple[float, float, float]]:
        """Return x, y (m) of located nodes, and the variance (m^2) relative to the nearest node.

        What the team's positions have in common is no error of a pose found relative to them.
        """
        if not self._row:
            return {}
        mean, covariance = self.core.hypotheses.moments(poses_alone=True)
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

    def _admit(self, mixture: PoseMixture | None) -> None:
        """Add nodes whose pose has been found to the core."""
        if mixture is None:
            return
        beside = self._nearest(mixture) if self._row else None
        rows = [
            self.core.add_node((0.0, 0.0, 0.0), 1.0, 1.0, antenna_m(self.mounting, node))
            for node in mixture.nodes
        ]
        self._row.update(zip(mixture.nodes, rows, strict=True))
        self.core.adaptive.grow()
        these = self.core.hypotheses
        these.place(
            np.array(rows, dtype=np.int64), mixture.poses, mixture.covariances,
            np.log(np.maximum(mixture.weights, 1e-300)), beside,
        )  # fmt: skip
        for n, (node, row) in enumerate(zip(mixture.nodes, rows, strict=True)):
            these.set_scale(row, float(mixture.scales[n]))
            if mixture.heading_sigma_rad(n) > HEADING_RESOLVED_RAD:
                self._standing[node] = Way()

    def _nearest(self, mixture: PoseMixture) -> int:
        """Return the row of the located node nearest to the nodes that have been found."""
        mean, _ = self.core.hypotheses.moments(poses_alone=True)
        middle = mixture.poses[0, :, :2].mean(axis=0)
        rows = list(self._row.values())
        off = [np.hypot(*(mean[PER_NODE * r : PER_NODE * r + 2] - middle)) for r in rows]
        return rows[int(np.argmin(off))]

    def _set_off(self, step: Advance) -> None:
        """Give a node without a heading all directions once it has moved; its ranges select."""
        way = self._standing[step.node]
        way.move(step)
        if abs(way.now_m) < SET_OFF_M:
            return
        self._advance()
        del self._standing[step.node]
        self.core.adaptive.grow()
        self.core.hypotheses.split_heading(self._row[step.node], abs(way.now_m))
        self._counters["headings_sought"] += 1

    def _pairs(self, pairs: Sequence[tuple[int, int]]) -> tuple[Indices, Indices, Floats, Floats]:
        """Return the rows of pairs, their differences of height (m) and those's variances."""
        row = self._row
        rows = np.array([(row[a], row[b]) for a, b in pairs], dtype=np.int64).reshape(-1, 2)
        first, second = np.ascontiguousarray(rows.T)
        return first, second, *heights_apart(self._known, pairs)

    def _attempts(
        self, time_s: float, ranges: Sequence[Range], timeline: Timeline
    ) -> list[Attempts]:
        """Return the attempts of each round that ends here; the detection curve learns them."""
        rounds = []
        ended = self.detection.rounds.add(time_s, ranges, timeline.reported_s, self._telling)
        for done in ended:
            pairs = done.received + done.missed
            for late in timeline.catch_up({n for p in pairs for n in p}, time_s):
                self.update(late, timeline)
            self._advance()
            first, second, dz, variance = self._pairs(pairs)
            rows = first, second, slant_height(dz, variance)
            received = np.arange(len(pairs)) < len(done.received)
            attempted = np.ones(len(pairs))
            attempted[len(done.received) :] = self.detection.update(
                done, *self.core.predicted_ranges(*rows)
            )
            rounds.append(Attempts(*rows, received, attempted))
        return rounds

    def _telling(self, pairs: Sequence[tuple[int, int]]) -> Bools:
        """Return of which pairs an attempt says something new of the plane."""
        new = self.range_correlation.tells(pairs)
        telling: Bools = new & on_one_floor(*heights_apart(self._known, pairs))
        return telling

    def _sense(self, step: Sensed) -> None:
        measured = step.measurement
        if isinstance(measured, Height):
            self._counters["heights_stuck"] += not self.vertical.measure(measured, step.time_s)
            self.core.hypotheses.biases.know_heights()
        elif isinstance(measured, Heading) and measured.node in self._row:
            self._advance()
            self._turn(step.time_s, measured, self._row[measured.node])
        else:
            self._counters[step.unused] += 1

    def _turn(self, time_s: float, measured: Heading, row: int) -> None:
        """Update with an absolute heading, as far as north is known."""
        north = self.north
        reported = measured.sigma_rad or HEADING_SIGMA_RAD
        sigma = north.alone_sigma_rad(measured.node, time_s, reported)
        these = self.core.hypotheses
        mean, covariance = these.moments(poses_alone=True)
        place = PER_NODE * row + StateIndex.HEADING
        own, variance = float(mean[place]), float(covariance[place, place] + these.common[2, 2])
        used_rad = north.used_sigma_rad(sigma, variance)
        if used_rad is not None:
            self.core.update_heading(row, measured.heading_rad - north.angle_rad, used_rad)
        compass = measured.node, measured.source
        if not north.learn(compass, measured.heading_rad, sigma, own, variance):
            self._counters["headings_doubted"] += 1

    def _estimate(self, time_s: float, timeline: Timeline) -> Estimate:
        for known in self._known.values():
            known.close_epoch(self._epoch_s)
        since_s, self._epoch_s = self._epoch_s, time_s
        mean, covariance, common = self.core.moments()
        self.core.relocalisation.end_ambiguity(covariance)
        rows = np.array([self._row[node] for node in sorted(self._row)], dtype=np.int64)
        distances = self.core.distances(rows)
        unsure = self.handedness.unsure(
            *open_nodes(self._row, self.core.hypotheses, covariance, distances[1], self._standing)
        )
        heading_rad = {
            node: float(mean[PER_NODE * row + StateIndex.HEADING])
            for node, row in self._row.items()
            if row not in self.core.relocalisation.ambiguous
        }
        turns = self.turn_agreement
        contradicted = turns.close_epoch(heading_rad)
        if turns.doubted:
            unsure = self._row.keys() | unsure
        report = Report(
            time_s, self._row, self._known, self.core, mean, covariance, covariance + common,
            self.initialiser, self.detection, self.clocks, distances, unsure,
        )  # fmt: skip
        estimate = report.estimate(self.north.known())
        if contradicted:
            self.core.relocalisation.reflect_team(north_known=self.north.is_usable)
        if since_s > -math.inf:
            self._slew_clocks(time_s - since_s, mean, covariance, timeline)
        return estimate

    def _slew_clocks(
        self, duration_s: float, mean: Floats, covariance: Floats, timeline: Timeline
    ) -> None:
        """Let what has been learned of time stamps go into those of later measurements."""
        these, rows = self.core.hypotheses, self._row
        lateness = these.common_entry(CommonIndex.LATENESS)
        sigma_s = math.sqrt(max(float(covariance[lateness, lateness]), 0.0))
        clocks = these.clock_entries()
        offset_s, sigmas_s = mean[clocks], deviations_within(covariance, clocks)
        usual_s = median(offset_s.tolist()) if rows else 0.0
        offsets = {n: (offset_s[row] - usual_s, sigmas_s[row]) for n, row in rows.items()}
        late_s, steps = self.clocks.slew(duration_s, (float(mean[lateness]), sigma_s), offsets)
        steps_s = {lateness: late_s}
        steps_s |= {these.clock_entry(rows[node]): step_s for node, step_s in steps.items()}
        for entry, step_s in steps_s.items():
            if step_s != 0.0:
                these.shift_common(entry, -step_s)
        # Otherwise whatever is dated back would come late.
        timeline.reorder_s = self.settings.reorder_s + self.clocks.longest_s
