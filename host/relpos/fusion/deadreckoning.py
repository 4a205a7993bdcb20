"""Dead reckoning alone: what everything else has to beat.

Reported displacements are composed from the initial poses; ranges are counted and not used. The
covariance is that of the reports' own standard deviations, where they bring any, propagated to
first order.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from relpos.errors import RelposError
from relpos.fusion.arrays import Floats
from relpos.fusion.estimator import (
    Estimate,
    NodeEstimate,
    NodeStatus,
    Presence,
    Vertical,
    pairs_of,
    refuse_unmoved,
)
from relpos.fusion.estimator_settings import DeadReckoningSettings
from relpos.fusion.initial_poses import by_node
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Timeline
from relpos.measurements import Height, Measurement, Prior, Range


@dataclass(slots=True)
class _Node:
    x_m: float
    y_m: float
    heading_rad: float
    covariance: Floats
    placed: bool
    presence: Presence = field(default_factory=Presence)

    def move(self, step: Advance) -> None:
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        east, north = c * step.dx_m - s * step.dy_m, s * step.dx_m + c * step.dy_m
        self.x_m += east
        self.y_m += north
        self.heading_rad += step.dtheta_rad
        by_pose = np.array([[1.0, 0.0, -north], [0.0, 1.0, east], [0.0, 0.0, 1.0]])
        by_step = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        sigmas = (step.sigma_x_m or 0.0, step.sigma_y_m or 0.0, step.sigma_theta_rad or 0.0)
        noise = by_step @ np.diag(np.square(sigmas)) @ by_step.T
        self.covariance = by_pose @ self.covariance @ by_pose.T + noise


@dataclass(slots=True)
class DeadReckoning:
    """The baseline as an :class:`~relpos.fusion.estimator.Estimator`.

    A node without a prior is reckoned from the origin and reported ``unlocated``.
    """

    priors: Sequence[Prior] = ()
    settings: DeadReckoningSettings = field(default_factory=DeadReckoningSettings)
    _timeline: Timeline = field(init=False)
    _nodes: dict[int, _Node] = field(default_factory=dict)
    _own: Counter[str] = field(default_factory=Counter)
    _moved: bool = False
    _epoch_s: float = -math.inf

    def __post_init__(self) -> None:
        self._timeline = Timeline(
            [p.node for p in self.priors],
            reorder_s=self.settings.reorder_s,
            max_lag_s=self.settings.max_lag_s,
            lazy=True,
        )
        for p in by_node(self.priors):
            sigma = (p.sigma_m, p.sigma_m, p.sigma_rad) if p.is_known else (0.0, 0.0, 0.0)
            self._nodes[p.node] = _Node(
                p.x_m, p.y_m, p.heading_rad, np.diag(np.square(sigma)), p.is_known
            )

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; return the estimates it completes."""
        steps = self._timeline.push(measurement)
        self._meet(measurement.node)
        if isinstance(measurement, Range):
            self._meet(measurement.peer)
        return self._work_off(steps)

    def finish(self) -> list[Estimate]:
        """Work off what waits; RelposError where not two nodes have a place."""
        estimates = self._work_off(self._timeline.finish())
        refuse_unmoved(self._moved)
        if len(self._nodes) > 1 and not any(node.placed for node in self._nodes.values()):
            raise RelposError(
                "dead reckoning alone cannot tell relative positions from unknown starts: "
                "give initial poses"
            )
        return estimates

    def counters(self) -> Mapping[str, int]:
        """Count everything dropped, late or not used."""
        return dict(self._timeline.counters + self._own)

    def _meet(self, node: int) -> None:
        if node not in self._nodes:
            self._nodes[node] = _Node(0.0, 0.0, 0.0, np.zeros((3, 3)), placed=False)

    def _work_off(self, steps: Sequence[object]) -> list[Estimate]:
        estimates = []
        for step in steps:
            match step:
                case Advance():
                    self._moved = True
                    node = self._nodes[step.node]
                    node.presence.received(step.time_s)
                    node.move(step)
                case Ranging():
                    self._own["ranges_unused"] += len(step.ranges)
                case Sensed(measurement=Height() as height):
                    vertical = Vertical(height.height_m, height.sigma_m or 0.0)
                    self._nodes[height.node].presence.vertical = vertical
                case Sensed():
                    self._own[step.unused] += 1
                case Epoch():
                    estimates.append(self._estimate(step.time_s))
        return estimates

    def _estimate(self, time_s: float) -> Estimate:
        nodes = []
        for name in sorted(self._nodes):
            node = self._nodes[name]
            node.presence.close_epoch(self._epoch_s)
            p = node.covariance
            nodes.append(
                NodeEstimate(
                    name, node.x_m, node.y_m, math.remainder(node.heading_rad, 2.0 * math.pi),
                    float(p[0, 0]), float(p[1, 1]), float(p[0, 1]), math.sqrt(float(p[2, 2])),
                    node.presence.status if node.placed else NodeStatus.UNLOCATED,
                    *node.presence.vertical,
                )
            )  # fmt: skip
        self._epoch_s = time_s
        return Estimate(time_s, tuple(nodes), pairs_of(nodes))
