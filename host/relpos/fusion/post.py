"""The command post's node: nobody wears it, and it lies still.

Before any estimator (:class:`Referring`) its motion becomes none, and the drift of its pressure
is taken from the heights of all (:class:`~relpos.fusion.models.pressure.Weather`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from relpos.fusion.estimator import Estimate, Estimator
from relpos.fusion.models.pressure import Weather
from relpos.fusion.models.ranging import Mounting
from relpos.fusion.timeline import refusal
from relpos.measurements import Height, Measurement, Motion, at_rest


def posts_of(nodes: Mapping[int, Mounting] | None) -> frozenset[int]:
    """Return the nodes that are the command post's."""
    return frozenset(node for node, info in (nodes or {}).items() if info.post)


@dataclass(slots=True)
class Referring:
    """An estimator that gets what a team measures referred to its nodes at the command post."""

    estimator: Estimator
    posts: frozenset[int]
    weather: Weather = field(default_factory=Weather)
    _start_m: dict[int, float] = field(default_factory=dict)
    """Node -> drift at its first height, which is over its own start."""

    def refer(self, measured: Measurement) -> Measurement:
        """Return a measurement without the weather; the posts' own show no motion."""
        if isinstance(measured, Motion) and measured.node in self.posts:
            return at_rest(measured)
        if not isinstance(measured, Height) or refusal(measured) is not None:
            return measured
        if measured.node in self.posts:
            self.weather.measure(measured)
            return replace(measured, height_m=0.0)
        drift_m = self.weather.at(measured.time_s)
        drift_m -= self._start_m.setdefault(measured.node, drift_m)
        return replace(measured, height_m=measured.height_m - drift_m)

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; return the estimates it completes."""
        return self.estimator.process(self.refer(measurement))

    def finish(self) -> list[Estimate]:
        """Process what waits for a later motion."""
        return self.estimator.finish()

    def counters(self) -> Mapping[str, int]:
        """Count what the estimator counts."""
        return self.estimator.counters()


def referring(estimator: Estimator, nodes: Mapping[int, Mounting] | None) -> Estimator:
    """Let an estimator use the command post's nodes; without any it stays as it is."""
    posts = posts_of(nodes)
    return Referring(estimator, posts) if posts else estimator
