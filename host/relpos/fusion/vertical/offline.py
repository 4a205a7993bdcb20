"""A whole run as measured, with heights decided and without what dead reckoning adds on stairs."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Timeline
from relpos.fusion.vertical.filter import Decided, VerticalFilter
from relpos.measurements import Height, Measurement, Motion


def as_climbed(
    measurements: Sequence[Measurement], nodes: Iterable[int], posts: frozenset[int] = frozenset()
) -> list[Measurement]:
    """Return measurements with heights and ways on stairs as the vertical filter decides them.

    ``nodes`` are known from the start, ``posts`` lie at the command post. Without reported heights
    nothing changes.
    """
    if not any(isinstance(m, Height) for m in measurements):
        return list(measurements)
    timeline, vertical = Timeline(nodes), VerticalFilter(posts=posts, decided=[])
    for step in timeline.push_all(measurements, final=True):
        if isinstance(step, Advance):
            vertical.move(step)
        elif isinstance(step, Sensed) and isinstance(step.measurement, Height):
            vertical.measure(step.measurement, step.time_s)
        elif isinstance(step, Ranging):
            for measured in step.ranges:
                vertical.ranged(measured)
        elif isinstance(step, Epoch):
            vertical.close(step.time_s)
    vertical.finish()
    of: dict[int, list[Decided]] = {}
    for one in vertical.decided or ():
        of.setdefault(one.node, []).append(one)
    heights = {
        node: (np.array([d.end_s for d in own]), np.array([d.z_m for d in own]))
        for node, own in of.items()
    }
    before: dict[int, float] = {}
    changed: list[Measurement] = []
    for m in sorted(measurements, key=lambda m: m.time_s):
        own = of.get(m.node, ())
        if isinstance(m, Motion) and own:
            share = _share(own, before.get(m.node, -math.inf), m.time_s)
            changed.append(replace(m, dx_m=share * m.dx_m, dy_m=share * m.dy_m))
            before[m.node] = m.time_s
        elif isinstance(m, Height) and own:
            changed.append(replace(m, height_m=float(np.interp(m.time_s, *heights[m.node]))))
        else:
            changed.append(m)
    return changed


def _share(own: Sequence[Decided], begin_s: float, end_s: float) -> float:
    """Return the true share of a displacement between two times."""
    begin_s = max(begin_s, end_s - 10.0)
    less = 0.0
    # They follow each other in time.
    for one in own[bisect_right(own, begin_s, key=attrgetter("end_s")) :]:
        overlap_s = min(end_s, one.end_s) - max(begin_s, one.begin_s)
        if overlap_s <= 0.0:
            break
        less += overlap_s * (1.0 - one.share)
    return 1.0 - less / max(end_s - begin_s, 1e-9)
