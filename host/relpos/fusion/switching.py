"""The default estimator whatever the team's size: a bank for few nodes, one sparse filter for many.

A bank's work grows with the square of the team for every hypothesis, and a large team is hardly
ever ambiguous. So :class:`SwitchingEstimator` replaces the
:class:`~relpos.fusion.bank.estimator.Bank` of a team of more than ``LARGE_TEAM`` by a
:class:`~relpos.fusion.large_teams.estimator.LargeTeam`: at once if the priors name so many nodes,
else when so many have been received. The last estimates are then the priors; nodes that are not
located yet join later.

If too few of a large team are located, a *nucleus* comes first: the known nodes, else the best
connected one, and some of their neighbours, whose initial poses a bank finds. Once most of them are
found, all others join them.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.bank.estimator import Bank
from relpos.fusion.estimator import Estimate, NodeStatus, unlocated
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.initialisation.initialiser import HypothesisInitialiser
from relpos.fusion.large_teams.estimator import LargeTeam
from relpos.fusion.models.ranging import Mounting
from relpos.fusion.rewind import Core, Rewinder
from relpos.fusion.rigid_motion import rigid_motion
from relpos.fusion.timeline import Displacement, Timeline, refusal
from relpos.measurements import Measurement, Motion, Prior, Range

LARGE_TEAM = 20
"""From more nodes on one sparse filter, strip by strip: with 20 it has the bank's error at a fifth
of the time (``docs/notebook/large-teams.md``)."""

KEPT_S = 20.0
"""What is younger is kept: a bank's newest estimate is never older."""

NUCLEUS = 6
"""Nodes of the nucleus: a bank finds six within a minute or two."""

NUCLEUS_FOUND, NUCLEUS_EPOCHS = 4, 3
"""So many of them have to be located for so many epochs."""

LISTEN_S = 4.0
"""So long ranges, of a known node if there is one, are listened to before the nucleus is chosen."""


