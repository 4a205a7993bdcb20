"""The default estimator whatever the team's size: a bank for a few, one joint filter for many.

A bank's work grows with the square of the team for every hypothesis, and with many users about
the picture is hardly ever ambiguous. So a team of more than ``LARGE_TEAM`` is handed from
:class:`~relpos.fusion.bank.Bank` to :class:`~relpos.fusion.large_team.LargeTeam`, at once where
the priors already name so many, else when so many have been met: everybody's last estimate is
then the prior, and who was not located yet joins later.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace

from relpos.fusion.bank import Bank
from relpos.fusion.bank_settings import BankSettings
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.fusion.large_team import LargeTeam
from relpos.fusion.ranging_model import Mounting
from relpos.fusion.timeline import Displacement
from relpos.measurements import Measurement, Motion, Prior, Range

LARGE_TEAM = 30
"""From more users on one joint filter, strip by strip (crossover: ``docs/fusion.md``)."""

KEPT_S = 20.0
"""What is younger is kept: a bank's newest estimate is never older."""


class GrowingTeam:
    """An :class:`~relpos.fusion.estimator.Estimator` for any number of users."""

    def __init__(
        self,
        priors: Sequence[Prior] = (),
        settings: BankSettings | None = None,
        seed: int = 0,
        mountings: Mapping[int, Mounting] | None = None,
    ) -> None:
        """Start with whoever has a prior; ``mountings`` tell how nodes are worn."""
        self._mountings = mountings or {}
        self._settings = settings or BankSettings()
        self._seed = seed
        self._priors = tuple(priors)
        self._met = {p.node for p in priors}
        self._recent: deque[Measurement] = deque()
        self._newest_s = -math.inf
        self._last: Estimate | None = None
        self._before: Counter[str] = Counter()
        self.estimator: Bank | LargeTeam = (
            LargeTeam(priors, self._settings, seed, self._mountings)
            if len(self._met) > LARGE_TEAM
            else Bank(priors, self._settings, seed, self._mountings)
        )

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; return the estimates it completes."""
        if isinstance(self.estimator, LargeTeam):
            return self.estimator.process(measurement)
        estimates = self.estimator.process(measurement)
        self._recent.append(measurement)
        self._newest_s = max(self._newest_s, measurement.time_s)
        while self._recent[0].time_s < self._newest_s - KEPT_S:
            self._recent.popleft()
        if estimates:
            self._last = estimates[-1]
        self._met.add(measurement.node)
        if isinstance(measurement, Range):
            self._met.add(measurement.peer)
        if len(self._met) > LARGE_TEAM:
            estimates += self._hand_over()
        return estimates

    def finish(self) -> list[Estimate]:
        """Work off what waits; RelposError where the run cannot give relative positions."""
        return self.estimator.finish()

    def counters(self) -> Mapping[str, int]:
        """Count everything dropped, late, reset or resampled."""
        return dict(self._before + Counter(self.estimator.counters()))

    def _hand_over(self) -> list[Estimate]:
        """Go on as a large team from the last estimate; what came since is taken again."""
        last = self._last
        since_s = -math.inf if last is None else last.time_s
        priors = list(self._priors)
        if last is not None:
            self._before = Counter(self.estimator.counters())
            self._before["teams_handed_over"] += 1
            priors = [
                Prior(
                    n.node, n.x_m, n.y_m, n.heading_rad,
                    math.sqrt(0.5 * (n.variance_x_m2 + n.variance_y_m2)), n.sigma_heading_rad,
                )
                for n in last.nodes
                if n.status not in (NodeStatus.UNLOCATED, NodeStatus.AMBIGUOUS)
            ]  # fmt: skip
        self.estimator = LargeTeam(
            priors,
            self._settings,
            self._seed,
            self._mountings,
            0.0 if last is None else since_s,
        )
        estimates: list[Estimate] = []
        begun: dict[int, float] = {}
        for measurement in sorted(self._recent, key=lambda m: m.time_s):
            again = measurement
            if isinstance(measurement, Motion):
                begin_s = begun.get(measurement.node, -math.inf)
                begun[measurement.node] = measurement.time_s
                if begin_s < since_s < measurement.time_s and math.isfinite(begin_s):
                    again = _rest(measurement, begin_s, since_s)
            if again.time_s > since_s:
                estimates += self.estimator.process(again)
        self._recent.clear()
        return [e for e in estimates if e.time_s > since_s]


def _rest(motion: Motion, begin_s: float, since_s: float) -> Motion:
    """Give the part of a motion after a time within it."""
    share = (since_s - begin_s) / (motion.time_s - begin_s)
    _, rest = Displacement(motion.dx_m, motion.dy_m, motion.dtheta_rad).split(share)
    return replace(motion, dx_m=rest.dx_m, dy_m=rest.dy_m, dtheta_rad=rest.dtheta_rad)
