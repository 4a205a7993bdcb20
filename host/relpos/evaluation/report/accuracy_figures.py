"""The figures of accuracy: error over time and its distribution, distances of pairs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from relpos.evaluation import ranging
from relpos.evaluation.iso18305 import Frame
from relpos.evaluation.metrics import Metrics
from relpos.evaluation.report.content import Content
from relpos.evaluation.report.drawing import (
    MOST_PANELS,
    Picture,
    broken_at_gaps,
    dots,
    flat_distance,
    grid,
    logarithmic,
)
from relpos.evaluation.style import (
    COLOURS,
    DASHES,
    DEAD_RECKONING,
    FUSED,
    GREY,
    INK,
    MEASURED,
)
from relpos.tracks import whole_seconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def error_over_time(content: Content) -> Picture | None:
    """Draw the error of the team's distances, and of its shape, beside the bound."""
    scored = content.evaluation
    if scored is None or not scored.metrics.epochs:
        return None
    metrics = scored.metrics
    shape = bool(np.isfinite(metrics.position_rmse_over_time_m).any())
    series: list[tuple[str, Metrics, str, str]] = [(content.result.estimator, metrics, FUSED, "-")]
    baseline = content.baseline.metrics if content.baseline is not None else None
    if baseline is not None:
        series.insert(0, ("dead reckoning", baseline, DEAD_RECKONING, "--"))
    bound, smoothed = content.bound, content.result.smoothed
    wide = baseline is not None and (
        baseline.relative_distance_rmse_m > 4.0 * metrics.relative_distance_rmse_m
    )

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1 + shape, 1, squeeze=False, sharex=True)[:, 0]
        words = ("relative distance,\nRMS over pairs (m)", "aligned position,\nRMS over nodes (m)")
        for place, (axes, label) in enumerate(zip(panels, words, strict=False)):
            lowest = math.inf
            for name, m, colour, line in series:
                over, whole = (
                    (m.distance_rmse_over_time_m, m.relative_distance_rmse_m),
                    (m.position_rmse_over_time_m, m.relative_position_rmse_m),
                )[place]
                x, y = broken_at_gaps(m.time_s, over)
                axes.plot(
                    x, y, color=colour, linestyle=line, linewidth=1.5, zorder=2,
                    label=f"{name}: {whole:.2f} m over the whole run",
                )  # fmt: skip
                if np.isfinite(over).any():
                    lowest = min(lowest, float(np.nanquantile(over, 0.05)))
            if bound is not None:
                over = bound.of(smoothed=smoothed)[place]
                whole = bound.totals().of(smoothed=smoothed)[place]
                axes.plot(
                    bound.time_s, over, color=INK, linestyle=(0, (2, 2)), linewidth=1.2, zorder=3,
                    label=f"bound: {whole:.2f} m",
                )  # fmt: skip
                lowest = min(lowest, float(np.nanquantile(over, 0.1)))
            axes.set_ylabel(label)
            if wide and math.isfinite(lowest):
                logarithmic(axes, max(0.7 * lowest, 0.01))
            else:
                axes.set_ylim(bottom=0.0)
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2)
        panels[-1].set_xlabel("time (s)")

    return Picture(
        "error",
        "Error over time",
        "At every whole second, "
        + ("on a logarithmic scale, " if wide else "")
        + f"{content.result.estimator}"
        + (f" and {content.baseline.words}" if content.baseline is not None else "")
        + (
            f"; dotted: the Cramer-Rao bound of {'smoothing' if smoothed else 'filtering'}, which "
            "no estimator can beat on average."
            if bound is not None
            else "."
        ),
        f"Curves of the error over time; relative distance {metrics.relative_distance_rmse_m:.2f} "
        "m over the whole run"
        + (f", dead reckoning {baseline.relative_distance_rmse_m:.2f} m." if baseline else "."),
        draw,
        (9.6, 5.6 if shape else 3.4),
    )


