"""Detection probability over distance in the laboratory (paper, fig. 10)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from relpos.evaluation.figures.sheet import COLOURS, MARKERS, Floats, Sheet, Work, legend_beside
from relpos.evaluation.study import CONFIDENCE_95
from relpos.simulation.lab import LabSettings, attempts_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

STEP_M = 2.0
KINDS = ("all", "nothing in the way", "a body", "walls")
LEAST = 30
"""A fraction of fewer attempts than this is not shown."""


def count_attempts(seed: int) -> Floats:
    """Attempts and successes by kind and distance of one run, (2, kinds, bins)."""
    made = attempts_of(LabSettings(), seed)
    places = (made.distance_m // STEP_M).astype(np.int64)
    bins = 14
    of_kind = (
        np.ones(places.size, dtype=bool),
        (made.walls == 0) & (made.bodies == 0),
        (made.walls == 0) & (made.bodies > 0),
        made.walls > 0,
    )
    return np.array(
        [
            [np.bincount(places[k & which], minlength=bins)[:bins] for k in of_kind]
            for which in (np.ones(places.size, dtype=bool), made.heard)
        ],
        dtype=np.float64,
    )


def laboratory(work: Work) -> Sheet:
    """Detection probability over distance."""
    tried, found = np.sum(work.each(count_attempts, [(seed,) for seed in work.seeds]), axis=0)
    middle = (np.arange(tried.shape[1]) + 0.5) * STEP_M
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(tried >= LEAST, found / tried, np.nan)
        half = CONFIDENCE_95 * np.sqrt(share * (1.0 - share) / tried)
    rows: list[Sequence[float | int | str]] = [
        (kind, float(m - STEP_M / 2), float(m + STEP_M / 2), int(tried[k, b]), int(found[k, b]),
         float(share[k, b]), float(half[k, b]))
        for k, kind in enumerate(KINDS)
        for b, m in enumerate(middle)
    ]  # fmt: skip

    def draw(canvas: Canvas) -> None:
        axes = canvas.add_subplot()
        axes.bar(middle, np.nan_to_num(share[0]), 0.9 * STEP_M, yerr=np.nan_to_num(half[0]),
                 color="#BBD7EA", edgecolor=COLOURS[0], capsize=2.5, label="all")  # fmt: skip
        for k in (1, 2, 3):
            axes.errorbar(middle, share[k], half[k], color=COLOURS[k], marker=MARKERS[k],
                          linestyle="none", capsize=2.5, label=KINDS[k])  # fmt: skip
        axes.set(xlabel="distance (m)", ylabel="detection probability", ylim=(0.0, 1.0))
        axes.set_xlim(0.0, 24.0)
        legend_beside(axes, "between the two")

    total = found[0].sum() / max(tried[0].sum(), 1.0)
    return Sheet(
        "detection",
        "Detection probability over distance in the laboratory",
        f"Fraction of attempts received, 95 % intervals; {100 * total:.0f} % of all. The paper's "
        "figure is not printed as numbers; its text says that even close users may not receive "
        "each other. Here the reason is that the person ahead obstructs the link to their own tag.",
        ("between", "from_m", "to_m", "attempts", "heard", "share", "half_width_95"),
        rows,
        draw,
        (),
        (7.4, 4.2),
    )
