"""Estimators as somebody else writes them: one that works, and ones that do wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from relpos import Estimate, Measurement, Motion, NodeEstimate, NodeStatus, Prior, pairs_of


class Adder:
    """Adds motions up; ``stretch`` is what every length is multiplied by."""

    def __init__(self, priors: Sequence[Prior] = (), *, stretch: float = 1.0) -> None:
        self.poses = {p.node: [p.x_m, p.y_m, p.heading_rad] for p in priors}
        self.stretch = stretch
        self.motions = 0

    def process(self, measurement: Measurement) -> list[Estimate]:
        if not isinstance(measurement, Motion):
            return []
        self.motions += 1
        pose = self.poses.setdefault(measurement.node, [0.0, 0.0, 0.0])
        pose[2] += measurement.dtheta_rad
        c, s = self.stretch * math.cos(pose[2]), self.stretch * math.sin(pose[2])
        pose[0] += c * measurement.dx_m - s * measurement.dy_m
        pose[1] += s * measurement.dx_m + c * measurement.dy_m
        nodes = tuple(
            NodeEstimate(node, x, y, heading, 1.0, 1.0, 0.0, 0.1, NodeStatus.OK)
            for node, (x, y, heading) in sorted(self.poses.items())
        )
        return [Estimate(measurement.time_s, nodes, pairs_of(nodes))]

    def finish(self) -> list[Estimate]:
        return []

    def counters(self) -> Mapping[str, int]:
        return {"motions": self.motions}


class Crashing(Adder):
    def process(self, measurement: Measurement) -> list[Estimate]:
        if measurement.time_s > 5.0:
            raise KeyError("no such node")
        return super().process(measurement)


class Talkative(Adder):
    def process(self, measurement: Measurement) -> Any:
        return "here I am"


class Nowhere(Adder):
    def process(self, measurement: Measurement) -> list[Estimate]:
        self.stretch = math.nan
        return super().process(measurement)


class Leaving(Adder):
    def process(self, measurement: Measurement) -> Any:
        raise SystemExit(3)


class Unfinished:
    def process(self, measurement: Measurement) -> list[Estimate]:
        return []


class Stillborn:
    def __init__(self) -> None:
        raise ValueError("two\nlines")
