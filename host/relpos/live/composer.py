"""From what was received and concluded to the picture that is shown."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from relpos.fusion.estimator import Estimate, MagneticNorth, NodeEstimate, NodeStatus
from relpos.live.alarms import Alarms, Condition
from relpos.live.nowcast import Nowcast
from relpos.live.picture import (
    Alert,
    GhostPerson,
    Ghosts,
    MeasuredRange,
    Notice,
    Pair,
    Person,
    Picture,
)
from relpos.measurements import Motion, Observation, Range
from relpos.nodes.view import NodeView, TeamView

if TYPE_CHECKING:
    from relpos.link.decoder import Decoder

RANGE_AGE_S = 10.0
"""A range older than this is no link any more."""
STALE_S = 3.0
"""Silence after which somebody is shown as stale, as after three epochs in an estimator."""
HEALTH_S = 0.5
NORTH_SHOWN_RAD = math.radians(15.0)
"""With a larger deviation one in seven would be sent to the wrong one of eight compass points."""
NORTH_MOVES_RAD = math.radians(4.0)
"""A map that turned with every reading could not be read; less than this nobody can tell."""


@dataclass(frozen=True, slots=True)
class _Health:
    """What a node told of itself, judged at ``looked_s``."""

    looked_s: float
    colour: str
    reasons: tuple[str, ...]
    battery_v: float | None
    loss: float | None
    ranging: float | None
    neighbours: int | None


class Composer:
    """Feed it everything that happens, in order; ask for the picture at any moment.

    ``names`` are shown in place of numbers and may be changed at any time.
    """

    def __init__(self, names: Mapping[int, str] | None = None, start_s: float = 0.0) -> None:
        self.names: dict[int, str] = dict(names or {})
        self.alarms = Alarms()
        self.nowcast = Nowcast(start_s)
        self.team = TeamView()
        self._ranges: dict[tuple[int, int], Range] = {}
        self._paired: dict[tuple[int, int], tuple[tuple[int, int], Pair]] = {}
        self._healths: dict[int, _Health] = {}
        self._north: MagneticNorth | None = None
        self._given = 0
        self._seq = 0
        self.first_s: float | None = None
        """Time of the first motion or range that came."""
        self.newest_s: float | None = None
        """Time of the newest motion or range."""

    @property
    def given(self) -> int:
        """How many observations have been taken; estimates refer to this count."""
        return self._given

    def observed(
        self, now_s: float, observations: Sequence[Observation], decoder: Decoder | None
    ) -> None:
        """Take what has just been decoded."""
        if decoder is None:
            self.team.hear(now_s, observations)
        else:
            self._count_heard(now_s, decoder, observations)
        for observation in observations:
            self._given += 1
            if isinstance(observation, Motion):
                self.nowcast.take(observation, self._given)
                self.alarms.take(observation)
                self._newer(observation.time_s)
            elif isinstance(observation, Range):
                self._range(observation)
                self._newer(observation.time_s)
            if decoder is None:
                self.alarms.heard(observation.node)

    def told(self, observations: Sequence[Observation]) -> None:
        """Take what phones told: the fusion is given it, but no node was heard by it."""
        self._given += len(observations)

    def estimated(self, estimate: Estimate, given: int) -> None:
        """Take an estimate that came out when ``given`` observations had been worked off."""
        self.nowcast.fused(estimate, given)
        self._north = _shown_north(self._north, estimate.north)

    def picture(
        self,
        now_s: float,
        unix_s: float,
        arrived_unix_s: float | None = None,
        notices: Iterable[Notice] = (),
    ) -> Picture:
        """Give the picture of this moment."""
        self._seq += 1
        estimate = self.nowcast.estimate
        placed = {} if estimate is None else {n.node: n for n in estimate.nodes}
        people = sorted(self.team.nodes.keys() | placed.keys())
        return Picture(
            seq=self._seq,
            time_s=now_s,
            unix_s=unix_s,
            arrived_unix_s=arrived_unix_s,
            fused_s=None if estimate is None else estimate.time_s,
            north_rad=None if self._north is None else self._north.bearing_rad,
            sigma_north_rad=None if self._north is None else self._north.sigma_rad,
            ambiguous=estimate is not None and bool(estimate.alternatives),
            notices=tuple(notices),
            people=tuple(self._person(node, now_s) for node in people),
            pairs=() if estimate is None else self._pairs(estimate),
            ranges=self._measured(now_s),
            alternatives=() if estimate is None else _ghosts(estimate),
        )

    def _count_heard(
        self, now_s: float, decoder: Decoder, observations: Sequence[Observation]
    ) -> None:
        before = {node: view.received for node, view in self.team.nodes.items()}
        self.team.update(now_s, decoder, observations)
        for node, view in self.team.nodes.items():
            if view.received != before.get(node):
                self.alarms.heard(node)

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

    def _pairs(self, estimate: Estimate) -> tuple[Pair, ...]:
        """Everybody's distances; those anew of whom something is new."""
        versions = {node.node: self.nowcast.version(node.node) for node in estimate.nodes}
        before, self._paired = self._paired, {}
        for fused in estimate.pairs:
            ends = fused.node, fused.peer
            version = versions[ends[0]], versions[ends[1]]
            known = before.get(ends)
            if known is None or known[0] != version:
                p = self.nowcast.pair(fused)
                known = (
                    version,
                    Pair(
                        *ends,
                        p.distance_m,
                        p.sigma_distance_m,
                        p.bearing_rad,
                        p.sigma_bearing_rad,
                    ),
                )
            self._paired[ends] = known
        return tuple(pair for _, pair in self._paired.values())

    def _health(self, node: int, now_s: float) -> _Health:
        """How the node itself is; looked at now and then, for it goes by half minutes."""
        known = self._healths.get(node)
        if known is None or now_s - known.looked_s > HEALTH_S or now_s < known.looked_s:
            view = self.team.nodes.get(node) or NodeView(node)
            colour, reasons = view.health(now_s)
            neighbours = view.status.get("neighbours")
            known = self._healths[node] = _Health(
                now_s,
                colour.name.lower(),
                tuple(reasons),
                # 0: this board does not measure it.
                view.status.get("battery_v") or None,
                view.loss(now_s),
                view.ranging(now_s)[0],
                None if neighbours is None else int(neighbours),
            )
        return known

    def _person(self, node: int, now_s: float) -> Person:
        view = self.team.nodes.get(node)
        condition = self.alarms.of(node)
        seen_s = None if view is None else now_s - view.heard_s
        at = self.nowcast.node(node)
        health = self._health(node, now_s)
        return Person(
            node=node,
            name=self.names.get(node, f"Node {node}"),
            status=_status(at, seen_s, condition),
            motion_s=self.nowcast.newest_s(node),
            seen_s=seen_s,
            moving=condition.moving,
            still_s=condition.still_s,
            alert=condition.alert,
            acknowledged=condition.acknowledged,
            health=health.colour,
            reasons=health.reasons,
            battery_v=health.battery_v,
            rssi_dbm=None if view is None else view.rssi_dbm,
            loss=health.loss,
            ranging=health.ranging,
            neighbours=health.neighbours,
            **({} if at is None else _pose(at)),
        )


