"""Every figure of a report, drawn from its content; those that nothing can be said in are left out.

Each function returns a :class:`Picture`, or None where the run has nothing for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from relpos.evaluation import ranging
from relpos.evaluation.health import SERIES
from relpos.evaluation.iso18305 import Frame
from relpos.evaluation.metrics import Metrics
from relpos.evaluation.report.content import Content, alignment
from relpos.evaluation.report.drawing import Picture, broken_at_gaps, dots, grid
from relpos.evaluation.style import (
    BAD,
    COLOURS,
    DASHES,
    DEAD_RECKONING,
    FAIR,
    FUSED,
    GOOD,
    GREY,
    INK,
    MEASURED,
    PAPER,
    TRUTH,
    of_node,
)
from relpos.fusion.estimator import NodeStatus
from relpos.nodes.health import (
    BATTERY_YELLOW_V,
    LOSS_YELLOW,
    RANGING_YELLOW,
    RSSI_YELLOW_DBM,
    Health,
)
from relpos.tracks import MAX_GAP_S, Track, Tracks, interpolate, whole_seconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = npt.NDArray[np.float64]

MOST_PANELS = 15
"""All pairs of six nodes; more would be too small to read."""

MOST_BANDS = 6
"""Bands of more nodes than this would only cover each other."""

STATUS_COLOURS: Mapping[str, str] = {
    NodeStatus.OK: GOOD,
    NodeStatus.AMBIGUOUS: FAIR,
    NodeStatus.UNLOCATED: TRUTH,
    NodeStatus.STALE: COLOURS[5],
    NodeStatus.LOST: BAD,
}
STATUS_WORDS: Mapping[str, str] = {
    NodeStatus.OK: "ok",
    NodeStatus.AMBIGUOUS: "ambiguous",
    NodeStatus.UNLOCATED: "not located",
    NodeStatus.STALE: "stale (3 epochs silent)",
    NodeStatus.LOST: "lost (10 epochs silent)",
}


def tracks(content: Content) -> Picture | None:
    """Draw who walked where: truth, dead reckoning, fusion."""
    fused = {node: t for node, t in content.guessed.items() if np.isfinite(t.x_m).any()}
    if not fused:
        return None
    located = any(np.isfinite(t.x_m).any() for t in content.fused.values())
    ours = content.fused if located else content.guessed
    shown: list[tuple[str, Tracks]] = [(content.result.estimator, ours)]
    if content.baseline is not None:
        shown.insert(0, ("dead reckoning", content.baseline.tracks))
    true = bool(content.truth)
    moved = {name: _moved(ways, content.truth if true else content.guessed) for name, ways in shown}
    extent = {name: _extent([*moved[name].values(), *_points(content.truth)]) for name, _ in shown}
    # A picture that dead reckoning has blown up must not shrink the other to a dot.
    share = max(size for _, size in extent.values()) < 3.0 * min(
        size for _, size in extent.values()
    )
    aspect = float(np.median([ratio for ratio, _ in extent.values()]))
    width_in = min(max(5.0 * aspect, 3.8), 6.4)
    height_in = min(max(width_in / aspect, 2.2), 5.0) + 0.9

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(shown), squeeze=False, sharex=share, sharey=share)[0]
        for axes, (name, _) in zip(panels, shown, strict=True):
            _draw_tracks(axes, content, moved[name], ellipses=name != "dead reckoning")
            axes.set_title(name)
            axes.set_xlabel("x (m)")
        panels[0].set_ylabel("y (m)")
        handles, labels = panels[-1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))

    frame = (
        "Each estimate is moved as a whole (turned and shifted by one rigid motion for the run, "
        "never mirrored) onto the truth, which is the wide grey line."
        if true
        else "No truth: the picture is in the estimate's own frame, and may be turned and shifted "
        "as a whole."
    )
    nodes = ", ".join(content.name(node) for node in content.nodes)
    return Picture(
        "tracks",
        "Tracks",
        f"{frame} Dots mark the end, rings the true end, ellipses two sigmas of it relative to the "
        "frame. "
        + (
            "A node is left out while it was not located."
            if located
            else "Nobody was located: each way is from where it began."
        ),
        f"Map of the ways of {nodes}"
        + (", dead reckoning beside the fusion" if len(shown) > 1 else "")
        + (", on the true ways." if true else "."),
        draw,
        (width_in * len(shown) + 0.4, height_in),
    )


def _draw_tracks(
    axes: Axes, content: Content, moved: Mapping[int, Floats], *, ellipses: bool
) -> None:
    from matplotlib.patches import Ellipse

    for k, node in enumerate(content.nodes):
        colour, line = of_node(k)
        true = content.truth.get(node)
        if true is not None:
            label = "truth" if node == min(content.truth) else None
            x, y = broken_at_gaps(true.time_s, true.x_m, true.y_m)
            axes.plot(
                x, y, color=TRUTH, linewidth=5.0, solid_capstyle="round", zorder=1, label=label
            )
            alone = _alone(true)
            if alone.any():
                axes.plot(
                    true.x_m[alone], true.y_m[alone], "+", color=GREY, markersize=9, zorder=1.2
                )
            axes.plot(
                true.x_m[-1], true.y_m[-1], "o", color=colour, markerfacecolor=PAPER,
                markersize=6, zorder=3,
            )  # fmt: skip
        if node not in moved:
            continue
        x_m, y_m = moved[node].T
        axes.plot(
            x_m, y_m, color=colour, linestyle=line, linewidth=1.1, alpha=0.9,
            label=content.name(node), zorder=2,
        )  # fmt: skip
        there = np.flatnonzero(np.isfinite(x_m))
        if there.size:
            axes.plot(x_m[there[-1]], y_m[there[-1]], "o", color=colour, markersize=6, zorder=4)
    if ellipses and content.result.estimates:
        turn = alignment(content.fused, content.truth) if content.truth else None
        # A wide ellipse must not shrink the tracks.
        limits = axes.get_xlim(), axes.get_ylim()
        for k, node in enumerate(content.nodes):
            last = next((n for n in content.result.estimates[-1].nodes if n.node == node), None)
            if last is None or last.status is NodeStatus.UNLOCATED:
                continue
            at = np.array([[last.x_m, last.y_m]])
            angle = last.sigma_angle_rad
            if turn is not None:
                at, angle = turn(at), angle + turn.angle_rad
            sizes = 4.0 * last.sigma_major_m, 4.0 * last.sigma_minor_m
            if all(map(math.isfinite, (*at[0], *sizes, angle))):
                axes.add_patch(
                    Ellipse(
                        (at[0, 0], at[0, 1]),
                        *sizes,
                        angle=math.degrees(angle),
                        fill=False,
                        edgecolor=of_node(k)[0],
                        linewidth=1.0,
                        zorder=3.5,
                    )
                )
        axes.set(xlim=limits[0], ylim=limits[1])
    axes.set_aspect("equal", adjustable="box")


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
                totals = bound.totals()
                over, whole = (
                    (bound.smoothing_distance_m, totals.smoothing_distance_m)
                    if smoothed
                    else (bound.filtering_distance_m, totals.filtering_distance_m),
                    (bound.smoothing_position_m, totals.smoothing_position_m)
                    if smoothed
                    else (bound.filtering_position_m, totals.filtering_position_m),
                )[place]
                axes.plot(
                    bound.time_s, over, color=INK, linestyle=(0, (2, 2)), linewidth=1.2, zorder=3,
                    label=f"bound: {whole:.2f} m",
                )  # fmt: skip
                lowest = min(lowest, float(np.nanquantile(over, 0.1)))
            axes.set_ylabel(label)
            if wide and math.isfinite(lowest):
                _logarithmic(axes, max(0.7 * lowest, 0.01))
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
        axes.set(xlabel="horizontal error (m)", ylabel="share of errors below", ylim=(0.0, 1.01))
        axes.set_xlim(0.0, max(1.6 * most, 0.1))
        axes.legend(loc="lower right")

    return Picture(
        "error-distribution",
        "Distribution of the horizontal error",
        "All nodes and whole seconds together (ISO/IEC 18305). How the relative picture was laid "
        "on the truth first is said at each curve; the tail beyond 1.6 CE95 is cut off.",
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
        true = _flat_distance(content.truth, pair, at_s)
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


def consistency(content: Content) -> Picture | None:
    """Draw whether the estimate is as uncertain as it says."""
    scored = content.evaluation
    # An error of exactly 0 is a copy of the truth, not an estimate with an uncertainty.
    if scored is None or not (scored.metrics.nees_over_time > 1e-12).any():
        return None
    metrics, chance = scored.metrics, scored.nees_distance
    off = normalised(content)

    def draw(figure: Figure) -> None:
        from scipy.special import erf

        left, right = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
        time_s, nees = metrics.time_s, metrics.nees_over_time
        left.axhspan(
            chance.low, chance.high, color=COLOURS[2], alpha=0.15, linewidth=0,
            label=f"whole run, by chance: {chance.low:.2f} to {chance.high:.2f}",
        )  # fmt: skip
        left.axhline(1.0, color=INK, linewidth=0.9, linestyle=":")
        x, y = broken_at_gaps(time_s, nees)
        left.plot(x, y, color=FUSED, alpha=0.35, linewidth=0.8, label="each second")
        x, y = broken_at_gaps(time_s, _moving_mean(time_s, nees, 30.0))
        left.plot(x, y, color=FUSED, label="mean of 30 s")
        left.axhline(
            chance.mean, color=DEAD_RECKONING, linestyle="--", linewidth=1.2,
            label=f"whole run: {chance.mean:.3g}",
        )  # fmt: skip
        good = nees[nees > 1e-12]
        _logarithmic(left, max(float(np.quantile(good, 0.02)), 1e-3))
        left.set_ylim(top=max(2.0 * float(np.quantile(good, 0.99)), 3.0))
        left.set(xlabel="time (s)", ylabel="NEES of the distances (1 is honest)")
        left.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2)
        sigmas = np.linspace(0.0, 3.5, 71)
        expected = erf(sigmas / math.sqrt(2.0))
        found = np.array([(off <= s).mean() for s in sigmas])
        right.plot([0, 1], [0, 1], color=INK, linewidth=0.9, linestyle=":", label="honest")
        right.plot(expected, found, color=FUSED, label=content.result.estimator)
        right.set(xlabel="share that should be inside", ylabel="share that is", xlim=(0, 1))
        right.set(ylim=(0, 1), aspect="equal")
        right.legend(loc="lower right")

    inside = 100.0 * float((off <= 1.96).mean())
    return Picture(
        "consistency",
        "As uncertain as it says",
        "Left: mean squared error of all pairs' distances over the reported variance; the green "
        "band holds an honest estimator's mean over the whole run in 95 of 100 cases. Right: how "
        "many errors lie within the reported uncertainty, against a Gaussian's shares; above the "
        f"line is too modest, below too sure. Within 1.96 sigma: {inside:.0f} %.",
        f"NEES {chance.mean:.3g} over the whole run, {chance.low:.2f} to {chance.high:.2f} by "
        f"chance; {inside:.0f} % of the errors within 1.96 sigma.",
        draw,
        (10.4, 4.0),
    )


def normalised(content: Content) -> Floats:
    """Distance errors over their reported deviations, absolute, all pairs and seconds, (n,)."""
    at_s = whole_seconds(content.truth.values())
    found = [np.empty(0)]
    for pair, track in content.pairs.items():
        good = track.sigma_distance_m > 0.0
        if pair[0] not in content.truth or pair[1] not in content.truth or not good.any():
            continue
        distance = interpolate(track.time_s[good], track.distance_m[good], at_s)
        sigma = interpolate(track.time_s[good], track.sigma_distance_m[good], at_s)
        off = np.abs(distance - _flat_distance(content.truth, pair, at_s)) / sigma
        found.append(off[np.isfinite(off)])
    return np.concatenate(found)


def detection(content: Content) -> Picture | None:
    """Draw who was heard over which distance, and the curve learned of it."""
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
    """Draw what ranges differ from the estimated distance by, pair by pair."""
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
    middle, spread = ranging.median(everything), ranging.spread(everything)
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
    true = ranging.median(one.error_m)
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
        alpha=0.55,
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


def status(content: Content) -> Picture | None:
    """Draw how sure the picture was: every node's status, and how many pictures were possible."""
    estimates = content.result.estimates
    if not estimates:
        return None
    nodes = [node for node in content.nodes if node in content.guessed]
    pictures = [len({a.alternative for a in e.alternatives}) or 1 for e in estimates]
    likely = [max((a.probability for a in e.alternatives), default=1.0) for e in estimates]
    ambiguous = max(pictures) > 1
    seen: dict[str, float] = {}

    def draw(figure: Figure) -> None:
        from matplotlib.patches import Patch

        heights = [0.28 * max(len(nodes), 2) + 0.5] + [1.5] * ambiguous
        panels = figure.subplots(
            len(heights), 1, squeeze=False, sharex=True, height_ratios=heights
        )[:, 0]
        used: dict[str, str] = {}
        for row, node in enumerate(nodes):
            for state, begin, end in _spans(content, node):
                panels[0].broken_barh(
                    [(begin, end - begin)], (row - 0.38, 0.76), facecolors=STATUS_COLOURS[state],
                    linewidth=0,
                )  # fmt: skip
                used[state] = STATUS_COLOURS[state]
        panels[0].set_yticks(range(len(nodes)), [content.name(node) for node in nodes])
        panels[0].set_ylim(len(nodes) - 0.5, -0.5)
        panels[0].grid(visible=False, axis="y")
        panels[0].legend(
            [Patch(color=colour) for colour in used.values()],
            [STATUS_WORDS[state] for state in used],
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, borderaxespad=0.2,
        )  # fmt: skip
        if ambiguous:
            time_s = [e.time_s for e in estimates]
            panels[1].plot(
                time_s, pictures, color=FUSED, drawstyle="steps-post", label="possible pictures"
            )
            panels[1].set_ylabel("possible pictures")
            panels[1].set_ylim(bottom=0.0)
            beside = panels[1].twinx()
            beside.plot(
                time_s, likely, color=DEAD_RECKONING, linestyle="--", linewidth=1.2,
                drawstyle="steps-post",
            )  # fmt: skip
            beside.set_ylim(0.0, 1.02)
            beside.set_ylabel("probability of the best\n(dashed)")
            beside.grid(visible=False)
            beside.spines["right"].set_visible(True)
        panels[-1].set_xlabel("time (s)")

    for node in nodes:
        for state, begin, end in _spans(content, node):
            seen[state] = seen.get(state, 0.0) + end - begin
    total = sum(seen.values()) or 1.0
    words = ", ".join(
        f"{100.0 * value / total:.1f} % {STATUS_WORDS[state]}" for state, value in seen.items()
    )
    held = content.evaluation.ambiguity if content.evaluation is not None else None
    region = (
        f" While ambiguous the 90 % region held the truth in {100.0 * held.coverage.share:.0f} % "
        f"of {held.looks} looks ({100.0 * held.coverage.low:.0f} to "
        f"{100.0 * held.coverage.high:.0f} %), with {held.area_m2:.0f} m² on average; a blind "
        f"guess has {held.blind_m2:.0f} m²."
        if held is not None
        else ""
    )
    return Picture(
        "status",
        "How sure the picture was",
        f"Status of every node over time: {words}."
        + (" Below: how many pictures of the team were possible." if ambiguous else "")
        + region,
        f"A bar for each node over time, coloured by status: {words}.{region}",
        draw,
        (9.6, 1.3 + 0.28 * max(len(nodes), 2) + (1.8 if ambiguous else 0.0)),
    )