class SwitchingEstimator:
    """An :class:`~relpos.fusion.estimator.Estimator` for any number of nodes."""

    def __init__(
        self,
        priors: Sequence[Prior] = (),
        settings: BankSettings | None = None,
        seed: int = 0,
        mountings: Mapping[int, Mounting] | None = None,
    ) -> None:
        """Begin with the nodes that have a prior; ``mountings`` describe how nodes are worn."""
        self._mountings = mountings or {}
        self._settings = settings or BankSettings()
        self._seed = seed
        self._priors = tuple(priors)
        self._met = {p.node for p in priors}
        self._recent: deque[Measurement] = deque()
        self._newest_s = -math.inf
        self._last: Estimate | None = None
        self._told_s = -math.inf
        self._before: Counter[str] = Counter()
        self._nucleus: frozenset[int] = frozenset()
        self._first_range_s = math.inf
        self._found_epochs = 0
        self.estimator = self._large_team(priors) if self._is_large() else self._bank(priors)

    def _bank(self, priors: Sequence[Prior], start_s: float = 0.0) -> Rewinder:
        initialiser = HypothesisInitialiser(seed=self._seed)
        core = Bank(priors, initialiser, self._settings, self._seed, self._mountings)
        return self._around(core, priors, start_s)

    def _large_team(
        self, priors: Sequence[Prior], start_s: float = 0.0, common: Floats | None = None
    ) -> Rewinder:
        initialiser = HypothesisInitialiser(seed=self._seed, large_team=True)
        core = LargeTeam(priors, initialiser, self._settings, self._mountings)
        if common is not None:
            core.filter.common += common
        return self._around(core, priors, start_s)

    def _around(self, core: Core, priors: Sequence[Prior], start_s: float = 0.0) -> Rewinder:
        """Return the estimator around a core; motion counts from ``start_s``."""
        s = self._settings
        timeline = Timeline(
            [p.node for p in priors],
            start_s=start_s,
            reorder_s=s.reorder_s,
            max_lag_s=s.max_lag_s,
            lazy=True,
        )
        return Rewinder(core, timeline, s.late_s)

    def _is_large(self) -> bool:
        """Whether the team is a large one of which enough is located to continue from."""
        enough = min(NUCLEUS_FOUND, len(self._priors) or NUCLEUS_FOUND)
        return len(self._met) > LARGE_TEAM and self._located() >= enough

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; return the estimates it completes."""
        if isinstance(self.estimator.core, LargeTeam) or refusal(measurement) is not None:
            return self.estimator.process(measurement)
        recent, time_s = self._recent, measurement.time_s
        recent.append(measurement)
        if time_s > self._newest_s:
            self._newest_s = time_s
            # Until a large team begins, how its known nodes have moved since the start is needed.
            begun = self._last is not None or self._nucleus or len(self._met) <= LARGE_TEAM
            while begun and recent[0].time_s < time_s - KEPT_S:
                recent.popleft()
        self._met.add(measurement.node)
        if isinstance(measurement, Range):
            self._met.add(measurement.peer)
            if time_s < self._first_range_s and self._is_of_known(measurement):
                self._first_range_s = time_s
        if len(self._met) <= LARGE_TEAM:
            return self._feed(measurement)
        if self._is_large():
            return self._feed(measurement) + self._hand_over()
        return self._begin(measurement)

    def _feed(self, measurement: Measurement) -> list[Estimate]:
        estimates = self.estimator.process(measurement)
        if estimates:
            self._last = estimates[-1]
            self._told_s = self._last.time_s
        return estimates

    def _is_of_known(self, measured: Range) -> bool:
        """Whether one of the two has a known start, or nobody has."""
        known = {p.node for p in self._priors if p.is_known}
        return not known or measured.node in known or measured.peer in known

    def _located(self) -> int:
        """Return how many nodes a large team could begin from."""
        if self._last is None:
            return sum(p.is_known for p in self._priors)
        return sum(n.status in (NodeStatus.OK, NodeStatus.STALE) for n in self._last.nodes)

    def _begin(self, measurement: Measurement) -> list[Estimate]:
        """Let a bank find a nucleus of a large team; all other nodes are unlocated until then."""
        if not self._nucleus:
            if self._newest_s < self._first_range_s + LISTEN_S:
                return []
            if not any(p.is_known for p in self._priors):
                self._last = None
            priors, since_s = self._starts()
            known = {p.node for p in priors if p.is_known}
            self._nucleus = _best_connected(self._recent, known)
            self._last = None
            self.estimator = self._bank(
                [p for p in priors if p.node in self._nucleus], max(since_s, 0.0)
            )
            some = [m for m in self._since(since_s) if self._concerns(m)]
        else:
            some = [measurement] if self._concerns(measurement) else []
        estimates = []
        for one in some:
            for estimate in self.estimator.process(one):
                found = sum(n.status is NodeStatus.OK for n in estimate.nodes)
                self._found_epochs = self._found_epochs + 1 if found >= NUCLEUS_FOUND else 0
                if estimate.time_s > self._told_s:
                    self._told_s = estimate.time_s
                    estimates.append(self._with_others(estimate))
                if self._found_epochs >= NUCLEUS_EPOCHS:
                    self._last = estimate
                    return estimates + self._hand_over()
        return estimates

    def _concerns(self, measurement: Measurement) -> bool:
        inside = measurement.node in self._nucleus
        return inside and (not isinstance(measurement, Range) or measurement.peer in self._nucleus)

    def _with_others(self, estimate: Estimate) -> Estimate:
        others = [unlocated(node) for node in sorted(self._met - self._nucleus)]
        nodes = sorted([*estimate.nodes, *others], key=lambda n: n.node)
        return replace(estimate, nodes=tuple(nodes))

    def finish(self) -> list[Estimate]:
        """Work off what waits; RelposError where the run cannot give relative positions."""
        return self.estimator.finish()

    def counters(self) -> Mapping[str, int]:
        """Count everything dropped, late, reset or resampled."""
        return dict(self._before + Counter(self.estimator.counters()))

    def _hand_over(self) -> list[Estimate]:
        """Go on as a large team from the last estimate; what came since is taken again."""
        priors, since_s = self._starts()
        common = None
        if self._last is not None:
            self._before = Counter(self.estimator.counters())
            self._before["teams_handed_over"] += 1
            if isinstance(self.estimator.core, Bank):
                common = self.estimator.core.core.hypotheses.common_motion()
                priors = [_alone(p, common) for p in priors]
        again = self._since(since_s)
        start_s = 0.0 if since_s == -math.inf else since_s
        self.estimator = self._large_team(priors, start_s, common)
        estimates = [e for measurement in again for e in self.estimator.process(measurement)]
        self._recent.clear()
        return [e for e in estimates if e.time_s > max(since_s, self._told_s)]

    def _starts(self) -> tuple[list[Prior], float]:
        """Return what is known of poses, and when: by the last estimate, else at the start."""
        if self._last is None:
            return list(self._priors), -math.inf
        priors = [
            Prior(
                n.node, n.x_m, n.y_m, n.heading_rad,
                math.sqrt(0.5 * (n.variance_x_m2 + n.variance_y_m2)), n.sigma_heading_rad,
            )
            for n in self._last.nodes
            if n.status not in (NodeStatus.UNLOCATED, NodeStatus.AMBIGUOUS)
        ]  # fmt: skip
        return priors, self._last.time_s

    def _since(self, since_s: float) -> list[Measurement]:
        """Return what was measured since then, of motions the rest."""
        later: list[Measurement] = []
        begun: dict[int, float] = {}
        for measurement in sorted(self._recent, key=lambda m: m.time_s):
            again = measurement
            if isinstance(measurement, Motion):
                begin_s = begun.get(measurement.node, -math.inf)
                begun[measurement.node] = measurement.time_s
                if begin_s < since_s < measurement.time_s and math.isfinite(begin_s):
                    again = _rest(measurement, begin_s, since_s)
            if again.time_s > since_s:
                later.append(again)
        return later


def _best_connected(measurements: Iterable[Measurement], known: set[int]) -> frozenset[int]:
    """Return the known nodes that range, then one by one that with most ranges to those chosen.

    Where none has any, that with most ranges of all.
    """
    count: Counter[tuple[int, int]] = Counter()
    degree: Counter[int] = Counter()
    for m in measurements:
        if isinstance(m, Range) and m.range_m > 0.0:
            count[min(m.node, m.peer), max(m.node, m.peer)] += 1
            degree.update((m.node, m.peer))
    chosen = known & degree.keys()
    while len(chosen) < NUCLEUS:
        near: Counter[int] = Counter()
        for (a, b), times in count.items():
            if (a in chosen) != (b in chosen):
                near[b if a in chosen else a] += 10 + times
        near = near or Counter({node: degree[node] for node in degree.keys() - chosen})
        if not near:
            break
        chosen.add(min(near, key=lambda node: (-near[node], node)))
    return frozenset(chosen)


def _alone(prior: Prior, common: Floats) -> Prior:
    """Return a start without the uncertainty of the team's rigid motion (3, 3).

    As a part of each start it would be taken for independent errors, whose mean is far surer.
    """
    g = rigid_motion(np.array([prior.x_m]), np.array([prior.y_m]))
    shared = (g @ common @ g.T).diagonal()
    place_m2 = prior.sigma_m**2 - 0.5 * (shared[0] + shared[1])
    heading_rad2 = prior.sigma_rad**2 - shared[2]
    return replace(
        prior,
        sigma_m=math.sqrt(max(place_m2, 0.0)),
        sigma_rad=math.sqrt(max(heading_rad2, 0.0)),
    )


def _rest(motion: Motion, begin_s: float, since_s: float) -> Motion:
    """Give the part of a motion after a time within it."""
    fraction = (since_s - begin_s) / (motion.time_s - begin_s)
    _, rest = Displacement(motion.dx_m, motion.dy_m, motion.dtheta_rad).split(fraction)
    return replace(motion, dx_m=rest.dx_m, dy_m=rest.dy_m, dtheta_rad=rest.dtheta_rad)
