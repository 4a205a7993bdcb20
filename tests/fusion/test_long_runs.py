"""What a run of hours or of a hundred people costs."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from relpos.evaluation.report.drawing import Picture, svg
from relpos.fusion import deadreckoning
from relpos.fusion.timeline import Advance
from relpos.measurements import Motion, Range
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