def _spans(content: Content, node: int) -> list[tuple[str, float, float]]:
    """Stretches of one status: what, from, to."""
    spans: list[tuple[str, float, float]] = []
    last_s: float | None = None
    for estimate in content.result.estimates:
        own = next((n for n in estimate.nodes if n.node == node), None)
        if own is None:
            last_s = None
            continue
        state = str(own.status)
        begin = estimate.time_s if last_s is None else last_s
        if last_s is not None and spans and spans[-1][0] == state:
            spans[-1] = (state, spans[-1][1], estimate.time_s)
        else:
            spans.append((state, begin, estimate.time_s))
        last_s = estimate.time_s
    return spans


TEAM_WIDE = ("detection_range_m",)
"""Parameters that are the team's, though they are told of each node."""

_PARAMETER_WORDS: Mapping[str, tuple[str, float]] = {
    "step_scale": ("step scale\n(true over reported)", 1.0),
    "heading_drift_rad_s": ("heading drift (deg/s)", math.degrees(1.0)),
    "detection_range_m": ("detection range (m)", 1.0),
}


def parameters(content: Content) -> Picture | None:
    """Draw what the estimator learned on the way, range biases apart."""
    rows: dict[str, dict[int, list[tuple[float, float, float]]]] = {}
    for p in content.result.parameters:
        if p.peer is None:
            of_name = rows.setdefault(p.name, {})
            of_name.setdefault(p.node, []).append((p.time_s, p.value, p.sigma))
    if not rows:
        return None
    for name in rows:
        if name in TEAM_WIDE:
            rows[name] = dict([next(iter(rows[name].items()))])
    places = {node: k for k, node in enumerate(content.nodes)}

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(rows), 1, squeeze=False, sharex=True)[:, 0]
        for axes, (name, nodes) in zip(panels, rows.items(), strict=True):
            label, factor = _PARAMETER_WORDS.get(name, (name, 1.0))
            for node, values in nodes.items():
                time_s, value, sigma = np.array(values).T
                team = name in TEAM_WIDE
                colour, line = (INK, "-") if team else of_node(places.get(node, 0))
                if len(nodes) <= MOST_BANDS:
                    axes.fill_between(
                        time_s, factor * (value - sigma), factor * (value + sigma), step="post",
                        color=colour, alpha=0.1, linewidth=0,
                    )  # fmt: skip
                axes.plot(
                    time_s, factor * value, color=colour, linestyle=line, drawstyle="steps-post",
                    linewidth=1.3, label=None if team else content.name(node),
                )  # fmt: skip
            middle = np.concatenate([factor * np.array(v)[:, 1] for v in nodes.values()])
            low, high = np.quantile(middle, [0.01, 0.99])
            room = 0.5 * (high - low) + 0.05 * max(abs(low), abs(high), 1e-3)
            axes.set_ylim(low - room, high + room)
            axes.set_ylabel(label)
        longest = max(panels, key=lambda a: len(a.get_legend_handles_labels()[1]))
        handles, labels = longest.get_legend_handles_labels()
        if labels:
            figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))
        panels[-1].set_xlabel("time (s)")

    return Picture(
        "parameters",
        "What was learned",
        "Constants that the estimator learned as it went, with one standard deviation.",
        "Learned " + ", ".join(name.replace("_", " ") for name in rows) + " over time.",
        draw,
        (9.6, 0.9 + 1.9 * len(rows)),
    )


