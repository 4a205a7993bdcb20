"""Tracks without and with UWB, in the simulation and the laboratory (paper, figs. 4 and 8)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from relpos import fusion, tracks
from relpos.evaluation import metrics
from relpos.evaluation.figures.sheet import (
    COLOURS,
    DASHES,
    Beside,
    Floats,
    Sheet,
    Work,
    short,
)
from relpos.evaluation.study import ESTIMATOR_SEED
from relpos.simulation.lab import MARGIN_M, WALLS
from relpos.simulation.scenarios import LAB, simulate
from relpos.simulation.team import SCENARIOS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

PANELS = (("deadreckoning", "IMU alone"), ("particle", "IMU and UWB, particle filter"),
          ("bank", "IMU and UWB, bank"))  # fmt: skip


def one_run(scenario: str, estimator: str, seed: int) -> tuple[float, dict[int, Floats]]:
    """Distance RMSE (m) and every node's track as rows of time, x, y (3, T)."""
    run = simulate(scenario, seed)
    made = fusion.make(estimator, run.priors, {}, seed + ESTIMATOR_SEED)
    estimates = [e for m in run.measurements for e in made.process(m)] + made.finish()
    found = tracks.estimated_tracks(estimates)
    score = metrics.evaluate(found, tracks.true_tracks(run.truth))
    return (
        score.relative_distance_rmse_m,
        {node: np.stack([t.time_s, t.x_m, t.y_m]) for node, t in found.items()},
    )


def _tracks(work: Work, scenario: str, seed: int) -> Sheet:
    panels = (*PANELS, *((name, f"IMU and UWB, {short(name)}") for name in work.own))
    made = work.each(one_run, [(scenario, estimator, seed) for estimator, _ in panels])
    run = simulate(scenario, seed)
    way = np.array([(t.x_m, t.y_m) for t in run.truth if t.node == 1])
    rows: list[Sequence[float | int | str]] = [
        (estimator, node, *(float(v) for v in row))
        for (estimator, _), (_, found) in zip(panels, made, strict=True)
        for node, track in found.items()
        for row in track.T
    ]
    lab = scenario == LAB

    def draw(canvas: Canvas) -> None:
        grid = canvas.subplots(1, len(panels), sharex=True, sharey=True)
        for axes, (_, title), (error_m, found) in zip(grid, panels, made, strict=True):
            if lab:
                _room(axes)
            for k, (node, (_, x, y)) in enumerate(found.items()):
                axes.plot(x, y, color=COLOURS[k], linestyle=DASHES[k], linewidth=1.0,
                          label=f"user {node}")  # fmt: skip
            axes.plot(*way.T, color="black", linewidth=2.2, alpha=0.85, label="true way", zorder=1)
            axes.set_aspect("equal")
            axes.set_title(f"{title}\ndistance RMSE {error_m:.2f} m")
            axes.set_xlabel("x (m)")
        grid[0].set_ylabel("y (m)")
        handles, labels = grid[0].get_legend_handles_labels()
        canvas.legend(handles, labels, loc="outside lower center", ncols=len(labels))

    where = "laboratory" if lab else "simulation"
    return Sheet(
        f"tracks-{'lab' if lab else 'simulation'}",
        f"Tracks in the {where} without and with UWB",
        f"Seed {seed}, one run as it came. Only the picture's shape is observable: it may turn and "
        "shift as a whole" + ("; grey: the walls." if lab else "."),
        ("estimator", "user", "time_s", "x_m", "y_m"),
        rows,
        draw,
        tuple(
            Beside(f"this run, {title}", "-", error)
            for (_, title), (error, _) in zip(panels, made, strict=True)
        ),
        (3.7 * len(panels), 4.1),
    )


def _room(axes: Axes) -> None:
    width, depth = SCENARIOS["lab"].path_m
    low, x, y = -MARGIN_M, width + MARGIN_M, depth + MARGIN_M
    axes.plot([low, x, x, low, low], [low, low, y, y, low], color="#999999", linewidth=1.5)
    for x0, y0, x1, y1 in WALLS:
        axes.plot([x0, x1], [y0, y1], color="#999999", linewidth=1.5)


def simulation(work: Work) -> Sheet:
    """Tracks of the simulation, first seed."""
    return _tracks(work, "paper", work.seeds[0])


def laboratory(work: Work) -> Sheet:
    """Tracks of the laboratory, first seed."""
    return _tracks(work, LAB, work.seeds[0])
