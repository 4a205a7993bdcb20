"""What a run of hours or of a hundred people costs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from matplotlib.figure import Figure

import relpos
from relpos import fusion
from relpos.evaluation.report.drawing import Picture, svg
from relpos.fusion import deadreckoning
from relpos.fusion.timeline import Advance
from relpos.measurements import Measurement, Motion, Range
from relpos.runs import Description
from relpos.runs.run import assemble


def test_dead_reckoning_moves_nobody_for_ranges_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    moved: list[int] = []
    move = deadreckoning._Node.move

    def counted(node: deadreckoning._Node, step: Advance) -> None:
        moved.append(step.node)
        move(node, step)

    monkeypatch.setattr(deadreckoning._Node, "move", counted)
    people, estimator = 40, deadreckoning.DeadReckoning()
    for second in range(1, 11):
        for k in range(people):
            peer = (k + 1) % people
            estimator.process(Range(second - 1.0 + (k + 0.5) / people, k, peer, 4.0))
        for k in range(people):
            estimator.process(Motion(float(second), k, 1.0, 0.0, 0.0))
    # Its own motion, and the cuts of the two ranges that are with it.
    assert len(moved) < 10 * people * 4


def test_the_nodes_of_a_run_are_looked_for_once() -> None:
    run = assemble("run", Description(), [Motion(1.0, 3, 1.0, 0.0, 0.0)])
    assert run.node_ids is run.node_ids


def test_a_figure_of_very_long_lines_stays_small() -> None:
    time_s = np.arange(60_000.0)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k in range(5):
            axes.plot(time_s, np.sin(time_s * (1.3 + k)))
        axes.fill_between(time_s, -np.cos(time_s), np.cos(time_s))
        axes.plot([0.0, 60_000.0], [0.0, 0.0], label="drawn as a line")

    document = svg(Picture("long", "Long", "", "", draw, (6.0, 4.0)).figure())
    assert len(document) < 1_000_000
    assert document.count("<image") >= 1


@pytest.mark.parametrize("seed", [14, 16])
def test_two_who_rest_for_long_stay_as_far_apart_as_they_are(seed: int) -> None:
    walk_s, rest_s = 300.0, 1500.0
    run = relpos.simulate("mission-base", seed, nodes=2, seconds=walk_s, range_rate_hz=0.5)
    (x, y), (u, v) = ([(t.x_m, t.y_m) for t in run.truth if t.node == node][-1] for node in (1, 2))
    apart_m, rng = math.hypot(x - u, y - v), np.random.default_rng(seed)
    rest: list[Measurement] = []
    for time_s in np.arange(walk_s + 1.0, walk_s + rest_s):
        rest += [Motion(time_s, node, 0.0, 0.0, 0.0, moving=False) for node in (1, 2)]
        if time_s % 2.0 == 0.0:
            rest.append(Range(time_s, 1, 2, apart_m + 0.1 * rng.standard_normal()))
    estimator = fusion.make("bank", run.priors, seed=seed)
    for measurement in [*run.measurements, *rest]:
        estimator.process(measurement)
    (pair,) = estimator.finish()[-1].pairs
    assert abs(pair.distance_m - apart_m) < 0.15