def _shown_north(shown: MagneticNorth | None, known: MagneticNorth | None) -> MagneticNorth | None:
    """Return what is to be shown of north: what is, as long as that is near enough."""
    if known is None or known.sigma_rad > NORTH_SHOWN_RAD:
        return None
    moved_rad = math.inf
    if shown is not None:
        moved_rad = abs(math.remainder(known.bearing_rad - shown.bearing_rad, math.tau))
    if shown is None or moved_rad > NORTH_MOVES_RAD:
        return known
    return MagneticNorth(shown.bearing_rad, known.sigma_rad)


def _pose(at: NodeEstimate) -> dict[str, float]:
    return {
        "x_m": at.x_m,
        "y_m": at.y_m,
        "z_m": at.z_m,
        "heading_rad": at.heading_rad,
        "sigma_major_m": at.sigma_major_m,
        "sigma_minor_m": at.sigma_minor_m,
        "sigma_angle_rad": at.sigma_angle_rad,
        "sigma_heading_rad": at.sigma_heading_rad,
    }


def _status(at: NodeEstimate | None, seen_s: float | None, condition: Condition) -> str:
    """What the estimator says of the position, unless silence says more.

    An estimate is of a moment ago, or of a minute ago where the fusion is behind: whether somebody
    is heard is known better here.
    """
    if condition.alert is Alert.LOST:
        return NodeStatus.LOST
    located = NodeStatus.UNLOCATED if at is None else at.status
    if located in (NodeStatus.UNLOCATED, NodeStatus.AMBIGUOUS):
        return located
    if seen_s is None or seen_s > STALE_S or located is NodeStatus.LOST:
        return NodeStatus.STALE
    return located


def _ghosts(estimate: Estimate) -> tuple[Ghosts, ...]:
    """The alternatives, by probability; of the fused moment, for they are not moved on."""
    rows: dict[int, list[GhostPerson]] = {}
    shares: dict[int, float] = {}
    for a in estimate.alternatives:
        shares[a.alternative] = a.probability
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
    return tuple(Ghosts(shares[k], tuple(rows[k])) for k in sorted(rows))
