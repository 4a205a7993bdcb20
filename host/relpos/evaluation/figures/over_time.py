"""The error at different times, in the simulation and in the laboratory (paper, figs. 6 and 9)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from relpos.evaluation import study
from relpos.evaluation.figures.sheet import (
    COLOURS,
    DASHES,
    GREY,
    IMU_SCALES,
    INK,
    Floats,
    Sheet,
    Work,
    beside,
    legend_beside,
    own_colour,
)
from relpos.evaluation.study import CONFIDENCE_95, Case, Outcome
from relpos.simulation.scenarios import LAB

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

MARK_EVERY_S = 10.0
"""The series are drawn and listed at these times: a point a second is no more to be seen."""


def bound_over_time(case: Case, seed: int) -> Floats:
    """Filtering bound of the distance over time, rows of time and metres (2, T)."""
    bound = study.bound(case, seed)
    return np.stack([bound.time_s, bound.filtering_distance_m])


def _windows(time_s: Floats, values: Floats, at_s: Floats) -> Floats:
    """Root mean square of the values since the last of the wanted times, at each of them."""
    squares = values**2
    windows = [(time_s > t - MARK_EVERY_S) & (time_s <= t) for t in at_s]
    return np.array([np.sqrt(squares[w].mean()) if w.any() else np.nan for w in windows])


def _series(outcome: Outcome, at_s: Floats) -> tuple[Floats, Floats]:
    """Mean over the seeds at the wanted times, and half of its 95 % interval."""
    values = np.array(
        [_windows(s.time_s, s.distance_over_time_m, at_s) for s in outcome.scores if s.time_s.size]
    )
    count = np.isfinite(values).sum(axis=0)
    mean = np.nanmean(values, axis=0)
    spread = np.nanstd(values, axis=0, ddof=1)
    return mean, CONFIDENCE_95 * spread / np.sqrt(count)


def _over_time(work: Work, scenario: str, seconds: float, known: Sequence[str]) -> Sheet:
    cases = [Case("0, 0 (IMU alone)", scenario, estimator="deadreckoning")]
    cases += [
        Case(f"{d:g}, {t:g}", scenario, settings={"sigma_d": d, "sigma_theta": t})
        for d, t in IMU_SCALES[1:]
    ]
    cases.append(Case("bank", scenario, estimator="bank"))
    ours = len(cases)
    cases += work.own_cases(scenario)
    outcomes = work.outcomes(cases)
    at_s = np.arange(MARK_EVERY_S, seconds + 1e-9, MARK_EVERY_S)
    series = [_series(outcome, at_s) for outcome in outcomes]
    each = work.each(bound_over_time, [(cases[0], seed) for seed in work.seeds])
    bound = np.sqrt(np.mean([_windows(one[0], one[1], at_s) ** 2 for one in each], axis=0))
    rows: list[Sequence[float | str]] = [
        (case.label, float(t), float(m), float(h))
        for case, (mean, half) in zip(cases, series, strict=True)
        for t, m, h in zip(at_s, mean, half, strict=True)
    ]
    rows += [("bound", float(t), float(b), "") for t, b in zip(at_s, bound, strict=True)]

    def draw(canvas: Canvas) -> None:
        axes = canvas.add_subplot()
        colours = [GREY, *COLOURS[:4], COLOURS[5]]
        colours += [own_colour(k) for k in range(len(cases) - ours)]
        for k, (case, (mean, half)) in enumerate(zip(cases, series, strict=True)):
            axes.plot(at_s, mean, color=colours[k], linestyle=DASHES[k % 4 if k < 5 else 0],
                      label=case.label)  # fmt: skip
            axes.fill_between(
                at_s, np.maximum(mean - half, 1e-3), mean + half, color=colours[k], alpha=0.15,
                linewidth=0,
            )  # fmt: skip
        axes.plot(at_s, bound, color=INK, linestyle=(0, (2, 2)), linewidth=1.2,
                  label="bound (filtering)")  # fmt: skip
        axes.set_yscale("log")
        ticks = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0]
        axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
        low = np.nanmin([np.nanmin(mean) for mean, _ in series] + [bound.min()])
        axes.set_ylim(max(0.8 * low, 0.05), None)
        axes.set_xlim(0.0, seconds)
        axes.set(xlabel="time (s)", ylabel="relative distance RMSE (m)")
        legend_beside(axes, r"$\sigma_d$, $\sigma_\theta$")

    where = "laboratory" if scenario == LAB else "simulation"
    return Sheet(
        f"over-time-{'lab' if scenario == LAB else 'simulation'}",
        f"Error over time in the {where}, for five scales of IMU noise",
        f"Root mean square over all pairs and {MARK_EVERY_S:g} s, mean over the seeds; "
        "sigma_r 2, M 500, alpha .01. Note the logarithmic scale.",
        ("estimator", "time_s", "distance_rmse_m", "half_width_95_m"),
        rows,
        draw,
        tuple(
            beside(what, paper, outcome.distance_m)
            for what, paper, outcome in zip(
                ("IMU alone, whole run", "particle filter, whole run"),
                known,
                (outcomes[0], outcomes[2]),
                strict=True,
            )
        ),
        (7.4, 4.2),
    )


def simulation(work: Work) -> Sheet:
    """Error over time in the simulation."""
    return _over_time(work, "paper", 600.0, ("10", "2.1"))


def laboratory(work: Work) -> Sheet:
    """Error over time in the laboratory."""
    return _over_time(work, LAB, 380.0, ("3.0", "2.2"))