_HEALTH_WORDS: Mapping[str, tuple[str, float | None]] = {
    "battery_v": ("supply (V)", BATTERY_YELLOW_V),
    "rssi_dbm": ("radio (dBm)", RSSI_YELLOW_DBM),
    "loss": ("frames lost, of 30 s", LOSS_YELLOW),
    "ranging": ("rangings that\nsucceed, of 30 s", RANGING_YELLOW),
}


def health(content: Content) -> Picture | None:
    """Draw how nodes and links fared."""
    nodes = content.health
    shown = [
        name
        for name in SERIES
        if any(np.isfinite(one.series[name]).any() for one in nodes.values())
    ]
    told = any(one.time_s.size for one in nodes.values())
    silent = any(one.silences for one in nodes.values())
    if not told and not silent:
        return None
    places = {node: k for k, node in enumerate(content.nodes)}
    last_s = max(
        [m.time_s for m in content.run.measurements[-1:]]
        + [float(one.time_s[-1]) for one in nodes.values() if one.time_s.size],
        default=0.0,
    )

    def draw(figure: Figure) -> None:
        heights = [0.28 * max(len(nodes), 2) + 0.4] + [1.3] * len(shown)
        panels = figure.subplots(
            len(heights), 1, squeeze=False, sharex=True, height_ratios=heights
        )[:, 0]
        _draw_colours(panels[0], content, last_s)
        for axes, name in zip(panels[1:], shown, strict=True):
            label, limit = _HEALTH_WORDS[name]
            for node, one in nodes.items():
                colour, line = of_node(places.get(node, 0))
                axes.plot(
                    one.time_s, one.series[name], color=colour, linestyle=line, marker=".",
                    markersize=3, linewidth=1.1, label=content.name(node),
                )  # fmt: skip
            if limit is not None:
                low, high = axes.get_ylim()
                if low <= limit <= high:
                    axes.axhline(limit, color=BAD, linewidth=0.9, linestyle=":")
            if name in ("loss", "ranging"):
                axes.set_ylim(0.0, min(1.02, max(axes.get_ylim()[1], 0.1)))
            axes.set_ylabel(label)
        if shown:
            handles, labels = panels[1].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))
        panels[-1].set_xlabel("time (s)")

    restarts = sum(len(one.restarts) for one in nodes.values())
    silences = sum(len(one.silences) for one in nodes.values())
    return Picture(
        "health",
        "Links and nodes",
        "Top: each node's colour, by the rules of the live table, from its status reports; ▲ a "
        "restart, hatched: no motion heard for more than 5 s. Dotted: where it becomes yellow. "
        f"{restarts} restart{'s' * (restarts != 1)}, {silences} silence{'s' * (silences != 1)}.",
        f"Health of {len(nodes)} nodes over time: {restarts} restarts, {silences} silences.",
        draw,
        (9.6, 1.2 + 0.28 * max(len(nodes), 2) + 1.45 * len(shown)),
    )


