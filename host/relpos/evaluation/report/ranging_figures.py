"""The figures of ranging: detection probability over distance, and range residuals."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from relpos.evaluation import ranging
from relpos.evaluation.finite import median
from relpos.evaluation.report.content import Content
from relpos.evaluation.report.drawing import MOST_PANELS, Picture, dots, grid
from relpos.evaluation.style import (
    COLOURS,
    DEAD_RECKONING,
    FUSED,
    GREY,
    INK,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = npt.NDArray[np.float64]


def detection(content: Content) -> Picture | None:
    """Draw the detection probability over distance, and its learned curve."""
    heard = content.heard
    if heard is None or heard.distance_m.size < 20:
        return None
    longest = float(np.quantile(heard.distance_m, 0.995))
    step = next((s for s in (0.5, 1.0, 2.0, 5.0, 10.0) if longest / s <= 16.0), 20.0)
    edges = np.arange(0.0, longest + step, step)
    share, low, high, tried = ranging.shares(heard, edges)

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        middle = 0.5 * (edges[1:] + edges[:-1])
        enough = tried >= 5
        axes.bar(
            middle[enough], share[enough], 0.9 * step, color=COLOURS[5], alpha=0.45,
            label=f"measured ({heard.distance_m.size} attempts)",
        )  # fmt: skip
        # Not below 0 by rounding.
        error = np.maximum(np.stack([share - low, high - share])[:, enough], 0.0)
        axes.errorbar(
            middle[enough], share[enough], error, color=COLOURS[0], linestyle="none", capsize=2.5,
            elinewidth=1.0,
        )  # fmt: skip
        for x, y, count in zip(middle[enough], high[enough], tried[enough], strict=True):
            axes.annotate(
                str(count), (x, min(y, 1.0)), (0, 2), textcoords="offset points", ha="center",
                fontsize=7, color=GREY,
            )  # fmt: skip
        axes.plot(
            heard.curve_m, heard.curve, color=DEAD_RECKONING, label="learned from the estimate"
        )
        if math.isfinite(heard.edge_m):
            axes.axvspan(
                heard.edge_m - heard.edge_sigma_m, heard.edge_m + heard.edge_sigma_m,
                color=DEAD_RECKONING, alpha=0.12, linewidth=0,
                label=f"edge {heard.edge_m:.1f} ± {heard.edge_sigma_m:.1f} m",
            )  # fmt: skip
        axes.set(
            xlabel="true distance (m)" if heard.true else "estimated distance (m)",
            ylabel="detection probability", ylim=(0.0, 1.08),
        )  # fmt: skip
        axes.set_xlim(0.0, edges[-1])
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)

    total = 100.0 * float(heard.heard.mean())
    edge = (
        f" The edge, where it has fallen to half, is learned at {heard.edge_m:.1f} m."
        if math.isfinite(heard.edge_m)
        else " No edge was seen."
    )
    return Picture(
        "detection",
        "Detection probability over distance",
        "Share of the attempts to range that succeeded, with 95 % intervals and the number of "
        "attempts. A pair counts as tried in vain where one of it took part in another range of "
        f"the round and the other was alive. {total:.0f} % of all were heard.{edge}",
        f"Bars of the share heard by distance, {total:.0f} % in all, and the learned curve.{edge}",
        draw,
        (7.6, 4.2),
    )


def residuals(content: Content) -> Picture | None:
    """Draw the range residuals of every pair."""
    known = [one for one in content.ranges if np.isfinite(one.residual_m).any()]
    if not known:
        return None
    shown = sorted(
        sorted(known, key=lambda one: -one.range_m.size)[:MOST_PANELS], key=lambda one: one.pair
    )
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    everything = np.concatenate([one.residual_m for one in shown])
    everything = everything[np.isfinite(everything)]
    middle, spread = median(everything), ranging.spread(everything)
    room = max(4.0 * spread, 0.1)
    low = min(middle - room, 1.1 * float(np.quantile(everything, 0.02)), 0.0)
    high = max(middle + room, 1.1 * float(np.quantile(everything, 0.98)), 0.0)
    biases = _biases(content)

    def draw(figure: Figure) -> None:
        panels = grid(figure, len(shown), columns)
        for k, (one, axes) in enumerate(zip(shown, panels, strict=True)):
            _draw_residuals(axes, one, (low, high), biases.get(one.pair))
            if k % columns == 0:
                axes.set_ylabel("residual (m)")
        first_s = min(float(one.time_s[0]) for one in shown)
        last_s = max(float(one.time_s[-1]) for one in shown)
        # Room for the histograms at the right.
        room = max(last_s - first_s, 1.0)
        panels[0].set_xlim(first_s - 0.03 * room, last_s + 0.27 * room)
        panels[0].set_ylim(low, high)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=max(len(labels), 1))

    outside = int(((everything > high) | (everything < low)).sum())
    rest = len(known) - len(shown)
    return Picture(
        "residuals",
        "Range residuals",
        "Measured range less the estimated distance at that time (each range has helped to make "
        "the estimate), over time and as a histogram at the right of each panel."
        + (
            " Dashed: the pair's true bias, the median of range less true distance."
            * bool(content.truth)
        )
        + (f" {outside} residuals beyond the axis stand at its edge." * bool(outside))
        + (f" The other {rest} pairs are in the table only." if rest > 0 else ""),
        f"Residuals of {len(shown)} pairs over time; median spread "
        f"{np.nanmedian([ranging.spread(one.residual_m) for one in shown]):.2f} m.",
        draw,
        (max(7.0, 3.7 * columns), 1.0 + 1.9 * rows + (1.2 if rows == 1 else 0.0)),
    )


def _draw_residuals(
    axes: Axes,
    one: ranging.PairRanges,
    limits: tuple[float, float],
    bias: tuple[Floats, Floats, Floats] | None,
) -> None:
    there = np.isfinite(one.residual_m)
    time_s, values = one.time_s[there], np.clip(one.residual_m[there], *limits)
    axes.axhline(0.0, color=INK, linewidth=0.8)
    dots(axes, time_s, values, FUSED, label="residual", markersize=4)
    true = median(one.error_m)
    if math.isfinite(true):
        axes.axhline(true, color=INK, linestyle="--", linewidth=1.0, label="true bias")
    if bias is not None:
        at_s, value, sigma = bias
        axes.fill_between(
            at_s, value - sigma, value + sigma, step="post", color=DEAD_RECKONING, alpha=0.25,
            linewidth=0,
        )  # fmt: skip
        axes.plot(
            at_s, value, color=DEAD_RECKONING, drawstyle="steps-post", linewidth=1.3,
            label="learned bias ± 1 sigma",
        )  # fmt: skip
    side = axes.inset_axes((0.84, 0.0, 0.16, 1.0), sharey=axes)
    side.hist(
        values, bins=np.linspace(*limits, 31).tolist(), orientation="horizontal", color=FUSED,
        alpha=0.55, histtype="stepfilled",
    )  # fmt: skip
    side.axis("off")
    axes.set_title(
        f"{one.pair[0]} - {one.pair[1]}: {one.range_m.size} ranges, sigma "
        f"{ranging.spread(one.residual_m):.2f} m",
        fontsize=10,
    )


def _biases(content: Content) -> dict[tuple[int, int], tuple[Floats, Floats, Floats]]:
    """Learned range biases over time: pair -> times, values, sigmas."""
    rows: dict[tuple[int, int], list[tuple[float, float, float]]] = {}
    for p in content.result.parameters:
        if p.name == "range_bias_m" and p.peer is not None:
            pair = (min(p.node, p.peer), max(p.node, p.peer))
            rows.setdefault(pair, []).append((p.time_s, p.value, p.sigma))
    last_s = content.result.estimates[-1].time_s if content.result.estimates else 0.0
    found = {}
    for pair, values in rows.items():
        if not any(value or sigma for _, value, sigma in values):
            continue  # not estimated at all
        times, value, sigma = np.array([*values, (last_s, *values[-1][1:])]).T
        found[pair] = (times, value, sigma)
    return found
