"""A sheet: the numbers of a figure, its drawing, and the paper's values beside ours."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.evaluation import bounds, study
from relpos.evaluation.executors import run_all
from relpos.evaluation.style import COLOURS as COLOURS
from relpos.evaluation.style import DASHES as DASHES
from relpos.evaluation.style import GREY as GREY
from relpos.evaluation.style import INK as INK
from relpos.evaluation.style import MARKERS as MARKERS
from relpos.evaluation.style import STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = npt.NDArray[np.float64]
T = TypeVar("T")
Cell = str | float | int

OWN_COLOURS = ("#6A3D9A", "#8C510A", "#01665E")
"""Colours of the estimators that a user adds."""

IMU_SCALES = ((0.0, 0.0), (0.1, 0.05), (0.2, 0.1), (0.4, 0.2), (0.8, 0.4))
"""The paper's five scales of IMU noise, (sigma_d, sigma_theta) (sect. V-B)."""


@dataclass(frozen=True, slots=True)
class Beside:
    """A value that the paper prints, and ours: mean and half of its 95 % interval."""

    what: str
    paper: str
    ours: float
    half_width: float = math.nan
    unit: str = "m"


@dataclass(frozen=True)
class Sheet:
    """One figure: its numbers as rows under ``columns``, how to draw them, and what they say."""

    name: str
    title: str
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    draw: Callable[[Figure], None]
    beside: Sequence[Beside] = ()
    size_in: tuple[float, float] = (6.4, 4.2)


@dataclass
class Work:
    """Where and on how many seeds figures are computed; ``on_done`` is called after every job.

    ``own`` are estimators of the user, drawn wherever estimators are compared.
    """

    seeds: Sequence[int]
    pool: Executor
    on_done: Callable[[int, int], None] | None = None
    own: Sequence[str] = ()
    _bounds: dict[tuple[Any, ...], bounds.Totals] = field(default_factory=dict)
    _outcomes: dict[tuple[Any, ...], study.Outcome] = field(default_factory=dict)

    def outcomes(self, cases: Sequence[study.Case]) -> list[study.Outcome]:
        """Score cases on all seeds; what two figures share is computed once."""
        fresh = {key(case): case for case in cases if key(case) not in self._outcomes}
        made = study.run(list(fresh.values()), self.seeds, self.pool, self.on_done)
        for outcome in made:
            # An estimator of relpos may give up on a run; one of the user must not.
            if outcome.case.estimator in self.own and outcome.failures:
                raise RelposError(outcome.failures[0])
        self._outcomes.update(zip(fresh, made, strict=True))
        return [self._outcomes[key(case)] for case in cases]

    def bounds(self, cases: Sequence[study.Case]) -> list[bounds.Totals]:
        """Return the bound of each case's scenario over all seeds."""
        fresh = {key(case)[:2]: case for case in cases if key(case)[:2] not in self._bounds}
        made = study.bounds_of(list(fresh.values()), self.seeds, self.pool, self.on_done)
        self._bounds.update(zip(fresh, made, strict=True))
        return [self._bounds[key(case)[:2]] for case in cases]

    def own_cases(self, scenario: str = "paper") -> list[study.Case]:
        """Return a case for each estimator of the user."""
        return [study.Case(short(name), scenario, estimator=name) for name in self.own]

    def each(self, function: Callable[..., T], jobs: Sequence[tuple[Any, ...]]) -> list[T]:
        """Run any jobs."""
        return run_all(self.pool, function, jobs, self.on_done)


def short(name: str) -> str:
    """Call ``path/to/module:Class`` just Class."""
    return name.rpartition(":")[2]


def own_colour(place: int) -> str:
    """Colour of the user's estimator at an index."""
    return OWN_COLOURS[place % len(OWN_COLOURS)]


def key(case: study.Case) -> tuple[Any, ...]:
    """Return a key of what is computed, without the label."""
    return (
        case.scenario,
        tuple(sorted(case.overrides.items())),
        case.estimator,
        tuple(sorted((k, str(v)) for k, v in case.settings.items())),
    )


def beside(what: str, paper: str, figure: study.Statistic) -> Beside:
    """Put a figure over seeds beside a printed value."""
    return Beside(what, paper, figure.mean, figure.half_width)


def curve(
    axes: Axes, place: int, x: Sequence[float], figures: Sequence[study.Statistic], label: str
) -> None:
    """Draw means over seeds with their 95 % intervals."""
    mean = np.array([f.mean for f in figures])
    half = np.nan_to_num(np.array([f.half_width for f in figures]))
    axes.errorbar(
        x, mean, half, color=COLOURS[place % 6], marker=MARKERS[place % 6],
        linestyle=DASHES[place % 6],
        capsize=2.5, elinewidth=1.0, label=label,
    )  # fmt: skip


def level(axes: Axes, figure: study.Statistic, label: str, color: str, dash: Any = "-") -> None:
    """Draw a mean over seeds that depends on nothing along x, with its 95 % interval."""
    axes.axhline(figure.mean, color=color, linestyle=dash, label=label)
    half = 0.0 if math.isnan(figure.half_width) else figure.half_width
    axes.axhspan(figure.mean - half, figure.mean + half, color=color, alpha=0.15, linewidth=0)


def bound_level(axes: Axes, value_m: float) -> None:
    """Draw the Cramer-Rao bound of filtering."""
    axes.axhline(
        value_m, color=INK, linestyle=(0, (2, 2)), linewidth=1.2, label="bound (filtering)"
    )


def printed(axes: Axes, x: Sequence[float], y: Sequence[float]) -> None:
    """Mark values that the paper prints."""
    axes.plot(
        x, y, linestyle="none", marker="*", markersize=12, markerfacecolor="white",
        markeredgecolor=INK, markeredgewidth=1.2, label="printed in the paper", zorder=5,
    )  # fmt: skip


def legend_beside(axes: Axes, title: str | None = None) -> None:
    """Put the legend to the right of the axes, where it covers nothing."""
    from matplotlib.lines import Line2D

    handles, labels = axes.get_legend_handles_labels()
    # Curves before levels and marks, each kind in the order it was drawn.
    order = sorted(range(len(labels)), key=lambda k: isinstance(handles[k], Line2D))
    axes.legend(
        [handles[k] for k in order], [labels[k] for k in order],
        loc="center left", bbox_to_anchor=(1.01, 0.5), title=title,
    )  # fmt: skip


def save(sheet: Sheet, directory: Path) -> tuple[Path, Path, Path]:
    """Write NAME.svg, NAME.png and NAME.csv; return their paths in this order."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    svg, png, table = (directory / f"{sheet.name}.{kind}" for kind in ("svg", "png", "csv"))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=sheet.size_in, layout="constrained")
        sheet.draw(figure)
        figure.savefig(svg, metadata={"Date": None})
        figure.savefig(png, dpi=130)
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(sheet.columns)
        writer.writerows([[_cell(cell) for cell in row] for row in sheet.rows])
    return svg, png, table


def _cell(cell: Cell) -> str:
    if isinstance(cell, float):
        return f"{cell:.6g}" if math.isfinite(cell) else ""
    return str(cell)