def _draw_colours(axes: Axes, content: Content, last_s: float) -> None:
    from matplotlib.patches import Patch

    words = {Health.GREEN: ("well", GOOD), Health.YELLOW: ("less than it should have", FAIR),
             Health.RED: ("not usable, or about to fall silent", BAD)}  # fmt: skip
    used: dict[Health, None] = {}
    for row, one in enumerate(content.health.values()):
        ends = np.append(one.time_s[1:], last_s)
        for begin, end, colour in zip(one.time_s, ends, one.colour, strict=True):
            # One report a ten seconds: after a longer silence nothing is known of it.
            end = min(end, begin + 15.0)
            axes.broken_barh(
                [(begin, end - begin)], (row - 0.36, 0.72), facecolors=words[Health(colour)][1],
                linewidth=0,
            )  # fmt: skip
            used[Health(colour)] = None
        for begin, end in one.silences:
            axes.broken_barh(
                [(begin, end - begin)], (row - 0.36, 0.72), facecolors="none", edgecolor=INK,
                hatch="////", linewidth=0.6,
            )  # fmt: skip
        if one.restarts:
            axes.plot(
                [t for t, _ in one.restarts], [row] * len(one.restarts), "^", color=INK,
                markersize=6, zorder=4,
            )  # fmt: skip
    names = [content.name(node) for node in content.health]
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    if used:
        axes.legend(
            [Patch(color=words[one][1]) for one in sorted(used)],
            [words[one][0] for one in sorted(used)],
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2,
        )  # fmt: skip


