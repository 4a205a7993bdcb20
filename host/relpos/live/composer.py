"""Builds the team's view: newest estimate, motion since, alarms, node health, measured ranges."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from relpos.fusion.estimator import Estimate, MagneticNorth, NodeEstimate, NodeStatus, PairEstimate
from relpos.live.alarms import Alarms, Condition, KnownAlert
from relpos.live.nowcast import Nowcast
from relpos.live.team_view import (
    Alert,
    GhostPerson,
    Ghosts,
    MeasuredRange,
    Notice,
    Person,
    TeamView,
    name_of,
)
from relpos.measurements import Height, Motion, Observation, Range, at_rest
from relpos.nodes.monitor import NodeMonitor, TeamMonitor

if TYPE_CHECKING:
    from relpos.link.decoder import Decoder

RANGE_AGE_S = 10.0
"""Age from which a range is not shown any more."""
STALE_S = 3.0
"""Silence after which a wearer is shown as stale, as after three epochs in an estimator."""
HEALTH_S = 0.5
NORTH_SHOWN_RAD = math.radians(15.0)
"""With a larger standard deviation one reading in seven would name the wrong one of eight compass
points."""
NORTH_MOVES_RAD = math.radians(4.0)
"""The map keeps its orientation while north moves by less: a map that turns with every reading is
unreadable."""

POSE = (
    "x_m", "y_m", "z_m", "sigma_z_m", "heading_rad", "sigma_major_m", "sigma_minor_m",
    "sigma_angle_rad", "sigma_heading_rad", "episode_probability", "floor", "floor_probability",
)  # fmt: skip
"""What an estimate's node and a person on the page have in common, beside the episode."""


class Composer:
    """Gathers everything that happens, in order, and composes the view of any moment.

    ``names`` replace node numbers on display and may change at any time; ``posts`` are nodes at
    the command post, which nobody wears.
    """

    def __init__(
        self, names: Mapping[int, str] | None = None, posts: frozenset[int] = frozenset()
    ) -> None:
        self.names: dict[int, str] = dict(names or {})
        self.posts = posts
        self.alarms = Alarms()
        self.alarms.posts = posts
        self.nowcast = Nowcast()
        self.monitor = TeamMonitor()
        self._ranges: dict[tuple[int, int], Range] = {}
        self._pair_cache: dict[tuple[int, int], tuple[tuple[int, int], PairEstimate]] = {}
        self._health_cache: dict[int, tuple[float, dict[str, Any]]] = {}
        self._north: MagneticNorth | None = None
        self._submitted = 0
        self._seq = 0
        self.first_s: float | None = None
        """Time of the first motion or range that came."""
        self.newest_s: float | None = None
        """Time of the newest motion or range."""

    def add_observations(
        self, now_s: float, observations: Sequence[Observation], decoder: Decoder | None
    ) -> None:
        """Add observations that have just been decoded; ``decoder`` is None for a recorded run."""
        if decoder is None:
            self.monitor.update_without_link(now_s, observations)
        else:
            self._count_heard(now_s, decoder, observations)
        for observation in observations:
            self._submitted += 1
            if isinstance(observation, Motion):
                still = observation.node in self.posts
                motion = at_rest(observation) if still else observation
                self.nowcast.add_motion(motion, self._submitted)
                self.alarms.add_motion(observation)
                self._newer(observation.time_s)
            elif isinstance(observation, Range):
                self._range(observation)
                self._newer(observation.time_s)
            elif isinstance(observation, Height):
                self.alarms.add_height(observation)
            if decoder is None:
                self.alarms.mark_heard(observation.node)

    def add_reported(self, observations: Sequence[Observation]) -> None:
        """Count observations sent by phones: the fusion gets them, but no node was received."""
        self._submitted += len(observations)

    def add_estimate(self, estimate: Estimate, processed: int) -> None:
        """Add an estimate that was emitted after ``processed`` observations."""
        self.nowcast.add_estimate(estimate, processed)
        self._north = _shown_north(self._north, estimate.north)

    def view(
        self,
        now_s: float,
        unix_s: float,
        arrived_unix_s: float | None = None,
        notices: Iterable[Notice] = (),
    ) -> TeamView:
        """Return the view of this moment."""
        self._seq += 1
        estimate = self.nowcast.estimate
        located = {} if estimate is None else {n.node: n for n in estimate.nodes}
        people = sorted(self.monitor.nodes.keys() | located.keys() | self.alarms.mayday)
        return TeamView(
            seq=self._seq,
            time_s=now_s,
            unix_s=unix_s,
            arrived_unix_s=arrived_unix_s,
            fused_s=None if estimate is None else estimate.time_s,
            north_rad=None if self._north is None else self._north.bearing_rad,
            sigma_north_rad=None if self._north is None else self._north.sigma_rad,
            ambiguous=estimate is not None and bool(estimate.alternatives),
            notices=tuple(notices),
            people=tuple(self.person(node, now_s) for node in people),
            pairs=() if estimate is None else self._pairs(estimate),
            ranges=self._measured(now_s),
            alternatives=() if estimate is None else ghosts_of(estimate),
        )

    def person(self, node: int, now_s: float) -> Person:
        """Return a person as the view of this moment has them."""
        monitor = self.monitor.nodes.get(node)
        condition = self.alarms.condition(node)
        seen_s = None if monitor is None else now_s - monitor.heard_s
        at = self.nowcast.node(node)
        return Person(
            node=node,
            name=self.name(node),
            status=_status(at, seen_s, condition),
            motion_s=self.nowcast.newest_s(node),
            seen_s=seen_s,
            moving=condition.moving,
            still_s=condition.still_s,
            alert=condition.alert,
            acknowledged=condition.acknowledged,
            acknowledged_by=condition.acknowledged_by,
            shelved_s=condition.shelved_s,
            rssi_dbm=None if monitor is None else monitor.rssi_dbm,
            post=node in self.posts,
            episode=None if at is None or at.episode is None else str(at.episode),
            **self._health(node, now_s),
            **({} if at is None else {name: getattr(at, name) for name in POSE}),
        )

    def remember(self, node: int, heard_s: float, now_s: float, alert: KnownAlert | None) -> None:
        """Go on with a person of a session before, heard from now or not: nobody is left out."""
        self.monitor.nodes.setdefault(node, NodeMonitor(node, heard_s=heard_s))
        self.alarms.remember(node, heard_s, now_s, alert)

    def name(self, node: int) -> str:
        """Return the name of the node's wearer."""
        return name_of(node, self.names, self.posts)

    def _count_heard(
        self, now_s: float, decoder: Decoder, observations: Sequence[Observation]
    ) -> None:
        before = {node: monitor.received for node, monitor in self.monitor.nodes.items()}
        self.monitor.update(now_s, decoder, observations)
        for node, monitor in self.monitor.nodes.items():
            if monitor.received != before.get(node):
                self.alarms.mark_heard(node)

    def _newer(self, time_s: float) -> None:
        self.first_s = time_s if self.first_s is None else self.first_s
        self.newest_s = time_s if self.newest_s is None else max(self.newest_s, time_s)

    def _range(self, measured: Range) -> None:
        if measured.range_m <= 0.0:
            return
        pair = (min(measured.node, measured.peer), max(measured.node, measured.peer))
        before = self._ranges.get(pair)
        if before is None or before.time_s <= measured.time_s:
            self._ranges[pair] = measured

    def _measured(self, now_s: float) -> tuple[MeasuredRange, ...]:
        old = [p for p, measured in self._ranges.items() if now_s - measured.time_s > RANGE_AGE_S]
        for pair in old:
            del self._ranges[pair]
        return tuple(
            MeasuredRange(m.node, m.peer, m.range_m, max(now_s - m.time_s, 0.0))
            for m in self._ranges.values()
        )

    def _pairs(self, estimate: Estimate) -> tuple[PairEstimate, ...]:
        """Return all pairs; recompute those of nodes with new motion or a new estimate."""
        versions = {node.node: self.nowcast.version(node.node) for node in estimate.nodes}
        before, self._pair_cache = self._pair_cache, {}
        for fused in estimate.pairs:
            ends = fused.node, fused.peer
            version = versions[ends[0]], versions[ends[1]]
            known = before.get(ends)
            if known is None or known[0] != version:
                known = version, self.nowcast.pair(fused)
            self._pair_cache[ends] = known
        return tuple(pair for _, pair in self._pair_cache.values())

    def _health(self, node: int, now_s: float) -> dict[str, Any]:
        """Return the node's own health, at most :data:`HEALTH_S` old: it changes slowly."""
        assessed_s, known = self._health_cache.get(node, (-math.inf, {}))
        if assessed_s <= now_s <= assessed_s + HEALTH_S:
            return known
        monitor = self.monitor.nodes.get(node) or NodeMonitor(node)
        colour, reasons = monitor.health(now_s)
        neighbours = monitor.status.get("neighbours")
        known = {
            "health": colour.name.lower(),
            "reasons": tuple(reasons),
            # 0: this board does not measure it.
            "battery_v": monitor.status.get("battery_v") or None,
            "frame_loss": monitor.frame_loss(now_s),
            "ranging": monitor.ranging(now_s)[0],
            "neighbours": None if neighbours is None else int(neighbours),
        }
        self._health_cache[node] = now_s, known
        return known