def error_distribution(content: Content) -> Picture | None:
    """Draw how often the horizontal error stays below a length, CE50 and CE95 marked."""
    if content.evaluation is None or not content.evaluation.iso.known:
        return None
    iso = content.evaluation.iso
    labels = {
        Frame.AS_GIVEN: "as given",
        Frame.PER_RUN: "one motion for the run",
        Frame.PER_EPOCH: "one motion a second (shape alone)",
    }

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for k, (frame, errors) in enumerate(iso.errors.items()):
            flat = np.sort(np.hypot(*errors.error_m[:, :2].T))
            flat = flat[np.isfinite(flat)]
            one = iso.frames[frame].horizontal
            axes.plot(
                flat, np.arange(1, flat.size + 1) / flat.size, color=COLOURS[k],
                linestyle=DASHES[k], drawstyle="steps-post",
                label=f"{labels[frame]}: CE50 {one.e50_m:.2f} m, CE95 {one.e95_m:.2f} m",
            )  # fmt: skip
            for share, value in ((0.5, one.e50_m), (0.95, one.e95_m)):
                axes.plot(value, share, "o", color=COLOURS[k], markersize=5)
        for share in (0.5, 0.95):
            axes.axhline(share, color=GREY, linewidth=0.8, linestyle=":")
        most = max(one.horizontal.e95_m for one in iso.frames.values())
        axes.set(xlabel="horizontal error (m)", ylabel="fraction of errors below", ylim=(0.0, 1.01))
        axes.set_xlim(0.0, max(1.6 * most, 0.1))
        axes.legend(loc="lower right")

    return Picture(
        "error-distribution",
        "Distribution of the horizontal error",
        "All nodes and whole seconds together (ISO/IEC 18305). The alignment with the "
        "truth stands at each curve; the tail beyond 1.6 CE95 is cut off.",
        "Cumulative share of horizontal errors: "
        + "; ".join(
            f"{labels[frame]}, half below {one.horizontal.e50_m:.2f} m, 95 % below "
            f"{one.horizontal.e95_m:.2f} m"
            for frame, one in iso.frames.items()
        )
        + ".",
        draw,
        (7.6, 4.2),
    )


def distances(content: Content) -> Picture | None:
    """Draw the distance of every pair: true, estimated with one sigma, and measured."""
    pairs = sorted({(min(p), max(p)) for p in content.pairs} | {one.pair for one in content.ranges})
    ranges = {one.pair: one for one in content.ranges}
    if not pairs:
        return None
    # Of large teams those that were measured most.
    most = sorted(pairs, key=lambda p: -(ranges[p].range_m.size if p in ranges else 0))
    shown = sorted(most[:MOST_PANELS])
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)

    def draw(figure: Figure) -> None:
        panels = grid(figure, len(shown), columns)
        top = 0.0
        for k, (pair, axes) in enumerate(zip(shown, panels, strict=True)):
            top = max(top, _draw_distance(axes, content, pair, ranges.get(pair)))
            if k % columns == 0:
                axes.set_ylabel("distance (m)")
        panels[0].set_ylim(bottom=0.0, top=1.15 * top + 0.5)
        seen: dict[str, Any] = {}
        for axes in panels:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                seen.setdefault(label, handle)
        figure.legend(
            list(seen.values()), list(seen), loc="outside lower center", ncols=max(len(seen), 1)
        )

    rest = len(pairs) - len(shown)
    return Picture(
        "distances",
        "Distances",
        "Distance of every pair"
        + (": true, " if content.truth else ": ")
        + "estimated with one standard deviation, measured; a wild range may lie outside."
        + (f" The other {rest} pairs are in the table only." if rest > 0 else ""),
        f"Distance over time of {len(shown)} pairs, one panel each.",
        draw,
        (max(7.0, 3.7 * columns), 1.0 + 2.0 * rows + (1.2 if rows == 1 else 0.0)),
    )


def _draw_distance(
    axes: Axes, content: Content, pair: tuple[int, int], measured: ranging.PairRanges | None
) -> float:
    """Draw one pair; return the largest distance that has to be seen."""
    top = [0.0]
    if measured is not None and measured.range_m.size:
        dots(
            axes,
            measured.time_s,
            measured.range_m,
            MEASURED,
            label="measured",
            markersize=3.5,
            zorder=2.5,
        )
        top.append(float(np.quantile(measured.range_m, 0.98)))
    at_s = whole_seconds([content.truth[n] for n in pair if n in content.truth])
    if at_s.size:
        true = flat_distance(content.truth, pair, at_s)
        axes.plot(*broken_at_gaps(at_s, true), color=INK, linewidth=1.6, label="true", zorder=2)
        top.append(float(np.nanmax(true, initial=0.0)))
    track = content.pairs.get(pair) or content.pairs.get((pair[1], pair[0]))
    if track is not None:
        low = np.maximum(track.distance_m - track.sigma_distance_m, 0.0)
        high = track.distance_m + track.sigma_distance_m
        axes.fill_between(
            track.time_s, low, high, color=FUSED, alpha=0.2, linewidth=0,
            label="estimated ± 1 sigma",
        )  # fmt: skip
        x, y = broken_at_gaps(track.time_s, track.distance_m)
        axes.plot(x, y, color=FUSED, linewidth=1.3, label="estimated", zorder=3)
        top.append(float(np.nanquantile(track.distance_m, 0.99)))
    words = f"{pair[0]} - {pair[1]}"
    scored = content.evaluation
    if scored is not None and pair in scored.metrics.pairs:
        words += f": RMSE {scored.metrics.pairs[pair].distance_rmse_m:.2f} m"
    axes.set_title(words, fontsize=10)
    return max(value for value in top if math.isfinite(value))