def heights(content: Content) -> Picture | None:
    """Draw everybody's height over the own start."""
    known = {n: t for n, t in content.guessed.items() if np.isfinite(t.z_m).any()}
    if not known:
        return None
    places = {node: k for k, node in enumerate(content.nodes)}

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for node, track in known.items():
            colour, line = of_node(places[node])
            there = np.isfinite(track.z_m)
            first_s = track.time_s[there][0]
            true = content.truth.get(node)
            if true is not None and np.isfinite(true.z_m).any():
                z_m = true.z_m - interpolate(true.time_s, true.z_m, np.array([first_s]))[0]
                x, y = broken_at_gaps(true.time_s, z_m)
                axes.plot(
                    x, y, color=TRUTH, linewidth=3.5, zorder=1,
                    label="truth" if node == min(known) else None,
                )  # fmt: skip
            x, y = broken_at_gaps(track.time_s[there], track.z_m[there])
            axes.plot(x, y, color=colour, linestyle=line, linewidth=1.1, label=content.name(node))
        axes.set(xlabel="time (s)", ylabel="height over the start (m)")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))

    return Picture(
        "height",
        "Height",
        "Estimated height of every node over its own start, from pressure.",
        f"Height over time of {len(known)} nodes.",
        draw,
        (9.6, 3.2),
    )