def _shown_north(shown: MagneticNorth | None, known: MagneticNorth | None) -> MagneticNorth | None:
    """Return the north to show: the one shown before while the estimate is close to it."""
    if known is None or known.sigma_rad > NORTH_SHOWN_RAD:
        return None
    moved_rad = math.inf
    if shown is not None:
        moved_rad = abs(math.remainder(known.bearing_rad - shown.bearing_rad, math.tau))
    if shown is None or moved_rad > NORTH_MOVES_RAD:
        return known
    return MagneticNorth(shown.bearing_rad, known.sigma_rad)


def _status(at: NodeEstimate | None, seen_s: float | None, condition: Condition) -> str:
    """Return the estimator's status of the position, unless silence overrules it.

    An estimate is a second old, or a minute where the fusion is behind; silence is known here at
    once.
    """
    if condition.alert is Alert.LOST:
        return NodeStatus.LOST
    located = NodeStatus.UNLOCATED if at is None else at.status
    if located in (NodeStatus.UNLOCATED, NodeStatus.AMBIGUOUS):
        return located
    if seen_s is None or seen_s > STALE_S or located is NodeStatus.LOST:
        return NodeStatus.STALE
    return located


def ghosts_of(estimate: Estimate) -> tuple[Ghosts, ...]:
    """Return the alternatives by probability, at the time of the estimate (no nowcast)."""
    rows: dict[int, list[GhostPerson]] = {}
    probabilities: dict[int, float] = {}
    for a in estimate.alternatives:
        probabilities[a.alternative] = a.probability
        rows.setdefault(a.alternative, []).append(
            GhostPerson(
                a.node,
                a.x_m,
                a.y_m,
                a.heading_rad,
                a.sigma_major_m,
                a.sigma_minor_m,
                a.sigma_angle_rad,
                str(a.shape),
            )
        )
    return tuple(Ghosts(probabilities[k], tuple(rows[k])) for k in sorted(rows))
