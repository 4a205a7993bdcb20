"""Measurements without the errors that the online estimator has learned of them.

At the end of a run it knows by how much ranges are dated late, how far each clock is ahead, and
what a body adds to a range. Smoothing begins from measurements without these. Where nobody reports
a height it knows how far one is over the other, which makes their ranges slant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.clocks import Clocks
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.fusion.models.ranging import shadow_slope
from relpos.measurements import Measurement, Range

SURE = 3.0
"""What is smaller than so many of its standard deviations is left in."""

LEARNED_AFTER_S = 20.0
"""So much later it is looked up how high people were: first it has to be learned.

NEES of the smoother in ``mission-floors-no-heights``, 150 s, seeds 4050 to 4052: 2.7 of six people
without heights, 1.7, 1.3, 1.0, 0.9, 0.9 after 0, 10, 20, 30, 60 s; of eight of whom a third takes
the stairs 5.8 without, then 2.4, 1.8, 1.8, 2.2, 4.0."""


@dataclass(frozen=True, slots=True)
class Rises:
    """How far one node was over another (m), as far as that was learned from ranges alone."""

    by_pair: Mapping[tuple[int, int], tuple[Floats, Floats]]
    """Pair, the lower node first -> times (s) and differences (m)."""

    def rise_m(self, node: int, peer: int, time_s: float) -> float:
        """Return the difference of a pair; 0 where none is known."""
        known = self.by_pair.get((min(node, peer), max(node, peer)))
        return float(np.interp(time_s + LEARNED_AFTER_S, *known)) if known else 0.0


def learned_rises(estimates: Sequence[Estimate]) -> Rises:
    """Return the differences of height that estimates tell, 0 where they are not sure of any."""
    rows: dict[tuple[int, int], list[tuple[float, float]]] = {}
    for e in estimates:
        for p in e.parameters:
            if p.name == "height_difference_m" and p.peer is not None:
                value = p.value if p.value > SURE * p.sigma else 0.0
                rows.setdefault((p.node, p.peer), []).append((e.time_s, value))
    by_pair = {pair: np.array(row).T for pair, row in rows.items()}
    return Rises({pair: (row[0], row[1]) for pair, row in by_pair.items()})


def as_learned(
    measurements: Sequence[Measurement], estimates: Sequence[Estimate]
) -> list[Measurement]:
    """Return measurements at their true times, and ranges without the bodies' shadows."""
    clocks, shadow_m = Clocks(), 0.0
    for p in estimates[-1].parameters if estimates else ():
        if abs(p.value) <= SURE * p.sigma:
            continue
        if p.name == "range_lateness_s":
            clocks.lateness_s = p.value
        elif p.name == "clock_offset_s":
            clocks.offset_s[p.node] = p.value
        elif p.name == "body_shadow_m":
            shadow_m = p.value
    dated = [clocks.redate(m) for m in measurements]
    if shadow_m == 0.0:
        return dated
    tracks = _tracks(estimates)
    return [_unshadowed(m, tracks, shadow_m) if isinstance(m, Range) else m for m in dated]


def range_scale_sd(estimates: Sequence[Estimate]) -> float:
    """Return the mean deviation of the ranges' scale: what no later range makes surer."""
    every = [
        next((p.sigma for p in e.parameters if p.name == "range_scale"), 0.0) for e in estimates
    ]
    return sum(every) / max(len(every), 1)


def _tracks(estimates: Sequence[Estimate]) -> dict[int, Floats]:
    """Return each node's times (s), x, y (m) and unwrapped headings (rad): (4, T)."""
    rows: dict[int, list[tuple[float, ...]]] = {}
    for e in estimates:
        for n in e.nodes:
            if n.status is not NodeStatus.UNLOCATED:
                rows.setdefault(n.node, []).append((e.time_s, n.x_m, n.y_m, n.heading_rad))
    tracks = {node: np.array(own).T for node, own in rows.items()}
    for track in tracks.values():
        track[3] = np.unwrap(track[3])
    return tracks


def _unshadowed(measured: Range, tracks: dict[int, Floats], shadow_m: float) -> Range:
    """Return a range without what the bodies of both wearers add: as the bank models it."""
    if measured.node not in tracks or measured.peer not in tracks:
        return measured
    (x, y, heading), (peer_x, peer_y, peer_heading) = (
        [float(np.interp(measured.time_s, track[0], row)) for row in track[1:]]
        for track in (tracks[measured.node], tracks[measured.peer])
    )
    bearing = math.atan2(peer_y - y, peer_x - x)
    sight = math.cos(bearing), math.sin(bearing)
    added_m = shadow_m * shadow_slope(sight, heading, peer_heading)
    return replace(measured, range_m=max(measured.range_m - added_m, 0.0))