PICTURES: Mapping[str, Callable[[Content], Picture | None]] = {
    "tracks": tracks,
    "error": error_over_time,
    "error-distribution": error_distribution,
    "distances": distances,
    "consistency": consistency,
    "status": status,
    "detection": detection,
    "residuals": residuals,
    "parameters": parameters,
    "height": heights,
    "health": health,
}
"""Name -> what draws it, in the order of the page."""


def pictures(content: Content) -> list[Picture]:
    """Return every figure that this run has something for."""
    made = (draw(content) for draw in PICTURES.values())
    return [picture for picture in made if picture is not None]


def _moved(ways: Tracks, onto: Tracks) -> dict[int, Floats]:
    """Whole tracks (n, 2), gaps as NaN, moved by the one rigid motion that fits best."""
    moving = alignment(ways, onto)
    return {
        node: moving(np.column_stack(broken_at_gaps(track.time_s, track.x_m, track.y_m)))
        for node, track in ways.items()
    }


def _points(ways: Tracks) -> list[Floats]:
    return [np.column_stack((t.x_m, t.y_m)) for t in ways.values()]


def _extent(ways: Sequence[Floats]) -> tuple[float, float]:
    """Width over depth of a map, and its larger side (m)."""
    points = np.concatenate([*ways, np.zeros((0, 2))])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return 1.0, 1.0
    width, depth = np.ptp(points, axis=0) + 1.0
    return float(width / depth), float(max(width, depth))


