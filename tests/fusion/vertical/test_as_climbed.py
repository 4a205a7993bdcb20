"""A whole run with heights decided and stairs taken for stairs, as the smoother sees it."""

from __future__ import annotations

import math

import numpy as np

from relpos.fusion.vertical.offline import as_climbed
from relpos.measurements import Height, Motion, Range
from relpos.simulation.building import simulate_building


def test_a_run_loses_the_surplus_of_stairs_and_the_bias_of_barometers() -> None:
    run = simulate_building("building", 0, {"seconds": 150, "nodes": 3})
    nodes = [p.node for p in run.priors]
    climbed = as_climbed(run.measurements, nodes)
    assert len(climbed) == len(run.measurements)
    assert [m for m in climbed if isinstance(m, Range)] == [
        m for m in run.measurements if isinstance(m, Range)
    ]
    ways = [
        sum(math.hypot(m.dx_m, m.dy_m) for m in each if isinstance(m, Motion))
        for each in (run.measurements, climbed)
    ]
    assert 0.5 * ways[0] < ways[1] < 0.98 * ways[0]
    for node in nodes:
        true = np.array([(t.time_s, t.z_m) for t in run.truth if t.node == node]).T
        heights = [m for m in climbed if isinstance(m, Height) and m.node == node]
        error = [m.height_m - float(np.interp(m.time_s - 0.4, *true)) for m in heights]
        assert math.sqrt(np.mean(np.square(error))) < 0.4


def test_a_run_without_heights_stays_as_it_is() -> None:
    run = simulate_building("building", 0, {"seconds": 30, "nodes": 2, "without": 2})
    assert as_climbed(run.measurements, [1, 2]) == list(run.measurements)
