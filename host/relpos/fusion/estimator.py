"""The interface of all estimators.

An estimator takes measurements in roughly time order, however they come about (serial port,
recording, simulation), and yields an :class:`Estimate` at every motion epoch. It knows neither
files nor ports nor the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import combinations
from math import atan2, cos, hypot, inf, pi, sin, sqrt
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from relpos.errors import RelposError
from relpos.fusion.arrays import Floats
from relpos.fusion.models.motion import WALK_S, WithinReport, is_long
from relpos.fusion.models.odometry_faults import STILL_M_S
from relpos.fusion.models.unseen_walk import AXIS_M2_S2, UnseenWalk
from relpos.fusion.timeline import Advance
from relpos.measurements import Measurement

Progress = Callable[[str, int, int], None]
"""Called with the stage of a long task, and how many of how many parts of it are done.

A total of 0 parts says that the length of the stage is not known.
"""


class NodeStatus(StrEnum):
    """How far a node's estimate may be trusted; the words of ``estimate.csv``."""

    OK = "ok"
    AMBIGUOUS = "ambiguous"
    UNLOCATED = "unlocated"
    STALE = "stale"
    LOST = "lost"


class Episode(StrEnum):
    """What a node's wearer does, as far as height tells; the words of ``estimate.csv``."""

    LEVEL = "level"
    UP = "up"
    DOWN = "down"
    LIFT = "lift"
    DISTURBED = "disturbed"
    FALLING = "falling"


class Vertical(NamedTuple):
    """What is known of a node's height; the last fields of :class:`NodeEstimate`."""

    z_m: float = 0.0
    sigma_z_m: float = 0.0
    episode: Episode | None = None
    episode_probability: float | None = None
    floor: int | None = None
    floor_probability: float | None = None


AT_THE_START = Vertical()
"""Nobody has reported any height."""


def ellipse_axes(xx: float, yy: float, xy: float) -> tuple[float, float, float]:
    """Return a covariance's deviations along its long and short axis, and the long one's angle."""
    middle, radius = 0.5 * (xx + yy), hypot(0.5 * (xx - yy), xy)
    major, minor = sqrt(max(middle + radius, 0.0)), sqrt(max(middle - radius, 0.0))
    return major, minor, 0.5 * atan2(2.0 * xy, xx - yy)


@dataclass(frozen=True, slots=True)
class NodeEstimate:
    """One node's pose in the common frame: world axes, metres, radians counter-clockwise.

    The 2 x 2 position covariance is given by its three distinct entries in m^2. An
    ``unlocated`` node carries the mean of what is known of it and a covariance to match; its
    numbers are no position to rely on. Episode and floor (0 is the start's) are None where nothing
    is known of them.
    """

    node: int
    x_m: float
    y_m: float
    heading_rad: float
    variance_x_m2: float
    variance_y_m2: float
    covariance_xy_m2: float
    sigma_heading_rad: float
    status: NodeStatus
    z_m: float = 0.0
    sigma_z_m: float = 0.0
    episode: Episode | None = None
    episode_probability: float | None = None
    floor: int | None = None
    floor_probability: float | None = None

    @property
    def vertical(self) -> Vertical:
        """Its height, episode and floor."""
        return Vertical(*(getattr(self, name) for name in Vertical._fields))

    @property
    def sigma_major_m(self) -> float:
        """Standard deviation along the ellipse's long axis."""
        return ellipse_axes(self.variance_x_m2, self.variance_y_m2, self.covariance_xy_m2)[0]

    @property
    def sigma_minor_m(self) -> float:
        """Standard deviation along the ellipse's short axis."""
        return ellipse_axes(self.variance_x_m2, self.variance_y_m2, self.covariance_xy_m2)[1]

    @property
    def sigma_angle_rad(self) -> float:
        """Direction of the long axis, counter-clockwise from world x, in (-pi/2, pi/2]."""
        return ellipse_axes(self.variance_x_m2, self.variance_y_m2, self.covariance_xy_m2)[2]


@dataclass(frozen=True, slots=True)
class PairEstimate:
    """``peer`` as seen from ``node``; the bearing is in the common frame, from world x.

    ``status`` is that of a file; None where :meth:`Estimate.pair_statuses` derives it.
    """

    node: int
    peer: int
    distance_m: float
    sigma_distance_m: float
    bearing_rad: float
    sigma_bearing_rad: float
    status: NodeStatus | None = None


class Shape(StrEnum):
    """What region an alternative gives a node; the words of ``alternatives.csv``."""

    ELLIPSE = "ellipse"
    RING = "ring"


