"""The initialiser of all estimators: which nodes are sought, and when they are found.

:class:`HypothesisInitialiser` keeps the nodes that are not located. Those that a range ties to a
known node are sought together by a
:class:`~relpos.fusion.initialisation.search.HypothesisSearch`; they are found when its hypotheses
agree.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.initial_poses import PoseMixture
from relpos.fusion.initialisation.search import MOVED_M, HypothesisSearch
from relpos.fusion.timeline import Advance
from relpos.measurements import WIDEST_START_M, WIDEST_START_RAD, Prior, Range

MOST_SOUGHT, MOST_SOUGHT_LARGE_TEAM = 8, 12
"""So many are sought together; the others wait: the search grows with the cube of their number.
Of 60 nodes without initial poses all are located after 61 to 70 s with 12, after 76 to 90 with 8.
"""

AGREED = 0.99
AGREED_EPOCHS = 3
"""A node is resolved when hypotheses with this weight have agreed on it for so many epochs."""

MOST_STANDING = 2
QUIET_S = 30.0
"""Up to so many standing nodes are found without a heading, when no other has set off or been
resolved for so long: people set off one after another."""


@dataclass(slots=True)
class _UnlocatedNode:
    """A node outside the search: what was known of its pose, and how it has moved since."""

    mean: Floats
    sigma: Floats
    path_m: float = 0.0
    turned_rad: float = 0.0

    def move(self, step: Advance) -> None:
        """Compose a displacement; with an unknown heading only its length counts."""
        c, s = math.cos(self.mean[2]), math.sin(self.mean[2])
        if math.isinf(self.sigma[2]) and math.isfinite(self.sigma[0]):
            c, s = 0.0, 0.0  # The direction is unknown: ``sigmas`` says how far.
        self.mean += (c * step.dx_m - s * step.dy_m, s * step.dx_m + c * step.dy_m, step.dtheta_rad)
        self.path_m += math.hypot(step.dx_m, step.dy_m)
        self.turned_rad += abs(step.dtheta_rad)

    def sigmas(self) -> Floats:
        """Return the standard deviations (3,) of the pose now, m and rad."""
        heading = math.hypot(self.sigma[2], 0.1 * self.turned_rad, 0.01 * self.path_m)
        across_m = min(heading, 1.0) * self.path_m
        place = math.hypot(self.sigma[0], across_m, 0.05 * self.path_m)
        return np.array([place, place, heading])


@dataclass(slots=True)
class HypothesisInitialiser:
    """An :class:`~relpos.fusion.initial_poses.Initialiser` that carries many hypotheses.

    Where no node is located, the frame becomes the initial pose of one node of the first ranges
    (one that has moved, if any: the others' bearings are observable only with it).
    """

    seed: int = 0
    large_team: bool = False
    """The filter has one hypothesis, and many located nodes define its frame: a node is sought
    once it has moved and ranges a located one, and is not found before its heading is."""
    counters: Counter[str] = field(default_factory=Counter)
    resolved: set[int] = field(default_factory=set)
    search: HypothesisSearch = field(init=False)
    _has_frame: bool = field(init=False)
    _unlocated: dict[int, _UnlocatedNode] = field(default_factory=dict)
    """Nodes that are not in the search yet."""
    _agreed_epochs: Counter[int] = field(default_factory=Counter)
    _standing: set[int] = field(default_factory=set)
    """Resolved nodes that have not moved."""
    _quiet_since_s: float = -math.inf

    def __post_init__(self) -> None:
        self.search = HypothesisSearch(self.seed, self.counters)
        self._has_frame = self.large_team

    def __contains__(self, node: int) -> bool:
        return node in self._unlocated or node in self.search.nodes

    def add(self, node: int, prior: Prior | None = None) -> None:
        """Seek a node; of its pose nothing is known, or what ``prior`` knows well enough."""
        p = prior or Prior(node, 0.0, 0.0, 0.0, math.inf, math.inf)
        mean = np.array((p.x_m, p.y_m, p.heading_rad), float)
        sigma = np.array((p.sigma_m, p.sigma_m, p.sigma_rad), float)
        sigma[sigma >= (WIDEST_START_M, WIDEST_START_M, WIDEST_START_RAD)] = math.inf
        self._unlocated[node] = _UnlocatedNode(mean, sigma)
        if math.isfinite(sigma[0]):
            self._has_frame = True

    def advance(self, step: Advance, *, faulty: bool = False) -> None:
        """Move a sought node; of a ``faulty`` displacement only the turn is used."""
        waiting = self._unlocated.get(step.node)
        if waiting is None:
            self.search.advance(step, faulty=faulty)
        elif self._free() and math.isfinite(waiting.sigma[0]):
            # Its place is known: where it goes from there counts from now on.
            self._seek(step.node, step.time_s - step.duration_s)
            self.search.advance(step, faulty=faulty)
        else:
            waiting.move(step)

    def update(
        self,
        time_s: float,
        ranges: Sequence[Range],
        located: Mapping[int, tuple[float, float, float]],
        heights: Mapping[int, float],
    ) -> None:
        """Use the ranges of an instant, after the advances up to it."""
        self._has_frame |= bool(located)
        if not self._has_frame and ranges:
            self._choose_frame(time_s, ranges)
        while self._free():
            known = {*located} if self.large_team else {*located, *self.search.nodes}
            tied = [
                node
                for r in ranges
                for node, other in ((r.node, r.peer), (r.peer, r.node))
                if self._may_be_sought(node, other in known)
            ]
            if not tied:
                break
            self._seek(min(tied), time_s)
        self.search.log.update(time_s, ranges, located, heights)

    def _free(self) -> bool:
        """Whether the search has room for another node."""
        most = MOST_SOUGHT_LARGE_TEAM if self.large_team else MOST_SOUGHT
        return len(self.search.nodes) < most

    def _may_be_sought(self, node: int, tied: bool) -> bool:
        waiting = self._unlocated.get(node)
        if waiting is None or (self.large_team and waiting.path_m < MOVED_M):
            return False
        return tied or math.isfinite(waiting.sigma[0])

    def _seek(self, node: int, time_s: float) -> None:
        """Take a node into the search."""
        waiting = self._unlocated.pop(node)
        self.search.add(node, time_s, waiting.mean, waiting.sigmas())

    def _choose_frame(self, time_s: float, ranges: Sequence[Range]) -> None:
        there = sorted({n for r in ranges for n in (r.node, r.peer) if n in self._unlocated})
        if not there:
            return
        moved = max(there, key=lambda n: (self._unlocated[n].path_m, -n))
        node = moved if self._unlocated[moved].path_m > MOVED_M else there[0]
        self._unlocated[node].sigma[:] = 0.0
        self._seek(node, time_s)
        self.search.frame = node
        self._has_frame = True

    def find(self, time_s: float) -> PoseMixture | None:
        """Search at the end of an epoch; return the poses found, which are sought no more.

        Nodes that start together are returned together, once all of them are resolved.
        """
        search = self.search
        if not search.nodes:
            return None
        search.solve()
        agreed = search.resolved(AGREED)
        if agreed and search.may_be_mirrored():
            agreed = []
        self._agreed_epochs = Counter({n: self._agreed_epochs[n] + 1 for n in agreed})
        found = {n for n in agreed if self._agreed_epochs[n] >= AGREED_EPOCHS}
        if search.frame is not None:
            found.add(search.frame)
        if found != self.resolved or any(search.has_moved(n) for n in self._standing):
            self._quiet_since_s = time_s
        self.resolved = found
        self._standing = {n for n in found if not search.has_moved(n)}
        if search.frame is not None and (len(found) < 2 or found != search.active):
            return None
        if self.large_team:
            found = found - self._standing
        elif self._standing - {search.frame} and not self._unlocated:
            # A standing node has no heading yet. The search finds it best, with all others.
            is_quiet = time_s - self._quiet_since_s >= QUIET_S
            if len(self._standing - {search.frame}) > MOST_STANDING or not is_quiet:
                found = found - self._standing if search.frame is None else set()
        if not found:
            return None
        self.counters["starts_found"] += len(found)
        self.resolved, self._standing = self.resolved - found, self._standing - found
        order = sorted(found, key=lambda n: (n != search.frame, n))
        return search.release(order)

    def cost_s(self) -> float:
        """Return about how many seconds of a processor ``find`` takes."""
        return 3e-4 * len(self.search.nodes) ** 2

    @property
    def mixture(self) -> PoseMixture | None:
        """Hypotheses about the sought nodes that are tied to a known one; None without any."""
        return self.search.active_mixture if self.search.nodes else None