def _alone(track: Track) -> npt.NDArray[np.bool_]:
    """Which rows no line joins to another."""
    apart = np.diff(track.time_s, prepend=-math.inf, append=math.inf) > MAX_GAP_S
    result: npt.NDArray[np.bool_] = apart[:-1] & apart[1:]
    return result


def _flat_distance(ways: Tracks, pair: tuple[int, int], at_s: Floats) -> Floats:
    if pair[0] not in ways or pair[1] not in ways:
        return np.full(at_s.shape, np.nan)
    a, b = (ways[node] for node in pair)
    dx = interpolate(a.time_s, a.x_m, at_s) - interpolate(b.time_s, b.x_m, at_s)
    dy = interpolate(a.time_s, a.y_m, at_s) - interpolate(b.time_s, b.y_m, at_s)
    result: Floats = np.hypot(dx, dy)
    return result


def _moving_mean(time_s: Floats, values: Floats, window_s: float) -> Floats:
    """Mean of what is finite within half a window to either side."""
    finite = np.isfinite(values)
    total = np.concatenate(([0.0], np.cumsum(np.where(finite, values, 0.0))))
    count = np.concatenate(([0], np.cumsum(finite)))
    first = np.searchsorted(time_s, time_s - 0.5 * window_s, side="left")
    last = np.searchsorted(time_s, time_s + 0.5 * window_s, side="right")
    number = count[last] - count[first]
    means: Floats = np.divide(
        total[last] - total[first], number, out=np.full(time_s.shape, np.nan), where=number > 0
    )
    return means


def _logarithmic(axes: Axes, bottom: float) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_yscale("log")
    axes.set_ylim(bottom=bottom)
    decades = math.log10(axes.get_ylim()[1] / bottom)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 3.0 else (1.0,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