@dataclass(frozen=True, slots=True)
class Alternative:
    """One node in one of the possible modes of the team while anything is ambiguous.

    The rows of one ``alternative`` (0, 1, ... from the most probable on, at most
    ``MAX_ALTERNATIVES``) at one time are one mode of the whole team and share its
    ``probability``; those of all modes sum to 1. Of a ring, x, y is the centre,
    ``sigma_major_m`` the radius and ``sigma_minor_m`` the width.
    """

    time_s: float
    alternative: int
    probability: float
    node: int
    x_m: float
    y_m: float
    heading_rad: float
    sigma_major_m: float
    sigma_minor_m: float
    sigma_angle_rad: float
    shape: Shape = Shape.ELLIPSE


@dataclass(frozen=True, slots=True)
class Parameter:
    """One learned constant; ``peer`` is given where it belongs to a pair.

    Names: ``step_scale`` (true over reported length), ``heading_drift_rad_s``, ``range_bias_m``,
    ``antenna_delay_m`` (by how much a tag's ranges are longer than most others'),
    ``height_difference_m`` (of a pair, where no heights are reported), ``detection_range_m``,
    ``body_shadow_m`` (what a body in between adds to a range), ``range_growth_m`` (by how much
    ranges grow for each factor e of the distance, about 5 m), ``range_scale`` (1, and by how much
    ranges may err in proportion to the distance), ``range_lateness_s`` (by how much
    ranges are dated late), ``clock_offset_s`` (how far a node's clock is ahead of most others').
    """

    time_s: float
    node: int
    peer: int | None
    name: str
    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class MagneticNorth:
    """Where magnetic north lies in the common frame, as compasses have reported."""

    bearing_rad: float
    sigma_rad: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """All nodes at one time in one common frame.

    The frame is that of the priors where there are any, else the pose of the first located node
    at the start. ``nodes`` is ordered by node id, ``pairs`` holds node < peer of every two
    located nodes (of large teams: of those within reach of each other). ``alternatives`` is
    empty unless something is ambiguous; ``parameters`` is what has been learned so far; ``north``
    is None where no compass has reported.
    """

    time_s: float
    nodes: tuple[NodeEstimate, ...]
    pairs: tuple[PairEstimate, ...]
    alternatives: tuple[Alternative, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    north: MagneticNorth | None = None

    def pair_statuses(self) -> list[NodeStatus]:
        """Return the status of every pair, in their order.

        Where a pair has none of its own, it is the worse of its two nodes', and ``ambiguous`` at
        best where the distance between their reported places is uncertain by more than
        ``VAGUE_PAIR_M``: both may be well known relative to others. The mean of places on an arc
        lies inside it, so that places may be nearer to each other than the pair's own distance
        says; that is a part of their error.
        """
        of = {node.node: node for node in self.nodes}
        order = list(NodeStatus)
        statuses = []
        for p in self.pairs:
            if p.status is not None:
                statuses.append(p.status)
                continue
            one, other = of.get(p.node), of.get(p.peer)
            if one is None or other is None:
                statuses.append(NodeStatus.UNLOCATED)
                continue
            between_m = hypot(one.x_m - other.x_m, one.y_m - other.y_m)
            vague = hypot(p.sigma_distance_m, between_m - p.distance_m) > VAGUE_PAIR_M
            own = NodeStatus.AMBIGUOUS if vague else NodeStatus.OK
            statuses.append(max((own, one.status, other.status), key=order.index))
        return statuses


@runtime_checkable
class Estimator(Protocol):
    """Measurements in, estimates out; live, replay and simulation call it in the same way."""

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; return the estimates it completes, oldest first."""

    def finish(self) -> list[Estimate]:
        """Process what waits for a later motion; raise RelposError if the data were unfit."""

    def counters(self) -> Mapping[str, int]:
        """Name -> how often: everything dropped, rejected, clamped, reset or resampled."""


ANY_ANGLE_RAD = pi / sqrt(3.0)
"""Standard deviation of a heading or bearing of which nothing is known."""

VAGUE_PAIR_M = 0.67
"""Greatest uncertainty of the distance between the places of a pair that is ``ok``: an error of
2 m is then three deviations (docs/notebook/missions.md)."""

MAX_ALTERNATIVES = 16
"""At most so many modes are listed (run format, ``alternatives.csv``)."""

STALE_EPOCHS = 3
LOST_EPOCHS = 10
"""Without news for so many epochs a node is ``stale``, then ``lost`` (run format, "Out")."""


def by_silence(epochs: int) -> NodeStatus:
    """Return the status of a located node without news for so many epochs."""
    if epochs >= LOST_EPOCHS:
        return NodeStatus.LOST
    return NodeStatus.STALE if epochs >= STALE_EPOCHS else NodeStatus.OK


SLOW = 0.5
"""A report of less than this share of a node's usual speed may leave out most of its way."""

USUAL_RANGES = 3
"""A node that was ranged so often in as long before, and then never, is silent."""


@dataclass(slots=True)
class Presence:
    """What every estimator keeps of a node beside its pose: its height, and its last motion."""

    vertical: Vertical = AT_THE_START
    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    """Forward and left, by its newest displacement."""
    news_s: float = -inf
    silent_epochs: int = 0
    within: WithinReport = field(default_factory=WithinReport)
    begun_s: float = -inf
    before_s: float = -inf
    """When its present report began, and the one before."""
    ranges_s: tuple[float, ...] = (-inf,) * USUAL_RANGES
    """Times of its last ranges."""
    unseen: UnseenWalk | None = None
    """How it walked while its motion was missing last."""
    diffused_s: float = -inf
    """Until then it may have walked without a report, and its ranges have moved it."""
    carried_s: float = inf
    """Since then its ranges contradict that it stands, which is all that it reports."""

    def velocity_at(self, time_s: float) -> tuple[float, float]:
        """Return its velocity forward and left (m/s); 0 where its motion is missing."""
        return (0.0, 0.0) if self.diffused_s >= time_s else self.velocity_m_s

    def facing(self, time_s: float, heading_rad: float, sigma_rad: float) -> tuple[float, float]:
        """Return its heading and the deviation, which are known but for what it turned unseen."""
        if self.unseen is None or self.diffused_s < time_s:
            return heading_rad, sigma_rad
        return self.unseen.facing(time_s, heading_rad, sigma_rad)

    def received(self, time_s: float) -> None:
        """Note that the node reported motion up to ``time_s``."""
        if time_s > self.news_s:
            self.news_s = time_s

    def ranged(self, time_s: float) -> None:
        """Note that a range of the node was used."""
        self.received(time_s)
        self.ranges_s = (*self.ranges_s[1:], time_s)

    def move(self, a: Advance, usual_m_s: float, team: Iterable[Presence]) -> None:
        """Note a piece of a report of a node that usually moves at ``usual_m_s``.

        A node that is silent within a slow report restarts, and tells less than it walks. It was
        ranged before, and others report meanwhile: not all data are missing.
        """
        way_m = hypot(a.dx_m, a.dy_m)
        if way_m > STILL_M_S * a.duration_s:
            self.carried_s = inf
        if self.within.ended:
            self.before_s, self.begun_s = self.begun_s, a.time_s - a.duration_s
        self.within.move(way_m, a.duration_s, a.fraction, usual_m_s)
        heard_s = max(self.begun_s, self.ranges_s[-1])
        silent_s = a.time_s - heard_s
        if silent_s <= WALK_S or self._walks_unseen or self.ranges_s[0] <= heard_s - silent_s:
            return
        others = any(other.before_s > heard_s + 0.25 * silent_s for other in team)
        if others and way_m < SLOW * usual_m_s * a.duration_s:
            self.unseen = UnseenWalk(heard_s, np.zeros(2), AXIS_M2_S2 * np.eye(2))
            self.diffused_s = heard_s

    @property
    def _walks_unseen(self) -> bool:
        return self.unseen is not None and self.diffused_s >= self.begun_s

    def leads_nowhere(self, a: Advance) -> bool:
        """Return whether a report came too late, and is too long, to say where its end led to."""
        return is_long(a.duration_s, a.fraction) and self._walks_unseen

    def close_epoch(self, epoch_s: float) -> None:
        """Count the epoch as silent where nothing came since the one before, at ``epoch_s``."""
        self.silent_epochs = 0 if self.news_s > epoch_s else self.silent_epochs + 1

    def is_unseen(self, time_s: float, reported_s: float, heading_rad: Callable[[], float]) -> bool:
        """Return whether it walks unseen: it reported its motion up to ``reported_s`` alone.

        It does so from its last velocity on, with the heading that is asked for then. Who never
        reported any motion does not, unless its ranges contradict that.
        """
        if self.carried_s < inf:
            reported_s = self.carried_s
        since_s = max(self.diffused_s, reported_s)
        if not -inf < since_s < time_s:
            return False
        if self.unseen is None or self.unseen.since_s != reported_s:
            heading = heading_rad()
            c, s = cos(heading), sin(heading)
            forward, left = self.velocity_m_s
            world_m_s = np.array([c * forward - s * left, s * forward + c * left])
            self.unseen = UnseenWalk(reported_s, world_m_s)
        self.diffused_s = since_s
        return True

    def contradict(self, time_s: float) -> bool:
        """Note that ranges contradict its place; return whether it reports to stand.

        It is carried then, or its inertial sensor fails: from now on it walks unseen, until it
        reports motion.
        """
        if hypot(*self.velocity_m_s) > STILL_M_S:
            return False
        self.carried_s = min(self.carried_s, time_s)
        return True

    def walk_unseen(self, time_s: float) -> tuple[float, Floats, Floats] | None:
        """Walk on without a report; None where there is nothing left to walk.

        Returns the length of the path (m), the way (2,), and by how much its place is less
        certain (2, 2).
        """
        if self.unseen is None or self.diffused_s >= time_s:
            return None
        duration_s = time_s - self.diffused_s
        self.diffused_s = time_s
        path_m = self.unseen.speed_m_s * duration_s
        return path_m, *self.unseen.walk(duration_s)

    def undiffused(self, time_s: float, duration_s: float) -> float:
        """Return the share of a displacement up to ``time_s`` that ranges have not made yet."""
        if self.diffused_s <= time_s - duration_s:
            return 1.0
        return max(time_s - self.diffused_s, 0.0) / max(duration_s, 1e-9)

    @property
    def status(self) -> NodeStatus:
        """``ok``, ``stale`` or ``lost``, by silence alone."""
        return by_silence(self.silent_epochs)


def unlocated(node: int, vertical: Vertical = AT_THE_START) -> NodeEstimate:
    """Return the estimate of a node of which nothing but its height is known."""
    status = NodeStatus.UNLOCATED
    return NodeEstimate(node, 0.0, 0.0, 0.0, inf, inf, 0.0, ANY_ANGLE_RAD, status, *vertical)


def refuse_unmoved(moved: bool) -> None:
    """Raise RelposError where a run brought no motion."""
    if not moved:
        raise RelposError("no motion was received: nothing can be estimated")


def refuse_unranged(ranges_used: int, counters: Mapping[str, int]) -> None:
    """Raise RelposError where a run brought no range that could be used."""
    if not ranges_used:
        raise RelposError(
            f"no usable range ({counters['ranges_failed']} failed ones): relative positions "
            "cannot be fused; from known starts --estimator deadreckoning still works"
        )


def heights_apart(
    known: Mapping[int, Presence], pairs: Sequence[tuple[int, int]]
) -> tuple[Floats, Floats]:
    """Return by how much the second of each pair is higher (P,), m, and the variances (P,), m^2."""
    heights = [(known[a].vertical, known[b].vertical) for a, b in pairs]
    dz_m = np.array([b.z_m - a.z_m for a, b in heights])
    return dz_m, np.array([a.sigma_z_m**2 + b.sigma_z_m**2 for a, b in heights])


def pairs_of(nodes: Sequence[NodeEstimate]) -> tuple[PairEstimate, ...]:
    """Give distance and bearing of every two nodes, their errors taken as independent.

    For estimators that keep no cross-covariance. Distances are horizontal, as positions are;
    unlocated nodes are left out.
    """
    located = [n for n in nodes if n.status is not NodeStatus.UNLOCATED]
    covariance = np.zeros((len(located), 2, len(located), 2))
    for k, n in enumerate(located):
        covariance[k, 0, k] = n.variance_x_m2, n.covariance_xy_m2
        covariance[k, 1, k] = n.covariance_xy_m2, n.variance_y_m2
    places_m = np.array([(n.x_m, n.y_m) for n in located]).reshape(-1, 2)
    return named_pairs([n.node for n in located], pair_moments(places_m, covariance))


def pair_moments(places_m: Floats, covariance: Floats) -> Floats:
    """Return (P, 4) of every two of N places (N, 2), by their joint covariance (N, 2, N, 2).

    Distance, its standard deviation (m), bearing and its deviation (rad), to first order; of two on
    one spot any bearing is as likely.
    """
    # Numbers one by one: arrays so small take NumPy several times as long.
    places, p, rows = places_m.tolist(), covariance.tolist(), []
    for i, j in combinations(range(len(places)), 2):
        dx, dy = places[j][0] - places[i][0], places[j][1] - places[i][1]
        xx, yy, xy = (
            p[i][a][i][b] + p[j][a][j][b] - p[i][a][j][b] - p[j][a][i][b]
            for a, b in ((0, 0), (1, 1), (0, 1))
        )
        distance = hypot(dx, dy)
        if distance > 0.0:
            c, s = dx / distance, dy / distance
            along = c * c * xx + 2.0 * c * s * xy + s * s * yy
            across = s * s * xx - 2.0 * c * s * xy + c * c * yy
            sideways = min(sqrt(max(across, 0.0)) / distance, ANY_ANGLE_RAD)
        else:
            along, sideways = 0.5 * (xx + yy), ANY_ANGLE_RAD
        rows.append((distance, sqrt(max(along, 0.0)), atan2(dy, dx), sideways))
    return np.array(rows).reshape(-1, 4)


def named_pairs(nodes: Sequence[int], moments: Floats) -> tuple[PairEstimate, ...]:
    """Return the pairs of every two of ``nodes`` by their :func:`pair_moments`."""
    every = zip(combinations(nodes, 2), moments.tolist(), strict=True)
    return tuple(PairEstimate(*two, *own) for two, own in every)
