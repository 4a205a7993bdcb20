"""Time stamps are put right where measurements come in, as far as they are known to be off.

A filter learns by how much ranges are dated late, and each clock's offset, from how ranges change
while people walk. That is linear for fractions of a second alone. So what it has learned goes, bit
by bit, into the time stamps of all later measurements, and out of its state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from relpos.fusion.estimator import Estimate
from relpos.measurements import Measurement, Range
from relpos.said import Said

SLEW = 0.1
"""Seconds a second at most: consecutive reports of a node keep their order."""

LEAST_S, LEAST_SIGMAS = 0.1, 3.0
"""Smaller offsets, or less certain ones, stay in the state, and are not told: a walker makes 10 cm
in it."""


def is_known(offset_s: float, sigma_s: float) -> bool:
    """Whether an offset of time stamps is large and certain enough to be told, and put right."""
    return abs(offset_s) > max(LEAST_S, LEAST_SIGMAS * sigma_s)


@dataclass(slots=True)
class Clocks:
    """By how much time stamps are put right: seconds that are subtracted."""

    lateness_s: float = 0.0
    offset_s: dict[int, float] = field(default_factory=dict)
    """Node -> how far its clock is ahead."""
    held: bool = False
    """While measurements are repeated that have been dated already."""

    @property
    def longest_s(self) -> float:
        """The most by which a measurement is dated back."""
        return max(self.lateness_s, 0.0) + max(self.offset_s.values(), default=0.0)

    def redate(self, measurement: Measurement) -> Measurement:
        """Return a measurement at its time by the team's clock."""
        off_s = self.offset_s.get(measurement.node, 0.0)
        if isinstance(measurement, Range):
            off_s += self.lateness_s
        if off_s == 0.0:
            return measurement
        return replace(measurement, time_s=measurement.time_s - off_s)

    def slew(
        self,
        duration_s: float,
        lateness: tuple[float, float],
        offsets: Mapping[int, tuple[float, float]],
    ) -> tuple[float, dict[int, float]]:
        """Take over a part of what has been learned beside it: values and deviations (s).

        Returns these parts (s): of the lateness, and node -> of its clock's offset.
        """
        if self.held:
            return 0.0, {}
        late_s = _step(duration_s, *lateness)
        steps = {node: _step(duration_s, *learned) for node, learned in offsets.items()}
        self.lateness_s += late_s
        for node, step_s in steps.items():
            if step_s != 0.0:
                self.offset_s[node] = self.offset_s.get(node, 0.0) + step_s
        return late_s, steps


def _step(duration_s: float, value_s: float, sigma_s: float) -> float:
    if not is_known(value_s, sigma_s):
        return 0.0
    most_s = SLEW * duration_s
    return min(max(value_s, -most_s), most_s)


_SOME: Mapping[str, Any] = {"seconds": 0.0, "node": ""}
_OFFSETS = {
    ("range_lateness_s", True): Said(
        "ranges-late", "ranges are dated {seconds:.1f} s late", **_SOME
    ),
    ("range_lateness_s", False): Said(
        "ranges-early", "ranges are dated {seconds:.1f} s early", **_SOME
    ),
    ("clock_offset_s", True): Said(
        "clock-ahead", "the clock of node {node} is {seconds:.1f} s ahead", **_SOME
    ),
    ("clock_offset_s", False): Said(
        "clock-behind", "the clock of node {node} is {seconds:.1f} s behind", **_SOME
    ),
}


def time_offsets(estimate: Estimate) -> list[Said]:
    """Return what the user should know of time stamps that are off, a sentence each."""
    told = []
    for p in estimate.parameters:
        words = _OFFSETS.get((p.name, p.value > 0.0))
        if words is not None and is_known(p.value, p.sigma):
            told.append(words.filled(seconds=abs(p.value), node=str(p.node)))
    return list(dict.fromkeys(told))
